"""The pace of a loop whose cycles are begun by messages: whether they come once per period."""

from __future__ import annotations

from collections import deque
from math import inf, isfinite

WINDOW = 100
"""Number of the last times between two messages that are compared with the period."""

SETTLED = 20
"""Number of times between two messages from which on the pace is known."""

JITTER = 3.0
"""Number of periods by which the first message of the window may come late, and the last one."""

PAUSE = 4.0
"""Number of periods: a longer time between two messages is a pause, and counts for no more."""


LOST = 2.0
"""Number of periods: a longer mean of the times, pauses included, is too slow, however they vary."""


class PaceMonitor:
    """Compares the times between the messages that begin a loop's cycles with the period of the DPS.

    Every cycle advances the DPS by one period. If the messages come at another pace, its time is not the machine's, and
    its controllers and filters compute with a wrong period.

    Among the last `WINDOW` times (each counts for at most `PAUSE` periods), the pace is too quick if half are too short
    by more than the tolerance, and so is their sum, by `JITTER` periods more. The sum alone would be changed by a late
    message, the half by messages in pairs. The pace is too slow if nine of ten are too long, and so is
    their sum: on a busy computer, where a machine loses time, its times vary. It is too slow, too, if the mean is more
    than `LOST` periods: then the DPS lives through less than half of the time, because messages are lost.

    Args:
        signal: Name of the sensor signal whose messages begin the cycles.
        period: Period of the DPS, in seconds.
        tolerance: The largest difference, relative to the period; infinite: any pace is right.
    """

    def __init__(self, signal: str, period: float, *, tolerance: float) -> None:
        self.signal = signal
        self.period = period
        self.tolerance = tolerance
        self._times: deque[float] = deque(maxlen=WINDOW)
        self._total = 0.0
        self._short = self._long = 0  # number of times that are too short, and too long
        self._last: float | None = None

    def note(self, at: float) -> None:
        """Note a message.

        Args:
            at: Its time in seconds, on the clock by which the machine has to keep the pace; NaN is ignored.
        """
        if not isfinite(at):
            return
        last, self._last = self._last, at
        if last is None:
            return
        if len(self._times) == WINDOW:
            self._count(self._times[0], -1)
        time = min(at - last, PAUSE * self.period)
        self._times.append(time)
        self._count(time, 1)

    @property
    def unknown(self) -> str | None:
        """Return the reason why the pace is not known yet, as a sentence; None if it is known."""
        if self.tolerance == inf or len(self._times) >= SETTLED:
            return None
        return f"the pace of {self.signal} is not known yet: {len(self._times)} of {SETTLED} times between messages"

    @property
    def problem(self) -> str | None:
        """Return a sentence about a pace that differs from the period; None if it does not, or is not known yet."""
        count = len(self._times)
        excess, allowed = self._total - count * self.period, (count * self.tolerance + JITTER) * self.period
        quick = self._short > 0.5 * count and excess < -allowed
        slow = excess > allowed and (self._long >= 0.9 * count or self._total > LOST * count * self.period)
        if count < SETTLED or not (quick or slow):
            return None
        return (
            f"the messages of {self.signal} come about every {1e3 * self._total / count:.4g} ms, but the period of the "
            f"DPS is {1e3 * self.period:g} ms (a difference of {100.0 * self.tolerance:g} % is allowed): give the "
            "machine and the deployment the same period"
        )

    def _count(self, time: float, number: int) -> None:
        self._total += number * time
        self._short += number * (time < (1.0 - self.tolerance) * self.period)
        self._long += number * (time > (1.0 + self.tolerance) * self.period)
