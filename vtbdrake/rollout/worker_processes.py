"""Rollouts in worker processes, which keep their testbeds: jobs, time limits and restarts."""

from __future__ import annotations

import logging
import os
import pickle
import resource
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import islice
from math import ceil, inf
from typing import Any, NamedTuple

from vtbdrake.common.argument_checks import as_number
from vtbdrake.common.child_process import ChildProcess, ProcessStartError, report_ready
from vtbdrake.common.frames import FrameConnection
from vtbdrake.rollout.executor import Executor, Parameters, WorkerError, checked_workers
from vtbdrake.rollout.pickled_task import PickledTask, TaskPickler, answer, pack, pack_starts, unpack, unpack_start
from vtbdrake.rollout.pruning import Cutoff
from vtbdrake.rollout.runner import CancelledError
from vtbdrake.rollout.start import Starts
from vtbdrake.rollout.task import RolloutResult, RolloutTask, check_call
from vtbdrake.rollout.testbeds import MAX_TESTBEDS, Runners, Testbeds, failed, split

_log = logging.getLogger(__name__)

# A worker whose last rollout took less than this, in seconds, gets the next ones ahead, so that it need not wait for
# them: about as many in one message as take so long. Longer rollouts gain nothing from it, and one that waits behind a
# very long one would come late.
BRIEF = 0.1
# Largest message in bytes that fits into the buffer of a socket: sending it does not wait for the worker.
_SMALL = 1 << 16
# Time in s after a cutoff's deadline in which a rollout comes to its next sample and stops; else it hangs.
GRACE = 0.5
# Longest time of a rollout in s, unless the user says otherwise; after it the rollout hangs.
TIME_LIMIT = 3600.0
# What a worker sends when a rollout with a time limit begins.
_BEGUN = b"B"
# What a worker sends when its memory has grown too much.
_GROWN = b"G"
# Size of a page of memory, in bytes.
_PAGE = os.sysconf("SC_PAGE_SIZE")


class ProcessExecutor(Executor):
    """Processes that keep their testbed from rollout to rollout; for testbeds with systems in Python.

    A worker that dies, or takes longer than ``time_limit`` for one rollout, costs that rollout only: it is tried once
    more by another worker, and then counts as failed. A worker that is killed while it starts costs nothing. Where
    rollouts are short, a worker gets several at a time, before it has finished the last. A worker whose memory has
    grown by ``growth`` is replaced when it is idle, because every testbed that is built, for another value of a
    scenario's field, leaves memory behind.

    Rollouts with a `Cutoff` are urgent: while a lost worker's replacement starts and builds its testbed, the others do
    its work. It is waited for only if no other is left, and at most until the deadline.

    Args:
        workers: The number of processes; by default the number of cores.
        time_limit: The wall time for one rollout, in seconds; an hour by default, ``inf`` for none. A
            system that never returns is stopped by nothing but the end of the process.
        max_testbeds: The number of testbeds that each process keeps, for points with different scenario fields.
        growth: The number of bytes by which the memory of a process may grow after its first rollout.
    """

    def __init__(
        self,
        workers: int | None = None,
        *,
        time_limit: float = TIME_LIMIT,
        max_testbeds: int = MAX_TESTBEDS,
        growth: float = 1e9,
    ) -> None:
        self._count = self.side_by_side = checked_workers(workers)
        self.time_limit = checked_time_limit(time_limit)
        self._growth = as_number("the growth of a worker's memory", growth)
        if not self._growth > 0.0:
            raise ValueError(f"the growth of a worker's memory must be positive, not {growth} bytes")
        self._max_testbeds = Testbeds(max_testbeds=max_testbeds).max_testbeds
        self._pickler = TaskPickler()
        self._workers: list[_Worker] = []
        self._running = False
        self._launches_lost = 0  # The number of workers in a row that were killed before they were ready.

    @property
    def rollouts_of_workers(self) -> tuple[int, ...]:
        """Return the number of rollouts that each worker has: the one that it runs, and those given ahead."""
        return tuple(len(worker.jobs) for worker in self._workers)

    def start_workers(self, rollouts: int) -> None:
        """Start the workers that ``rollouts`` rollouts need, without waiting until they are ready (a second).

        `run` starts those that are missing.
        """
        while len(self._workers) < min(self._count, rollouts):
            self._workers.append(_Worker(self._max_testbeds, self._growth))

    def run(
        self, task: RolloutTask, points: Sequence[Parameters], *, start: Starts = None, cutoff: Cutoff | None = None
    ) -> Iterator[tuple[int, RolloutResult]]:
        check_call(task, points)
        starts = pack_starts(start, len(points))
        yield from self.run_pickled(self._pickler.pickle(task), points, starts, cutoff=cutoff)

    def run_pickled(
        self,
        task: PickledTask,
        points: Sequence[Parameters],
        starts: Sequence[bytes],
        *,
        cutoff: Cutoff | None = None,
    ) -> Iterator[tuple[int, RolloutResult]]:
        """Run one rollout per point, of a task and with starts that are pickled already; see `run`.

        Args:
            task: The pickled task.
            points: One point per rollout, address -> value.
            starts: The start of each rollout, see `pack_starts`.
            cutoff: When to end rollouts early; what its deadline cancels is not yielded.
        """
        if self._running:
            raise WorkerError(
                "the executor has rollouts of another call to run: finish or close what that call returned, or use a "
                "second executor"
            )
        self._running = True
        try:
            yield from self._run(_Call(task.content, points, starts, cutoff))
        finally:
            self._running = False

    def _run(self, call: _Call) -> Iterator[tuple[int, RolloutResult]]:
        self.start_workers(len(call.points))
        try:
            self._hand_out(call)
            while call.left:
                replies = self._replies(call)
                self._check_open()
                finished = [result for reply in replies if (result := self._note(reply, call)) is not None]
                if call.is_over:
                    call.drop_waiting()
                if call.error is None:
                    # Workers go on while the caller uses the finished results.
                    self._hand_out(call)
                call.left -= len(finished)
                yield from finished
                if call.error is not None:
                    raise call.error
        finally:
            # After an error or an interruption, the rollouts under way are not needed.
            for worker in [worker for worker in self._workers if worker.jobs]:
                self._workers.remove(worker)
                worker.kill()

    def _note(self, reply: _Reply, call: _Call) -> tuple[int, RolloutResult] | None:
        """Note what became of a rollout, and replace a lost worker; return the index and the result, if any."""
        match reply:
            case _Finished(index, result):
                return index, result
            case _Cancelled():
                call.left -= 1
            case _Raised(error):
                call.error = call.error or error
            case _Lost(worker, index, reason):
                # The rollouts that it had not begun are not at fault.
                call.waiting.extendleft(job for job in reversed(worker.jobs) if job != index)
                self._replace(worker, call)
                return call.note_loss(index, reason)
        return None

    def _hand_out(self, call: _Call) -> None:
        """Give rollouts to every idle worker; then, as long as there are enough for all, the next ones ahead."""
        waiting = call.waiting
        for idle in [worker for worker in self._workers if not worker.jobs]:
            worker = self._replace(idle, call) if waiting and idle.grown else idle
            while waiting and not worker.is_preparing and not self._give(worker, call):
                worker = self._replace(worker, call)  # It died while it was idle or starting.
        for worker in self._workers:
            if len(waiting) >= len(self._workers) and len(worker.jobs) == 1 and worker.is_brief and not worker.grown:
                # `_replies` notices a worker that has died.
                self._give(worker, call)

    def _give(self, worker: _Worker, call: _Call) -> bool:
        """Give the next rollouts; return False if the worker has died.

        What is large does not go ahead, nor what takes another testbed, which may take long to build.
        """
        waiting, cutoff = call.waiting, call.cutoff
        limited = self.time_limit < inf or (cutoff is not None and cutoff.deadline < inf)
        start, rollouts, size = worker.start, list[_Rollout](), 0
        for index in list(islice(waiting, worker.share(len(waiting) // (2 * len(self._workers))))):
            point, new_start = pack(call.points[index]), call.starts[index]
            size += len(point) + len(new_start)
            is_warm = worker.has_testbed(call, index)
            if (size > _SMALL or not is_warm) and (worker.jobs or rollouts):
                break
            rollouts.append(_Rollout(index, point, None if new_start == start else new_start, limited and not is_warm))
            start = new_start
        if not rollouts:
            return True
        for _ in rollouts:
            waiting.popleft()
        is_idle = not worker.jobs
        try:
            worker.give(call.task, start, rollouts, cutoff)
        except (OSError, ProcessStartError) as error:
            for rollout in reversed(rollouts):
                worker.jobs.pop()
                waiting.appendleft(rollout.number)
            if isinstance(error, ProcessStartError):
                self._launches_lost += 1
                # A worker that exits cannot work; one that is killed can be replaced, unless all of them are.
                if (worker.child.exit_code or 0) >= 0 or self._launches_lost > self._count:
                    raise WorkerError(str(error)) from error
            return False
        self._launches_lost = 0
        if is_idle:
            self._expect(worker, call)
        return True

    def _expect(self, worker: _Worker, call: _Call) -> None:
        """Limit the time until a worker begins its next rollout, if it has the testbed of that already."""
        if worker.has_testbed(call, worker.jobs[0]):
            worker.limit_time(self.time_limit, call.cutoff)

    def _replies(self, call: _Call) -> list[_Reply]:
        """Wait until something has arrived, or a worker has run out of time, and return the replies."""
        busy = [worker for worker in self._workers if worker.jobs and worker.connection]
        preparing = [worker for worker in self._workers if call.waiting and worker.is_preparing]
        if not busy and not preparing:
            return []
        ready = _ready(busy, preparing, call.cutoff)
        replies: list[_Reply] = []
        for worker in busy:
            assert worker.connection is not None
            if worker.connection.fileno() in ready:
                replies += self._received(worker, worker.connection, call)
            elif time.monotonic() >= worker.deadline:
                time_out = f"it took longer than its time limit of {self.time_limit:g} s"
                replies.append(_Lost(worker, worker.jobs[0], "it did not stop" if call.is_over else time_out))
        return replies

    def _received(self, worker: _Worker, connection: FrameConnection, call: _Call) -> Iterator[_Reply]:
        """Yield the replies of a worker that have arrived; the last one says if it has died."""
        try:
            for frame in connection.pop_frames():
                if frame == _BEGUN:
                    worker.limit_time(self.time_limit, call.cutoff)
                elif frame == _GROWN:
                    worker.grown = True
                else:
                    yield self._finish(worker, frame, call)
        except (EOFError, OSError):
            yield _Lost(worker, worker.jobs[0], f"its worker process died (exit code {worker.child.close()})")

    def _finish(self, worker: _Worker, frame: bytes, call: _Call) -> _Reply:
        """Return the outcome of a worker's rollout; it goes on with the next one that it was given."""
        index, outcome = pickle.loads(frame)
        worker.finish(index, outcome)
        if worker.jobs:
            self._expect(worker, call)
        if isinstance(outcome, RolloutResult):
            return _Finished(index, outcome)
        return _Cancelled() if isinstance(outcome, CancelledError) else _Raised(outcome)

    def _replace(self, worker: _Worker, call: _Call) -> _Worker:
        self._check_open()
        worker.kill()
        task = None if call.cutoff is None else call.task
        new = self._workers[self._workers.index(worker)] = _Worker(self._max_testbeds, self._growth, task)
        return new

    def _check_open(self) -> None:
        if not self._workers:
            raise WorkerError("the executor was closed while it had rollouts to run")

    def close(self) -> None:
        """End all workers; a call of `run` in another thread raises a `WorkerError`."""
        # At once: that thread must not take workers for lost that are killed here, and start others.
        workers, self._workers = self._workers, []
        for worker in workers:
            worker.kill()


@dataclass
class _Call:
    """The rollouts of one call of `ProcessExecutor.run`, and how far they are.

    Attributes:
        waiting: Indices of the points that no worker has got.
        left: Number of rollouts without an outcome.
        losses: Why a worker was lost, by the index of its rollout, which is tried once more.
        error: The error to be raised; no more rollouts are handed out then.
    """

    task: bytes
    points: Sequence[Parameters]
    starts: Sequence[bytes]
    cutoff: Cutoff | None
    waiting: deque[int] = field(init=False)
    left: int = field(init=False)
    losses: dict[int, str] = field(default_factory=dict, init=False)
    error: BaseException | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self.left = len(self.points)
        self.waiting = deque(range(self.left))

    @property
    def is_over(self) -> bool:
        """Return whether the rollouts are cut off by now."""
        return self.cutoff is not None and self.cutoff.is_over

    def drop_waiting(self) -> None:
        """Cancel the rollouts that no worker has got."""
        self.left -= len(self.waiting)
        self.waiting.clear()

    def note_loss(self, index: int, reason: str) -> tuple[int, RolloutResult] | None:
        """Note that the worker of a rollout was lost; return the rollout as failed if that was its second."""
        if self.is_over:
            self.left -= 1
            return None
        if index in self.losses:
            return index, failed(self.points[index], f"{self.losses[index]}; then {reason}")
        _log.warning("rollout %d is tried again: %s", index, reason)
        self.losses[index] = reason
        self.waiting.append(index)
        return None


class _Finished(NamedTuple):
    """A rollout has a result."""

    number: int
    result: RolloutResult


class _Cancelled(NamedTuple):
    """A rollout was cancelled by its cutoff's deadline."""


class _Raised(NamedTuple):
    """A rollout raised an error that ends the others."""

    error: BaseException


class _Lost(NamedTuple):
    """A worker died, or does not stop."""

    worker: _Worker
    number: int  # of the rollout that it had begun
    reason: str


_Reply = _Finished | _Cancelled | _Raised | _Lost


class _Rollout(NamedTuple):
    """A rollout on its way to a worker."""

    number: int
    point: bytes
    start: bytes | None  # None: the last one's
    announced: bool  # Whether the worker tells when its testbed is built.


class _Worker:
    """A worker process and the rollouts that it was given.

    Args:
        max_testbeds: The number of testbeds that it keeps.
        growth: The number of bytes by which its memory may grow after its first rollout.
        task: A task whose testbed it builds before it is ready; None: it is ready without one.
    """

    def __init__(self, max_testbeds: int, growth: float, task: bytes | None = None) -> None:
        # Without grace: its rollout may hang.
        self.child = ChildProcess(_run_worker, max_testbeds, growth, task, name="a worker process", grace=0.0)
        self.connection: FrameConnection | None = None  # None until the worker is known to be ready.
        self._task = task
        self.start = b""  # Start of the last rollout that it got; empty if that begins at the task's s0.
        self.jobs: deque[int] = deque()  # The rollout that it runs, and those that were given ahead.
        self.deadline = inf
        self.warm = task is not None  # True after the first rollout of a task, too: it has the testbed.
        self.duration = inf  # Duration of its last rollout, in seconds.
        self.grown = False  # True when its memory has grown so much that it must be replaced.

    @property
    def is_preparing(self) -> bool:
        """Return whether the worker still builds its testbed, while others work; false if it has died."""
        return self.connection is None and self._task is not None and not _readable(self.child.connection)

    @property
    def is_brief(self) -> bool:
        """Return whether the last rollout was short."""
        return self.duration < BRIEF

    def share(self, most: int) -> int:
        """Return the number of rollouts that the worker gets at a time, at least one and at most ``most``."""
        return max(1, int(min(most, BRIEF / max(self.duration, 1e-6)))) if self.is_brief else 1

    def has_testbed(self, call: _Call, index: int) -> bool:
        """Return whether the worker need not build a testbed for a rollout."""
        return self.warm and self._task == call.task and not split(call.points[index])[0]

    def give(self, task: bytes, start: bytes, rollouts: Sequence[_Rollout], cutoff: Cutoff | None) -> None:
        """Send rollouts, whose last one begins at ``start``, and the task if the worker does not have it."""
        # Before anything is sent: a worker that was interrupted here must not count as idle.
        self.jobs += [rollout.number for rollout in rollouts]
        if self.connection is None:
            self.child.wait_until_ready(None)
            self.connection = FrameConnection(self.child.connection)
        is_new = self._task != task
        if is_new:
            self.warm, self.duration = False, inf
        self.connection.send((task if is_new else None, rollouts, cutoff))
        self._task, self.start = task, start

    def limit_time(self, time_limit: float, cutoff: Cutoff | None) -> None:
        """Start the time limit: the worker has its testbed, and begins its rollout or is about to."""
        now = time.monotonic()
        self.deadline = now + time_limit
        if cutoff is not None:
            self.deadline = min(self.deadline, max(now, cutoff.deadline) + GRACE)

    def finish(self, index: int, outcome: Any) -> None:
        """Remove the rollout that is done; the worker goes on with the one that was given ahead."""
        assert index == self.jobs[0], "a worker answers to another rollout than its own"
        self.jobs.popleft()
        self.deadline = inf
        self.warm = True
        self.duration = outcome.wall_time if isinstance(outcome, RolloutResult) else inf

    def kill(self) -> None:
        self.child.kill()
        self.child.close()


def _ready(busy: Sequence[_Worker], preparing: Sequence[_Worker], cutoff: Cutoff | None) -> set[int]:
    """Wait for workers, until the first deadline at most; return the descriptors that have something to read."""
    first = min((worker.deadline for worker in busy), default=cutoff.deadline if cutoff else inf)
    poll = select.poll()
    for worker in busy:
        assert worker.connection is not None
        poll.register(worker.connection, select.POLLIN)
    for worker in preparing:
        poll.register(worker.child.connection, select.POLLIN)
    timeout = None if first == inf else ceil(1e3 * max(0.0, first - time.monotonic()))  # In milliseconds.
    return {descriptor for descriptor, _ in poll.poll(timeout)}


def _readable(connection: socket.socket) -> bool:
    poll = select.poll()
    poll.register(connection, select.POLLIN)
    return bool(poll.poll(0))


def checked_time_limit(time_limit: float) -> float:
    """Return a time limit in seconds as a float.

    Raises:
        ValueError: It is not positive.
    """
    time_limit = as_number("the time limit", time_limit)
    if not time_limit > 0.0:
        raise ValueError(f"the time limit must be positive, not {time_limit} s")
    return time_limit


# -- in the worker process


def _run_worker(parent: socket.socket, max_testbeds: int, growth: float, task: bytes | None) -> None:
    """Run rollouts on request until the connection closes.

    A request is (a new task or None, rollouts, cutoff). Each rollout has an answer, from `answer`; it is announced by
    `_BEGUN` on request, unless its testbed cannot be built. Once, `_GROWN` comes before an answer.

    Args:
        parent: The connection to the executor.
        max_testbeds: The number of testbeds to keep.
        growth: The number of bytes by which the memory may grow after the first rollout.
        task: The first task, whose testbed is built before this process is ready; None: there is none yet.
    """
    runners = Runners(Testbeds(max_testbeds=max_testbeds))
    load: Callable[[], RolloutTask] | None = None
    start = b""
    if task is not None:
        load = cache(partial(unpack, task))
        # A rollout that is cancelled at its first sample. Any other error will be the answer to the next one, too.
        answer(0, partial(_run_rollout, runners, load, pack({}), start, Cutoff(deadline=-inf), None))
    report_ready(parent)
    connection = FrameConnection(parent)
    limit = inf
    with suppress(EOFError, OSError):
        while True:
            task, rollouts, cutoff = connection.receive()
            if task is not None:
                # The same object each time, as its runner is known by it. One that cannot be read raises each time.
                load = cache(partial(unpack, task))
            assert load is not None, "a worker got a rollout before its task"
            for rollout in rollouts:
                start = start if rollout.start is None else rollout.start
                announce = partial(connection.send_frame, _BEGUN) if rollout.announced else None
                work: Callable[[], RolloutResult] = partial(
                    _run_rollout, runners, load, rollout.point, start, cutoff, announce
                )
                if rollout is not rollouts[0] and cutoff is not None and cutoff.is_over:
                    work = _cancel  # Without the time to reset the testbed.
                reply = answer(rollout.number, work)
                if limit == inf:
                    limit = _memory() + growth
                elif _memory() > limit:
                    connection.send_frame(_GROWN)
                    limit = growth = inf
                connection.send_frame(reply)


def _cancel() -> RolloutResult:
    raise CancelledError


def _run_rollout(
    runners: Runners,
    load: Callable[[], RolloutTask],
    point: bytes,
    start: bytes,
    cutoff: Cutoff | None,
    announce: Callable[[], Any] | None,
) -> RolloutResult:
    return runners.run(load(), unpack(point), start=unpack_start(start), cutoff=cutoff, announce=announce)


@cache
def _statm() -> int | None:
    """Return the descriptor of the file that tells how much memory this process holds; None without /proc."""
    with suppress(OSError):
        return os.open("/proc/self/statm", os.O_RDONLY)
    return None


def _memory() -> float:
    """Return the memory that this process holds, in bytes; without /proc, the most that it ever held."""
    statm = _statm()
    if statm is None:
        # Not used on Linux, where a process inherits the maximum of the one that started it.
        return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return float(os.pread(statm, 128, 0).split()[1]) * _PAGE
