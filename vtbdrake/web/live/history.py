"""The states that a session keeps, to go back to."""

from __future__ import annotations

from collections import deque
from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from vtbdrake.state import Snapshot

# Simulated time within which a state lies at the time that is asked for, in seconds.
_ROUNDING = 1e-9


class History:
    """States of one course in the order of their times; those after the present are its future until it is left.

    Args:
        period: Wall time between two states that are kept, in seconds.
        size: Number of states that are kept; older ones are forgotten.
    """

    def __init__(self, *, period: float, size: int) -> None:
        self._period = period
        self._states: deque[tuple[float, Snapshot]] = deque(maxlen=size)
        self._kept_at = -inf

    def __bool__(self) -> bool:
        return bool(self._states)

    def clear(self) -> None:
        """Forget all states."""
        self._states.clear()
        self._kept_at = -inf

    def keep(self, time: float, state: Callable[[], Snapshot], wall: float) -> None:
        """Keep the state of a time in seconds, if the period has passed and the time is behind all that is kept.

        Args:
            time: Simulated time of the state, in seconds.
            state: Returns the state; it is called only if the state is kept.
            wall: The present wall time, in seconds, on a clock that does not go back.
        """
        if wall - self._kept_at < self._period:
            return
        if not self._states or time > self._states[-1][0]:
            self._states.append((time, state()))
        self._kept_at = wall

    def reaches_beyond(self, time: float) -> bool:
        """Return whether a later state is kept: the session has gone back."""
        return bool(self._states) and self._states[-1][0] > time

    def later(self, time: float) -> deque[tuple[float, Snapshot]]:
        """Return time and state of what is kept after a time, in their order."""
        return deque(entry for entry in self._states if entry[0] > time)

    def forget_after(self, time: float) -> None:
        """Forget the states after a time."""
        while self.reaches_beyond(time):
            self._states.pop()

    def at(self, time: float) -> Snapshot:
        """Return the last state at or before a time; the first one, if there is none. One must be kept."""
        earlier = [state for when, state in self._states if when <= time + _ROUNDING]
        return earlier[-1] if earlier else self._states[0][1]

    def reach(self, now: float) -> tuple[float, float]:
        """Return the first and the last time that is kept; ``now`` for both if there is none."""
        return (self._states[0][0], self._states[-1][0]) if self._states else (now, now)
