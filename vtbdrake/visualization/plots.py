"""Pictures of problem (18): the quality trajectories of Figure 5, h over the parameters as in Figure 6."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.typing import ColorType

from vtbdrake.optimization.boundary import why_no_boundary
from vtbdrake.visualization.figure import Picture, finish, label
from vtbdrake.visualization.landscape import draw_landscape
from vtbdrake.visualization.trajectories import (
    FAILED,
    MARKERS,
    STYLES,
    describe,
    draw_bars,
    draw_threshold,
    draw_trajectory,
    is_two_valued,
    keys,
)

if TYPE_CHECKING:
    from vtbdrake.optimization import Boundary, Sweep
    from vtbdrake.rollout import RolloutResult

_BOUNDARY = "#f4a582"
_VALUES = colormaps["viridis"]
_CONDITIONS = colormaps["tab10"]
_SINGLE = "#2166ac"


def plot_sweep(sweep: Sweep, *, boundary: Boundary | None = None) -> Figure:
    """h over the parameters (Figure 6).

    Over one parameter: h, with the boundary interval shaded if there is a threshold, beside the quality trajectories
    with t* marked (Figure 5), coloured by the parameter's value. Where f' takes two values only (tipped over or not),
    trajectories would cover each other; then each rollout is a bar over time at its parameter value, up to t*. Over two
    parameters: the landscape of h, under the worst condition, with the best point.

    Args:
        sweep: what is drawn.
        boundary: the boundary to be shaded; left out, it is that of the sweep, if there is one.

    Raises:
        ValueError: there are more than two parameters, or no rollouts.
    """
    if len(sweep.parameters) > 2:
        names = ", ".join(parameter.address for parameter in sweep.parameters)
        raise ValueError(
            f"a sweep over one or two parameters can be drawn, not over {len(sweep.parameters)} ({names}): sweep two "
            "of them, with the others held in the scenario"
        )
    if not len(sweep):
        raise ValueError("the sweep has no finished rollouts, so that there is nothing to draw")
    if len(sweep.parameters) == 2:
        figure = Picture(7.2, 5.4)
        draw_landscape(figure.add_subplot(), sweep)
        return figure
    figure = Picture(12.0, 4.6)
    left, right = figure.subplots(1, 2)
    if boundary is None and not why_no_boundary(sweep):
        boundary = sweep.boundary()
    _draw_h(left, sweep, boundary)
    if is_two_valued(sweep.rollouts):
        _draw_bars(right, sweep)
    else:
        _draw_trajectories(right, sweep)
    return figure


def plot_quality(rollouts: Sequence[RolloutResult]) -> Figure:
    """The quality trajectories f'(t) of some rollouts, with f_m, the samples in G1 and t* (Figure 5).

    Raises:
        ValueError: there is none, or one has no quality.
    """
    if not rollouts or any(rollout.quality.size == 0 for rollout in rollouts):
        raise ValueError("a quality trajectory is that of a rollout with a quality and at least one sample")
    figure = Picture(7.6, 4.4)
    axes = figure.add_subplot()
    names = [describe(rollout.parameters) for rollout in rollouts]
    colors = [_CONDITIONS(i) if len(rollouts) <= 10 else _VALUES(i / len(rollouts)) for i in range(len(rollouts))]
    if is_two_valued(rollouts):
        rows = np.arange(len(rollouts), dtype=float)
        draw_bars(axes, rollouts, rows, colors=colors, styles=[0] * len(rollouts))
        axes.set_yticks(rows, names)
        figure.set_figheight(max(3.0, 1.5 + 0.25 * len(rollouts)))
        finish(axes)
    else:
        _draw_qualities(axes, rollouts, colors, names)
    return figure


def _draw_qualities(
    axes: Axes, rollouts: Sequence[RolloutResult], colors: Sequence[ColorType], names: Sequence[str]
) -> None:
    few = len(rollouts) <= 10
    for number, (rollout, color) in enumerate(zip(rollouts, colors, strict=True)):
        draw_trajectory(axes, rollout, color=color, style=number if few else 0, name=names[number])
        if rollout.exceedances.size:
            heights = rollout.quality[np.isin(rollout.times[: rollout.quality.size], rollout.exceedances)]
            axes.plot(rollout.exceedances, heights, "o", color=color, ms=10, alpha=0.3, mew=0, gid="G1")
        if not rollout.failed:
            axes.axvline(rollout.t_star, color=color, linewidth=0.8, linestyle=":", gid="t_star_line", zorder=1)
    threshold = rollouts[0].threshold
    draw_threshold(axes, threshold)
    handles = [line for line in axes.get_lines() if line.get_gid() == "trajectory"] if few else []
    handles += keys(
        threshold=threshold,
        exceedances=any(rollout.exceedances.size for rollout in rollouts),
        failed=any(rollout.failed for rollout in rollouts),
    )
    axes.set(xlabel="time t [s]", ylabel="quality f'(s⁰, t)", title="Quality trajectories")
    finish(axes)
    axes.legend(
        handles=handles, fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3, frameon=False
    )


def _draw_h(axes: Axes, sweep: Sweep, boundary: Boundary | None) -> None:
    values, h = sweep.points[:, 0], sweep.h
    many = len(sweep.conditions) > 1
    for number, condition in enumerate(sweep.conditions):
        mine = sweep.condition == number
        color = _CONDITIONS(number % 10) if many else _SINGLE
        marker = MARKERS[number % len(MARKERS)]
        name = describe(condition) if many else "h(s⁰)"
        order = np.argsort(values[mine], kind="stable")
        (line,) = axes.plot(
            values[mine][order], h[mine][order], color=color, marker=marker, markersize=5, label=name, gid="h"
        )
        # Between 0 and 1 of a quality that takes no other value there is nothing to be drawn.
        line.set_linestyle("none" if is_two_valued(sweep.rollouts) else STYLES[number % len(STYLES)])
        line.set_linewidth(1.2)
        # An open marker: f' exceeded f_m, or a constraint was violated.
        line.set_markerfacecolor("white")
        held = mine & ~sweep.unsafe
        axes.plot(values[held], h[held], marker, color=color, markersize=5, gid="not_exceeded")
    threshold = _threshold(sweep)
    draw_threshold(axes, threshold)
    handles = list(axes.get_legend_handles_labels()[0])
    if sweep.exceeded.any():
        handles += axes.plot([], [], "o", color="0.3", markerfacecolor="white", label="f_m exceeded")
    if (sweep.violated & ~sweep.exceeded).any():
        handles += axes.plot([], [], "o", color="0.6", markerfacecolor="white", label="a constraint violated")
    if sweep.failed.any():
        failed = values[sweep.failed]
        handles += axes.plot(
            failed,
            np.full(failed.size, 0.03),
            "x",
            color=FAILED,
            markeredgewidth=2,
            transform=axes.get_xaxis_transform(),
            label="simulation failed",
            gid="failed",
        )
    handles += [key for key in keys(threshold=threshold) if key.get_label() != "t*"]
    title = "" if boundary is None else _draw_boundary(axes, sweep, boundary, handles)
    parameter = sweep.parameters[0]
    axes.set(
        xlabel=label(parameter.address, sweep.units[0]), ylabel="h(s⁰) = f'(s⁰, t*)", title=title or "Quality at t*"
    )
    finish(axes)
    if len(handles) > 1:
        axes.legend(handles=handles, fontsize="small", title="condition" if many else None, loc="best")


def _draw_boundary(axes: Axes, sweep: Sweep, boundary: Boundary, handles: list[Artist]) -> str:
    """Shades the boundary interval; returns what it says."""
    lower = max(boundary.lower, float(sweep.points[:, 0].min()))
    upper = min(boundary.upper, float(sweep.points[:, 0].max()))
    if lower < upper and np.isfinite([boundary.lower, boundary.upper]).all():
        span = axes.axvspan(lower, upper, color=_BOUNDARY, alpha=0.5, linewidth=0, label="boundary", gid="boundary")
        # A narrow interval would be lost between two markers.
        axes.axvline((lower + upper) / 2, color=_BOUNDARY, linewidth=1.5, zorder=0)
        handles.append(span)
    text = boundary.interval_text(boundary.lower, boundary.upper)
    return text[:1].upper() + text[1:]


def _draw_trajectories(axes: Axes, sweep: Sweep) -> None:
    norm = _norm(sweep)
    width = 1.4 if len(sweep) <= 20 else 0.8
    for point, condition, rollout in zip(sweep.points, sweep.condition, sweep.rollouts, strict=True):
        draw_trajectory(axes, rollout, color=_VALUES(norm(point[0])), style=int(condition), width=width)
    draw_threshold(axes, _threshold(sweep))
    axes.set(xlabel="time t [s]", ylabel="quality f'(s⁰, t)", title="Quality trajectories")
    finish(axes)
    axes.legend(
        handles=keys(threshold=_threshold(sweep), failed=bool(sweep.failed.any())), fontsize="small", loc="best"
    )
    text = label(sweep.parameters[0].address, sweep.units[0])
    axes.figure.colorbar(ScalarMappable(norm, _VALUES), ax=axes, label=text, pad=0.02)


def _draw_bars(axes: Axes, sweep: Sweep) -> None:
    """One bar over time for each rollout, at its parameter value."""
    count = len(sweep.conditions)
    distinct = np.unique(sweep.points[:, 0])
    spacing = float(np.diff(distinct).min()) if distinct.size > 1 else 1.0
    # The conditions of one value lie side by side, close to it.
    spread = min(0.7 * spacing, 0.03 * float(np.ptp(distinct)) or 1.0)
    heights = sweep.points[:, 0] + spread * ((sweep.condition + 0.5) / count - 0.5)
    colors = [_CONDITIONS(number % 10) if count > 1 else _SINGLE for number in sweep.condition]
    draw_bars(axes, sweep.rollouts, heights, colors=colors, styles=sweep.condition.tolist())
    axes.set_ylabel(label(sweep.parameters[0].address, sweep.units[0]))
    finish(axes)


def _norm(sweep: Sweep) -> Normalize:
    return Normalize(float(sweep.points[:, 0].min()), float(sweep.points[:, 0].max()))


def _threshold(sweep: Sweep) -> float:
    return sweep.rollouts[0].threshold
