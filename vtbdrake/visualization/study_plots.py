"""Plots of studies: their history, one parameter against the value, two parameters, several qualities."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, PercentFormatter
from matplotlib.tri import Triangulation

from vtbdrake.optimization import Trial
from vtbdrake.optimization.importance import importances
from vtbdrake.optimization.parameter import Choice, Dimension
from vtbdrake.optimization.records import BROKEN, DROPPED, FEASIBLE
from vtbdrake.visualization.plots import FAILED, Picture, draw_mesh, finish, label, mark_best

if TYPE_CHECKING:
    from vtbdrake.optimization.study import Study

BEST = "#d6604d"
_POINTS = "#2166ac"
_BROKEN = "0.45"
_DROPPED = "0.6"
_METHODS = colormaps["tab10"]
_ORDER = colormaps["viridis"]
_ORDER_LABEL = "point, in the order of the study"
# Number of colours of the contours between points.
_LEVELS = 12
# Number of panels side by side.
_PER_ROW = 4


@dataclass(frozen=True)
class Points:
    """The points of a study, grouped by their outcome.

    Attributes:
        feasible: They have a value and keep all constraints.
        broken: They have a value, but break a constraint.
        dropped: Racing dropped them; their value is only known to be no better than their bound.
        failed: A simulation of them failed.
    """

    feasible: tuple[Trial, ...]
    broken: tuple[Trial, ...]
    dropped: tuple[Trial, ...]
    failed: tuple[Trial, ...]

    @classmethod
    def of(cls, study: Study) -> Points:
        """Group the points of a study.

        Raises:
            ValueError: The study has no points.
        """
        sorted_: dict[str, list[Trial]] = {FEASIBLE: [], BROKEN: [], DROPPED: [], "failed": []}
        for trial in study.trials:
            sorted_[trial.kind].append(trial)
        if not any(sorted_.values()):
            raise ValueError("the study has no judged points yet, so that there is nothing to draw: run it first")
        return cls(**{kind: tuple(trials) for kind, trials in sorted_.items()})

    @property
    def valued(self) -> tuple[Trial, ...]:
        """Return the points that have a value."""
        return (*self.feasible, *self.broken)

    def best_at(self, place: Callable[[Sequence[Trial]], np.ndarray], quality: int, sign: float) -> Points:
        """Return the best point in one quality at each of the places, which have shape (n, k) for n points.

        One that keeps the constraints is better than one that does not, and this better than one without a value.

        Args:
            place: Function of n points that returns their places, shape (n, k).
            quality: Number of the quality.
            sign: 1.0 if larger values are better, -1.0 for a cost.
        """
        groups = (self.feasible, self.broken, self.dropped, self.failed)
        trials = [trial for group in groups for trial in group]
        rank = np.repeat(range(4), [len(group) for group in groups])
        worth = np.where(rank < 2, sign * values(trials, quality), 0.0)
        # Sorted from good to bad, the first of each place is the best there.
        order = np.lexsort((-worth, rank))
        _, first = np.unique(place(trials)[order], axis=0, return_index=True)
        best = order[first]
        feasible, broken, dropped, failed = (
            tuple(trials[k] for k in best if rank[k] == group) for group in range(len(groups))
        )
        return Points(feasible, broken, dropped, failed)

    def best(self, study: Study, quality: int) -> Trial | None:
        """Return the best point in one quality; None if no point keeps the constraints and is allowed.

        Args:
            study: The study.
            quality: Number of the quality.
        """
        sign = study.signs[quality]
        return max(self.candidates(study), key=lambda trial: sign * trial.values[quality], default=None)

    def candidates(self, study: Study) -> tuple[Trial, ...]:
        """Return the points that keep the constraints, and lie in no region that is forbidden now."""
        allows = study.search.allows
        return tuple(trial for trial in self.feasible if allows(trial.point))


def values(trials: Sequence[Trial], quality: int) -> np.ndarray:
    """Return the values of one quality, shape (n,).

    Args:
        trials: The n points.
        quality: Number of the quality.
    """
    return np.array([trial.values[quality] for trial in trials], dtype=float)


def quality_label(study: Study, quality: int) -> str:
    """Return an axis label such as ``energy [J] (cost, worst of 5 conditions)``.

    Args:
        study: The study.
        quality: Number of the quality.
    """
    described = study.record["problem"]
    conditions = len(described["conditions"])
    remarks = ["cost"] if study.directions[quality] == "minimize" else []
    if conditions > 1:
        # From a repr: Worst(), CVaR(level=0.2).
        risk = described["risk"].removesuffix("()")
        remarks.append(f"{risk.lower() if risk.isalpha() else risk} of {conditions} conditions")
    name = label(study.names[quality], study.quality_units[quality])
    return f"{name} ({', '.join(remarks)})" if remarks else name


@dataclass(frozen=True)
class Scale:
    """The axis of a parameter: numbers as they are, options side by side.

    Attributes:
        dimension: The parameter.
        unit: Its unit.
    """

    dimension: Dimension
    unit: str

    @property
    def is_log(self) -> bool:
        return not isinstance(self.dimension, Choice) and self.dimension.log

    def places(self, trials: Sequence[Trial]) -> np.ndarray:
        """Return the positions of points on the axis, shape (n,)."""
        positions = [trial.parameters[self.dimension.address] for trial in trials]
        if isinstance(self.dimension, Choice):
            positions = [self.dimension.options.index(self.dimension.as_value(value)) for value in positions]
        return np.array(positions, dtype=float)

    def set_up(self, axes: Axes, which: str, *, width: int = 60) -> None:
        """Set label (wrapped after about ``width`` letters), scale and ticks of the axis ``x`` or ``y``.

        Args:
            axes: The axes whose axis is set up.
            which: ``x`` or ``y``.
            width: Number of letters after which the label is wrapped.
        """
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


def scales(study: Study) -> dict[str, Scale]:
    """Return the axis of each parameter, by address."""
    return {p.address: Scale(p, unit) for p, unit in zip(study.parameters, study.units, strict=True)}


def draw_points(
    axes: Axes, study: Study, points: Points, x: Callable[[Sequence[Trial]], np.ndarray], *, quality: int, **style: Any
) -> None:
    """Draw all points at the places ``x`` and their values.

    A failed one is a cross at the bottom, one that was dropped a triangle at its bound, or at the edge if that is
    infinite.

    Args:
        axes: The axes to draw into.
        study: The study of the points, which tells the direction of the quality.
        points: The points.
        x: Function of n points that returns their places, shape (n,).
        quality: Number of the quality, the y of the points.
        style: Keyword arguments of matplotlib's ``scatter`` for the feasible points, such as ``color``.
    """
    style = {"s": 22, "zorder": 3, "linewidths": 0, **style}
    axes.scatter(x(points.feasible), values(points.feasible, quality), gid="kept", **style)
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


_MARK: dict[str, Any] = {"ls": "none", "marker": "o", "zorder": 3}
BROKEN_STYLE: dict[str, Any] = {**_MARK, "mfc": "none", "mec": _BROKEN, "ms": 4.5, "mew": 0.8, "zorder": 2}
_DROPPED_STYLE: dict[str, Any] = {**_MARK, "marker": "v", "color": _DROPPED, "ms": 4, "mew": 0, "zorder": 1.5}
_FAILED_STYLE: dict[str, Any] = {**_MARK, "marker": "x", "color": FAILED, "ms": 6, "mew": 1.5, "clip_on": False}
# It must stand out from every colour of a map, and from white.
_BROKEN_ON_A_MAP: dict[str, Any] = {**BROKEN_STYLE, "mec": "#f4a582", "ms": 7, "mew": 1.4}


def draw_remarks(axes: Axes, points: Points, x: Scale, y: Scale) -> list[Line2D]:
    """Mark the points over two parameters that have no valid value, and return legend entries.

    Args:
        axes: The axes to draw into.
        points: The points.
        x: The axis of the first parameter.
        y: The axis of the second one.
    """
    marks = _marks(points, broken=_BROKEN_ON_A_MAP, dropped=("dropped by racing", _DROPPED_STYLE))
    for gid, trials, style, _ in marks:
        axes.plot(x.places(trials), y.places(trials), gid=gid, **style)
    return _keys(marks)


def point_keys(study: Study, points: Points) -> list[Line2D]:
    """Return the legend entries of the marks that `draw_points` makes.

    Args:
        study: The study of the points, which tells the direction of the quality.
        points: The points; groups without any have no entry.
    """
    dropped = "dropped by racing: no better than this", _dropped_style(study, 0)
    return _keys(_marks(points, broken=BROKEN_STYLE, dropped=dropped))


def _dropped_style(study: Study, quality: int) -> dict[str, Any]:
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


def plot_landscape(study: Study, *addresses: str) -> Figure:
    """Plot every quality over one or two parameters; if others vary too, the best value at each place.

    Over two: an image where the points fill a grid; else filled contours between the points if nothing but these two
    numbers varies (between points that differ in more there is nothing to interpolate), and the points in colour.

    Args:
        study: The study to draw.
        addresses: One or two parameters; by default all of a study that has one or two.

    Raises:
        ValueError: There are no points, an address is none of the study's parameters, or there are not one or two.
    """
    points = Points.of(study)
    scale_of = scales(study)
    addresses = addresses or tuple(scale_of)
    for address in addresses:
        if address not in scale_of:
            raise ValueError(f"{address} is no parameter of the study; those are {', '.join(scale_of)}")
    if not 1 <= len(addresses) <= 2 or len(set(addresses)) < len(addresses):
        raise ValueError(
            f"a landscape lies over one or two different parameters, not over {', '.join(addresses)}: name two of "
            "them, plot_landscape(first, second)"
        )
    count = len(study.names)
    figure = Picture(7.2 if count == 1 else 6.0 * count, 5.4 if len(addresses) == 2 else 4.6)
    draw = _draw_surface if len(addresses) == 2 else _draw_line
    shown = [scale_of[address] for address in addresses]
    for quality, axes in enumerate(figure.subplots(1, count, squeeze=False)[0]):
        handles = draw(axes, study, points, *shown, quality=quality, num_others=len(scale_of) - len(addresses))
        _legend_with_best(axes, study, points, addresses, handles, quality=quality)
    return figure


def draw_slice(
    axes: Axes, study: Study, points: Points, scale: Scale, *, quality: int, width: int = 60, **style: Any
) -> None:
    """Draw one quality over one parameter, with the best point.

    Points are coloured by their order unless ``style`` has a color.

    Args:
        axes: The axes to draw into.
        study: The study.
        points: Its points.
        scale: The axis of the parameter.
        quality: Number of the quality, the y of the points.
        width: Number of letters after which the label of the parameter is wrapped.
        style: Keyword arguments of matplotlib's ``scatter`` for the feasible points.
    """
    if "color" not in style:
        style["c"] = [trial.number for trial in points.feasible]
    draw_points(axes, study, points, scale.places, quality=quality, **style)
    best = points.best(study, quality)
    if best is not None:
        mark_best(axes, float(scale.places([best])[0]), best.values[quality], size=13)
    scale.set_up(axes, "x", width=width)
    finish(axes)


def _draw_line(
    axes: Axes, study: Study, points: Points, scale: Scale, *, quality: int, num_others: int
) -> list[Artist]:
    """Draw the values and return legend entries."""
    draw_slice(axes, study, points, scale, quality=quality, color=_POINTS)
    axes.set_ylabel(quality_label(study, quality))
    best = points.best_at(lambda trials: scale.places(trials)[:, None], quality, study.signs[quality])
    handles: list[Artist] = []
    # Where nearly every point has a place of its own, the best at each is no curve.
    if not isinstance(scale.dimension, Choice) and (not num_others or 2 * len(best.valued) <= len(points.valued)):
        order = np.argsort(scale.places(best.valued))
        text = f"the best over {_count(num_others)}" if num_others else None
        at, h = scale.places(best.valued)[order], values(best.valued, quality)[order]
        (line,) = axes.plot(at, h, color=_POINTS, lw=1.2, zorder=2, label=text, gid="h")
        handles = [line] if num_others else []
    return [*handles, *point_keys(study, points)]


def _draw_surface(
    axes: Axes, study: Study, points: Points, x: Scale, y: Scale, *, quality: int, num_others: int
) -> list[Artist]:
    """Draw the values and return legend entries."""
    sign = study.signs[quality]
    # Bright is good.
    style: dict[str, Any] = {"cmap": colormaps["viridis" if sign > 0.0 else "viridis_r"]}

    def places(trials: Sequence[Trial]) -> np.ndarray:
        return np.column_stack([x.places(trials), y.places(trials)])

    best = points.best_at(places, quality, sign)
    x.set_up(axes, "x")
    y.set_up(axes, "y")
    numbers = not any(isinstance(scale.dimension, Choice) for scale in (x, y))
    everywhere = (*best.valued, *best.dropped, *best.failed)
    (xs, column), (ys, row) = (np.unique(column, return_inverse=True) for column in places(everywhere).T)
    h = values(best.valued, quality)
    if len(everywhere) == xs.size * ys.size and min(xs.size, ys.size) > 1:
        image = np.full((ys.size, xs.size), np.nan)
        image[row[: h.size], column[: h.size]] = h
        lines = numbers and min(image.shape) > 2
        drawn: ScalarMappable = draw_mesh(axes, xs, ys, image, log=(x.is_log, y.is_log), lines=lines, **style)
    else:
        at = places(best.valued)
        if h.size:
            style.update(vmin=h.min(), vmax=h.max())
        if not num_others and numbers and _spans_a_plane(unit := _unit(at, x, y)):
            triangles = Triangulation(at[:, 0], at[:, 1], Triangulation(unit[:, 0], unit[:, 1]).triangles)
            axes.tricontourf(triangles, h, levels=_LEVELS, alpha=0.85, **style)
        marks: dict[str, Any] = {"s": 26, "edgecolors": "white", "linewidths": 0.5, "zorder": 2, "gid": "h"}
        drawn = axes.scatter(at[:, 0], at[:, 1], c=h, **marks, **style)
    handles = draw_remarks(axes, best, x, y)
    winner = points.best(study, quality)
    if winner is not None:
        mark_best(axes, *places([winner])[0])
    axes.figure.colorbar(drawn, ax=axes, label=quality_label(study, quality), pad=0.02)
    if num_others:
        axes.set_title(f"at each place, the best over {_count(num_others)}", fontsize="medium")
    return [*handles]


def _count(num_others: int) -> str:
    return f"{num_others} other parameter{'s' * (num_others > 1)}"


def _unit(places: np.ndarray, x: Scale, y: Scale) -> np.ndarray:
    """Return places in the unit square, where parameters of different units and scales are comparable."""
    columns = zip((x, y), places.T, strict=True)
    return np.column_stack([[scale.dimension.to_unit(value) for value in column] for scale, column in columns])


def _spans_a_plane(unit: np.ndarray) -> bool:
    return len(unit) >= 3 and bool(np.linalg.matrix_rank(unit - unit[0], tol=1e-6) == 2)


def _legend_with_best(
    axes: Axes, study: Study, points: Points, addresses: Sequence[str], handles: Sequence[Artist], *, quality: int
) -> None:
    best = points.best(study, quality)
    if best is not None:
        (star,) = (line for line in axes.get_lines() if line.get_gid() == "best")
        at = ", ".join(_text(best.parameters[address]) for address in addresses)
        star.set_label(f"s⁰* = [{at}], {study.names[quality]} = {best.values[quality]:.4g}")
        handles = [star, *handles]
    if handles:
        where: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.13)}
        axes.legend(handles=handles, fontsize="small", ncols=2, frameon=False, **where)


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def plot_history(study: Study) -> Figure:
    """Plot every quality in the order of the points, coloured by solver, with the best value so far.

    Points that have been forbidden since are not among the best, as in `Study.best`.

    Raises:
        ValueError: There are no points.
    """
    points = Points.of(study)
    trials = study.trials
    candidates = points.candidates(study)
    methods = Counter(trial.method for trial in trials)
    colors = {method: _METHODS(k % 10) for k, method in enumerate(methods)}
    count = len(study.names)
    figure = Picture(8.0, 1.6 + 2.6 * count)
    for quality, axes in enumerate(figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]):
        draw_points(
            axes,
            study,
            points,
            lambda trials: np.array([trial.number for trial in trials], dtype=float),
            quality=quality,
            c=[colors[trial.method] for trial in points.feasible],
        )
        if candidates:
            numbers = np.array([trial.number for trial in candidates])
            best = study.signs[quality] * np.maximum.accumulate(study.signs[quality] * values(candidates, quality))
            # The last best value holds up to the last point.
            numbers, best = np.append(numbers, trials[-1].number), np.append(best, best[-1])
            axes.plot(numbers, best, color=BEST, drawstyle="steps-post", lw=1.4, gid="best so far", zorder=2.5)
        axes.set_ylabel(quality_label(study, quality))
        axes.xaxis.set_major_locator(MaxNLocator(nbins="auto", integer=True))
        finish(axes)
    axes.set_xlabel(_ORDER_LABEL)
    handles = [
        Line2D([], [], marker="o", ls="none", ms=5, color=colors[method], label=f"{method} ({number})")
        for method, number in methods.items()
    ]
    if candidates:
        handles.append(Line2D([], [], color=BEST, lw=1.4, label="best so far"))
    _legend(figure, [*handles, *point_keys(study, points)])
    return figure


def plot_slices(study: Study) -> Figure:
    """Plot every quality over every parameter, coloured by the order of the points; the best point is a star.

    Raises:
        ValueError: There are no points.
    """
    points = Points.of(study)
    axis_of = scales(study)
    columns = min(_PER_ROW, len(axis_of))
    rows_per_quality = -(-len(axis_of) // columns)
    count = len(study.names)
    figure = Picture(2.0 + 2.6 * columns, 1.2 + 2.8 * rows_per_quality * count)
    grid = figure.subplots(rows_per_quality * count, columns, squeeze=False)
    norm = Normalize(0, max(1, study.trials[-1].number))
    for quality in range(count):
        panels = grid[quality * rows_per_quality : (quality + 1) * rows_per_quality].ravel()
        for k, (axes, scale) in enumerate(zip(panels, axis_of.values(), strict=False)):
            draw_slice(axes, study, points, scale, quality=quality, cmap=_ORDER, norm=norm, width=26)
            if k:
                axes.sharey(panels[0])
            if k % columns == 0:
                axes.set_ylabel(quality_label(study, quality))
            else:
                axes.tick_params(labelleft=False)
        for axes in panels[len(axis_of) :]:
            axes.set_axis_off()
    figure.colorbar(
        ScalarMappable(norm, _ORDER), ax=grid, ticks=MaxNLocator(integer=True), label=_ORDER_LABEL, pad=0.02
    )
    _legend(figure, [*_best_key(points), *point_keys(study, points)])
    return figure


def plot_importances(study: Study) -> Figure:
    """Plot how much each parameter decides whether a point is among the best tenth, for every quality.

    See `vtbdrake.optimization.importance.importances`.

    Raises:
        ValueError: There are too few points with a value, or they all have the same.
    """
    shares = importances(study)
    figure = Picture(8.0, 0.6 + len(shares) * (0.8 + 0.4 * len(study.parameters)))
    points = Points.of(study)
    for quality, axes in enumerate(figure.subplots(len(shares), 1, squeeze=False)[:, 0]):
        addresses = list(shares[quality])
        bars = axes.barh(addresses, list(shares[quality].values()), color=_POINTS, height=0.6, gid="importance")
        axes.bar_label(bars, fmt=lambda share: f"{share:.1%}", padding=4, fontsize="small")
        axes.invert_yaxis()
        axes.set_xlim(0.0, 1.1 * max(shares[quality].values()))
        axes.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        axes.set_title(
            f"{study.names[quality]}: what decides whether a point is among the best tenth", fontsize="medium"
        )
        finish(axes)
        axes.grid(False, axis="y")
    axes.set_xlabel(f"share of the importance (PED-ANOVA on {len(points.valued)} of {len(study.trials)} points)")
    return figure


def plot_pareto(study: Study) -> Figure:
    """Plot two qualities against each other with the Pareto front; of three qualities, every pair.

    Raises:
        ValueError: There are no points, or not two or three qualities.
    """
    points = Points.of(study)
    count = len(study.names)
    if not 2 <= count <= 3:
        remedy = "plot_history shows one" if count == 1 else "plot_slices shows them one by one"
        raise ValueError(f"a Pareto front is drawn of two or three qualities, but the study has {count}: {remedy}")
    pairs = list(combinations(range(count), 2))
    figure = Picture(7.2 if len(pairs) == 1 else 4.4 * len(pairs), 5.2)
    front = study.pareto()
    for axes, (i, j) in zip(figure.subplots(1, len(pairs), squeeze=False)[0], pairs, strict=True):
        _draw_pair(axes, study, points, (i, j))
        front_xy = np.array([[trial.values[i], trial.values[j]] for trial in front]).reshape(-1, 2)
        front_xy = front_xy[np.argsort(front_xy[:, 0], kind="stable")]
        # With three qualities the front is a surface, whose edge is not what a line would show.
        line = {"ls": "-" if count == 2 else "none", "drawstyle": "steps-pre" if study.signs[i] > 0.0 else "steps-post"}
        axes.plot(
            *front_xy.T, color=BEST, marker="o", ms=6, mec="white", mew=0.6, lw=1.0, zorder=4, gid="front", **line
        )
        axes.set(xlabel=quality_label(study, i), ylabel=quality_label(study, j))
        finish(axes)
    handles = [
        Line2D([], [], color=BEST, marker="o", ls="none", label=f"Pareto front ({len(front)})"),
        Line2D([], [], color=_POINTS, marker="o", ls="none", ms=5, alpha=0.6, label="other points"),
    ]
    _legend(figure, [*handles, *point_keys(study, replace(points, failed=()))])
    if points.failed:
        figure.suptitle(f"not shown: {len(points.failed)} points whose simulation failed", fontsize="medium")
    return figure


def _draw_pair(axes: Axes, study: Study, points: Points, pair: tuple[int, int]) -> None:
    i, j = pair
    axes.scatter(
        values(points.feasible, i), values(points.feasible, j), s=22, color=_POINTS, alpha=0.6, linewidths=0, gid="kept"
    )
    axes.plot(values(points.broken, i), values(points.broken, j), gid="broken", **BROKEN_STYLE)


def _best_key(points: Points) -> list[Line2D]:
    if not points.feasible:
        return []
    return [Line2D([], [], marker="*", ls="none", color=BEST, ms=11, mec="white", label="best")]


def _legend(figure: Figure, handles: list[Line2D]) -> None:
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize="small", frameon=False)
