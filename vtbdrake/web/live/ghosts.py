"""What a session shows beside the present, as ghosts: a preview of other values, and another course."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from vtbdrake.common.failures import FAILURES, one_line
from vtbdrake.web.live.fork import CommandLimits, Differences, Fork

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydrake.systems.framework import Context

    from vtbdrake.recording.recorded_course import RecordedCourse
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import VirtualTestbed
    from vtbdrake.visualization.drawing import Drawing
    from vtbdrake.web.live.scene import LiveScene

# Colours of the ghosts by name: a preview, one that fails, and the course without the intervention, of another branch
# or of a recording.
TINTS = {
    "preview": "#009e73",
    "refused": "#d00000",
    "without": "#0072b2",
    "branch": "#e69f00",
    "recorded": "#9c00c8",
}


@dataclass
class _Preview:
    """A fork that runs ahead, and its ghost."""

    fork: Fork
    end: float
    ghost: Drawing | None
    refused: str = ""

    @property
    def runs(self) -> bool:
        return not (self.refused or self.fork.failure) and self.fork.time < self.end

    def status(self) -> dict[str, Any]:
        return {"time": self.fork.time, "end": self.end, "refused": self.refused or self.fork.failure}


@dataclass
class _OtherCourse:
    """Another course beside the simulation, such as the one without an intervention, and its ghost.

    A branch had been simulated already, perhaps with interventions of its own: it passes through the states that were
    kept of it.
    """

    fork: Fork | RecordedCourse
    differences: Differences
    ghost: Drawing | None
    later: deque[tuple[float, Snapshot]] = field(default_factory=deque)
    is_branch: bool = False
    is_recorded: bool = False

    def advance_to(self, testbed: VirtualTestbed, when: float) -> None:
        while self.later and self.later[0][0] <= when:
            self.fork = Fork(testbed, self.later.popleft()[1])
        self.fork.advance_to(when)

    def status(self) -> dict[str, Any]:
        differences = [(difference.address, difference.time) for difference in self.differences.first]
        return {
            "failure": self.fork.failure,
            "differences": differences,
            "branch": self.is_branch,
            **({"recorded": True} if self.is_recorded else {}),
        }


class Ghosts:
    """The preview of a session, and the course that is compared with the present one; at most one of each.

    Args:
        testbed: The testbed.
        scene: Where they are drawn.
        limits: What a machine would refuse in a preview.
        step: Simulated time between two looks at the limits, in seconds.
        horizon: How far a preview looks ahead, in seconds.
    """

    def __init__(
        self, testbed: VirtualTestbed, scene: LiveScene, limits: CommandLimits, *, step: float, horizon: float
    ) -> None:
        self._testbed, self._scene, self._limits = testbed, scene, limits
        self._step, self._horizon = step, horizon
        self._preview: _Preview | None = None
        self._other: _OtherCourse | None = None

    @property
    def previews(self) -> bool:
        """Return whether there is a preview."""
        return self._preview is not None

    @property
    def runs_ahead(self) -> bool:
        """Return whether a preview has not reached its end yet."""
        return self._preview is not None and self._preview.runs

    def preview_status(self) -> dict[str, Any] | None:
        """Return the status of the preview, see `Frame.preview`."""
        return None if self._preview is None else self._preview.status()

    def comparison_status(self) -> dict[str, Any] | None:
        """Return the status of the other course, see `Frame.comparison`."""
        return None if self._other is None else self._other.status()

    # -- the preview

    def preview(self, state: Snapshot, values: Mapping[str, Any]) -> None:
        """Let a fork of a state run ahead with other values; a preview that is under way begins anew.

        Args:
            state: The snapshot from which the fork runs ahead.
            values: Values by address, set at the beginning of the fork.
        """
        fork = Fork(self._testbed, state, values)
        ghost = self._preview.ghost if self._preview is not None and not self._preview.refused else None
        if ghost is None:
            self.end_preview()
            ghost = self._scene.ghost(fork.context, "preview", TINTS["preview"])
        self._preview = _Preview(fork, fork.time + self._horizon, ghost)

    def run_ahead(self, deadline: float) -> None:
        """Go on with the preview, until a time on the clock of ``time.monotonic``."""
        preview = self._preview
        if preview is None:
            return
        while preview.runs and time.monotonic() < deadline:
            preview.fork.advance_to(min(preview.fork.time + self._step, preview.end))
            preview.refused = preview.fork.failure or next(iter(self._limits.violations(preview.fork.context)), "")
        if preview.refused and preview.ghost is not None and preview.ghost.path != "ghosts/refused":
            preview.ghost.delete()
            preview.ghost = self._scene.ghost(preview.fork.context, "refused", TINTS["refused"])

    def end_preview(self) -> None:
        """End the preview."""
        if self._preview is not None and self._preview.ghost is not None:
            self._preview.ghost.delete()
        self._preview = None

    # -- the other course

    def compare(self, start: Snapshot, later: deque[tuple[float, Snapshot]], *, is_branch: bool) -> None:
        """Let the course from a state on go on beside the present one.

        Args:
            start: The state.
            later: Times and states through which it passes.
            is_branch: Whether the session has left it by going back, not by a change now.
        """
        self.end_comparison()
        fork = Fork(self._testbed, start)
        name = "branch" if is_branch else "without"
        ghost = self._scene.ghost(fork.context, name, TINTS[name])
        self._other = _OtherCourse(fork, Differences(self._testbed), ghost, later, is_branch)

    def compare_recorded(self, course: RecordedCourse) -> None:
        """Let a recorded course go on beside the simulation that has left it."""
        self.end_comparison()
        # What the machine measured differs from any simulation at once: the DPS is compared.
        differences = Differences(self._testbed, only=lambda address: address.startswith(("dps.", "u.")))
        ghost = self._scene.ghost(course.world, "recorded", TINTS["recorded"])
        self._other = _OtherCourse(course, differences, ghost, is_recorded=True)

    def advance_to(self, when: float, present: Context) -> None:
        """Advance the other course to a time, and compare it with the present.

        Args:
            when: The simulated time to which the other course advances, in seconds.
            present: The root context of the present course, at that time.
        """
        other = self._other
        if other is None:
            return
        other.advance_to(self._testbed, when)
        if not other.fork.failure:
            other.differences.compare(present, other.fork.context)

    def end_comparison(self) -> None:
        """End the other course."""
        if self._other is not None and self._other.ghost is not None:
            self._other.ghost.delete()
        self._other = None

    # -- the scene

    def pose(self) -> None:
        """Draw the ghosts; one whose state is not finite has failed."""
        for part in (self._preview, self._other):
            if part is None or part.ghost is None or part.fork.failure:
                continue
            try:
                part.ghost.pose(part.fork.world)
            except FAILURES as error:
                if self._scene.is_alive():
                    part.fork.failure = one_line(error)

    def redraw(self) -> None:
        """Draw the ghosts into a new scene."""
        for part in (self._preview, self._other):
            if part is not None and part.ghost is not None:
                meshcat = self._scene.meshcat
                part.ghost = None if part.fork.failure else part.ghost.again(meshcat, part.fork.world)
