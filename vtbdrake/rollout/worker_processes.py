"""Worker processes, each with a testbed that it builds once and keeps."""

from __future__ import annotations

import logging
import pickle
import time
from collections import deque
from collections.abc import Iterator, Sequence
from math import inf
from multiprocessing.connection import Connection, wait
from typing import Any

from vtbdrake.child_process import ChildProcess, StartError
from vtbdrake.rollout.arguments import as_number
from vtbdrake.rollout.blob import Blob, Blobs, pack
from vtbdrake.rollout.executor import Executor, Parameters, WorkerError, checked_workers
from vtbdrake.rollout.runner import KEPT, Testbeds, failed
from vtbdrake.rollout.task import RolloutResult, RolloutTask
from vtbdrake.rollout.worker import BEGUN, GROWN, main

_log = logging.getLogger(__name__)

# A worker whose last rollout took less than this, in seconds, is given its next one ahead, so that it need not wait for
# it. Where rollouts are longer this gains nothing, and one that stands behind a very long one would come late.
_BRIEF = 0.1
# A point of at most so many bytes fits into what a socket holds: to send it does not wait for the worker to read it.
_SMALL = 1 << 16


class _Worker:
    """A worker process and the rollouts that it was given."""

    def __init__(self, kept: int, growth: float) -> None:
        # At once, without grace: its rollout may hang.
        self.child = ChildProcess(main, kept, growth, name="a worker process", grace=0.0)
        self.connection: Connection | None = None  # None until the worker is ready.
        self._task: bytes | None = None
        # The rollout that it runs, and one that was given ahead.
        self.jobs: deque[int] = deque()
        self.deadline = inf
        self.brief = False
        # True when its memory has grown so much that another worker should replace it.
        self.grown = False

    def give(self, task: bytes, index: int, message: bytes) -> None:
        # Before anything is sent: a worker that was interrupted here must not count as idle.
        self.jobs.append(index)
        if self.connection is None:
            self.child.wait_until_ready(None)
            self.connection = Connection(self.child.connection.detach())
        if self._task != task:
            self.brief = False
            self.connection.send_bytes(b"T" + task)
            self._task = task
        self.connection.send_bytes(message)

    def begin(self, time_limit: float) -> None:
        """Start the time limit: the worker has its testbed and begins its rollout."""
        self.deadline = time.monotonic() + time_limit

    def finish(self, index: int, outcome: Any) -> None:
        """Remove the rollout that is done; the worker goes on with the one that was given ahead."""
        assert index == self.jobs[0], "a worker answers to another rollout than its own"
        self.jobs.popleft()
        self.deadline = inf
        self.brief = isinstance(outcome, RolloutResult) and outcome.wall_time < _BRIEF

    def kill(self) -> None:
        self.child.kill()
        self.child.close()
        if self.connection is not None:
            self.connection.close()


class ProcessExecutor(Executor):
    """Processes that keep their testbed from rollout to rollout; for testbeds with systems in Python.

    A worker that dies, or takes longer than ``time_limit`` for one rollout, costs that rollout only: it is tried once
    more by another worker, and is then a failed result. One that is killed while it starts costs nothing. Where
    rollouts are short, a worker is given the next one before it has finished the last. A worker whose memory has grown
    by ``growth`` is replaced between two rollouts: every testbed that is built, for another value of a scenario's
    field, leaves memory behind.

    Args:
        workers: how many; the number of cores if left out.
        time_limit: in seconds of wall time for one rollout.
        kept: how many testbeds each process keeps, for points with different scenario fields.
        growth: by how many bytes the memory of a process may grow after its first rollout.
    """

    def __init__(
        self, workers: int | None = None, *, time_limit: float = inf, kept: int = KEPT, growth: float = 1e9
    ) -> None:
        self._count = checked_workers(workers)
        self._time_limit = checked_time_limit(time_limit)
        self._growth = as_number("the growth of a worker's memory", growth)
        if not self._growth > 0.0:
            raise ValueError(f"the growth of a worker's memory must be positive, not {growth} bytes")
        self._kept = Testbeds(kept=kept).kept
        self._blobs = Blobs()
        self._workers: list[_Worker] = []
        self._running = False
        # How many workers in a row were lost before they were ready.
        self._starts_lost = 0

    def start(self, rollouts: int) -> None:
        """Start the workers that so many rollouts need, without waiting until they are ready.

        `run` does so, too; but they take a second, in which one may have other things to do.
        """
        while len(self._workers) < min(self._count, rollouts):
            self._workers.append(_Worker(self._kept, self._growth))

    def run(self, task: RolloutTask, points: Sequence[Parameters]) -> Iterator[tuple[int, RolloutResult]]:
        """See `Executor.run`.

        Raises:
            WorkerError: the task cannot be sent to another process, or the executor has not finished another call.
        """
        yield from self.run_blob(self._blobs.get(task), points)

    def run_blob(self, blob: Blob, points: Sequence[Parameters]) -> Iterator[tuple[int, RolloutResult]]:
        """Run one rollout per point, of a task that is pickled already; see `run`."""
        if self._running:
            raise WorkerError(
                "the executor has rollouts of another call to run: finish or close what that call returned, or use a "
                "second executor"
            )
        self._running = True
        try:
            yield from self._run(blob.content, points)
        finally:
            self._running = False

    def _run(self, blob: bytes, points: Sequence[Parameters]) -> Iterator[tuple[int, RolloutResult]]:
        waiting = deque(range(len(points)))
        losses: dict[int, str] = {}
        error: BaseException | None = None
        self.start(len(points))
        try:
            self._hand_out(blob, waiting, points)
            left = len(points)
            while left:
                finished: list[tuple[int, RolloutResult]] = []
                replies = self._replies()
                if not self._workers:
                    raise WorkerError("the executor was closed while it had rollouts to run")
                for worker, index, reply in replies:
                    if isinstance(reply, RolloutResult):
                        finished.append((index, reply))
                    elif isinstance(reply, str):
                        # What it had not begun is as good as new.
                        waiting.extendleft(job for job in worker.jobs if job != index)
                        self._replace(worker)
                        if index in losses:
                            finished.append((index, failed(points[index], f"{losses[index]}; then {reply}")))
                        else:
                            _log.warning("rollout %d is tried again: %s", index, reply)
                            losses[index] = reply
                            waiting.append(index)
                    else:
                        error = error or reply
                if error is None:
                    # Workers go on while the caller looks at what is finished.
                    self._hand_out(blob, waiting, points)
                left -= len(finished)
                yield from finished
                if error is not None:
                    raise error
        finally:
            # After an error or an interruption, what still works works for nothing.
            for worker in [worker for worker in self._workers if worker.jobs]:
                self._workers.remove(worker)
                worker.kill()

    def _hand_out(self, task: bytes, waiting: deque[int], points: Sequence[Parameters]) -> None:
        """A rollout for every worker that is idle; then, as long as there are enough for all, the next ones ahead."""
        for idle in [worker for worker in self._workers if not worker.jobs]:
            worker = self._replace(idle) if waiting and idle.grown else idle
            while waiting and not self._give(worker, task, waiting, points):
                worker = self._replace(worker)  # It died while it was idle, or was killed while it started.
        for worker in self._workers:
            if len(waiting) >= len(self._workers) and len(worker.jobs) == 1 and worker.brief and not worker.grown:
                # One that has died is found by its reply.
                self._give(worker, task, waiting, points)

    def _give(self, worker: _Worker, task: bytes, waiting: deque[int], points: Sequence[Parameters]) -> bool:
        """Gives the next one, unless the worker has died; one that is large is not given ahead."""
        index = waiting[0]
        kind = b"R" if self._time_limit == inf else b"L"
        message = kind + pickle.dumps((index, pack(points[index])))
        if worker.jobs and len(message) > _SMALL:
            return True
        waiting.popleft()
        try:
            worker.give(task, index, message)
        except (OSError, StartError) as error:
            worker.jobs.pop()
            waiting.appendleft(index)
            if isinstance(error, StartError):
                self._starts_lost += 1
                # A worker that exits cannot work; one that is killed can be replaced, unless all of them are.
                if (worker.child.exit_code or 0) >= 0 or self._starts_lost > self._count:
                    raise WorkerError(str(error)) from error
            return False
        self._starts_lost = 0
        return True

    def _replies(self) -> list[tuple[_Worker, int, Any]]:
        """What came in: worker, index, and a result, an exception to raise or, as a string, how the worker was lost."""
        busy = {worker.connection: worker for worker in self._workers if worker.jobs and worker.connection}
        if not busy:
            return []
        first = min(worker.deadline for worker in busy.values())
        ready = wait(list(busy), None if first == inf else max(0.0, first - time.monotonic()))
        replies: list[tuple[_Worker, int, Any]] = []
        for connection, worker in busy.items():
            index = worker.jobs[0]
            if connection in ready:
                try:
                    message = connection.recv_bytes()
                    if message == BEGUN:
                        worker.begin(self._time_limit)
                    elif message == GROWN:
                        worker.grown = True
                    else:
                        reply = pickle.loads(message)
                        worker.finish(*reply)
                        replies.append((worker, index, reply[1]))
                except (EOFError, OSError):
                    code = worker.child.wait()
                    replies.append((worker, index, f"its worker process died (exit code {code})"))
            elif time.monotonic() >= worker.deadline:
                replies.append((worker, index, f"it took longer than its time limit of {self._time_limit:g} s"))
        return replies

    def _replace(self, worker: _Worker) -> _Worker:
        worker.kill()
        new = self._workers[self._workers.index(worker)] = _Worker(self._kept, self._growth)
        return new

    def close(self) -> None:
        for worker in self._workers:
            worker.kill()
        self._workers.clear()


def checked_time_limit(time_limit: float) -> float:
    """In seconds.

    Raises:
        ValueError: it is not positive.
    """
    time_limit = as_number("the time limit", time_limit)
    if not time_limit > 0.0:
        raise ValueError(f"the time limit must be positive, not {time_limit} s")
    return time_limit
