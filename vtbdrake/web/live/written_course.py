"""What somebody has set in a session, as a course that can be computed again."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.rollout.course import Course

if TYPE_CHECKING:
    from vtbdrake.state import Snapshot


@dataclass(frozen=True)
class _WrittenValues:
    """Values that were set from a state on: by the number of the step since then, address -> value."""

    start: Snapshot
    writes: dict[int, dict[str, Any]] = field(default_factory=dict)


def add_writes(writes: dict[str, Any], values: Mapping[str, Any]) -> None:
    """Add values that are set after others of the same instant: a variable is set whole, or by its entries.

    Args:
        writes: Values by address, such as ``dps.goal`` or its entry ``dps.goal[1]``; they are changed.
        values: The later ones.
    """
    for address, value in values.items():
        whole, bracket, index = address.partition("[")
        if bracket and whole in writes:
            array = np.array(writes[whole], dtype=float)
            array.flat[int(index.removesuffix("]"))] = value
            writes[whole] = array.tolist()
            continue
        if not bracket:
            for entry in [entry for entry in writes if entry.startswith(f"{address}[")]:
                del writes[entry]
        writes[address] = value


class WrittenCourse:
    """The last course of a session in which something was set or driven.

    What is set for hours, by a hand in virtual reality, does not fill the memory: the course is kept in two parts, each
    with the state at its beginning, and the older one gives way to a new one.

    Args:
        step: The time between two instants at which the session may be changed, in seconds.
        longest_part: The number of instants with values after which another part begins.
    """

    def __init__(self, step: float, *, longest_part: int = 10_000) -> None:
        self._step, self._longest_part = step, longest_part
        self._driven: Course | None = None
        self._parts: deque[_WrittenValues] = deque(maxlen=2)

    def forget(self, driven: Course | None = None) -> None:
        """Begin anew, behind a course that was driven or without one."""
        self._driven = driven
        self._parts.clear()

    @property
    def needs_state(self) -> bool:
        """Return whether the next values begin a course, or another part of it, at the state before them."""
        return not self._parts or len(self._parts[-1].writes) >= self._longest_part

    def begin(self, start: Snapshot) -> None:
        """Begin a course, or another part of it; a course that was driven is over."""
        self._driven = None
        self._parts.append(_WrittenValues(start))

    def add(self, time: float, values: Mapping[str, Any]) -> None:
        """Add values by address, which were set at a time in seconds to a course that has begun.

        Args:
            time: Simulated time at which they were set, in seconds.
            values: Values by address; they replace earlier ones of the same time.
        """
        part = self._parts[-1]
        add_writes(part.writes.setdefault(self._steps(part.start, time), {}), values)

    def course(self, now: float) -> Course | None:
        """Return the course until now; None if nothing was set or driven."""
        if not self._parts:
            return self._driven
        start = self._parts[0].start
        writes: dict[int, dict[str, Any]] = {}
        for part in self._parts:
            before = self._steps(start, part.start.time)
            for number, values in part.writes.items():
                writes.setdefault(before + number, {}).update(values)
        return Course(start, self._step, tuple(writes.items()), max(self._steps(start, now), 1))

    def _steps(self, start: Snapshot, time: float) -> int:
        return round((time - start.time) / self._step)
