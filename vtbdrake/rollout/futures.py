"""Rollouts on any pool with the interface of `concurrent.futures`."""

from __future__ import annotations

import concurrent.futures
import logging
import pickle
import queue
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from functools import partial

from vtbdrake.failures import error_text
from vtbdrake.lru import LruDict
from vtbdrake.rollout.executor import Executor, Parameters, WorkerError, cores
from vtbdrake.rollout.pickled_task import (
    MAX_TASKS,
    PickledTask,
    TaskPickler,
    answer,
    pack,
    pack_starts,
    unpack,
    unpack_start,
)
from vtbdrake.rollout.pruning import Cutoff
from vtbdrake.rollout.start import Starts
from vtbdrake.rollout.task import RolloutResult, RolloutTask
from vtbdrake.rollout.testbeds import Runners, Testbeds, failed
from vtbdrake.rollout.worker_processes import ProcessExecutor

_log = logging.getLogger(__name__)

_Future = concurrent.futures.Future[bytes]


class FuturesExecutor(Executor):
    """Rollouts on a `concurrent.futures.Executor` of the user; it is not closed.

    Each of its processes builds a testbed once and keeps it; each of its threads has a Context. A pool breaks when one
    of its processes is killed, and does not report the rollout that caused it. If its processes run on this computer
    (the standard library's, loky's) and it has no initializer, a `ProcessExecutor` with as many workers runs the
    unfinished rollouts, so that only the one that kills its process fails. With other pools, the rollouts under way
    fail, and the others end with a `WorkerError`. Any other error of the pool is raised unchanged.

    Any subclass of `concurrent.futures.Executor` will do whose ``submit(fn, *args)`` returns a
    `concurrent.futures.Future`; if it has an attribute ``num_workers``, that is the number that run at a time.

    Args:
        pool: The pool that runs the rollouts.
        in_flight: The number of rollouts that the pool has at a time; by default twice its workers, so that none is
            idle. An interruption cancels rollouts that have not begun; the others go on to their ends.
    """

    cancels = False

    def __init__(self, pool: concurrent.futures.Executor, *, in_flight: int | None = None) -> None:
        if in_flight is not None and in_flight < 1:
            raise ValueError(f"at least one rollout must be in flight, not {in_flight}")
        self._pool = pool
        self._in_flight = in_flight if in_flight is not None else 2 * _workers(pool)
        self._pickler = TaskPickler()
        self._rescue: ProcessExecutor | None = None

    def run(
        self, task: RolloutTask, points: Sequence[Parameters], *, start: Starts = None, cutoff: Cutoff | None = None
    ) -> Iterator[tuple[int, RolloutResult]]:
        if cutoff is not None:
            raise ValueError("a pool of concurrent.futures cannot cancel rollouts: use executor='processes'")
        pickled = self._pickler.pickle(task)
        starts = pack_starts(start, len(points))
        waiting = deque(range(len(points)))
        flying: dict[_Future, int] = {}
        landed: queue.SimpleQueue[_Future] = queue.SimpleQueue()
        lost: list[int] = []
        trouble: RuntimeError | None = None
        try:
            while True:
                while trouble is None and waiting and len(flying) < self._in_flight:
                    point = pack(points[waiting[0]])
                    try:
                        future = self._pool.submit(run_in_pool, pickled, waiting[0], point, starts[waiting[0]])
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
                    reason = f"the pool broke while it had this rollout ({error_text(error)})"
                    result = failed(points[index], reason)
                yield index, result
        finally:
            for future in flying:
                future.cancel()
        rest = [*lost, *waiting]
        if isinstance(trouble, BrokenExecutor) and self._replaceable() and rest:
            yield from self._run_without_pool(pickled, points, starts, rest, trouble)
        elif trouble is not None and rest:
            name = type(self._pool).__name__
            raise WorkerError(f"the pool {name} takes no more rollouts: {trouble}") from trouble

    def _replaceable(self) -> bool:
        """Return whether processes of our own can do what the pool's did."""
        local = isinstance(self._pool, ProcessPoolExecutor) or "loky" in type(self._pool).__module__.split(".")
        return local and getattr(self._pool, "_initializer", None) is None

    def _run_without_pool(
        self,
        task: PickledTask,
        points: Sequence[Parameters],
        starts: Sequence[bytes],
        rest: Sequence[int],
        trouble: BrokenExecutor,
    ) -> Iterator[tuple[int, RolloutResult]]:
        if self._rescue is None:
            _log.warning("the pool is broken; processes of vtbdrake take its place (%s)", trouble)
            self._rescue = ProcessExecutor(_workers(self._pool))
        for i, result in self._rescue.run_pickled(task, [points[i] for i in rest], [starts[i] for i in rest]):
            yield rest[i], result

    def close(self) -> None:
        """End the processes that replaced a broken pool. The pool itself belongs to the user."""
        if self._rescue is not None:
            self._rescue.close()
            self._rescue = None


def _workers(pool: concurrent.futures.Executor) -> int:
    """Return the number of workers: that which a pool states, or the private one of the standard library and loky."""
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


class _Worker:
    """The state of a process of the pool: the tasks used last, by digest, and their runners."""

    def __init__(self) -> None:
        self._runners = Runners(Testbeds())
        self._tasks: LruDict[str, RolloutTask] = LruDict(MAX_TASKS)
        self._lock = threading.Lock()

    def run(self, pickled: PickledTask, point: bytes, start: bytes) -> RolloutResult:
        with self._lock:
            task = self._tasks.use(pickled.digest)
            if task is None:
                task = unpack(pickled.content)
                self._tasks.add(pickled.digest, task)
        return self._runners.run(task, unpack(point), start=unpack_start(start))


_worker = _Worker()


def run_in_pool(task: PickledTask, index: int, point: bytes, start: bytes) -> bytes:
    """Run one rollout in a worker of the pool; return what `answer` returns."""
    return answer(index, partial(_worker.run, task, point, start))
