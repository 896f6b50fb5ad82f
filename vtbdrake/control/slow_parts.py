"""The slow parts of a DPS that runs in a loop: each is computed beside it, in a process of its own."""

from __future__ import annotations

import logging
import select
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydrake.systems.framework import Context

from vtbdrake.control.clock import Clock
from vtbdrake.control.slow_worker import ERROR, LOST, RESULT, keep, pack, unpack
from vtbdrake.control.statistics import Histogram
from vtbdrake.control.stepping import RESULT as CHANGE
from vtbdrake.control.worker_process import WorkerProcess
from vtbdrake.pickling import dumps
from vtbdrake.testbed.slow_part import Arrays, SlowPart, split_memory

_log = logging.getLogger(__name__)

# Of a cycle: where a step ends is a sum of floating-point numbers, and a result may be due just there.
_ROUNDING = 1e-6


@dataclass
class SlowStatistics:
    """How a slow part fares beside the loop.

    Attributes:
        results: how many came in time.
        missed: how many were declared missing.
        late: how many came after that, and were not used.
        errors: how many times its function raised.
        restarts: how many times its process died, or was ended because it did not answer, and another was started.
        took: from a request to its answer, in seconds on the loop's clock.
    """

    results: int = 0
    missed: int = 0
    late: int = 0
    errors: int = 0
    restarts: int = 0
    took: Histogram = field(default_factory=Histogram)


class SlowParts:
    """All of them, looked after once before and once after each step; neither waits.

    A result enters the context, and is told as a `Change`, in the cycle before whose step it is there. What is due
    within the coming step, or at its end, and is not there, is declared missing. So is what its process will not
    answer any more, as the function raised or the process died. A process works on one request at a time; what cannot
    begin in time becomes missing, and nothing queues up.

    Attributes:
        statistics: by path.

    Raises:
        ValueError: a latency is so short that no result could come in time, or a function cannot be sent to another
            process.
    """

    def __init__(
        self,
        parts: Mapping[str, SlowPart],
        context: Context,
        *,
        period: float,
        clock: Clock,
        changed: Callable[[str, Mapping[str, Any]], None],
    ) -> None:
        for path, part in parts.items():
            if part.latency < 2.0 * period:
                raise ValueError(
                    f"the slow part {path} has a latency of {part.latency:g} s; in a loop with a period of "
                    f"{period:g} s it takes at least {2.0 * period:g} s for a result to come back"
                )
        self._context = context
        self._step = period * (1.0 + _ROUNDING)
        functions = {path: _sendable(path, part) for path, part in parts.items()}
        self._beside = [_Beside(path, part, functions[path], context, clock, changed) for path, part in parts.items()]

    @property
    def statistics(self) -> dict[str, SlowStatistics]:
        return {beside.path: beside.statistics for beside in self._beside}

    def receive(self) -> None:
        """Before a step: hands in what has come, and declares missing what should have."""
        if self._beside:
            end = self._context.get_time() + self._step
            for beside in self._beside:
                beside.receive(end)

    def send(self) -> None:
        """After a step: sends off what has been sampled."""
        for beside in self._beside:
            beside.send()

    def wait(self, timeout: float) -> bool:
        """Waits until every process has something to say, at first that it is ready; whether they all had within
        ``timeout`` seconds.

        To be called before the first cycle, where no result is to be missing; and between any two of a loop on a
        simulated clock, which leaves no time to compute.
        """
        return all([beside.wait(timeout) for beside in self._beside])

    def close(self) -> None:
        """Ends the processes."""
        for beside in self._beside:
            beside.close()


class _Beside:
    """One slow part and its process."""

    def __init__(
        self,
        path: str,
        part: SlowPart,
        function: bytes,
        context: Context,
        clock: Clock,
        changed: Callable[[str, Mapping[str, Any]], None],
    ) -> None:
        self.path = path
        self.statistics = SlowStatistics()
        self._part = part
        self._context = context
        self._clock = clock
        self._changed = changed
        self._waiting = part.waiting(context)
        self._working: int | None = None
        self._ready = False
        self._asked = 0.0
        self._trouble = ""
        self._answers: list[bytes] = []
        self._worker = WorkerProcess(
            keep,
            function,
            part.patience * part.latency,
            path,
            name=f"the keeper of the slow part {path}",
        )

    def receive(self, end: float) -> None:
        answers, self._answers = self._answers + self._worker.take(), []
        for answer in answers:
            self._take_in(*unpack(answer))
        for tick in [tick for tick in self._waiting if self._part.due(tick) <= end]:
            self._miss(tick)

    def _take_in(self, kind: str, content: Any) -> None:
        self._ready = kind != LOST
        if kind == LOST:
            self.statistics.restarts += 1
            self._fail(self._working, content)
            self._working = None
        elif kind in (RESULT, ERROR):
            tick, answer = content
            if tick == self._working:
                self.statistics.took.record(self._clock.now() - self._asked)
                self._working = None
            if kind == RESULT:
                self._use(tick, answer)
            else:
                self.statistics.errors += 1
                self._fail(tick, answer)

    def _use(self, tick: int, arrays: Arrays) -> None:
        if tick in self._waiting:
            self.statistics.results += 1
            self._deliver(tick, arrays)
        else:
            self.statistics.late += 1
            memory, _ = split_memory(arrays)
            if memory:
                self._deliver(tick, memory)

    def _fail(self, tick: int | None, reason: str) -> None:
        # What happens with every sample is told once.
        if reason != self._trouble:
            _log.error("the slow part %s: %s", self.path, reason)
            self._trouble = reason
        if tick is not None:
            self._miss(tick)

    def _miss(self, tick: int) -> None:
        if tick in self._waiting:
            self.statistics.missed += 1
            self._deliver(tick, {})

    def _deliver(self, tick: int, arrays: Arrays) -> None:
        self._waiting.pop(tick, None)
        self._part.deliver(self._context, tick, arrays)
        self._changed(CHANGE, {self.path: {"tick": tick, **arrays}})

    def send(self) -> None:
        self._worker.flush()
        self._waiting = self._part.waiting(self._context)
        if self._ready and self._working is None and self._waiting:
            self._working = next(iter(self._waiting))
            self._asked = self._clock.now()
            arrays = {**self._waiting[self._working], **self._part.memory(self._context)}
            if not self._worker.post(*pack((self._working, arrays))):
                _log.error("the slow part %s: its processes are gone, and nothing is computed any more", self.path)

    def wait(self, timeout: float) -> bool:
        end = time.monotonic() + timeout
        while (self._working is not None or not self._ready) and not self._answers:
            left = end - time.monotonic()
            if left <= 0.0 or not self._worker.alive:
                return False
            line = [self._worker.fileno()]
            select.select(line, line if self._worker.unsent else [], [], left)
            self._worker.flush()
            self._answers += self._worker.take()
        return True

    def close(self) -> None:
        self._worker.close()


def _sendable(path: str, part: SlowPart) -> bytes:
    try:
        return dumps(part.function)
    except Exception as error:
        raise ValueError(
            f"the function of the slow part {path} cannot be sent to another process ({type(error).__name__}: "
            f"{error}): keep what cannot be pickled out of it"
        ) from error
