"""What somebody has set in a session, as a course that can be computed again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from vtbdrake.rollout.course import Course

if TYPE_CHECKING:
    from vtbdrake.state import Snapshot


class Interventions:
    """The last course of a session in which something was set or driven.

    Args:
        step: The time between two instants at which the session may be changed, in seconds.
    """

    def __init__(self, step: float) -> None:
        self._step = step
        self._driven: Course | None = None
        self._start: Snapshot | None = None
        self._writes: dict[int, dict[str, Any]] = {}

    def forget(self, driven: Course | None = None) -> None:
        """Begin anew, behind a course that was driven or without one."""
        self._driven, self._start, self._writes = driven, None, {}

    @property
    def begun(self) -> bool:
        """Return whether something was set, so that a course goes on."""
        return self._start is not None

    def begin(self, start: Snapshot) -> None:
        """Begin a course at the state before its first values; one that was driven is over."""
        self.forget()
        self._start = start

    def add(self, time: float, values: Mapping[str, Any]) -> None:
        """Add values by address, which were set at a time in seconds to a course that has begun."""
        self._writes.setdefault(self._steps_until(time), {}).update(values)

    def course(self, now: float) -> Course | None:
        """Return the course until now; None if nothing was set or driven."""
        if self._start is None:
            return self._driven
        return Course(self._start, self._step, tuple(self._writes.items()), max(self._steps_until(now), 1))

    def _steps_until(self, time: float) -> int:
        assert self._start is not None
        return round((time - self._start.time) / self._step)
