"""Rollouts on any pool that speaks `concurrent.futures`: the standard library's, loky's, mpi4py's, Ray's."""

from __future__ import annotations

import concurrent.futures
import pickle
import queue
from collections.abc import Iterator, Sequence
from functools import partial

from vtbdrake.rollout.blob import Blob, Blobs, pack, run_blob
from vtbdrake.rollout.executor import Executor, Parameters, WorkerError, cores
from vtbdrake.rollout.result import RolloutResult
from vtbdrake.rollout.task import RolloutTask
from vtbdrake.rollout.testbeds import failed
from vtbdrake.rollout.worker import answer

_Future = concurrent.futures.Future[bytes]


class FuturesExecutor(Executor):
    """Rollouts on a `concurrent.futures.Executor` that the user brings, and closes.

    Each of its processes builds a testbed once and keeps it; each of its threads has a Context. When the pool breaks,
    because one of its processes was killed, the rollouts that it had are failed results, for it does not say whose
    fault it was; `ProcessExecutor` does, and goes on. Any other error of the pool is raised as itself.

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

    def run(self, task: RolloutTask, points: Sequence[Parameters]) -> Iterator[tuple[int, RolloutResult]]:
        """See `Executor.run`.

        Raises:
            WorkerError: the task cannot be sent to another process, or the pool takes no more work.
        """
        blob = self._blobs.get(task)
        waiting = iter(enumerate(points))
        flying: dict[_Future, int] = {}
        landed: queue.SimpleQueue[_Future] = queue.SimpleQueue()
        trouble: WorkerError | None = None
        try:
            while True:
                while trouble is None and len(flying) < self._in_flight and (item := next(waiting, None)):
                    index, point = item
                    try:
                        future = self._submit(blob, index, point)
                    except WorkerError as error:
                        trouble = error
                    else:
                        flying[future] = index
                        future.add_done_callback(landed.put)
                if not flying:
                    break
                future = landed.get()
                index = flying.pop(future)
                yield index, _result(future, points[index])
            if trouble is not None:
                raise trouble
        finally:
            for future in flying:
                future.cancel()

    def _submit(self, blob: Blob, index: int, point: Parameters) -> _Future:
        try:
            return self._pool.submit(roll, blob, index, pack(point))
        except RuntimeError as error:  # It is broken, or was shut down.
            raise WorkerError(f"the pool {type(self._pool).__name__} takes no more rollouts: {error}") from error


def _workers(pool: concurrent.futures.Executor) -> int:
    """How many workers the pool has: mpi4py says so, the standard library and loky know it."""
    return int(getattr(pool, "num_workers", None) or getattr(pool, "_max_workers", None) or cores())


def _result(future: _Future, point: Parameters) -> RolloutResult:
    try:
        _, outcome = pickle.loads(future.result())
    except concurrent.futures.BrokenExecutor as error:
        return failed(point, f"the pool broke while it had this rollout ({type(error).__name__}: {error})")
    except concurrent.futures.CancelledError as error:
        raise WorkerError("the pool was shut down while it had rollouts to run") from error
    if isinstance(outcome, BaseException):
        raise outcome
    result: RolloutResult = outcome
    return result


def roll(blob: Blob, index: int, point: bytes) -> bytes:
    """One rollout in a worker of any pool; the answer is that of `worker.answer`."""
    return answer(index, partial(run_blob, blob, point))
