"""The rollouts of a problem that a user looks at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.rollout import RolloutResult
from vtbdrake.testbed import Scenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pydrake.geometry import Meshcat

    from vtbdrake.optimization.problem import Problem
    from vtbdrake.visualization import Scene


@dataclass(frozen=True)
class Motion:
    """How the simulated world moved: the plant's states [q; v] at ``times``, shape (n, nq + nv)."""

    scenario: Scenario
    times: np.ndarray
    states: np.ndarray


@dataclass(frozen=True, kw_only=True)
class ProblemRollout(RolloutResult):
    """A rollout that knows its problem, so that it can be looked at."""

    problem: Problem = field(repr=False)
    condition: Mapping[str, Any] = field(default_factory=dict)

    def show(self, meshcat: Meshcat, *, prefix: str = "rollout") -> Scene:
        """Record the motion in ``meshcat`` under ``prefix``; the returned scene shows itself in a notebook."""
        from vtbdrake.visualization import show_motion

        return show_motion(meshcat, self.problem.motion(self.parameters), prefix=prefix)

    def plot(self) -> Figure:
        """The quality trajectory with t* marked (Figure 5)."""
        from vtbdrake.visualization import plot_quality

        return plot_quality([self])
