"""What a command has to keep to before it may be sent: size, finite entries, range, rate and acceleration."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, sqrt
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.control.kernels import Bounds, RateLimiter, finite
from vtbdrake.testbed import Signal

# What stands for "no limit" of a range. Its square is still finite, so that no arithmetic of limits overflows.
_FAR = 1e150

# Of the magnitude of a command: a difference that only comes from how the command was computed is no limiting.
_ROUNDING = 1e-12

_LARGEST = float(np.finfo(float).max)

NOT_STARTED = "has a limit of its rate or acceleration, but no start: say what it departs from"


class CommandFault(ValueError):  # noqa: N818 - a fault is what the guards of a machine call it
    """A command that cannot be sent, whatever the limits.

    Attributes:
        kind: ``size``, ``not finite`` or ``not started``.
    """

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind


@dataclass
class LimitCount:
    """What a limit did.

    Attributes:
        count: how many entries of commands it changed.
        largest: by how much at most, in the signal's unit.
    """

    count: int = 0
    largest: float = 0.0


class CommandLimiter:
    """Keeps the commands of a vector actuator signal within its limits.

    With the period T, the command c, what was sent last s and the step before it x, the step that is sent, w = s' - s,
    keeps, entry by entry,

        |w| <= rate T,    |w - x| <= acceleration T^2,    lower <= s' <= upper,

    and stops in time: after it, steps that shrink by a = acceleration T^2 each come to rest within the range. Since w
    is followed by w - a, w - 2 a, ..., the way that a step takes in all is

        f(w) = sum_{j >= 0} max(0, w - j a),

    and the largest step towards an end at the distance d is the solution of f(w) = d: with the whole number m for which
    a m (m + 1) / 2 <= d < a (m + 1) (m + 2) / 2,

        w = d / (m + 1) + a m / 2,

    which is the known approach speed sqrt(2 acceleration d) in steps. No other limiter is more generous: a sequence of
    commands passes unchanged if and only if it can be continued for ever within the limits. Three limits never
    contradict each other, because what was sent before kept to them too.

    Args:
        signal: its limits count.
        period: T, in seconds: the time from one command to the next.

    Attributes:
        counts: what each limit did, by its name: ``range`` (stopping before its end included), ``rate``,
            ``acceleration``. An entry that several limit counts for the last of rate, acceleration and range.
        has_start: whether there is something that the next command departs from.
    """

    def __init__(self, signal: Signal, *, period: float) -> None:
        if signal.size is None:
            raise ValueError(f"the actuator signal {signal.name} is abstract: only vectors can be limited")
        if not (period > 0.0 and isfinite(period)):
            raise ValueError(f"commands are limited for a positive period, not {period} s")
        self.signal = signal
        self.counts = {name: LimitCount() for name in ("range", "rate", "acceleration")}
        self._size = signal.size
        steps = signal.vector(signal.rate) * period
        changes = signal.vector(signal.acceleration) * period**2
        if not (steps.min() > 1 / _FAR and changes.min() > 1 / _FAR):
            raise ValueError(
                f"signal {signal.name}: its rate {signal.rate} and acceleration {signal.acceleration} leave no step at "
                f"a period of {period} s"
            )
        lower = np.maximum(signal.vector(signal.lower), -_FAR)
        upper = np.minimum(signal.vector(signal.upper), _FAR)
        self._limits: list[tuple[float, float, float, float]] = list(
            zip(steps.tolist(), changes.tolist(), lower.tolist(), upper.tolist(), strict=True)
        )
        self.needs_start = bool(np.isfinite(steps).any() or np.isfinite(changes).any())
        self.has_start = self._had_start = False
        # s and x of above, and what they were before the last command.
        self._state, self._state_before = np.zeros((2, self._size)), np.zeros((2, self._size))
        self._sent, self._step_before = self._state
        self._passage = RateLimiter(self._limits)

    @property
    def last_sent(self) -> NDArray[np.float64] | None:
        """Of shape (size,); None while there is neither a start nor a command."""
        return self._sent.copy() if self.has_start else None

    def start_from(self, value: ArrayLike) -> None:
        """Lets the next command depart from ``value`` (shape (size,)), at rest; out of range, from the range's end.

        Raises:
            CommandFault: it has another size or is not finite.
        """
        self._sent[:] = [
            min(max(entry, lower), upper)
            for entry, (_, _, lower, upper) in zip(self.checked(value).tolist(), self._limits, strict=True)
        ]
        self._step_before[:] = 0.0
        self.has_start = True

    def release(self) -> None:
        """Forgets what was sent: from now on somebody else commands."""
        self.has_start = False

    def take_back(self) -> None:
        """Take the last command for one that was never sent. It needs a command since the last start."""
        self._state[:] = self._state_before
        self.has_start = self._had_start

    def limit(self, command: ArrayLike) -> NDArray[np.float64]:
        """What may be sent for ``command``, of shape (size,); it counts as sent.

        Raises:
            CommandFault: it has another size or is not finite, or a limit of rate or acceleration lacks a start.
        """
        return self.send(self.checked(command))

    def checked(self, command: ArrayLike) -> NDArray[np.float64]:
        """``command`` as an array; nothing is sent.

        Raises:
            CommandFault: as `limit`.
        """
        if finite(command, self._size):
            return command  # type: ignore[return-value]
        try:
            array = np.asarray(command, dtype=float)
        except (TypeError, ValueError) as error:
            raise CommandFault("size", f"is not a vector of {self._size} numbers: {error}") from error
        if array.shape != (self._size,):
            raise CommandFault("size", f"has the shape {array.shape} instead of ({self._size},)")
        if not np.isfinite(array).all():
            raise CommandFault("not finite", f"is not finite: {array.tolist()}")
        return array

    def send(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """As `limit`, for what was `checked`."""
        self._had_start = self.has_start
        if not self.has_start:
            if self.needs_start:
                raise CommandFault("not started", NOT_STARTED)
            self.start_from(values)
        self._state_before[:] = self._state
        passed = self._passage.advance(values, self._sent, self._step_before)
        if passed is not None:
            return passed
        before = self._sent.copy()
        entries = zip(values.tolist(), before.tolist(), self._step_before.tolist(), self._limits, strict=True)
        self._sent[:] = [self._limited(c, s, x, *limits) for c, s, x, limits in entries]
        self._step_before[:] = self._sent - before
        return self._sent.copy()

    def _limited(self, c: float, s: float, x: float, step: float, change: float, lower: float, upper: float) -> float:
        """One entry of what is sent."""
        w, acted = c - s, ""
        if abs(w) > step:
            w, acted = step if w > 0.0 else -step, "rate"
        if abs(w - x) > change:
            w, acted = x + change if w > x else x - change, "acceleration"
        # The range comes last: where rounding makes limits contradict each other, it is the one that holds exactly.
        if w > (most := _longest_step(upper - s, change)):
            w, acted = most, "range"
        elif w < (least := -_longest_step(s - lower, change)):
            w, acted = least, "range"
        # Unless a limit acted, c passes as it is, without the rounding of s + w.
        sent = min(max(s + w if acted else c, lower), upper)
        amount = abs(sent - c)
        if acted and amount > _ROUNDING * (abs(s) + abs(c)):
            count = self.counts[acted]
            count.count += 1
            count.largest = max(count.largest, amount)
        return sent


def _longest_step(d: float, a: float) -> float:
    """The step w with f(w) = d; see `CommandLimiter`."""
    if d <= a:
        return d
    m = (sqrt(1.0 + 8.0 * d / a) - 1.0) // 2.0
    return d / (m + 1.0) + 0.5 * a * m


class PassThrough:
    """Stands for `CommandLimiter` where the actuator signal is abstract: it remembers what was sent, no more."""

    needs_start = False

    def __init__(self, signal: Signal) -> None:
        self.signal = signal
        self.counts: dict[str, LimitCount] = {}
        self.last_sent: Any = None
        self._sent_before: Any = None

    @property
    def has_start(self) -> bool:
        return self.last_sent is not None

    def start_from(self, value: Any) -> None:
        self.last_sent = value

    def release(self) -> None:
        self.last_sent = None

    def take_back(self) -> None:
        self.last_sent = self._sent_before

    def limit(self, command: Any) -> Any:
        return self.send(self.checked(command))

    def checked(self, command: Any) -> Any:
        if command is None:
            raise CommandFault("size", "is None")
        return command

    def send(self, command: Any) -> Any:
        self._sent_before, self.last_sent = self.last_sent, command
        return command


class ValueRange:
    """What a signal's values can be: arrays of its size, finite and within its limits, or objects of its type.

    Attributes:
        lower, upper: of a vector signal, by entry, finite: so what is infinite is not within them.
        box: of both.
    """

    def __init__(self, signal: Signal) -> None:
        self._size = signal.size
        self._type: type | None = None
        self.lower: list[float] = []
        self.upper: list[float] = []
        if signal.size is None:
            self._type = type(signal.abstract_value().get_value())
        else:
            self.lower = np.maximum(signal.vector(signal.lower), -_LARGEST).tolist()
            self.upper = np.minimum(signal.vector(signal.upper), _LARGEST).tolist()
            self.box = Bounds(self.lower, self.upper)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ValueRange) and self._shape() == other._shape()

    def __hash__(self) -> int:
        return hash((self._size, self._type))

    def check(self, value: Any) -> str:
        """Why ``value`` is not one of this signal (``type``, ``size``, ``limits``, ``not finite``); empty if it is."""
        if self._type is not None:
            return "" if isinstance(value, self._type) else "type"
        if self.box.contains(value):
            return ""
        try:
            entries = np.array(value, dtype=float)
        except (TypeError, ValueError):
            return "type"
        if entries.shape != (self._size,):
            return "size"
        if self.box.contains(entries):
            return ""
        return "limits" if np.isfinite(entries).all() else "not finite"

    def _shape(self) -> tuple[Any, ...]:
        return self._size, self._type, self.lower, self.upper
