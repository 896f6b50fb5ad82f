"""What tells whether a sensor signal can be relied on."""

from __future__ import annotations

from dataclasses import dataclass
from operator import le

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.control.bridge import Reception
from vtbdrake.testbed import Signal

_LARGEST_FLOAT = float(np.finfo(float).max)

# Up to this size Python's floats are quicker than numpy's calls.
_SMALL = 32


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


class Watchdog:
    """Watches one sensor signal: it has to be fresh, and what it says plausible.

    A signal that never arrived is stale, whatever its maximum age. A vector is plausible if it has the right size and
    all entries are finite and within lower and upper. An implausible sample is a fault until the next one arrives.

    Args:
        signal: its limits count.
        jump_tolerance: a scalar or one per entry, in the signal's unit. If given, entries may change from one accepted
            sample to the next by rate * dt + jump_tolerance, with dt between their arrivals: noise and jitter of the
            arrival are to be tolerated.
    """

    def __init__(self, signal: Signal, *, jump_tolerance: ArrayLike | None = None) -> None:
        self.signal = signal
        self._max_age = signal.max_age
        self._count = -1
        self._fault: Fault | None = None
        self._arrived = -np.inf
        self._value: np.ndarray | None = None
        if jump_tolerance is not None and signal.size is None:
            raise ValueError(f"the sensor signal {signal.name} is abstract: there is no jump to tolerate")
        if signal.size is not None:
            # An infinite limit becomes the largest float, so that one comparison finds what is infinite, too.
            self._lower = np.maximum(signal.vector(signal.lower), -_LARGEST_FLOAT)
            self._upper = np.minimum(signal.vector(signal.upper), _LARGEST_FLOAT)
            self._bounds = self._lower.tolist(), self._upper.tolist()
            self._rate = signal.vector(signal.rate)
            if jump_tolerance is not None and not np.isfinite(self._rate).all():
                raise ValueError(f"the sensor signal {signal.name} may jump: to tell a jump, it needs a finite rate")
            self._tolerates = jump_tolerance is not None
            self._tolerance = signal.vector(0.0 if jump_tolerance is None else jump_tolerance)

    def check(self, now: float, reception: Reception) -> Fault | None:
        """What is wrong with the signal now."""
        if reception.count == 0:
            return Fault(now, self.signal.name, "stale", f"sensor signal {self.signal.name} has never arrived")
        if now - reception.arrived > self._max_age:
            age = reception.age(now)
            reason = (
                f"sensor signal {self.signal.name} is stale: {1e3 * age:.1f} ms old, {1e3 * self._max_age:g} allowed"
            )
            return Fault(now, self.signal.name, "stale", reason)
        if reception.count != self._count:
            self._count = reception.count
            self._fault = self._examine(now, reception) if self.signal.size is not None else None
        return self._fault

    def _examine(self, now: float, reception: Reception) -> Fault | None:
        name, value = self.signal.name, np.asarray(reception.value, dtype=float)
        if value.shape != self._lower.shape:
            reason = f"sensor signal {name} has the shape {value.shape} instead of {self._lower.shape}"
            return Fault(now, name, "implausible", reason)
        if not self._is_within(value):
            return Fault(now, name, "implausible", f"sensor signal {name} leaves its limits: {value.tolist()}")
        return self._jump(now, reception, value) if self._tolerates else None

    def _is_within(self, value: np.ndarray) -> bool:
        if value.size > _SMALL:
            return bool(((value >= self._lower) & (value <= self._upper)).all())
        entries, (lower, upper) = value.tolist(), self._bounds
        return all(map(le, lower, entries)) and all(map(le, entries, upper))

    def _jump(self, now: float, reception: Reception, value: np.ndarray) -> Fault | None:
        before, since = self._value, reception.arrived - self._arrived
        self._value, self._arrived = value.copy(), reception.arrived
        if before is None:
            return None
        excess = abs(value - before) - (self._rate * max(since, 0.0) + self._tolerance)
        if not excess.max() > 0.0:
            return None
        reason = f"sensor signal {self.signal.name} jumps within {1e3 * since:.1f} ms from {before} to {value}"
        return Fault(now, self.signal.name, "jump", reason)
