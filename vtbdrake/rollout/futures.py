"""Rollouts on any pool with the interface of `concurrent.futures`."""

from __future__ import annotations

import concurrent.futures
import logging
import pickle
import queue
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

from vtbdrake.common.argument_checks import as_whole
from vtbdrake.common.failures import error_text
from vtbdrake.common.lru import LruDict
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
from vtbdrake.rollout.task import RolloutResult, RolloutTask, check_call
from vtbdrake.rollout.testbeds import Runners, Testbeds, failed
from vtbdrake.rollout.worker_processes import ProcessExecutor

_log = logging.getLogger(__name__)


class _RefusedError(WorkerError):
    """The workers take no more rollouts."""


class Call(NamedTuple):
    """The rollouts of one call of `FuturesExecutor.run`.

    Attributes:
        task: The task, pickled.
        points: The parameters of each rollout.
        starts: The start of each rollout, see `pack_starts`.
    """

    task: PickledTask
    points: Sequence[Parameters]
    starts: Sequence[bytes]


class _Landed:
    """The futures of a pool, as they finish."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[concurrent.futures.Future[bytes]] = queue.SimpleQueue()

    def add(self, future: concurrent.futures.Future[bytes]) -> None:
        future.add_done_callback(self._queue.put)

    def __next__(self) -> tuple[concurrent.futures.Future[bytes], bytes | BaseException]:
        future = self._queue.get()
        if future.cancelled():
            return future, WorkerError("the pool was shut down while it had rollouts to run")
        return future, future.exception() or future.result()


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
    # What errors call the workers; the error of a rollout whose worker was lost; and why it failed.
    _name = "a pool of concurrent.futures"
    _loss: type[Exception] = BrokenExecutor
    _loss_text = "the pool broke while it had this rollout"

    def __init__(self, pool: concurrent.futures.Executor | Any, *, in_flight: int | None = None) -> None:
        if not callable(getattr(pool, "submit", None)):
            raise ValueError(f"a pool of concurrent.futures has a method submit, unlike {pool!r}")
        if in_flight is not None and as_whole("the number of rollouts in flight", in_flight) < 1:
            raise ValueError(f"at least one rollout must be in flight, not {in_flight}")
        self._in_flight = in_flight
        self._pool = pool
        self._pickler = TaskPickler()
        self._rescue: ProcessExecutor | None = None

    def run(
        self, task: RolloutTask, points: Sequence[Parameters], *, start: Starts = None, cutoff: Cutoff | None = None
    ) -> Iterator[tuple[int, RolloutResult]]:
        if cutoff is not None:
            raise ValueError(f"{self._name} cannot cancel rollouts: use executor='processes'")
        check_call(task, points)
        call = Call(self._pickler.pickle(task), points, pack_starts(start, len(points)))
        yield from self._run(call, range(len(points)))

    def _run(
        self, call: Call, indices: Iterable[int], *, retrying: bool = False
    ) -> Iterator[tuple[int, RolloutResult]]:
        """Submit rollouts, as many at a time as keep all workers busy, and yield (index, result) as they finish."""
        waiting, flying, landed = deque(indices), dict[Any, list[int]](), self._landed()
        lost: dict[int, BaseException] = {}
        refusal: _RefusedError | None = None
        try:
            while flying or (waiting and refusal is None):
                if refusal is None:
                    refusal = self._fill(call, waiting, flying, landed)
                if not flying:
                    continue
                future, reply = next(landed)
                chunk, outcomes = flying.pop(future), self._outcomes(reply)
                if isinstance(outcomes, self._loss) and self._retries() and not retrying:
                    lost.update(dict.fromkeys(chunk, outcomes))
                    continue
                for k, index in enumerate(chunk):
                    yield index, self._result(call, index, outcomes[k] if isinstance(outcomes, list) else outcomes)
        finally:
            self._cancel(flying)
        if refusal is not None:
            raise refusal
        if lost:
            yield from self._retry(call, lost)

    def _fill(self, call: Call, waiting: deque[int], flying: dict[Any, list[int]], landed: Any) -> _RefusedError | None:
        """Submit rollouts that wait while there is room; return the refusal if the workers take no more."""
        try:
            while waiting and len(flying) < self._room():
                chunk = list(islice(waiting, self._chunk(call, len(waiting))))
                future = self._submit(call, chunk)
                flying[future] = chunk
                landed.add(future)
                for _ in chunk:
                    waiting.popleft()
        except _RefusedError as error:
            return error  # The rollouts under way come first.
        return None

    def _result(self, call: Call, index: int, outcome: bytes | BaseException) -> RolloutResult:
        if isinstance(outcome, self._loss):
            return failed(call.points[index], f"{self._loss_text} ({error_text(outcome)})")
        result: RolloutResult | BaseException
        result = outcome if isinstance(outcome, BaseException) else pickle.loads(outcome)[1]
        if isinstance(result, BaseException):
            raise result
        return result

    # -- what differs with other workers

    def _landed(self) -> Any:
        """Return an empty collection that yields futures as they finish, each with its reply or error."""
        return _Landed()

    def _outcomes(self, reply: Any) -> list[bytes] | BaseException:
        """Return the results of `answer` in the worker for the rollouts of a chunk, or an error of the workers."""
        outcomes: list[bytes] | BaseException = reply
        return outcomes

    def _room(self) -> int:
        """Return the largest number of chunks under way."""
        return self._in_flight or 2 * _workers(self._pool)

    def _chunk(self, call: Call, waiting: int) -> int:
        """Return the number of waiting rollouts that travel together next."""
        return 1

    def _submit(self, call: Call, chunk: Sequence[int]) -> Any:
        """Return the future of some rollouts, which a worker runs one after another."""
        points, starts = [pack(call.points[i]) for i in chunk], [call.starts[i] for i in chunk]
        try:
            return self._pool.submit(run_in_pool, call.task, chunk, points, starts)
        except RuntimeError as error:  # It is broken, or was shut down.
            if isinstance(error, self._loss) and self._retries():
                future: concurrent.futures.Future[bytes] = concurrent.futures.Future()
                future.set_exception(error)
                return future
            name = type(self._pool).__name__
            raise _RefusedError(f"the pool {name} takes no more rollouts: {error}") from error

    def _cancel(self, futures: Iterable[Any]) -> None:
        for future in futures:
            future.cancel()

    def _retries(self) -> bool:
        """Return whether rollouts whose worker was lost are tried again: here by processes of our own."""
        local = isinstance(self._pool, ProcessPoolExecutor) or "loky" in type(self._pool).__module__.split(".")
        return local and getattr(self._pool, "_initializer", None) is None

    def _retry(self, call: Call, lost: Mapping[int, BaseException]) -> Iterator[tuple[int, RolloutResult]]:
        indices = list(lost)
        if self._rescue is None:
            error = lost[indices[0]]
            _log.warning("the pool is broken; processes of vtbdrake take its place (%s)", error)
            self._rescue = ProcessExecutor(_workers(self._pool))
        points, starts = [call.points[i] for i in indices], [call.starts[i] for i in indices]
        for k, result in self._rescue.run_pickled(call.task, points, starts):
            yield indices[k], result

    def close(self) -> None:
        """End the processes that replaced a broken pool. The pool itself belongs to the user."""
        if self._rescue is not None:
            self._rescue.close()
            self._rescue = None


def _workers(pool: concurrent.futures.Executor) -> int:
    """Return the number of workers: that which a pool states, or the private one of the standard library and loky."""
    return int(getattr(pool, "num_workers", None) or getattr(pool, "_max_workers", None) or cores())


class _PoolWorker:
    """The state of a process of the pool: the tasks used last, by digest, and their runners."""

    def __init__(self) -> None:
        self._runners = Runners(Testbeds())
        self._tasks: LruDict[str, RolloutTask] = LruDict(MAX_TASKS)
        self._lock = threading.RLock()

    def run(self, pickled: PickledTask, point: bytes, start: bytes) -> RolloutResult:
        with self._lock:
            task = self._tasks.use(pickled.digest)
            if task is None:
                task = unpack(pickled.content)
                self._tasks.add(pickled.digest, task)
        return self._runners.run(task, unpack(point), start=unpack_start(start))


_worker = _PoolWorker()


def run_in_pool(
    task: PickledTask, indices: Sequence[int], points: Sequence[bytes], starts: Sequence[bytes]
) -> list[bytes]:
    """Run rollouts in a worker of the pool; return what `answer` returns for each.

    Args:
        task: The task; a worker keeps its testbeds from call to call.
        indices: Index of the point of each rollout, for its answer.
        points: The pickled points.
        starts: The starts, see `pack_starts`.
    """
    rollouts = (partial(_worker.run, task, point, start) for point, start in zip(points, starts, strict=True))
    return [answer(index, rollout) for index, rollout in zip(indices, rollouts, strict=True)]
