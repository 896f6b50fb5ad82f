"""f'(t) over time with t* marked: the elements of Figure 5 that several plots share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.typing import ColorType

from vtbdrake.rollout import RolloutResult

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
    """True if f' takes only two values (an event such as tipping over), so that trajectories would cover each other."""
    values = np.unique(np.concatenate([rollout.quality for rollout in rollouts] or [np.empty(0)]))
    return len(rollouts) > 1 and values.size <= 2


def draw_trajectory(
    axes: Axes, rollout: RolloutResult, *, color: ColorType, style: int = 0, width: float = 1.4, name: str | None = None
) -> None:
    """f' over time, t* as a marker; a failed rollout ends with a cross."""
    times = rollout.times[: rollout.quality.size]
    steps = "steps-post" if np.unique(rollout.quality).size <= 2 else "default"
    (line,) = axes.plot(times, rollout.quality, color=color, linewidth=width, label=name, drawstyle=steps)
    line.set_linestyle(STYLES[style % len(STYLES)])
    line.set_gid("trajectory")
    if rollout.failed and times.size:
        axes.plot(
            times[-1],
            rollout.quality[-1],
            "x",
            color=FAILED,
            markersize=7,
            markeredgewidth=2,
            gid="failed",
            clip_on=False,
            zorder=3,
        )
    elif not rollout.failed:
        draw_t_star(axes, rollout.t_star, rollout.h, color=color, style=style)


def draw_t_star(axes: Axes, t_star: float, height: float, *, color: ColorType, style: int = 0) -> None:
    """The mark of t*."""
    axes.plot(
        t_star,
        height,
        MARKERS[style % len(MARKERS)],
        color=color,
        markeredgecolor="black",
        markeredgewidth=0.6,
        markersize=6,
        zorder=3,
        clip_on=False,
        gid="t_star",
    )


def draw_bars(
    axes: Axes,
    rollouts: Sequence[RolloutResult],
    heights: np.ndarray,
    *,
    colors: Sequence[ColorType],
    styles: Sequence[int],
) -> None:
    """Trajectories of two values as bars at ``heights``: thin at the lower value of f', thick at the upper one.

    t* is marked where h is the upper value. A failed rollout ends with a cross.
    """
    lower, upper = levels(rollouts)
    for rollout, height, color, style in zip(rollouts, heights, colors, styles, strict=True):
        times, high = rollout.times[: rollout.quality.size], rollout.quality > lower
        if not times.size:
            axes.plot(0.0, height, "x", color=FAILED, markersize=6, markeredgewidth=2, gid="failed", clip_on=False)
            continue
        axes.plot([0.0, times[-1]], [height, height], color=color, linewidth=1.0, alpha=0.6, gid="bar")
        # A sample holds until the next one.
        begins, ends = times[:-1][high[:-1]], times[1:][high[:-1]]
        axes.hlines(np.full(begins.size, height), begins, ends, colors=color, linewidth=4, alpha=0.6)
        if rollout.failed:
            axes.plot(
                times[-1], height, "x", color=FAILED, markersize=6, markeredgewidth=2, gid="failed", clip_on=False
            )
        elif rollout.h > lower:
            draw_t_star(axes, rollout.t_star, height, color=color, style=style)
    handles = [_key(f"f' = {lower:g}", color="0.4", linewidth=1)]
    if upper > lower:
        handles.append(_key(f"f' = {upper:g}", color="0.4", linewidth=4))
    handles += keys(failed=any(rollout.failed for rollout in rollouts))
    axes.legend(handles=handles, fontsize="small", loc="best")
    axes.set(xlabel="time t [s]", title="Quality trajectories f'(s⁰, t) of two values")


def levels(rollouts: Sequence[RolloutResult]) -> tuple[float, float]:
    """The least and the largest quality of all samples; (0, 0) if there is none."""
    values = np.concatenate([np.empty(0), *(rollout.quality for rollout in rollouts)])
    return (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)


def draw_threshold(axes: Axes, threshold: float) -> None:
    """f_m, if it is finite."""
    if np.isfinite(threshold):
        axes.axhline(threshold, color=THRESHOLD, linewidth=1, linestyle=(0, (4, 2)), gid="threshold", zorder=1)


def keys(*, threshold: float = np.inf, exceedances: bool = False, failed: bool = False) -> list[Line2D]:
    """Legend entries of what is drawn for all rollouts alike."""
    found = [_key("t*", marker="o", color="white", markeredgecolor="black", linestyle="")]
    if exceedances:
        found.append(_key("G₁: f' > f_m", color="0.6", linewidth=6, alpha=0.5))
    if np.isfinite(threshold):
        found.append(_key(f"f_m = {threshold:g}", color=THRESHOLD, linewidth=1, linestyle=(0, (4, 2))))
    if failed:
        found.append(_key("simulation failed", marker="x", color=FAILED, linestyle="", markeredgewidth=2))
    return found


def _key(text: str, **style: Any) -> Line2D:
    return Line2D([], [], label=text, **style)


def describe(values: object) -> str:
    """Elements of s0 as text: ``mass = 45, friction = 0.8``, by the last words of their addresses."""
    if not isinstance(values, dict) or not values:
        return "as the scenario is"
    return ", ".join(f"{_short(address, values)} = {_number(value)}" for address, value in values.items())


def _short(address: str, others: dict[str, object]) -> str:
    words = address.split(".")
    for count in range(1, len(words)):
        tail = words[-count:]
        if sum(other.split(".")[-count:] == tail for other in others) == 1:
            return ".".join(tail)
    return address


def _number(value: object) -> str:
    array = np.asarray(value, dtype=float)
    return f"{array:g}" if array.ndim == 0 else np.array2string(array, precision=4, separator=", ", threshold=6)
