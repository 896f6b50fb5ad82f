"""What tells whether a sensor signal can be relied on."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isnan, nan

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.control.bridge import Reception
from vtbdrake.control.kernels import Freshness
from vtbdrake.control.ranges import Range
from vtbdrake.testbed import Signal

# By how many seconds in one the clocks of two computers may drift apart: NTP's largest correction.
_DRIFT = 500e-6


@dataclass(frozen=True, slots=True)
class Fault:
    """Why the machine must not be commanded as the DPS would like.

    Attributes:
        time: when it was found, on the loop's clock, in seconds.
        signal: the one it is about; None if it is about all.
        kind: of a sensor signal ``stale``, ``implausible`` or ``jump``; of an actuator signal ``missing``, ``size``,
            ``not finite``, ``not started`` or ``fallback``; of all ``raised``, ``missed``, ``not ready`` or ``told``.
        reason: one sentence.
    """

    time: float
    signal: str | None
    kind: str
    reason: str

    def __str__(self) -> str:
        return self.reason


class Delay:
    """How much longer than the quickest one a message took, by its sender's clock; the clocks' zeros need not agree.

    Args:
        most: how much longer it may take, in seconds.
    """

    def __init__(self, most: float) -> None:
        self.most = most
        self._least = inf  # of the times from sending to arrival: the clocks' difference is in it
        self._sent = self._arrived = -inf

    def of(self, reception: Reception) -> float:
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


class Watchdog(Freshness):
    """Watches one sensor signal: it has to be fresh, and what it says plausible.

    A signal that never arrived is stale, whatever its maximum age. A vector is plausible if it has the right size and
    all entries are finite and within lower and upper. An implausible sample is a fault until the next one arrives.
    What the bridge has checked by the same limits is not checked again.

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
        self._arrived = -inf
        self._value: np.ndarray | None = None
        self._delay = None if max_delay is None else Delay(max_delay)
        self._range = None if signal.size is None else Range(signal)
        self._tolerates = jump_tolerance is not None
        self._compares = self._tolerates or self._delay is not None
        if jump_tolerance is not None:
            if signal.size is None:
                raise ValueError(f"the sensor signal {signal.name} is abstract: there is no jump to tolerate")
            self._rate = signal.vector(signal.rate)
            if not np.isfinite(self._rate).all():
                raise ValueError(f"the sensor signal {signal.name} may jump: to tell a jump, it needs a finite rate")
            self._tolerance = signal.vector(jump_tolerance)

    def stale(self, now: float, reception: Reception) -> Fault:
        name = self.signal.name
        if not reception.count:
            return Fault(now, name, "stale", f"sensor signal {name} has never arrived")
        age = f"{1e3 * reception.age(now):.1f} ms old, {1e3 * self.max_age:g} allowed"
        return Fault(now, name, "stale", f"sensor signal {name} is stale: {age}")

    def examine(self, now: float, reception: Reception) -> Fault | None:
        fault = None
        # Mostly they are not only equal but the same, from the second time on.
        if self._range is not reception.range:
            if self._range == reception.range:
                self._range = reception.range
            else:
                fault = self._implausible(now, reception)
        if not self._compares:
            self.trusted = self._range
        if fault is None and self._tolerates:
            fault = self._jump(now, reception)
        if fault is None and self._delay is not None:
            fault = self._delayed(now, reception, self._delay)
        return fault

    def _implausible(self, now: float, reception: Reception) -> Fault | None:
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

    def _jump(self, now: float, reception: Reception) -> Fault | None:
        value = np.array(reception.value, dtype=float)
        before, since = self._value, reception.arrived - self._arrived
        self._value, self._arrived = value, reception.arrived
        if before is None:
            return None
        excess = abs(value - before) - (self._rate * max(since, 0.0) + self._tolerance)
        if not excess.max() > 0.0:
            return None
        reason = f"sensor signal {self.signal.name} jumps within {1e3 * since:.1f} ms from {before} to {value}"
        return Fault(now, self.signal.name, "jump", reason)

    def _delayed(self, now: float, reception: Reception, delay: Delay) -> Fault | None:
        more = delay.of(reception)
        if not more > delay.most:
            return None
        reason = (
            f"sensor signal {self.signal.name} is stale: it took {1e3 * more:.1f} ms longer than the quickest sample, "
            f"{1e3 * delay.most:g} allowed"
        )
        return Fault(now, self.signal.name, "stale", reason)
