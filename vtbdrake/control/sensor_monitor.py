"""What tells whether a sensor signal can be relied on."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite, isnan, nan

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.control.bridge import ReceivedSignal
from vtbdrake.control.kernels import JumpBounds, StalenessMonitor
from vtbdrake.control.limits import ValueRange
from vtbdrake.testbed import Signal

# By how many seconds in one the clocks of two computers may drift apart: NTP's largest correction.
_DRIFT = 500e-6

SETTLING = 0.1
"""Seconds for which samples have to agree before the level that a signal has jumped to can be accepted."""


@dataclass(frozen=True, slots=True)
class Fault:
    """Why the machine must not be commanded as the DPS would like.

    Attributes:
        time: when it was found, on the loop's clock, in seconds.
        signal: the one it is about; None if it is about all.
        kind: of a sensor signal ``stale``, ``implausible`` or ``jump``; of an actuator signal ``missing``, ``size``,
            ``not finite``, ``not started``, ``not sent`` or ``fallback``; of all ``raised``, ``missed``, ``not ready``
            or ``told``.
        reason: one sentence.
    """

    time: float
    signal: str | None
    kind: str
    reason: str

    def __str__(self) -> str:
        return self.reason


class LatencyMonitor:
    """How much longer than the quickest one a message took, by its sender's clock; the clocks' zeros need not agree.

    Args:
        most: how much longer it may take, in seconds.
    """

    def __init__(self, most: float) -> None:
        self.most = most
        self._least = inf  # of the times from sending to arrival: the clocks' difference is in it
        self._sent = self._arrived = -inf

    def of(self, reception: ReceivedSignal) -> float:
        """Of the newest message, in seconds; NaN if it does not tell when it was sent."""
        took = reception.arrived - reception.sent
        if isnan(took):
            return nan
        if reception.sent < self._sent:  # The sender's clock was set back.
            self._least = inf
        drifted = self._least + _DRIFT * max(reception.arrived - self._arrived, 0.0)
        self._least = min(took, drifted)
        self._sent, self._arrived = reception.sent, reception.arrived
        return took - self._least


class SensorMonitor(StalenessMonitor):
    """Watches one sensor signal: it has to be fresh, and what it says plausible.

    A signal that never arrived is stale, whatever its maximum age. A vector is plausible if it has the right size and
    all entries are finite and within lower and upper. An implausible sample is a fault until the next one arrives.
    What the bridge has checked by the same limits is not checked again.

    A sample that is further from the last accepted one than the signal can have changed is a *jump*. The signal stays
    implausible until a sample is within reach of the last accepted one again. While samples are refused, that reach
    grows for `max_age` at most (or for the gap before the first of them, if that was longer): a wrong value does not
    become right by being repeated. `accept_steady` is the way on for a sensor that really is elsewhere.

    Args:
        signal: its limits count.
        jump_tolerance: a scalar or one per entry, in the signal's unit. If given, entries may change from one accepted
            sample to the next by rate * dt + jump_tolerance, with dt between their arrivals: noise and jitter of the
            arrival are to be tolerated.
        max_delay: in seconds. If given, a sample that took so much longer than the quickest one, by its sender's clock,
            is stale: it may have waited anywhere before it was read. Only for a sender whose clock runs as ours does;
            that of a simulation may stand still.
    """

    def __init__(
        self, signal: Signal, *, jump_tolerance: ArrayLike | None = None, max_delay: float | None = None
    ) -> None:
        if max_delay is not None and not max_delay > 0.0:
            raise ValueError(f"the sensor signal {signal.name} has a positive max_delay, not {max_delay} s")
        self.signal = signal
        super().__init__(signal.max_age)
        # The newest sample that was refused as a jump, and since when such samples have agreed with each other.
        self._refused: np.ndarray | None = None
        self._refused_at = self._steady_since = -inf
        self._longest_gap = inf
        self._delay = None if max_delay is None else LatencyMonitor(max_delay)
        self._range = None if signal.size is None else ValueRange(signal)
        self._reach: JumpBounds | None = None
        self._compares = jump_tolerance is not None or self._delay is not None
        if jump_tolerance is not None:
            if signal.size is None:
                raise ValueError(f"the sensor signal {signal.name} is abstract: there is no jump to tolerate")
            rate, tolerance = signal.vector(signal.rate), signal.vector(jump_tolerance)
            if not np.isfinite(rate).all():
                raise ValueError(f"the sensor signal {signal.name} may jump: to tell a jump, it needs a finite rate")
            if not (tolerance >= 0.0).all():
                raise ValueError(f"the jump_tolerance of {signal.name} is not negative, unlike {tolerance.tolist()}")
            self._reach = JumpBounds(rate.tolist(), tolerance.tolist())

    def stale(self, now: float, reception: ReceivedSignal) -> Fault:
        name = self.signal.name
        if not reception.count:
            return Fault(now, name, "stale", f"sensor signal {name} has never arrived")
        age = f"{1e3 * reception.age(now):.1f} ms old, {1e3 * self.max_age:g} allowed"
        return Fault(now, name, "stale", f"sensor signal {name} is stale: {age}")

    def examine(self, now: float, reception: ReceivedSignal) -> Fault | None:
        fault = None
        # Mostly they are not only equal but the same, from the second time on.
        if self._range is not reception.range:
            if self._range == reception.range:
                self._range = reception.range
            else:
                fault = self._implausible(now, reception)
        if not self._compares:
            self.trusted = self._range
        if fault is None and self._delay is not None:
            fault = self._delayed(now, reception, self._delay)
        if fault is None and self._reach is not None:
            fault = self._jump(now, reception, self._reach)
        return fault

    @property
    def steady(self) -> bool:
        """Whether the signal has jumped, and its samples have agreed with each other for `SETTLING` since then."""
        return self._refused is not None and self._refused_at - self._steady_since >= SETTLING

    def accept_steady(self) -> None:
        """Accept the level that the signal has jumped to, if it is steady there.

        To be called when somebody takes the responsibility (a reset by hand), or nothing depends on the signal.
        """
        if self.steady:
            self.accept(self._refused, self._refused_at)
            self._refused = None

    def _implausible(self, now: float, reception: ReceivedSignal) -> Fault | None:
        if self._range is None:
            return None
        name, value = self.signal.name, reception.value
        problem = self._range.check(value)
        if not problem:
            return None
        if problem in ("size", "type"):
            reason = f"sensor signal {name} has the shape {np.shape(value)} instead of ({self.signal.size},)"
        else:
            reason = f"sensor signal {name} leaves its limits: {np.asarray(value).tolist()}"
        return Fault(now, name, "implausible", reason)

    def _jump(self, now: float, reception: ReceivedSignal, reach: JumpBounds) -> Fault | None:
        value = np.asarray(reception.value, dtype=float)
        if self.value is None:
            return None
        accepted = np.asarray(self.value, dtype=float)
        since = max(reception.arrived - self.arrived, 0.0)
        within = since if self._refused is None else min(since, self._longest_gap)
        if reach.contains(accepted, value, within):
            self._refused = None
            return None
        if self._refused is None:
            self._longest_gap = max(since, self.max_age) if isfinite(self.max_age) else since
        if self._refused is None or not reach.contains(self._refused, value, reception.arrived - self._refused_at):
            self._steady_since = reception.arrived
        self._refused, self._refused_at = value, reception.arrived
        reason = (
            f"sensor signal {self.signal.name} jumps within {1e3 * since:.1f} ms from {accepted.tolist()} to "
            f"{value.tolist()}"
        )
        return Fault(now, self.signal.name, "jump", reason)

    def _delayed(self, now: float, reception: ReceivedSignal, delay: LatencyMonitor) -> Fault | None:
        more = delay.of(reception)
        if not more > delay.most:
            return None
        reason = (
            f"sensor signal {self.signal.name} is stale: it took {1e3 * more:.1f} ms longer than the quickest sample, "
            f"{1e3 * delay.most:g} allowed"
        )
        return Fault(now, self.signal.name, "stale", reason)
