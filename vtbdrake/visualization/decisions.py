"""Pictures of a decision: the qualities of the candidates (Figures 5 and 6), and their motions (Figure 8)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, to_hex
from matplotlib.figure import Figure

from vtbdrake.reasoning.decision import ELIGIBLE, Candidate, Decision
from vtbdrake.visualization.meshcat import Scene, show_motions, show_poses
from vtbdrake.visualization.plots import FAILED, Picture, draw_trajectory, finish

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

    from vtbdrake.optimization import Motion
    from vtbdrake.reasoning.reasoner import Reasoner

_QUALITIES = colormaps["viridis"]
_CHOSEN = "#d55e00"
_PLAN = "black"


def plot_decision(decision: Decision) -> Figure:
    """Plot the quality of all candidates over time (Figure 5), and over the decided values (Figure 6).

    The chosen candidate is orange, the plan in use black, the others have the colour of their quality. If one number is
    decided, the right plot shows the quality over it; otherwise over the order in which the candidates were tried, with
    the best so far as a line. Crosses are candidates that are not eligible.

    Raises:
        ValueError: No rollout has a quality.
    """
    drawn = [candidate for candidate in decision.candidates if candidate.has_trajectory]
    if not drawn:
        raise ValueError("no rollout of the decision has a quality that could be drawn")
    figure = Picture(10.5, 4.2)
    left, right = figure.subplots(1, 2)
    colors = decision_colors(decision)
    for candidate in sorted(drawn, key=lambda c: _rank(decision, c)):
        width = 2.4 if candidate.number in (0, decision.chosen) else 1.0
        draw_trajectory(left, candidate.rollouts[0], color=colors[candidate.number], width=width)
    left.set(xlabel="time t [s]", ylabel=f"quality f' of {decision.name}", title="Quality trajectories")
    finish(left)
    _draw_qualities(right, decision, colors)
    finish(right)
    return figure


def _draw_qualities(axes: Axes, decision: Decision, colors: Mapping[int, str]) -> None:
    (address, value), *further = decision.candidates[0].values.items()
    single = not further and isinstance(value, float | int | np.floating) and not isinstance(value, bool)
    judged = [candidate for candidate in decision.candidates if np.isfinite(candidate.quality)]
    places = {c.number: float(c.values[address]) if single else float(c.number) for c in judged}
    for candidate in sorted(judged, key=lambda c: _rank(decision, c)):
        place, counts = places[candidate.number], candidate.status == ELIGIBLE
        marker = "*" if candidate.number == decision.chosen else "s" if candidate.number == 0 else "o"
        color = colors[candidate.number] if counts else FAILED
        size = 14 if marker == "*" else 7
        axes.plot(place, candidate.quality, marker if counts else "x", color=color, ms=size, gid=candidate.status)
    if not single:
        eligible = [candidate for candidate in judged if candidate.status == ELIGIBLE]
        best = (np.minimum if decision.minimize else np.maximum).accumulate([c.quality for c in eligible])
        axes.plot([c.number for c in eligible], best, drawstyle="steps-post", color="0.6", lw=1, zorder=1, gid="best")
    title = "Quality over the decision" if single else "Quality in the order of trying, and the best so far"
    axes.set(xlabel=address if single else "candidate", ylabel=decision.name, title=title)


@dataclass(frozen=True)
class GhostMotions:
    """Motions that are shown together, each with a look of its own.

    Attributes:
        motions: Label -> motion.
        colors: Label -> tint, any matplotlib colour; a motion without an entry keeps its own colours.
        opacity: Label -> opacity, in (0, 1].
    """

    motions: Mapping[str, Motion]
    colors: Mapping[str, str]
    opacity: Mapping[str, float]

    @property
    def looks(self) -> dict[str, Any]:
        """Return the arguments ``colors`` and ``opacity`` of what shows motions."""
        return {"colors": self.colors, "opacity": self.opacity}


def decision_ghosts(reasoner: Reasoner, decision: Decision, *, most: int = 6) -> GhostMotions:
    """Return the motions of the candidates as ghosts: coloured by their quality, and the chosen one solid.

    The rollouts are simulated again from the state in which the decision was made.

    Args:
        reasoner: The reasoner that made the decision.
        decision: The decision.
        most: The largest number of candidates, the best first; the plan in use is one of them.

    Raises:
        ValueError: All candidates failed at once, or the mental testbed has no plant.
    """
    if most < 1:
        raise ValueError(f"one candidate is shown at least, not {most}")
    ranked = [candidate for candidate in decision.ranked if candidate.rollouts]
    shown = ranked[:most] if decision.candidates[0] in ranked[:most] else [*ranked[: most - 1], decision.candidates[0]]
    colors = decision_colors(decision)
    labels = {c.number: f"{c.number}{' (plan in use)' if c.number == 0 else ''}" for c in shown}
    motions = {labels[c.number]: reasoner.motion(decision, c.number) for c in shown}
    tints = {labels[c.number]: colors[c.number] for c in shown}
    opacity = {labels[c.number]: 1.0 if c.number == decision.chosen else 0.35 for c in shown}
    return GhostMotions(motions, tints, opacity)


def show_decision(
    meshcat: Meshcat, reasoner: Reasoner, decision: Decision, *, most: int = 6, count: int = 0, prefix: str = "decision"
) -> Scene:
    """Show how the candidates would move: ghosts coloured by their quality, and the chosen one solid.

    The rollouts are simulated again from the state in which the decision was made.

    Args:
        meshcat: The server that shows them.
        reasoner: The reasoner that made the decision.
        decision: The decision.
        most: The largest number of candidates shown, the best first; the plan in use is one of them.
        count: Number of overlaid poses per motion (Figure 8); 0 records the motions instead.
        prefix: The Meshcat path under which they are drawn.

    Raises:
        ValueError: All candidates failed at once, or the mental testbed has no plant.
    """
    ghosts = decision_ghosts(reasoner, decision, most=most)
    if count:
        return show_poses(meshcat, ghosts.motions, count=count, prefix=prefix, **ghosts.looks)
    return show_motions(meshcat, ghosts.motions, prefix=prefix, **ghosts.looks)


def decision_colors(decision: Decision) -> dict[int, str]:
    """Return the colour of each candidate by its number."""
    qualities = [c.quality for c in decision.candidates if np.isfinite(c.quality)]
    norm = Normalize(min(qualities, default=0.0), max(qualities, default=1.0))
    colors = {
        c.number: to_hex(_QUALITIES(float(norm(c.quality)))) if np.isfinite(c.quality) else FAILED
        for c in decision.candidates
    }
    special = {0: _PLAN} | ({decision.chosen: _CHOSEN} if decision.chosen is not None else {})
    return colors | special


def _rank(decision: Decision, candidate: Candidate) -> tuple[bool, bool]:
    """Return a key that draws the plan in use above the others, and the chosen candidate above all."""
    return candidate.number == decision.chosen, candidate.number == 0
