"""The slow parts of a DPS that runs in a loop: each is computed beside it, in a process of its own."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydrake.systems.framework import Context

from vtbdrake.control.clock import Clock
from vtbdrake.control.companion import Companion
from vtbdrake.control.cycle import RESULT
from vtbdrake.control.slow_worker import READY, pack, serve, unpack
from vtbdrake.control.statistics import Histogram
from vtbdrake.testbed.slow_function import MEMORY, Arrays
from vtbdrake.testbed.slow_part import SlowPart

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
        ValueError: a latency is so short that no result could come in time.
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
        self._beside = [_Beside(path, part, context, clock, changed) for path, part in parts.items()]

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
        self._patience = part.patience * part.latency
        self._error = ""
        self._waiting = part.waiting(context)
        self._start()

    def _start(self) -> None:
        self._companion = Companion(serve, self._part.function, name=f"the process of the slow part {self.path}")
        self._started = self._clock.now()
        self._ready = False
        self._working: int | None = None
        self._asked = 0.0

    def receive(self, end: float) -> None:
        for frame in self._companion.take():
            if frame == READY:
                self._ready = True
            else:
                self._take_in(unpack(frame))
        if self._working is not None and not self._companion.alive:
            self._miss(self._working)
            self._working = None
        for tick in [tick for tick in self._waiting if self._part.due(tick) <= end]:
            self._miss(tick)

    def _take_in(self, answer: Arrays | str) -> None:
        tick, self._working = self._working, None
        assert tick is not None
        self.statistics.took.record(self._clock.now() - self._asked)
        if isinstance(answer, str):
            self.statistics.errors += 1
            if answer != self._error:
                self._error = answer
                _log.error("the slow part %s raised:\n%s", self.path, answer)
            self._miss(tick)
        elif tick in self._waiting:
            self.statistics.results += 1
            self._deliver(tick, answer)
        else:
            self.statistics.late += 1
            if memory := {name: array for name, array in answer.items() if name.partition(".")[0] == MEMORY}:
                self._deliver(tick, memory)

    def _miss(self, tick: int) -> None:
        if tick in self._waiting:
            self.statistics.missed += 1
            self._deliver(tick, {})

    def _deliver(self, tick: int, arrays: Arrays) -> None:
        self._waiting.pop(tick, None)
        self._part.deliver(self._context, tick, arrays)
        self._changed(RESULT, {self.path: {"tick": tick, **arrays}})

    def send(self) -> None:
        self._companion.flush()
        self._waiting = self._part.waiting(self._context)
        if not self._companion.alive:
            self._replace()
        elif self._working is not None:
            if self._clock.now() - self._asked > self._patience:
                _log.error("the slow part %s has not answered for %g s", self.path, self._patience)
                self._companion.kill()
        elif self._ready and self._waiting:
            self._working = next(iter(self._waiting))
            self._asked = self._clock.now()
            request = {**self._waiting[self._working], **self._part.memory(self._context)}
            self._companion.post(*pack(request))

    def _replace(self) -> None:
        # To start a process costs the loop some milliseconds: one that dies at its start must not do so all the time.
        if self._clock.now() - self._started > self._patience:
            code = self._companion.close(0.0)
            _log.error("the process of the slow part %s ended (exit code %d); another is started", self.path, code)
            self.statistics.restarts += 1
            self._start()

    def close(self) -> None:
        self._companion.kill()
