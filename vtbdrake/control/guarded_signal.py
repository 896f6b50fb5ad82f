"""One actuator signal between a DPS and a machine: its limits, its fallbacks, and what became of its commands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.argument_checks import as_number
from vtbdrake.control.acting import ActingMonitor
from vtbdrake.control.fallback import Fallback, chain, default_fallback, is_position
from vtbdrake.control.fault import FaultKind
from vtbdrake.control.limits import ActuationError, PassThrough, RateLimiter
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.testbed import Interface, Signal

Limiter = RateLimiter | PassThrough
"""The limiter of an actuator signal: of a vector's entries, or of nothing."""

LARGEST_ACTING_LATENCY = 255
"""The largest number of periods within which an actuator command may act."""

_NO_TOLERANCE = 1e-6  # of a reported command whose signal has neither a limited rate nor a range, in its unit


@dataclass(slots=True, eq=False)
class GuardedSignal:
    """An actuator signal, and all that the guards remember of it between cycles.

    Attributes:
        name: Its name.
        limiter: Its limiter.
        acting: Compares what the machine reports as acting with what was sent; None for an abstract signal.
        fallbacks: Its fallback, the one that replaces it if it fails, and so on.
        is_position: Whether it commands a position.
        cycles_left: While it leaves real, for how many more cycles its fallbacks command.
        unsent: Number of cycles in a row in which nothing has left: it could not, or a fallback was silent.
        is_held_back: Whether the command of the last cycle did not leave.
        is_silent: Whether nothing was to be sent in the last cycle, though the signal is commanded.
        departs: Whether no command has left since its start, or since the loop itself has paused.
        had_left: If the signal `departs`, whether commands had left before the loop paused.
        is_withheld: Whether nothing is sent until a reset.
    """

    name: str
    limiter: Limiter
    acting: ActingMonitor | None
    fallbacks: tuple[Fallback, ...]
    is_position: bool
    cycles_left: float = 0.0
    unsent: int = 0
    is_held_back: bool = False
    is_silent: bool = False
    departs: bool = False
    had_left: bool = False
    is_withheld: bool = False

    @property
    def is_irregular(self) -> bool:
        """Return whether anything but the command of each cycle has left: `note_left` and the next cycle matter."""
        return self.departs or self.is_silent or self.unsent > 0

    def begin_comparison(self) -> None:
        """Forget what was sent: the machine gets the first commands only now, or again."""
        if self.acting is not None:
            self.acting.begin()

    def note_pause(self) -> None:
        """Note that the loop has paused: the next command departs from what is measured."""
        self.had_left = self.had_left or not self.departs
        self.departs = True
        self.begin_comparison()

    def note_left(self, *, held_back: bool, commanded: bool) -> None:
        """Note what became of the last command.

        Args:
            held_back: Whether it could not leave.
            commanded: Whether the signal is on real, or leaves it.
        """
        self.is_held_back = held_back
        if not commanded:
            self.unsent = 0
        elif held_back or self.is_silent:
            self.unsent += 1
        else:
            self.unsent = 0
            self.departs = self.had_left = False

    def goes_on_leaving(self, *, released: bool) -> bool:
        """Return whether its fallbacks command a signal that has left real for another cycle, and count that."""
        if released or self.cycles_left <= 0.0 or not self.limiter.has_start:
            return False
        self.cycles_left -= 1.0
        return True

    def release(self) -> None:
        """Forget the last command: from now on another controller commands."""
        self.limiter.release()
        self.departs = self.had_left = self.is_withheld = False

    def checked(self, actuation: Mapping[str, Any]) -> Any:
        """Return the signal's command, checked.

        Raises:
            ActuationError: It is missing, has another size, is not finite, or has nothing to depart from.
        """
        if self.name not in actuation:
            raise ActuationError(FaultKind.MISSING, "is missing")
        if self.limiter.needs_start and not self.limiter.has_start:
            raise ActuationError(
                FaultKind.NOT_STARTED,
                "has nothing to depart from within its limits of rate or acceleration: no command of it is "
                "recent, and no measurement of it is reliable",
            )
        return self.limiter.checked(actuation[self.name])

    def reported_value(self, report: ReceivedSignal | None) -> Any:
        """Return the newest report of what acts; None if there is none, or it is old."""
        if report is None or self.acting is None or self.acting.is_unreported:
            return None
        return report.value

    def not_acting(self, report: ReceivedSignal) -> str:
        """Return the difference of the report from the newest commands, as a sentence."""
        if self.acting is None or self.acting.is_unreported or report.value is None:
            return f"the machine does not report any more what acts on {self.name}"
        low, high = self.acting.range_of_sent()
        distance = np.maximum(report.value - high, low - report.value)
        k = int(np.argmax(distance))
        entry = f"[{k}]" if len(low) > 1 else ""
        if distance[k] <= 0.0:
            return (
                f"the machine did not act on the last actuator commands {self.name}: its report stayed the same while "
                "they changed, until a moment ago; they do not arrive, or the machine has stopped by itself"
            )
        return (
            f"the machine does not act on the actuator commands {self.name}: it reports {report.value[k]:.5g} for "
            f"{self.name}{entry}, the newest commands were {low[k]:.5g} to {high[k]:.5g}; they do not arrive, or too "
            "late, or the machine has stopped by itself"
        )


def guarded_signal(
    signal: Signal,
    interface: Interface,
    period: float,
    *,
    fallback: Fallback | None,
    latency: float,
    tolerance: ArrayLike | None,
) -> GuardedSignal:
    """Return the record of an actuator signal at the start of its guards, whose arguments these are.

    Args:
        signal: The actuator signal, with its limits.
        interface: All signals of the DPS.
        period: Period of the loop, in seconds.
        fallback: Its fallback; None for `default_fallback`.
        latency: Number of periods within which a command acts on the machine and is reported, rounded up.
        tolerance: Largest difference between the reported and the sent command that counts as none, in the signal's
            unit; None for the default of `Guards`.

    Raises:
        ValueError: The fallback, the latency or the tolerance does not fit the signal.
    """
    first = default_fallback(signal) if fallback is None else fallback
    return GuardedSignal(
        name=signal.name,
        limiter=RateLimiter(signal, period=period) if signal.is_vector else PassThrough(),
        acting=_acting_monitor(signal, period, latency, tolerance) if signal.is_vector else None,
        fallbacks=tuple(chain(first, signal, interface=interface)),
        is_position=is_position(signal),
    )


def _acting_monitor(signal: Signal, period: float, latency: float, tolerance: ArrayLike | None) -> ActingMonitor:
    if not 1.0 <= as_number("acting_latency", latency) <= LARGEST_ACTING_LATENCY:
        raise ValueError(f"acting_latency is 1 to {LARGEST_ACTING_LATENCY} periods, not {latency}")
    if tolerance is None:
        step = 0.5 * signal.vector(signal.rate) * period
        width = signal.vector(signal.upper) - signal.vector(signal.lower)
        allowed = np.minimum(step, 0.01 * width)
        tolerance = np.where(np.isfinite(allowed), allowed, _NO_TOLERANCE)
    elif not (signal.vector(tolerance) >= 0.0).all():
        raise ValueError(f"the acting_tolerance of {signal.name} must not be negative, unlike {tolerance}")
    return ActingMonitor(signal.size or 0, latency=ceil(latency), tolerance=tolerance)
