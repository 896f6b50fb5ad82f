"""Detection of sensor signals that cannot be relied on: stale, late, implausible, or jumping."""

from __future__ import annotations

from math import inf, isfinite, isnan, nan
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.argument_checks import as_number
from vtbdrake.control.fault import Fault, FaultKind
from vtbdrake.control.limits import Bounds, JumpBounds
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.staleness import StalenessMonitor
from vtbdrake.testbed import Signal

_DRIFT = 500e-6  # Largest drift between the clocks of two computers, in s per s: NTP's largest correction.

SETTLING = 0.1
"""Seconds for which samples have to agree before the level that a signal has jumped to can be accepted."""


class LatencyMonitor:
    """Measures how much longer a message took than the quickest one, by its sender's clock.

    The zeros of the two clocks need not agree, and the clocks may drift apart slowly.

    Args:
        limit: Largest excess latency, in seconds.
    """

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self._least = inf  # Least time from sending to arrival; it contains the difference of the clocks.
        self._sent = self._arrived = -inf

    def excess(self, received: ReceivedSignal) -> float:
        """Return the excess latency of the newest message in seconds; NaN if it has no time stamp."""
        took = received.arrived - received.sent
        if isnan(took):
            return nan
        if received.sent < self._sent:  # The sender's clock was set back.
            self._least = inf
        drifted = self._least + _DRIFT * max(received.arrived - self._arrived, 0.0)
        self._least = min(took, drifted)
        self._sent, self._arrived = received.sent, received.arrived
        return took - self._least


class SensorMonitor(StalenessMonitor):
    """Checks that one sensor signal is fresh and plausible; `fault_at` returns the fault, if there is one.

    A signal that has never arrived is stale, for any maximum age. A vector is plausible if it has the right size
    and all entries are finite and within lower and upper. An implausible sample is a fault until the next one arrives.
    Values that the bridge has checked against the same bounds are not checked again. The bridge keeps the last value
    while it refuses newer ones; a signal that it refuses more than ten times in a row, or whose every third value it
    refuses for a while, is implausible until it accepts some again.

    A sample that differs from the last accepted one by more than the signal can have changed is a *jump*. The signal
    stays implausible until a sample is close enough to the last accepted one again. While samples are rejected, the
    allowed change grows for `max_age` at most (or for the gap before the first of them, if that was longer), so that a
    wrong value is not accepted because it is repeated. `accept_steady` accepts the new level of a sensor that really is
    elsewhere.

    Args:
        signal: The sensor signal with its limits.
        jump_tolerance: A scalar or one per entry, in the signal's unit. If given, entries may change from one accepted
            sample to the next by rate * dt + jump_tolerance, with dt between their arrivals: the tolerance covers
            noise and the jitter of the arrival.
        max_delay: Largest excess latency of a sample, in seconds (see `LatencyMonitor`); a later one is stale. Only for
            a sender whose clock runs as ours does; a simulation's clock may stand still.

    Raises:
        ValueError: ``max_delay`` is not positive, or the signal does not allow ``jump_tolerance``.
    """

    def __init__(
        self, signal: Signal, *, jump_tolerance: ArrayLike | None = None, max_delay: float | None = None
    ) -> None:
        if max_delay is not None and not as_number(f"the max_delay of {signal.name}", max_delay) > 0.0:
            raise ValueError(f"the sensor signal {signal.name} has a positive max_delay, not {max_delay} s")
        super().__init__(signal.max_age)
        self.signal = signal
        # The newest sample rejected as a jump, and since when such samples have agreed with each other.
        self._rejected: np.ndarray | None = None
        self._rejected_at = self._steady_since = -inf
        self._longest_gap = inf
        self._latency = None if max_delay is None else LatencyMonitor(max_delay)
        self._bounds = None if signal.size is None else Bounds(signal)
        self._jump_bounds = None if jump_tolerance is None else _jump_bounds(signal, jump_tolerance)
        self._examines_all = jump_tolerance is not None or max_delay is not None

    def stale(self, now: float, received: ReceivedSignal) -> Fault:
        """Return the fault of a signal that is too old or has never arrived.

        Args:
            now: The time on the loop's clock, in seconds.
            received: What the bridge has received of the signal.
        """
        name = self.signal.name
        if received.count:
            age = f"{1e3 * received.age(now):.1f} ms old, {1e3 * self.max_age:g} allowed"
            reason = f"sensor signal {name} is stale: {age}"
        else:
            reason = f"sensor signal {name} has never arrived"
        if received.rejected:
            rejected = ", ".join(f"{count} {why}" for why, count in received.rejected.items())
            reason += f"; messages rejected so far: {rejected}"
            if received.refused_value is not None:
                reason += f" ({self._violation(received.refused_value)})"
        return Fault(now, name, FaultKind.STALE, reason)

    def refusing(self, now: float, received: ReceivedSignal) -> Fault:
        """Return the fault of a signal whose messages are refused again and again, so that its value is an old one.

        Args:
            now: The time on the loop's clock, in seconds.
            received: What the bridge has received, and refused, of the signal.
        """
        name, value = self.signal.name, received.refused_value
        problem = received.refused_reason if value is None else self._violation(value)
        reason = f"sensor signal {name} is refused again and again, {received.refused} times so far: {problem}"
        return Fault(now, name, FaultKind.IMPLAUSIBLE, reason)

    def examine(self, now: float, received: ReceivedSignal) -> Fault | None:
        """Return the fault of a new sample, or None.

        Args:
            now: The time on the loop's clock, in seconds.
            received: What the bridge has received of the signal, with the new sample.
        """
        fault = None
        if self._bounds is not received.bounds:
            if self._bounds == received.bounds:
                self._bounds = received.bounds  # From now on the comparison above is enough.
            else:
                fault = self._implausible(now, received)
        if not self._examines_all:
            self.trusted = self._bounds
        return fault or self._late(now, received) or self._jump(now, received)

    @property
    def steady(self) -> bool:
        """Return whether the signal has jumped and its samples have agreed for `SETTLING` since then."""
        return self._rejected is not None and self._rejected_at - self._steady_since >= SETTLING

    def accept_steady(self) -> None:
        """Accept the level that the signal has jumped to, if it is steady there.

        Call it when an operator takes the responsibility (a reset by hand), or when nothing depends on the signal.
        """
        if self.steady:
            self.accept(self._rejected, self._rejected_at)
            self._rejected = None

    def _implausible(self, now: float, received: ReceivedSignal) -> Fault | None:
        problem = "" if self._bounds is None else self._bounds.violation(received.value)
        if not problem:
            return None
        name, value = self.signal.name, received.value
        if problem in ("size", "type"):
            reason = f"sensor signal {name} has the shape {np.shape(value)} instead of ({self.signal.size},)"
        else:
            reason = f"sensor signal {name} leaves its limits: {np.asarray(value).tolist()}"
        return Fault(now, name, FaultKind.IMPLAUSIBLE, reason)

    def _violation(self, value: Any) -> str:
        """Return a text with the entry of a value and the limit that it leaves; the type of an abstract value."""
        if self.signal.size is None:
            return f"its value is a {type(value).__name__}"
        entries, lower, upper = map(self.signal.vector, (value, self.signal.lower, self.signal.upper))
        k = int(np.argmax(np.nan_to_num(np.maximum(entries - upper, lower - entries), nan=inf)))
        entry = f"{self.signal.name}[{k}]" if self.signal.size > 1 else self.signal.name
        if not isfinite(entries[k]):
            return f"{entry} is {entries[k]}"
        side, limit = ("above", upper[k]) if entries[k] > upper[k] else ("below", lower[k])
        return f"{entry} is {entries[k]:.5g}, {side} its limit {limit:.5g}"

    def _late(self, now: float, received: ReceivedSignal) -> Fault | None:
        if self._latency is None or not (excess := self._latency.excess(received)) > self._latency.limit:
            return None
        reason = (
            f"sensor signal {self.signal.name} is stale: it took {1e3 * excess:.1f} ms longer than the quickest "
            f"sample, {1e3 * self._latency.limit:g} allowed"
        )
        return Fault(now, self.signal.name, FaultKind.STALE, reason)

    def _jump(self, now: float, received: ReceivedSignal) -> Fault | None:
        bounds = self._jump_bounds
        if bounds is None or self.value is None:
            return None
        value, accepted = np.asarray(received.value, dtype=float), np.asarray(self.value, dtype=float)
        gap = max(received.arrived - self.arrived, 0.0)
        if bounds.contains(accepted, value, gap if self._rejected is None else min(gap, self._longest_gap)):
            self._rejected = None
            return None
        if self._rejected is None:
            self._longest_gap = max(gap, self.max_age) if isfinite(self.max_age) else gap
        if self._rejected is None or not bounds.contains(self._rejected, value, received.arrived - self._rejected_at):
            self._steady_since = received.arrived
        self._rejected, self._rejected_at = value, received.arrived
        reason = (
            f"sensor signal {self.signal.name} jumps within {1e3 * gap:.1f} ms from {accepted.tolist()} to "
            f"{value.tolist()}"
        )
        return Fault(now, self.signal.name, FaultKind.JUMP, reason)


def _jump_bounds(signal: Signal, jump_tolerance: ArrayLike) -> JumpBounds:
    if signal.size is None:
        raise ValueError(f"the sensor signal {signal.name} is abstract: there is no jump to tolerate")
    rate, tolerance = signal.vector(signal.rate), signal.vector(jump_tolerance)
    if not np.isfinite(rate).all():
        raise ValueError(f"the sensor signal {signal.name} may jump: to tell a jump, it needs a finite rate")
    if not (tolerance >= 0.0).all():
        raise ValueError(f"the jump_tolerance of {signal.name} is not negative, unlike {tolerance.tolist()}")
    return JumpBounds(rate, tolerance)
