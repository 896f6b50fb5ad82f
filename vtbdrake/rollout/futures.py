"""Rollouts on any pool that speaks `concurrent.futures`: the standard library's, loky's, mpi4py's, Ray's."""

from __future__ import annotations

import concurrent.futures
import logging
import pickle
import queue
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from functools import partial

from vtbdrake.rollout.blob import Blob, Blobs, pack, run_blob
from vtbdrake.rollout.executor import Executor, Parameters, WorkerError, cores
from vtbdrake.rollout.runner import failed
from vtbdrake.rollout.task import RolloutResult, RolloutTask
from vtbdrake.rollout.worker import answer
from vtbdrake.rollout.worker_processes import ProcessExecutor

_log = logging.getLogger(__name__)

_Future = concurrent.futures.Future[bytes]


class FuturesExecutor(Executor):
    """Rollouts on a `concurrent.futures.Executor` that the user brings, and closes.

    Each of its processes builds a testbed once and keeps it; each of its threads has a Context. A pool breaks when one
    of its processes is killed, and does not say by which rollout. If it is one of processes on this computer (the
    standard library's, loky's) and has no initializer, a `ProcessExecutor` of as many workers runs what it had and what
    it has not begun, so that the rollout at fault fails alone. With other pools, the rollouts that it had are failed
    results, and a `WorkerError` ends the others. Any other error of the pool is raised as itself.

    Ray has no such pool of its own: one is a subclass of `concurrent.futures.Executor` whose ``submit(fn, *args)``
    returns ``ray.remote(fn).remote(*args).future()``, and whose ``num_workers`` says how many run at a time.

    Args:
        pool: where the rollouts run.
        in_flight: how many rollouts it is given at a time; twice its workers if left out, so that none waits. An
            interruption takes back what has not begun; what runs goes on to its end.
    """

    def __init__(self, pool: concurrent.futures.Executor, *, in_flight: int | None = None) -> None:
        if in_flight is not None and in_flight < 1:
            raise ValueError(f"at least one rollout must be in flight, not {in_flight}")
        self._pool = pool
        self._in_flight = in_flight if in_flight is not None else 2 * _workers(pool)
        self._blobs = Blobs()
        self._rescue: ProcessExecutor | None = None

    def run(self, task: RolloutTask, points: Sequence[Parameters]) -> Iterator[tuple[int, RolloutResult]]:
        """See `Executor.run`.

        Raises:
            WorkerError: the task cannot be sent to another process, or the pool takes no more work.
        """
        blob = self._blobs.get(task)
        waiting = deque(range(len(points)))
        flying: dict[_Future, int] = {}
        landed: queue.SimpleQueue[_Future] = queue.SimpleQueue()
        lost: list[int] = []
        trouble: RuntimeError | None = None
        try:
            while True:
                while trouble is None and waiting and len(flying) < self._in_flight:
                    packed = pack(points[waiting[0]])
                    try:
                        future = self._pool.submit(roll, blob, waiting[0], packed)
                    except RuntimeError as error:  # It is broken, or was shut down.
                        trouble = error
                    else:
                        flying[future] = waiting.popleft()
                        future.add_done_callback(landed.put)
                if not flying:
                    break
                future = landed.get()
                index = flying.pop(future)
                try:
                    result = _result(future)
                except BrokenExecutor as error:
                    trouble = error
                    if self._replaceable():
                        lost.append(index)
                        continue
                    reason = f"the pool broke while it had this rollout ({type(error).__name__}: {error})"
                    result = failed(points[index], reason)
                yield index, result
        finally:
            for future in flying:
                future.cancel()
        rest = [*lost, *waiting]
        if isinstance(trouble, BrokenExecutor) and self._replaceable() and rest:
            yield from self._run_without_pool(task, points, rest, trouble)
        elif trouble is not None and rest:
            name = type(self._pool).__name__
            raise WorkerError(f"the pool {name} takes no more rollouts: {trouble}") from trouble

    def _replaceable(self) -> bool:
        """Whether processes of ours can do what the pool's did."""
        local = isinstance(self._pool, ProcessPoolExecutor) or "loky" in type(self._pool).__module__.split(".")
        return local and getattr(self._pool, "_initializer", None) is None

    def _run_without_pool(
        self, task: RolloutTask, points: Sequence[Parameters], rest: Sequence[int], trouble: BrokenExecutor
    ) -> Iterator[tuple[int, RolloutResult]]:
        if self._rescue is None:
            _log.warning("the pool is broken; processes of vtbdrake take its place (%s)", trouble)
            self._rescue = ProcessExecutor(_workers(self._pool))
        for i, result in self._rescue.run(task, [points[index] for index in rest]):
            yield rest[i], result

    def close(self) -> None:
        if self._rescue is not None:
            self._rescue.close()
            self._rescue = None


def _workers(pool: concurrent.futures.Executor) -> int:
    """How many workers the pool has: mpi4py says so, the standard library and loky know it."""
    return int(getattr(pool, "num_workers", None) or getattr(pool, "_max_workers", None) or cores())


def _result(future: _Future) -> RolloutResult:
    try:
        _, outcome = pickle.loads(future.result())
    except concurrent.futures.CancelledError as error:
        raise WorkerError("the pool was shut down while it had rollouts to run") from error
    if isinstance(outcome, BaseException):
        raise outcome
    result: RolloutResult = outcome
    return result


def roll(blob: Blob, index: int, point: bytes) -> bytes:
    """One rollout in a worker of any pool; the answer is that of `worker.answer`."""
    return answer(index, partial(run_blob, blob, point))
