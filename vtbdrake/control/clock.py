"""Clocks of a loop: the wall clock, and a simulated one for tests; a throttle by such a clock."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from math import inf, isfinite
from typing import Any


class Clock(ABC):
    """A monotonic clock, in seconds."""

    @abstractmethod
    def now(self) -> float:
        """Return the time in seconds, from an arbitrary zero."""

    @abstractmethod
    def wait_until(self, t: float, meanwhile: Callable[[], object] | None = None) -> float:
        """Wait until `now` is at least ``t``, and return the time then.

        Args:
            t: A time of this clock, in seconds.
            meanwhile: Called shortly before ``t``, if there is time for it.

        Raises:
            ValueError: ``t`` is not finite.
        """


class WallClock(Clock):
    """The time of `time.monotonic`, that is CLOCK_MONOTONIC.

    Other threads and signal handlers run while it sleeps: Ctrl-C ends the wait.

    Args:
        spin: Time in seconds before the deadline at which it wakes up, calls ``meanwhile`` and then polls the clock. It
            keeps a processor (and the GIL) busy to save the time that waking up takes.

    Raises:
        ValueError: ``spin`` is negative or not below 1 s.
    """

    def __init__(self, *, spin: float = 0.0) -> None:
        if not 0.0 <= spin < 1.0:
            raise ValueError(f"spin must be from 0 to below 1 s, not {spin}")
        self._spin = spin

    now = staticmethod(time.monotonic)

    def wait_until(self, t: float, meanwhile: Callable[[], object] | None = None) -> float:
        if not isfinite(t):
            raise ValueError(f"the deadline must be finite, not {t}")
        if (now := time.monotonic()) >= t:
            return now
        if now < t - self._spin:
            time.sleep(t - self._spin - now)
            if self._spin and meanwhile is not None:
                meanwhile()
        while (now := time.monotonic()) < t:
            pass
        return now


class ScaledClock(Clock):
    """A wall clock that runs ``speed`` times as fast as the time, or as slowly: for recordings, never for machines."""

    def __init__(self, speed: float) -> None:
        if not 0.0 < speed < inf:
            raise ValueError(
                f"the speed of a clock is positive and finite, not {speed}: SimulatedClock() does not wait"
            )
        self._speed = speed
        self._clock = WallClock()

    def now(self) -> float:
        return self._speed * self._clock.now()

    def wait_until(self, t: float, meanwhile: Callable[[], object] | None = None) -> float:
        return self._speed * self._clock.wait_until(t / self._speed, meanwhile)


class SimulatedClock(Clock):
    """A clock that only advances when it is waited for, so that runs are repeatable. It never calls ``meanwhile``.

    Args:
        start: The first time, in seconds.
        lateness: Delay of `wait_until` in seconds, one per call; later calls have none.
    """

    def __init__(self, *, start: float = 0.0, lateness: Sequence[float] = ()) -> None:
        self._now = start
        self._lateness = iter(tuple(lateness))

    def now(self) -> float:
        return self._now

    def wait_until(self, t: float, meanwhile: Callable[[], object] | None = None) -> float:
        if not isfinite(t):
            raise ValueError(f"the deadline must be finite, not {t}")
        late = next(self._lateness, 0.0)
        if not late >= 0.0:
            raise ValueError(f"lateness must not be negative, unlike {late} s")
        self._now = max(self._now, t + late)
        return self._now

    def advance(self, seconds: float) -> None:
        """Advance the time, as work does."""
        if not 0.0 <= seconds < inf:
            raise ValueError(f"time advances by a finite number of seconds from 0 on, not by {seconds}")
        self._now += seconds


class Throttle:
    """Calls a function at most once per period, such as one that logs what could be logged in every cycle.

    Args:
        clock: The clock of the period.
        period: The shortest time between two calls, in seconds.
    """

    def __init__(self, clock: Clock, *, period: float = 1.0) -> None:
        self._clock = clock
        self._period = period
        self._called_at = -inf

    def __call__(self, function: Callable[..., object], *arguments: Any) -> None:
        """Call ``function(*arguments)``, unless the last call was less than a period ago."""
        now = self._clock.now()
        if now - self._called_at >= self._period:
            self._called_at = now
            function(*arguments)
