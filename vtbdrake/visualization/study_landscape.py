"""A quality of a study over one or two of its parameters, as in Figure 6."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from vtbdrake.optimization.outcome import Trial
from vtbdrake.optimization.parameter import Choice
from vtbdrake.visualization.figure import Picture, finish
from vtbdrake.visualization.landscape import draw_mesh, mark_best
from vtbdrake.visualization.study_points import (
    Points,
    Scale,
    draw_points,
    draw_remarks,
    name,
    point_keys,
    quality_label,
    scales,
    values,
)

if TYPE_CHECKING:
    from vtbdrake.optimization.study_record import StudyRecord

_SINGLE = "#2166ac"
_LEVELS = 12


def plot_landscape(study: StudyRecord, *addresses: str) -> Figure:
    """Every quality over one or two parameters; where others vary too, the best found at each place.

    Over two: an image where the points fill a grid; else filled contours between the points if nothing but these two
    numbers varies (between points that differ in more there is nothing to interpolate), and the points in colour.

    Args:
        addresses: of the parameters; of a study over one or two, these.

    Raises:
        ValueError: there are no points, an address is none of the study's parameters, or there are not one or two.
    """
    points = Points.of(study)
    known = scales(study)
    chosen = addresses or tuple(known)
    for address in chosen:
        if address not in known:
            raise ValueError(f"{address} is no parameter of the study; those are {', '.join(known)}")
    if not 1 <= len(chosen) <= 2 or len(set(chosen)) < len(chosen):
        raise ValueError(
            f"a landscape lies over one or two different parameters, not over {', '.join(chosen)}: name two of them, "
            "plot_landscape(first, second)"
        )
    count = len(study.names)
    figure = Picture(7.2 if count == 1 else 6.0 * count, 5.4 if len(chosen) == 2 else 4.6)
    draw = _draw_surface if len(chosen) == 2 else _draw_line
    shown = [known[address] for address in chosen]
    for quality, axes in enumerate(figure.subplots(1, count, squeeze=False)[0]):
        handles = draw(axes, study, points, *shown, quality=quality, others=len(known) - len(chosen))
        _legend(axes, study, points, chosen, handles, quality=quality)
    return figure


def draw_slice(
    axes: Axes, study: StudyRecord, points: Points, scale: Scale, *, quality: int, width: int = 60, **style: Any
) -> None:
    """One quality over one parameter, with the best point; coloured by the order of the points unless ``style`` has a
    color."""
    if "color" not in style:
        style["c"] = [trial.number for trial in points.kept]
    draw_points(axes, study, points, scale.places, quality=quality, **style)
    best = points.best(study, quality)
    if best is not None:
        mark_best(axes, float(scale.places([best])[0]), best.values[quality], size=13)
    scale.set_up(axes, "x", width=width)
    finish(axes)


def _draw_line(
    axes: Axes, study: StudyRecord, points: Points, scale: Scale, *, quality: int, others: int
) -> list[Artist]:
    """Returns legend entries."""
    draw_slice(axes, study, points, scale, quality=quality, color=_SINGLE)
    axes.set_ylabel(quality_label(study, quality))
    best = points.best_at(lambda trials: scale.places(trials)[:, None], quality, study.signs[quality])
    handles: list[Artist] = []
    # Where nearly every point has a place of its own, the best at each is no curve.
    if not isinstance(scale.dimension, Choice) and (not others or 2 * len(best.known) <= len(points.known)):
        order = np.argsort(scale.places(best.known))
        text = f"the best over {_count(others)}" if others else None
        (line,) = axes.plot(
            scale.places(best.known)[order],
            values(best.known, quality)[order],
            color=_SINGLE,
            linewidth=1.2,
            zorder=2,
            label=text,
            gid="h",
        )
        handles = [line] if others else []
    return [*handles, *point_keys(study, points)]


def _draw_surface(
    axes: Axes, study: StudyRecord, points: Points, x: Scale, y: Scale, *, quality: int, others: int
) -> list[Artist]:
    """Returns legend entries."""
    sign = study.signs[quality]
    # Bright is good.
    style: dict[str, Any] = {"cmap": colormaps["viridis" if sign > 0.0 else "viridis_r"]}

    def places(trials: Sequence[Trial]) -> np.ndarray:
        return np.column_stack([x.places(trials), y.places(trials)])

    best = points.best_at(places, quality, sign)
    x.set_up(axes, "x")
    y.set_up(axes, "y")
    numbers = not any(isinstance(scale.dimension, Choice) for scale in (x, y))
    everywhere = (*best.known, *best.dropped, *best.failed)
    (xs, column), (ys, row) = (np.unique(found, return_inverse=True) for found in places(everywhere).T)
    h = values(best.known, quality)
    if len(everywhere) == xs.size * ys.size and min(xs.size, ys.size) > 1:
        image = np.full((ys.size, xs.size), np.nan)
        image[row[: h.size], column[: h.size]] = h
        lines = numbers and min(image.shape) > 2
        drawn: ScalarMappable = draw_mesh(axes, xs, ys, image, log=(x.is_log, y.is_log), lines=lines, **style)
    else:
        at = places(best.known)
        if h.size:
            style.update(vmin=h.min(), vmax=h.max())
        if not others and numbers and _spans_a_plane(unit := _unit(at, x, y)):
            triangles = Triangulation(at[:, 0], at[:, 1], Triangulation(unit[:, 0], unit[:, 1]).triangles)
            axes.tricontourf(triangles, h, levels=_LEVELS, alpha=0.85, **style)
        marks: dict[str, Any] = {"s": 26, "edgecolors": "white", "linewidths": 0.5, "zorder": 2, "gid": "h"}
        drawn = axes.scatter(at[:, 0], at[:, 1], c=h, **marks, **style)
    handles = draw_remarks(axes, best, x, y)
    winner = points.best(study, quality)
    if winner is not None:
        mark_best(axes, *places([winner])[0])
    axes.figure.colorbar(drawn, ax=axes, label=quality_label(study, quality), pad=0.02)
    if others:
        axes.set_title(f"at each place, the best over {_count(others)}", fontsize="medium")
    return [*handles]


def _count(others: int) -> str:
    return f"{others} other parameter{'s' * (others > 1)}"


def _unit(places: np.ndarray, x: Scale, y: Scale) -> np.ndarray:
    """Places in the unit square, in which parameters of different units and scales are alike."""
    columns = zip((x, y), places.T, strict=True)
    return np.column_stack([[scale.dimension.to_unit(value) for value in column] for scale, column in columns])


def _spans_a_plane(unit: np.ndarray) -> bool:
    return len(unit) >= 3 and bool(np.linalg.matrix_rank(unit - unit[0], tol=1e-6) == 2)


def _legend(
    axes: Axes, study: StudyRecord, points: Points, chosen: Sequence[str], handles: Sequence[Artist], *, quality: int
) -> None:
    best = points.best(study, quality)
    if best is not None:
        (star,) = (line for line in axes.get_lines() if line.get_gid() == "best")
        at = ", ".join(_text(best.parameters[address]) for address in chosen)
        star.set_label(f"s⁰* = [{at}], {name(study, quality)} = {best.values[quality]:.4g}")
        handles = [star, *handles]
    if handles:
        where: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.13)}
        axes.legend(handles=handles, fontsize="small", ncols=2, frameon=False, **where)


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
