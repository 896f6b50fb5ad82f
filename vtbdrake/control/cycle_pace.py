"""Paces of a loop: the clock begins its cycles, or the messages of a machine do, which may wait for the loop."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from math import floor, inf, nan

from vtbdrake.control.bridge import Bridge
from vtbdrake.control.clock import Clock
from vtbdrake.control.guards import Guards
from vtbdrake.control.pace import PaceMonitor
from vtbdrake.control.reception import Reception
from vtbdrake.control.statistics import LoopStatistics

_log = logging.getLogger(__name__)

_KEEP_PERIOD = 0.1
"""Time between two messages that keep command channels while a loop waits, and two looks at whether it is to end."""

_LONG_WAIT = 1.0
"""Time of waiting for a message that begins a cycle after which the log says so, in seconds."""

_UNORDERED = ("out of order", "ahead of time")
"""Reasons to reject a message that does not continue the sender's time."""


class CyclePace(ABC):
    """Begins the cycles of a loop.

    Args:
        period: Period of the loop, in seconds.
        clock: The clock of the loop.
        statistics: Where missed deadlines are counted.

    Attributes:
        messages: Number of messages so far that begin a cycle; always 0 if the clock begins them.
        receives: Whether `wait` has received the newest messages when it returns.
        problem: Why the pace prevents a switch to real, or None.
    """

    receives = False

    def __init__(self, period: float, clock: Clock, statistics: LoopStatistics) -> None:
        self._period = period
        self._clock = clock
        self._statistics = statistics

    @property
    def messages(self) -> int:
        return 0

    @property
    def problem(self) -> str | None:
        return None

    @abstractmethod
    def wait(self, deadline: float, active: tuple[str, ...], ends: Callable[[], bool]) -> tuple[float, float] | None:
        """Wait for the next cycle; return when it was due and how late it is, in seconds, or None if none is to begin.

        Args:
            deadline: When it is due by the clock, in seconds.
            active: The actuator signals that are on real.
            ends: Called again and again in a wait that may be long; True ends it without a cycle.
        """

    @abstractmethod
    def next_deadline(self, due: float, lateness: float) -> float:
        """Return the next deadline; deadlines that have passed already are left out and counted.

        Args:
            due: When the cycle that has ended was due by the clock, in seconds.
            lateness: How late it began, in seconds.
        """

    def overrun(self, lateness: float, worked: float) -> int:
        """Return the number of deadlines that passed before anything is sent: after an overrun, inputs are stale.

        Args:
            lateness: How late the cycle began, in seconds.
            worked: Time since then, in seconds.
        """
        return int((lateness + worked) / self._period)

    def note_cycle(self) -> str | None:
        """Note that a cycle begins; return how the pace differs from the period, or None."""
        return None

    @abstractmethod
    def time_of_commands(self, due: float, now: float) -> float:
        """Return the time by which the rates of a cycle's commands are limited, in seconds.

        Args:
            due: When the cycle was due by the clock, in seconds.
            now: The time on the clock after the step of the DPS, in seconds.
        """

    def time_of_last_commands(self, now: float) -> float:
        """Return the time for the commands after the last cycle; NaN: they count for a period each."""
        return now

    def cycles_in(self, seconds: float) -> float:
        """Return for how many cycles fallbacks command after the last one, to do so for ``seconds``."""
        return seconds / self._period


class ClockPace(CyclePace):
    """The clock begins a cycle once per period.

    Args:
        receive: Receives what has arrived; called shortly before a deadline.
    """

    def __init__(self, period: float, clock: Clock, statistics: LoopStatistics, *, receive: Callable[[], None]) -> None:
        super().__init__(period, clock, statistics)
        self._receive = receive

    def wait(self, deadline: float, active: tuple[str, ...], ends: Callable[[], bool]) -> tuple[float, float] | None:
        # Shortly before the deadline, messages that have arrived are received and fed already.
        return deadline, self._clock.wait_until(deadline, self._receive) - deadline

    def next_deadline(self, due: float, lateness: float) -> float:
        # A deadline that is due just now can still be kept.
        behind = max(floor((self._clock.now() - due) / self._period), 0)
        self._statistics.miss(behind)
        return due + (behind + 1) * self._period

    def time_of_commands(self, due: float, now: float) -> float:
        # Cycles of the clock are due at least a period apart, however late they are.
        return due


class MessagePace(CyclePace):
    """Every message of a sensor signal begins a cycle, or the clock, if none comes for a while.

    A message whose value is refused begins a cycle, too: the machine has done one.

    Args:
        signal: Name of the sensor signal.
        bridge: Receives it.
        reception: Knows until when all messages were received.
        guards: Say how much the pace may differ, and whether a fallback sends anything.
        patience: Time after which a cycle begins without a message, in seconds.
    """

    receives = True

    def __init__(
        self,
        period: float,
        clock: Clock,
        statistics: LoopStatistics,
        *,
        signal: str,
        bridge: Bridge,
        reception: Reception,
        guards: Guards,
        patience: float,
    ) -> None:
        super().__init__(period, clock, statistics)
        self._bridge = bridge
        self._reception = reception
        self._guards = guards
        self._patience = patience
        self._received = bridge.sensed[signal]
        self._noted = 0  # The count of the newest message that the monitor knows.
        self._monitor = PaceMonitor(signal, period, tolerance=guards.pace_tolerance)

    @property
    def messages(self) -> int:
        return self._received.count + self._received.refused

    @property
    def problem(self) -> str | None:
        return self._monitor.problem or self._monitor.unknown

    def wait(self, deadline: float, active: tuple[str, ...], ends: Callable[[], bool]) -> tuple[float, float] | None:
        messages, begin = self.messages, self._clock.now()
        limit, keep_at, tell_at = begin + self._patience, begin + _KEEP_PERIOD, begin + _LONG_WAIT
        while self.messages == messages:
            self._reception.read_at = now = self._clock.now()
            if now >= tell_at:
                self._tell_wait(now - begin)
                tell_at = inf
            if now >= keep_at:
                if ends():
                    return None
                self._bridge.keep(active)
                keep_at = now + _KEEP_PERIOD
            left = limit - now
            if left <= 0.0:
                break
            self._bridge.poll(min(left, _KEEP_PERIOD))
        woke = self._clock.now()
        return woke, max(woke - limit, 0.0)

    def next_deadline(self, due: float, lateness: float) -> float:
        now = self._clock.now()
        self._statistics.miss(self.overrun(lateness, now - due))
        return now

    def overrun(self, lateness: float, worked: float) -> int:
        # The loop may work for as long as its patience.
        return super().overrun(lateness, 0.0 if worked <= self._patience else worked)

    def note_cycle(self) -> str | None:
        if self._received.count != self._noted:
            self._noted = self._received.count
            self._monitor.note(self._time_of_message())
        problem = self._monitor.problem
        self._statistics.off_pace += problem is not None
        return problem

    def time_of_commands(self, due: float, now: float) -> float:
        return now

    def _time_of_message(self) -> float:
        """Return the time of the newest message, on the clock by which the machine has to keep the pace."""
        return self._received.arrived

    def _tell_wait(self, seconds: float) -> None:
        """Log that the loop has been waiting for a message."""
        silent = self._guards.latched and self._guards.silent
        why = " The fallback sends nothing, and a machine in lock-step waits for a command." if silent else ""
        _log.warning(
            "no message with %s for %.1f s; the loop waits for %g s before it goes on without.%s",
            self._monitor.signal,
            seconds,
            self._patience,
            why,
        )


class LockStepPace(MessagePace):
    """Messages begin the cycles, and the machine waits for the command: meanwhile, its time stands still.

    So the stamps of the messages tell the time, and the pace is known only after a switch to real. A message that
    does not continue the machine's time begins a cycle, too: the machine sends nothing else before it gets a command.
    """

    @property
    def messages(self) -> int:
        unordered = sum(self._received.rejected.get(reason, 0) for reason in _UNORDERED)
        return super().messages + unordered

    @property
    def problem(self) -> str | None:
        return self._monitor.problem

    def time_of_commands(self, due: float, now: float) -> float:
        return self._received.sent

    def time_of_last_commands(self, now: float) -> float:
        return nan

    def cycles_in(self, seconds: float) -> float:
        return 0.0

    def _time_of_message(self) -> float:
        return self._received.sent
