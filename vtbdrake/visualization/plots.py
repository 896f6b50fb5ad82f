"""Plots of rollouts and sweeps: quality trajectories (Figure 5), and h over the parameters (Figure 6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.typing import ColorType

from vtbdrake.common.summary_html import png_of
from vtbdrake.optimization.boundary import why_no_boundary
from vtbdrake.optimization.parameter import short_address
from vtbdrake.rollout import Quality, RolloutResult

if TYPE_CHECKING:
    from vtbdrake.optimization import Boundary, Sweep


class Picture(Figure):
    """A matplotlib Figure that pyplot does not know.

    pyplot would keep it in memory, open a window on a desktop, and in a notebook show it beside the returned value.

    Args:
        width: The width, in inches.
        height: The height, in inches.
    """

    def __init__(self, width: float, height: float) -> None:
        super().__init__(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(self)

    def _repr_png_(self) -> bytes:
        return png_of(self)


def label(name: str, unit: str) -> str:
    """Return an axis label such as ``sim.sys.payload.mass [kg]``; without brackets if there is no unit.

    Args:
        name: The name of the quantity, such as an address.
        unit: Its unit; empty or ``"1"`` for numbers without one.
    """
    return name if unit in ("", "1") else f"{name} [{unit}]"


def finish(axes: Axes) -> None:
    """Draw a pale grid, and remove the frame above and to the right."""
    axes.grid(True, color="0.9", lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


@dataclass(frozen=True)
class _Words:
    """Return the name of a quality, or of a cost, in a plot."""

    symbol: str  # of the trajectory
    noun: str
    limit: str  # of the threshold
    beyond: str  # how a sample in G1 compares with the threshold
    passed: str  # what happened to the threshold there
    name: str = ""  # of the function
    unit: str = ""

    @classmethod
    def of(cls, *, minimize: bool, name: str = "", unit: str = "") -> _Words:
        """Return the words for a quality, or for a cost if ``minimize``."""
        return replace(_COST if minimize else _QUALITY, name="" if name == "f" else name, unit=unit)

    @property
    def title(self) -> str:
        return f"{self.noun.capitalize()} trajectories"

    @property
    def trajectory(self) -> str:
        """Return the label of the axis of a trajectory."""
        name = f"{self.name}: " if self.name else ""
        return label(f"{name}{self.noun} {self.symbol}(s⁰, t)", self.unit)

    @property
    def result(self) -> str:
        """Return the label of the axis of h, or of the cost at t*."""
        return "cost c(s⁰, t*)" if self.symbol == "c" else "h(s⁰) = f'(s⁰, t*)"


_QUALITY = _Words("f'", "quality", "f_m", ">", "exceeded")
_COST = _Words("c", "cost", "c_m", "<", "reached")

MARKERS = "osD^vP*X<>hp"
STYLES: tuple[tuple[float, Sequence[float]], ...] = (
    (0, ()),
    (0, (4, 1.5)),
    (0, (1, 1.2)),
    (0, (5, 1.5, 1, 1.5)),
    (0, (8, 2)),
)
FAILED = "#b2182b"
THRESHOLD = "#555555"


def is_two_valued(rollouts: Sequence[RolloutResult]) -> bool:
    """Return whether f' takes only two values (an event such as tipping over): their trajectories would overlap."""
    return len(rollouts) > 1 and np.unique(_qualities(rollouts)).size <= 2


def _qualities(rollouts: Sequence[RolloutResult]) -> np.ndarray:
    return np.concatenate([np.empty(0), *(rollout.quality for rollout in rollouts)])


def draw_trajectory(
    axes: Axes, rollout: RolloutResult, *, color: ColorType, style: int = 0, width: float = 1.4, name: str | None = None
) -> None:
    """Draw f' over time, with t* as a marker; a failed rollout ends with a cross.

    Args:
        axes: The axes to draw into, with time in seconds as x.
        rollout: The rollout, with its samples of the quality or of the cost.
        color: Colour of line and marker.
        style: Number of the style of the line and of the marker, see `STYLES` and `MARKERS`, modulo their numbers.
        width: Width of the line in points.
        name: Its name in the legend; None: it has no entry.
    """
    times = rollout.times[: rollout.quality.size]
    steps = "steps-post" if np.unique(rollout.quality).size <= 2 else "default"
    (line,) = axes.plot(times, rollout.quality, color=color, lw=width, label=name, drawstyle=steps)
    line.set_linestyle(STYLES[style % len(STYLES)])
    line.set_gid("trajectory")
    if rollout.failed and times.size:
        axes.plot(times[-1], rollout.quality[-1], "x", color=FAILED, ms=7, mew=2, gid="failed", clip_on=False, zorder=3)
    elif not rollout.failed:
        draw_t_star(axes, rollout.t_star, rollout.h, color=color, style=style)


def draw_t_star(axes: Axes, t_star: float, height: float, *, color: ColorType, style: int = 0) -> None:
    """Mark t*.

    Args:
        axes: The axes to draw into.
        t_star: The time t*, in seconds.
        height: The y of the mark.
        color: Colour of the mark.
        style: Number of its form, see `MARKERS`, modulo their number.
    """
    mark: dict[str, Any] = {"marker": MARKERS[style % len(MARKERS)], "mec": "black", "mew": 0.6, "ms": 6}
    axes.plot(t_star, height, color=color, zorder=3, clip_on=False, gid="t_star", **mark)


def draw_bars(
    axes: Axes,
    rollouts: Sequence[RolloutResult],
    heights: np.ndarray,
    *,
    colors: Sequence[ColorType],
    styles: Sequence[int],
    words: _Words,
) -> None:
    """Draw two-valued trajectories as bars at ``heights``: thin at the lower value of f', thick at the upper one.

    t* is marked where h is the upper value. A failed rollout ends with a cross.

    Args:
        axes: The axes to draw into, with time in seconds as x.
        rollouts: The rollouts, whose f' takes only two values, see `is_two_valued`.
        heights: The y of each bar, shape (rollouts,).
        colors: Colour of each bar.
        styles: Number of the form of each t*, see `MARKERS`.
        words: The words for a quality, or for a cost, in the legend.
    """
    values = _qualities(rollouts)
    lower, upper = (values.min(), values.max()) if values.size else (0.0, 0.0)
    for rollout, height, color, style in zip(rollouts, heights, colors, styles, strict=True):
        times, high = rollout.times[: rollout.quality.size], rollout.quality > lower
        if not times.size:
            axes.plot(0.0, height, "x", color=FAILED, ms=6, mew=2, gid="failed", clip_on=False)
            continue
        axes.plot([0.0, times[-1]], [height, height], color=color, lw=1.0, alpha=0.6, gid="bar")
        # A sample holds until the next one.
        begins, ends = times[:-1][high[:-1]], times[1:][high[:-1]]
        axes.hlines(np.full(begins.size, height), begins, ends, colors=color, lw=4, alpha=0.6)
        if rollout.failed:
            axes.plot(times[-1], height, "x", color=FAILED, ms=6, mew=2, gid="failed", clip_on=False)
        elif rollout.h > lower:
            draw_t_star(axes, rollout.t_star, height, color=color, style=style)
    handles = [_key(f"{words.symbol} = {lower:g}", color="0.4", lw=1)]
    if upper > lower:
        handles.append(_key(f"{words.symbol} = {upper:g}", color="0.4", lw=4))
    handles += keys(words, failed=any(rollout.failed for rollout in rollouts))
    axes.legend(handles=handles, fontsize="small", loc="best")
    axes.set(xlabel="time t [s]", title=f"{words.title} {words.symbol}(s⁰, t) of two values")


def draw_threshold(axes: Axes, threshold: float) -> None:
    """Draw f_m as a line, if it is finite.

    Args:
        axes: The axes to draw into, with f' or the cost as y.
        threshold: The threshold f_m; infinite: none.
    """
    if np.isfinite(threshold):
        axes.axhline(threshold, color=THRESHOLD, lw=1, ls=(0, (4, 2)), gid="threshold", zorder=1)


def keys(words: _Words, *, threshold: float = np.inf, exceedances: bool = False, failed: bool = False) -> list[Line2D]:
    """Return the legend entries that all rollouts share.

    Args:
        words: The words for a quality, or for a cost.
        threshold: The threshold; infinite, as by default, it has no entry.
        exceedances: Whether the samples that exceed the threshold, G1, are marked.
        failed: Whether a rollout has failed.
    """
    entries = [_key("t*", marker="o", color="white", mec="black", ls="")]
    if exceedances:
        entries.append(_key(f"G₁: {words.symbol} {words.beyond} {words.limit}", color="0.6", lw=6, alpha=0.5))
    if np.isfinite(threshold):
        entries.append(_key(f"{words.limit} = {threshold:g}", color=THRESHOLD, lw=1, ls=(0, (4, 2))))
    if failed:
        entries.append(_key("rollout failed", marker="x", color=FAILED, ls="", mew=2))
    return entries


def _key(text: str, **style: Any) -> Line2D:
    return Line2D([], [], label=text, **style)


def describe(values: object) -> str:
    """Return elements of s0 as text such as ``mass = 45, friction = 0.8``, with the last words of their addresses."""
    if not isinstance(values, dict) or not values:
        return "as the scenario is"
    return ", ".join(f"{short_address(address, values)} = {_number(value)}" for address, value in values.items())


def _number(value: object) -> str:
    array = np.asarray(value, dtype=float)
    return f"{array:g}" if array.ndim == 0 else np.array2string(array, precision=4, separator=", ", threshold=6)


# It must stand out from every colour of the map.
_THRESHOLD = "#f4a582"


def worst(sweep: Sweep) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct points, shape (n, p), and the worst h (or cost) over their conditions, shape (n,).

    It is NaN where a condition is missing or its rollout failed.
    """
    points, where = np.unique(sweep.points, axis=0, return_inverse=True)
    where = where.reshape(-1)
    cost = sweep.minimize[0]
    h = np.full(len(points), -np.inf if cost else np.inf)
    # Unlike fmin, minimum keeps a NaN, though with a warning.
    with np.errstate(invalid="ignore"):
        (np.maximum if cost else np.minimum).at(h, where, sweep.h)
    h[np.bincount(where, minlength=len(points)) < len(sweep.conditions)] = np.nan
    return points, h


def draw_landscape(axes: Axes, sweep: Sweep) -> None:
    """Draw h as an image on a full grid, else as coloured points, with contour lines, failures and the best point.

    Args:
        axes: The axes to draw into; their figure gets a colour bar.
        sweep: A sweep over two parameters.
    """
    words = _Words.of(minimize=sweep.minimize[0])
    points, h = worst(sweep)
    x, y = np.unique(points[:, 0]), np.unique(points[:, 1])
    is_finite = np.isfinite(h)
    threshold = sweep.rollouts[0].threshold
    if len(points) == x.size * y.size and min(x.size, y.size) > 1:
        # np.unique has sorted the points by x, then y.
        image = h.reshape(x.size, y.size).T
        log = sweep.parameters[0].log, sweep.parameters[1].log
        drawn: ScalarMappable = draw_mesh(axes, x, y, image, log=log, lines=min(x.size, y.size) > 2)
        if is_finite.any() and np.nanmin(h) < threshold < np.nanmax(h):
            axes.contour(x, y, image, levels=[threshold], colors=_THRESHOLD, linewidths=2)
            axes.plot([], [], color=_THRESHOLD, lw=2, label=f"{words.limit} = {threshold:g}")
    else:
        xs, ys = points[is_finite].T
        drawn = axes.scatter(xs, ys, c=h[is_finite], cmap="viridis", s=60, gid="h")
    if not is_finite.all():
        axes.plot(*points[~is_finite].T, "x", color=FAILED, mew=2, label="failed or not finished", gid="failed")
    _draw_best(axes, sweep, words)
    first, second = (label(p.address, unit) for p, unit in zip(sweep.parameters, sweep.units, strict=True))
    axes.set(xlabel=first, ylabel=second)
    several = len(sweep.conditions) > 1
    text = words.result.partition(" = ")[0]
    axes.set_title(f"{text}, the worst of {len(sweep.conditions)} conditions" if several else text)
    axes.figure.colorbar(drawn, ax=axes, label=words.result, pad=0.02)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2, frameon=False)


def draw_mesh(
    axes: Axes,
    x: np.ndarray,
    y: np.ndarray,
    image: np.ndarray,
    *,
    log: tuple[bool, bool] = (False, False),
    lines: bool = True,
    cmap: str | Colormap = "viridis",
) -> ScalarMappable:
    """Draw values on a full grid as cells around its points, with lines of equal value.

    Args:
        axes: Where it is drawn.
        x: Positions of the columns, ascending, shape (n,).
        y: Positions of the rows, ascending, shape (m,).
        image: The values, shape (m, n); NaN leaves a hole.
        log: Whether the cells lie around their points on a logarithmic scale, in x and y.
        lines: Whether to draw the lines.
        cmap: The colour map.
    """
    cells = axes.pcolormesh(
        _edges(x, log=log[0]), _edges(y, log=log[1]), np.ma.masked_invalid(image), cmap=cmap, gid="h"
    )
    heights = image[np.isfinite(image)]
    if lines and heights.size and heights.max() > heights.min():
        levels = np.linspace(heights.min(), heights.max(), 9)[1:-1]
        axes.contour(x, y, image, levels=levels, colors="white", linewidths=0.6, alpha=0.6)
    return cells


def _edges(centers: np.ndarray, *, log: bool) -> np.ndarray:
    """Return the edges of cells, halfway between their centers, shape (n + 1,) for n >= 2."""
    c = np.log(centers) if log else centers
    middle = (c[:-1] + c[1:]) / 2.0
    edges = np.concatenate([[2.0 * c[0] - middle[0]], middle, [2.0 * c[-1] - middle[-1]]])
    return np.exp(edges) if log else edges


def mark_best(axes: Axes, x: float, y: float, *, text: str | None = None, size: float = 18) -> None:
    """Mark the best point with a star.

    Args:
        axes: The axes to draw into.
        x: The x of the best point.
        y: The y of the best point.
        text: Its name in the legend; None: it has no entry.
        size: Size of the star in points.
    """
    axes.plot(x, y, "*", color="#d6604d", ms=size, mec="white", clip_on=False, zorder=4, label=text, gid="best")


def _draw_best(axes: Axes, sweep: Sweep, words: _Words) -> None:
    several = len(sweep.minimize) > 1
    if several or sweep.risk is None or not any(evaluation.feasible for evaluation in sweep.evaluations):
        return
    best = sweep.best
    text = ", ".join(f"{value:.4g}" for value in best.point)
    mark_best(axes, *best.point, text=f"s⁰* = [{text}], {'c' if words.symbol == 'c' else 'h'} = {best.value:.4g}")


_BOUNDARY = "#f4a582"
_VALUES = colormaps["viridis"]
_CONDITIONS = colormaps["tab10"]
_SINGLE = "#2166ac"


def plot_sweep(sweep: Sweep, *, boundary: Boundary | None = None) -> Figure:
    """Plot h over one or two parameters (Figure 6).

    Over one parameter: h, with the boundary interval shaded if there is a threshold, beside the quality trajectories
    with t* marked (Figure 5), coloured by the parameter's value. Where f' takes two values only (tipped over or not),
    trajectories would cover each other; then each rollout is a bar over time at its parameter value, up to t*. Over two
    parameters: the landscape of h, under the worst condition, with the best point.

    Args:
        sweep: The sweep to draw.
        boundary: The boundary to shade; by default the sweep's, if there is one.

    Raises:
        ValueError: There are more than two parameters, or no rollouts.
    """
    if len(sweep.parameters) > 2:
        names = ", ".join(parameter.address for parameter in sweep.parameters)
        raise ValueError(
            f"a sweep over one or two parameters can be drawn, not over {len(sweep.parameters)} ({names}): sweep two "
            "of them, with the others held in the scenario"
        )
    if not len(sweep):
        raise ValueError("the sweep has no finished rollouts, so that there is nothing to draw")
    if boundary is None and not why_no_boundary(sweep):
        boundary = sweep.boundary()
    if sweep.minimize[0]:
        sweep = replace(sweep, rollouts=tuple(in_user_terms(rollout) for rollout in sweep.rollouts))
    if len(sweep.parameters) == 2:
        figure = Picture(7.2, 5.4)
        draw_landscape(figure.add_subplot(), sweep)
        return figure
    figure = Picture(12.0, 4.6)
    left, right = figure.subplots(1, 2)
    _draw_h(left, sweep, boundary)
    if is_two_valued(sweep.rollouts):
        _draw_bars(right, sweep)
    else:
        _draw_trajectories(right, sweep)
    return figure


def in_user_terms(rollout: RolloutResult) -> RolloutResult:
    """Return a rollout of a cost whose trajectory, value and threshold are the cost instead of 1 / (1 + cost)."""
    threshold = 1.0 / rollout.threshold - 1.0 if np.isfinite(rollout.threshold) else rollout.threshold
    return replace(rollout, quality=1.0 / rollout.quality - 1.0, h=rollout.value, threshold=threshold)


def plot_quality(rollouts: Sequence[RolloutResult], *, quality: Quality | None = None) -> Figure:
    """Plot the quality trajectories f'(t) of some rollouts, with f_m, the samples in G1 and t* (Figure 5).

    Args:
        rollouts: Rollouts of one problem.
        quality: The quality of the rollouts, for its name and unit; if it is a cost, the cost is drawn.

    Raises:
        ValueError: There is no rollout, or one has no quality.
    """
    if not rollouts or any(rollout.quality.size == 0 for rollout in rollouts):
        raise ValueError("a quality trajectory needs a rollout with a quality and at least one sample")
    words = _QUALITY
    if quality is not None:
        words = _Words.of(minimize=quality.minimize, name=quality.name, unit=quality.unit)
        rollouts = [in_user_terms(rollout) for rollout in rollouts] if quality.minimize else rollouts
    figure = Picture(7.6, 4.4)
    axes = figure.add_subplot()
    names = [describe(rollout.parameters) for rollout in rollouts]
    colors = [_CONDITIONS(i) if len(rollouts) <= 10 else _VALUES(i / len(rollouts)) for i in range(len(rollouts))]
    if is_two_valued(rollouts):
        rows = np.arange(len(rollouts), dtype=float)
        draw_bars(axes, rollouts, rows, colors=colors, styles=[0] * len(rollouts), words=words)
        axes.set_yticks(rows, names)
        figure.set_figheight(max(3.0, 1.5 + 0.25 * len(rollouts)))
        finish(axes)
    else:
        _draw_qualities(axes, rollouts, colors, names, words)
    return figure


def _draw_qualities(
    axes: Axes, rollouts: Sequence[RolloutResult], colors: Sequence[ColorType], names: Sequence[str], words: _Words
) -> None:
    few = len(rollouts) <= 10
    for number, (rollout, color) in enumerate(zip(rollouts, colors, strict=True)):
        draw_trajectory(axes, rollout, color=color, style=number if few else 0, name=names[number])
        if rollout.exceedances.size:
            heights = rollout.quality[np.isin(rollout.times[: rollout.quality.size], rollout.exceedances)]
            axes.plot(rollout.exceedances, heights, "o", color=color, ms=10, alpha=0.3, mew=0, gid="G1")
        if not rollout.failed:
            axes.axvline(rollout.t_star, color=color, lw=0.8, ls=":", gid="t_star_line", zorder=1)
    threshold = rollouts[0].threshold
    draw_threshold(axes, threshold)
    handles = [line for line in axes.get_lines() if line.get_gid() == "trajectory"] if few else []
    handles += keys(
        words,
        threshold=threshold,
        exceedances=any(rollout.exceedances.size for rollout in rollouts),
        failed=any(rollout.failed for rollout in rollouts),
    )
    axes.set(xlabel="time t [s]", ylabel=words.trajectory, title=words.title)
    finish(axes)
    axes.legend(
        handles=handles, fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3, frameon=False
    )


def _draw_h(axes: Axes, sweep: Sweep, boundary: Boundary | None) -> None:
    words = _Words.of(minimize=sweep.minimize[0])
    values, h = sweep.points[:, 0], sweep.h
    many = len(sweep.conditions) > 1
    for number, condition in enumerate(sweep.conditions):
        mine = sweep.condition == number
        color = _CONDITIONS(number % 10) if many else _SINGLE
        marker = MARKERS[number % len(MARKERS)]
        name = describe(condition) if many else words.result.partition(" = ")[0]
        order = np.argsort(values[mine], kind="stable")
        (line,) = axes.plot(values[mine][order], h[mine][order], color=color, marker=marker, ms=5, label=name, gid="h")
        # Between 0 and 1 of a quality that takes no other value there is nothing to be drawn.
        line.set_linestyle("none" if is_two_valued(sweep.rollouts) else STYLES[number % len(STYLES)])
        line.set_linewidth(1.2)
        # An open marker: f' exceeded f_m, or a constraint was violated.
        line.set_markerfacecolor("white")
        safe = mine & ~sweep.unsafe
        axes.plot(values[safe], h[safe], marker, color=color, ms=5, gid="not_exceeded")
    threshold = _threshold(sweep)
    draw_threshold(axes, threshold)
    handles = list(axes.get_legend_handles_labels()[0])
    if sweep.exceeded.any():
        handles += axes.plot([], [], "o", color="0.3", mfc="white", label=f"{words.limit} {words.passed}")
    if (sweep.violated & ~sweep.exceeded).any():
        handles += axes.plot([], [], "o", color="0.6", mfc="white", label="a constraint violated")
    if sweep.failed.any():
        failed = values[sweep.failed]
        place: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "gid": "failed"}
        bottom = np.full(failed.size, 0.03)
        handles += axes.plot(failed, bottom, "x", color=FAILED, mew=2, label="rollout failed", **place)
    handles += [key for key in keys(words, threshold=threshold) if key.get_label() != "t*"]
    title = "" if boundary is None else _draw_boundary(axes, sweep, boundary, handles)
    parameter = sweep.parameters[0]
    axes.set(
        xlabel=label(parameter.address, sweep.units[0]),
        ylabel=words.result,
        title=title or f"{words.noun.capitalize()} at t*",
    )
    finish(axes)
    if len(handles) > 1:
        axes.legend(handles=handles, fontsize="small", title="condition" if many else None, loc="best")


def _draw_boundary(axes: Axes, sweep: Sweep, boundary: Boundary, handles: list[Artist]) -> str:
    """Shade the boundary interval, and return a title that states it."""
    lower = max(boundary.lower, float(sweep.points[:, 0].min()))
    upper = min(boundary.upper, float(sweep.points[:, 0].max()))
    if lower < upper and np.isfinite([boundary.lower, boundary.upper]).all():
        span = axes.axvspan(lower, upper, color=_BOUNDARY, alpha=0.5, lw=0, label="boundary", gid="boundary")
        # A narrow interval would be lost between two markers.
        axes.axvline((lower + upper) / 2, color=_BOUNDARY, lw=1.5, zorder=0)
        handles.append(span)
    text = boundary.interval_text(boundary.lower, boundary.upper)
    return text[:1].upper() + text[1:]


def _draw_trajectories(axes: Axes, sweep: Sweep) -> None:
    norm, words = _norm(sweep), _Words.of(minimize=sweep.minimize[0])
    width = 1.4 if len(sweep) <= 20 else 0.8
    for point, condition, rollout in zip(sweep.points, sweep.condition, sweep.rollouts, strict=True):
        draw_trajectory(axes, rollout, color=_VALUES(norm(point[0])), style=int(condition), width=width)
    draw_threshold(axes, _threshold(sweep))
    axes.set(xlabel="time t [s]", ylabel=words.trajectory, title=words.title)
    finish(axes)
    axes.legend(
        handles=keys(words, threshold=_threshold(sweep), failed=bool(sweep.failed.any())), fontsize="small", loc="best"
    )
    text = label(sweep.parameters[0].address, sweep.units[0])
    axes.figure.colorbar(ScalarMappable(norm, _VALUES), ax=axes, label=text, pad=0.02)


def _draw_bars(axes: Axes, sweep: Sweep) -> None:
    """Draw one bar over time for each rollout, at its parameter value."""
    count = len(sweep.conditions)
    distinct = np.unique(sweep.points[:, 0])
    spacing = float(np.diff(distinct).min()) if distinct.size > 1 else 1.0
    # The conditions of one value lie side by side, close to it.
    spread = min(0.7 * spacing, 0.03 * float(np.ptp(distinct)) or 1.0)
    heights = sweep.points[:, 0] + spread * ((sweep.condition + 0.5) / count - 0.5)
    colors = [_CONDITIONS(number % 10) if count > 1 else _SINGLE for number in sweep.condition]
    words = _Words.of(minimize=sweep.minimize[0])
    draw_bars(axes, sweep.rollouts, heights, colors=colors, styles=sweep.condition.tolist(), words=words)
    axes.set_ylabel(label(sweep.parameters[0].address, sweep.units[0]))
    finish(axes)


def _norm(sweep: Sweep) -> Normalize:
    return Normalize(float(sweep.points[:, 0].min()), float(sweep.points[:, 0].max()))


def _threshold(sweep: Sweep) -> float:
    return sweep.rollouts[0].threshold
