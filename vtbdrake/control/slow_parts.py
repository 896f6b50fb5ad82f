"""The slow parts of a DPS in a control loop: their functions run in other processes, beside the loop."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydrake.systems.framework import Context

from vtbdrake.common.child_process import ProcessStartError
from vtbdrake.common.failures import error_text
from vtbdrake.common.pickling import dumps
from vtbdrake.control.background_process import START_TIMEOUT, BackgroundProcess
from vtbdrake.control.clock import Clock, Throttle
from vtbdrake.control.statistics import Histogram
from vtbdrake.control.stepping import ChangeKind
from vtbdrake.control.supervisor import SupervisorMessage, supervise
from vtbdrake.testbed.slow_function import Arrays, split_memory
from vtbdrake.testbed.slow_part import SlowPart

_log = logging.getLogger(__name__)

# Relative to a period: the end of a step is a sum of floating-point numbers, and a result may be due just then.
_ROUNDING = 1e-6


@dataclass
class SlowStatistics:
    """Statistics of a slow part beside the loop.

    Attributes:
        results: The number of results that arrived in time.
        missed: The number of results that were declared missing or that the function did not have (None).
        late: The number of results that arrived after that, and were not used.
        errors: The number of calls of its function that raised an exception.
        restarts: The number of times its worker was replaced, because it died or did not answer.
        took: The times from a request to its answer, in seconds on the loop's clock.
    """

    results: int = 0
    missed: int = 0
    late: int = 0
    errors: int = 0
    restarts: int = 0
    took: Histogram = field(default_factory=Histogram)

    def __str__(self) -> str:
        return (
            f"{self.results} results in time, {self.missed} missed, {self.late} late, {self.errors} errors, "
            f"{self.restarts} restarts"
        )


class SlowParts:
    """All slow parts of a DPS, served once before and once after each step, without waiting.

    A result enters the context, and is reported as a `Change`, before the first step after its arrival. A result that
    is due by the end of the coming step, and has not arrived, is declared missing; so is one that will not arrive,
    because the function raised an exception or the worker was lost. A worker has one request at a time; samples that
    it cannot begin in time become missing, so that no queue grows.

    Args:
        parts: The slow parts, by path.
        context: The root context of the loop.
        period: The period of the loop, in seconds.
        clock: The clock of the loop.
        changed: Called with path and values of a result that has entered the context.

    Raises:
        ValueError: A latency is so short that no result could arrive in time, or a function cannot be sent to another
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
        functions = {}
        for path, part in parts.items():
            if part.latency < 2.0 * period:
                raise ValueError(
                    f"the slow part {path} has a latency of {part.latency:g} s; in a loop with a period of "
                    f"{period:g} s it takes at least {2.0 * period:g} s for a result to come back"
                )
            try:
                functions[path] = dumps(part.function_beside(period))
            except Exception as error:
                raise ValueError(
                    f"the function of the slow part {path} cannot be sent to another process ({error_text(error)}): "
                    "keep what cannot be pickled out of it"
                ) from error
        self._context = context
        self._step = period * (1.0 + _ROUNDING)
        # Processes start only when all functions are known to be good.
        self._parts = [_Part(path, part, functions[path], context, clock, changed) for path, part in parts.items()]

    @property
    def statistics(self) -> dict[str, SlowStatistics]:
        """Return the statistics of the slow parts, by path."""
        return {part.path: part.statistics for part in self._parts}

    def receive(self) -> None:
        """Deliver the results that have arrived, and declare overdue ones missing; called before a step."""
        if self._parts:
            end = self._context.get_time() + self._step
            for part in self._parts:
                part.receive(end)

    def send(self) -> None:
        """Send the new samples; called after a step."""
        for part in self._parts:
            part.send()

    def wait_until_ready(self, timeout: float = START_TIMEOUT) -> None:
        """Wait until every worker is ready for its first request, so that no result will be missing; see `deploy`.

        Raises:
            ProcessStartError: One has ended, or is not ready within ``timeout`` seconds.
        """
        end = time.monotonic() + timeout
        for part in self._parts:
            part.wait_until_ready(end, timeout)

    def wait(self, timeout: float) -> bool:
        """Wait until every worker has an answer, or is ready for its first request.

        Call it between the cycles of a loop on a simulated clock, which leaves no time to compute.

        Returns:
            False if one has no answer within ``timeout`` seconds.
        """
        end = time.monotonic() + timeout
        return all([part.wait(max(0.0, end - time.monotonic())) for part in self._parts])

    def close(self) -> None:
        """End all processes."""
        for part in self._parts:
            part.close()


class _Part:
    """One slow part and its processes."""

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
        self._requested: int | None = None  # The tick of the request that the worker has.
        self._requested_at = 0.0
        self._ready = False
        self._last_failure = ""
        self._log_missed = Throttle(clock)
        self._answers: list[tuple[SupervisorMessage, Any]] = []
        name = f"the supervisor of the slow part {path}"
        self._supervisor = BackgroundProcess(supervise, function, part.patience * part.latency, path, name=name)

    def receive(self, end: float) -> None:
        answers, self._answers = self._answers + self._supervisor.pop_messages(), []
        for answer in answers:
            self._handle(*answer)
        overdue = [tick for tick in self._waiting if self._part.due(tick) <= end]
        for tick in overdue:
            self._miss(tick)
        if overdue:
            reason = "" if self._ready else ": its process is not ready yet"
            self._log_missed(
                _log.warning,
                "the slow part %s has no result within its latency of %g s%s (missed so far: %d)",
                *(self.path, self._part.latency, reason, self.statistics.missed),
            )

    def _handle(self, kind: SupervisorMessage, content: Any) -> None:
        self._ready = kind != SupervisorMessage.LOST
        if kind == SupervisorMessage.LOST:
            self.statistics.restarts += 1
            self._fail(self._requested, content)
            self._requested = None
        elif kind in (SupervisorMessage.RESULT, SupervisorMessage.ERROR):
            tick, answer = content
            if tick == self._requested:
                self.statistics.took.record(self._clock.now() - self._requested_at)
                self._requested = None
            if kind == SupervisorMessage.RESULT:
                self._use(tick, answer)
            else:
                self.statistics.errors += 1
                self._fail(tick, answer)

    def _use(self, tick: int, arrays: Arrays) -> None:
        memory, outputs = split_memory(arrays)
        if tick in self._waiting:
            self.statistics.results += bool(outputs)
            self.statistics.missed += not outputs
            self._deliver(tick, arrays)
        else:
            self.statistics.late += bool(outputs)
            if memory:
                self._deliver(tick, memory)

    def _fail(self, tick: int | None, reason: str) -> None:
        if reason != self._last_failure:  # The same failure with every sample is logged once.
            _log.error("the slow part %s: %s", self.path, reason)
            self._last_failure = reason
        if tick is not None:
            self._miss(tick)

    def _miss(self, tick: int) -> None:
        if tick in self._waiting:
            self.statistics.missed += 1
            self._deliver(tick, {})

    def _deliver(self, tick: int, arrays: Arrays) -> None:
        self._waiting.pop(tick, None)
        self._part.deliver(self._context, tick, arrays)
        self._changed(ChangeKind.RESULT, {self.path: {"tick": tick, **arrays}})

    def send(self) -> None:
        self._supervisor.flush()
        self._waiting = self._part.waiting(self._context)
        if self._ready and self._requested is None and self._waiting:
            self._requested = next(iter(self._waiting))
            self._requested_at = self._clock.now()
            arrays = {**self._waiting[self._requested], **self._part.memory(self._context)}
            if not self._supervisor.post((self._requested, arrays)):
                _log.error("the slow part %s: its processes have ended, and all results will be missing", self.path)

    def wait_until_ready(self, end: float, timeout: float) -> None:
        """Wait until a time by `time.monotonic`, which is the end of a time-out; both are in seconds."""
        restarts = self.statistics.restarts
        while not self._ready:
            answers = self._supervisor.wait_for_messages(max(0.0, end - time.monotonic()))
            for answer in answers:
                self._handle(*answer)
            if not answers or self.statistics.restarts > restarts:
                reason = self._last_failure or f"it is not ready within {timeout:g} s"
                raise ProcessStartError(
                    f"the slow part {self.path} does not start: {reason}; see the output of its process above, and "
                    "what its function imports and prepares"
                )

    def wait(self, timeout: float) -> bool:
        if self._answers or (self._ready and self._requested is None):
            return True
        self._answers = self._supervisor.wait_for_messages(timeout)
        return bool(self._answers)

    def close(self) -> None:
        self._supervisor.close()
