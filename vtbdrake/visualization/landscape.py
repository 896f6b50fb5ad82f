"""h over two parameters: the landscape of Figure 6."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap

from vtbdrake.visualization.figure import label
from vtbdrake.visualization.trajectories import FAILED

# It must stand out from every colour of the map.
_THRESHOLD = "#f4a582"

if TYPE_CHECKING:
    from vtbdrake.optimization import Sweep


def worst(sweep: Sweep) -> tuple[np.ndarray, np.ndarray]:
    """(points, h): the distinct points, shape (n, p), and the worst h over their conditions, shape (n,).

    h is NaN where a condition is missing or its simulation failed.
    """
    points, where = np.unique(sweep.points, axis=0, return_inverse=True)
    where = where.reshape(-1)
    h = np.full(len(points), np.inf)
    # Unlike fmin, minimum keeps a NaN.
    np.minimum.at(h, where, sweep.h)
    h[np.bincount(where, minlength=len(points)) < len(sweep.conditions)] = np.nan
    return points, h


def draw_landscape(axes: Axes, sweep: Sweep) -> None:
    """An image of h on a full grid, else coloured points; contour lines, failures and the best point on top."""
    points, h = worst(sweep)
    x, y = np.unique(points[:, 0]), np.unique(points[:, 1])
    known = np.isfinite(h)
    threshold = sweep.rollouts[0].threshold
    if len(points) == x.size * y.size and min(x.size, y.size) > 1:
        # np.unique has sorted the points by x, then y.
        image = h.reshape(x.size, y.size).T
        log = sweep.parameters[0].log, sweep.parameters[1].log
        drawn: ScalarMappable = draw_mesh(axes, x, y, image, log=log, lines=min(x.size, y.size) > 2)
        if known.any() and np.nanmin(h) < threshold < np.nanmax(h):
            axes.contour(x, y, image, levels=[threshold], colors=_THRESHOLD, linewidths=2)
            axes.plot([], [], color=_THRESHOLD, linewidth=2, label=f"f_m = {threshold:g}")
    else:
        x_known, y_known = points[known].T
        drawn = axes.scatter(x_known, y_known, c=h[known], cmap="viridis", s=60, gid="h")
    if not known.all():
        axes.plot(*points[~known].T, "x", color=FAILED, mew=2, label="failed or not finished", gid="failed")
    _draw_best(axes, sweep)
    first, second = (label(p.address, unit) for p, unit in zip(sweep.parameters, sweep.units, strict=True))
    axes.set(xlabel=first, ylabel=second)
    several = len(sweep.conditions) > 1
    axes.set_title(f"h(s⁰), the worst of {len(sweep.conditions)} conditions" if several else "h(s⁰)")
    axes.figure.colorbar(drawn, ax=axes, label="h(s⁰) = f'(s⁰, t*)", pad=0.02)
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
    """Values on a full grid as cells around its points, with lines of equal value.

    Args:
        x, y: where the points lie, ascending, shapes (n,) and (m,).
        image: the values, shape (m, n); NaN leaves a hole.
        log: whether the cells lie around their points on a logarithmic scale, in x and y.
        lines: draw the lines.
    """
    cells = axes.pcolormesh(
        _edges(x, log=log[0]), _edges(y, log=log[1]), np.ma.masked_invalid(image), cmap=cmap, gid="h"
    )
    known = image[np.isfinite(image)]
    if lines and known.size and known.max() > known.min():
        levels = np.linspace(known.min(), known.max(), 9)[1:-1]
        axes.contour(x, y, image, levels=levels, colors="white", linewidths=0.6, alpha=0.6)
    return cells


def _edges(centers: np.ndarray, *, log: bool) -> np.ndarray:
    """The edges of cells, halfway between their centers, shape (n + 1,) for n >= 2."""
    c = np.log(centers) if log else centers
    middle = (c[:-1] + c[1:]) / 2.0
    edges = np.concatenate([[2.0 * c[0] - middle[0]], middle, [2.0 * c[-1] - middle[-1]]])
    return np.exp(edges) if log else edges


def mark_best(axes: Axes, x: float, y: float, *, text: str | None = None, size: float = 18) -> None:
    """A star at the best point."""
    axes.plot(
        x,
        y,
        "*",
        color="#d6604d",
        markersize=size,
        markeredgecolor="white",
        clip_on=False,
        zorder=4,
        label=text,
        gid="best",
    )


def _draw_best(axes: Axes, sweep: Sweep) -> None:
    several = len(sweep.minimize) > 1
    if several or sweep.risk is None or not any(evaluation.feasible for evaluation in sweep.evaluations):
        return
    point, best = sweep.best()
    text = ", ".join(f"{value:.4g}" for value in point.values())
    mark_best(axes, *point.values(), text=f"s⁰* = [{text}], h = {best:.4g}")
