"""The points of a study as its plots show them: sorted by what is known of them, placed, marked and named."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isnan
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from vtbdrake.optimization.outcome import Trial
from vtbdrake.optimization.parameter import Choice, Dimension
from vtbdrake.visualization.figure import label
from vtbdrake.visualization.trajectories import FAILED

if TYPE_CHECKING:
    from vtbdrake.optimization.study_record import StudyRecord

BEST = "#d6604d"
_BROKEN = "0.45"
_DROPPED = "0.6"


@dataclass(frozen=True)
class Points:
    """The points of a study by what is known of them.

    Attributes:
        kept: they have a value and keep all constraints.
        broken: they have a value, but break a constraint.
        dropped: by racing; their value is only known to be no better than their bound.
        failed: a simulation failed.
    """

    kept: tuple[Trial, ...]
    broken: tuple[Trial, ...]
    dropped: tuple[Trial, ...]
    failed: tuple[Trial, ...]

    @classmethod
    def of(cls, study: StudyRecord) -> Points:
        """
        Raises:
            ValueError: there are none.
        """
        sorted_: dict[str, list[Trial]] = {"kept": [], "broken": [], "dropped": [], "failed": []}
        for trial in study.trials:
            sorted_[_kind(trial)].append(trial)
        if not any(sorted_.values()):
            raise ValueError("the study has no judged points yet, so that there is nothing to draw: run it first")
        return cls(**{kind: tuple(trials) for kind, trials in sorted_.items()})

    @property
    def known(self) -> tuple[Trial, ...]:
        """Those that have a value."""
        return (*self.kept, *self.broken)

    def best_at(self, place: Callable[[Sequence[Trial]], np.ndarray], quality: int, sign: float) -> Points:
        """One point for each place, shape (n, k) for n points: the best there in one quality.

        One that keeps the constraints is better than one that does not, and this better than one without a value.
        """
        groups = (self.kept, self.broken, self.dropped, self.failed)
        trials = [trial for group in groups for trial in group]
        rank = np.repeat(range(4), [len(group) for group in groups])
        worth = np.where(rank < 2, sign * values(trials, quality), 0.0)
        # Sorted from good to bad, the first of each place is the best there.
        order = np.lexsort((-worth, rank))
        _, first = np.unique(place(trials)[order], axis=0, return_index=True)
        chosen = order[first]
        kept, broken, dropped, failed = (
            tuple(trials[k] for k in chosen if rank[k] == group) for group in range(len(groups))
        )
        return Points(kept, broken, dropped, failed)

    def best(self, study: StudyRecord, quality: int) -> Trial | None:
        """The best in one quality; None if no point keeps the constraints."""
        sign = study.signs[quality]
        return max(self.kept, key=lambda trial: sign * trial.values[quality], default=None)


def _kind(trial: Trial) -> str:
    # The bound of a dropped point may be infinite; only a failed simulation gives NaN.
    if any(isnan(value) for value in trial.values):
        return "failed"
    if not trial.exact:
        return "dropped"
    return "kept" if trial.feasible else "broken"


def values(trials: Sequence[Trial], quality: int) -> np.ndarray:
    """The values of one quality, shape (n,)."""
    return np.array([trial.values[quality] for trial in trials], dtype=float)


def name(study: StudyRecord, quality: int) -> str:
    """Of a quality; of a function without a name, h."""
    found = study.names[quality]
    return found if found.isidentifier() else "h(s⁰)"


def quality_label(study: StudyRecord, quality: int) -> str:
    """An axis label: ``energy (cost, worst of 5 conditions)``."""
    described = study.record["problem"]
    conditions = len(described["conditions"])
    remarks = ["cost"] if study.directions[quality] == "minimize" else []
    if conditions > 1:
        # Of a repr: Worst(), CVaR(level=0.2).
        risk = described["risk"].removesuffix("()")
        remarks.append(f"{risk.lower() if risk.isalpha() else risk} of {conditions} conditions")
    return f"{name(study, quality)} ({', '.join(remarks)})" if remarks else name(study, quality)


@dataclass(frozen=True)
class Scale:
    """How the values of a parameter lie on an axis: numbers as they are, options side by side."""

    dimension: Dimension
    unit: str

    @property
    def is_log(self) -> bool:
        return not isinstance(self.dimension, Choice) and self.dimension.log

    def places(self, trials: Sequence[Trial]) -> np.ndarray:
        """Where points lie on the axis, shape (n,)."""
        found = [trial.parameters[self.dimension.address] for trial in trials]
        if isinstance(self.dimension, Choice):
            found = [self.dimension.options.index(self.dimension.check(value)) for value in found]
        return np.array(found, dtype=float)

    def set_up(self, axes: Axes, which: str, *, width: int = 60) -> None:
        """Prepares the axis ``x`` or ``y``: its label, in lines of at most about ``width`` letters, scale and ticks."""
        axis = axes.xaxis if which == "x" else axes.yaxis
        if isinstance(self.dimension, Choice):
            axis.set_ticks(range(len(self.dimension.options)), [str(option) for option in self.dimension.options])
            _limits(axes, which)(-0.5, len(self.dimension.options) - 0.5)
        elif self.is_log:
            (axes.set_xscale if which == "x" else axes.set_yscale)("log")
        elif self.dimension.integer:
            axis.set_major_locator(MaxNLocator(nbins="auto", integer=True))
        axis.set_label_text(_wrapped(label(self.dimension.address, self.unit), width))


def _limits(axes: Axes, which: str) -> Callable[[float, float], Any]:
    return axes.set_xlim if which == "x" else axes.set_ylim


def _wrapped(text: str, width: int) -> str:
    lines = [""]
    for word in text.replace(".", ".\0").replace(" [", "\0 [").split("\0"):
        if lines[-1] and len(lines[-1] + word) > width:
            lines.append("")
        lines[-1] += word
    return "\n".join(line.strip() for line in lines)


def scales(study: StudyRecord) -> dict[str, Scale]:
    """By address."""
    return {p.address: Scale(p, unit) for p, unit in zip(study.parameters, study.units, strict=True)}


def draw_points(
    axes: Axes,
    study: StudyRecord,
    points: Points,
    x: Callable[[Sequence[Trial]], np.ndarray],
    *,
    quality: int,
    **style: Any,
) -> None:
    """All points at the places ``x`` and their values: those that keep the constraints with ``style`` of `scatter`.

    A failed one is a cross at the bottom, one that was dropped a triangle at its bound, or at the edge if that is
    infinite.
    """
    style = {"s": 22, "zorder": 3, "linewidths": 0, **style}
    axes.scatter(x(points.kept), values(points.kept, quality), gid="kept", **style)
    axes.plot(x(points.broken), values(points.broken, quality), gid="broken", **BROKEN_STYLE)
    bounds = values(points.dropped, quality)
    finite = np.isfinite(bounds)
    style_dropped = _dropped_style(study, quality)
    places = x(points.dropped)
    axes.plot(places[finite], bounds[finite], gid="dropped", **style_dropped)
    if not finite.all():
        edge = np.full(np.count_nonzero(~finite), 0.98)
        axes.plot(places[~finite], edge, gid="unbounded", transform=axes.get_xaxis_transform(), **style_dropped)
    # An empty line that is not clipped would take room in the corner of the figure.
    if points.failed:
        bottom = np.full(len(points.failed), 0.03)
        axes.plot(x(points.failed), bottom, gid="failed", transform=axes.get_xaxis_transform(), **_FAILED_STYLE)


BROKEN_STYLE: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "markerfacecolor": "none",
    "markeredgecolor": _BROKEN,
    "markersize": 4.5,
    "markeredgewidth": 0.8,
    "zorder": 2,
}
_DROPPED_STYLE: dict[str, Any] = {
    "linestyle": "none",
    "marker": "v",
    "color": _DROPPED,
    "markersize": 4,
    "markeredgewidth": 0,
    "zorder": 1.5,
}
_FAILED_STYLE: dict[str, Any] = {
    "linestyle": "none",
    "marker": "x",
    "color": FAILED,
    "markersize": 6,
    "markeredgewidth": 1.5,
    "zorder": 3,
    "clip_on": False,
}


# It must stand out from every colour of a map, and from white.
_BROKEN_ON_A_MAP: dict[str, Any] = {
    **BROKEN_STYLE,
    "markeredgecolor": "#f4a582",
    "markersize": 7,
    "markeredgewidth": 1.4,
}


def draw_remarks(axes: Axes, points: Points, x: Scale, y: Scale) -> list[Line2D]:
    """Over two parameters, marks the points whose value does not count, or that have none. Returns legend entries."""
    marks = _marks(points, broken=_BROKEN_ON_A_MAP, dropped=("dropped by racing", _DROPPED_STYLE))
    for gid, trials, style, _ in marks:
        axes.plot(x.places(trials), y.places(trials), gid=gid, **style)
    return _keys(marks)


def point_keys(study: StudyRecord, points: Points) -> list[Line2D]:
    """Legend entries of what `draw_points` marks in a way of its own."""
    dropped = "dropped by racing: no better than this", _dropped_style(study, 0)
    return _keys(_marks(points, broken=BROKEN_STYLE, dropped=dropped))


def _dropped_style(study: StudyRecord, quality: int) -> dict[str, Any]:
    # It points to where the value may be.
    return {**_DROPPED_STYLE, "marker": "v" if study.signs[quality] > 0.0 else "^"}


def _marks(
    points: Points, *, broken: dict[str, Any], dropped: tuple[str, dict[str, Any]]
) -> list[tuple[str, tuple[Trial, ...], dict[str, Any], str]]:
    marks = [
        ("broken", points.broken, broken, "breaks a constraint"),
        ("dropped", points.dropped, dropped[1], dropped[0]),
        ("failed", points.failed, _FAILED_STYLE, "simulation failed"),
    ]
    return [mark for mark in marks if mark[1]]


def _keys(marks: Sequence[tuple[str, tuple[Trial, ...], dict[str, Any], str]]) -> list[Line2D]:
    return [Line2D([], [], label=f"{text} ({len(trials)})", **style) for _, trials, style, text in marks]
