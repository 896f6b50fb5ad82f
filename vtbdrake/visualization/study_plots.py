"""Pictures of a study: its history, slices, importances and Pareto front."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, PercentFormatter

from vtbdrake.visualization.figure import Picture, finish
from vtbdrake.visualization.study_landscape import draw_slice, plot_landscape
from vtbdrake.visualization.study_points import (
    BEST,
    BROKEN_STYLE,
    Points,
    draw_points,
    name,
    point_keys,
    quality_label,
    scales,
    values,
)

if TYPE_CHECKING:
    from vtbdrake.optimization.study_record import StudyRecord

__all__ = ["plot_history", "plot_importances", "plot_landscape", "plot_pareto", "plot_slices"]

_METHODS = colormaps["tab10"]
_ORDER = colormaps["viridis"]
_BARS = "#2166ac"
_PER_ROW = 4
_ORDER_LABEL = "point, in the order of the study"


def plot_history(study: StudyRecord) -> Figure:
    """Every quality in the order of the points, coloured by the method that asked for them, and the best so far.

    Raises:
        ValueError: there are no points.
    """
    points = Points.of(study)
    trials = study.trials
    methods = Counter(trial.method for trial in trials)
    colors = {method: _METHODS(k % 10) for k, method in enumerate(methods)}
    count = len(study.names)
    figure = Picture(8.0, 1.6 + 2.6 * count)
    for quality, axes in enumerate(figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]):
        draw_points(
            axes,
            study,
            points,
            lambda found: np.array([trial.number for trial in found], dtype=float),
            quality=quality,
            c=[colors[trial.method] for trial in points.kept],
        )
        if points.kept:
            numbers = np.array([trial.number for trial in points.kept])
            best = study.signs[quality] * np.maximum.accumulate(study.signs[quality] * values(points.kept, quality))
            # What was best at the end stays so up to the last point.
            axes.plot(
                [*numbers, trials[-1].number],
                [*best, best[-1]],
                color=BEST,
                drawstyle="steps-post",
                linewidth=1.4,
                gid="best so far",
                zorder=2.5,
            )
        axes.set_ylabel(quality_label(study, quality))
        axes.xaxis.set_major_locator(MaxNLocator(nbins="auto", integer=True))
        finish(axes)
    axes.set_xlabel(_ORDER_LABEL)
    handles = [
        Line2D([], [], marker="o", linestyle="none", markersize=5, color=colors[method], label=f"{method} ({number})")
        for method, number in methods.items()
    ]
    if points.kept:
        handles.append(Line2D([], [], color=BEST, linewidth=1.4, label="best so far"))
    _legend(figure, [*handles, *point_keys(study, points)])
    return figure


def plot_slices(study: StudyRecord) -> Figure:
    """Every quality over every parameter, coloured by the order of the points; the best point as a star.

    Raises:
        ValueError: there are no points.
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


def plot_importances(study: StudyRecord) -> Figure:
    """How much each parameter decides about whether a point is among the best tenth, for every quality.

    See `vtbdrake.optimization.optuna_bridge.importances`.

    Raises:
        ModuleNotFoundError: Optuna is not installed.
        ValueError: there are too few points with a value, or they all have the same.
    """
    from vtbdrake.optimization.optuna_bridge import importances

    shares = importances(study)
    figure = Picture(8.0, 0.6 + len(shares) * (0.8 + 0.4 * len(study.parameters)))
    points = Points.of(study)
    for quality, axes in enumerate(figure.subplots(len(shares), 1, squeeze=False)[:, 0]):
        addresses = list(shares[quality])
        bars = axes.barh(addresses, list(shares[quality].values()), color=_BARS, height=0.6, gid="importance")
        axes.bar_label(bars, fmt=lambda share: f"{share:.1%}", padding=4, fontsize="small")
        axes.invert_yaxis()
        axes.set_xlim(0.0, 1.1 * max(shares[quality].values()))
        axes.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        axes.set_title(
            f"{name(study, quality)}: what decides whether a point is among the best tenth", fontsize="medium"
        )
        finish(axes)
        axes.grid(False, axis="y")
    axes.set_xlabel(f"share of the importance (PED-ANOVA on {len(points.known)} of {len(study.trials)} points)")
    return figure


def plot_pareto(study: StudyRecord) -> Figure:
    """Two qualities against each other, with the Pareto front; of three qualities, every pair of them.

    Raises:
        ValueError: there are no points, or not two or three qualities.
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
        # Of three qualities the front is a surface, whose edge is not what a line would show.
        axes.plot(
            *front_xy.T,
            color=BEST,
            marker="o",
            markersize=6,
            markeredgecolor="white",
            markeredgewidth=0.6,
            linestyle="-" if count == 2 else "none",
            linewidth=1.0,
            drawstyle="steps-pre" if study.signs[i] > 0.0 else "steps-post",
            zorder=4,
            gid="front",
        )
        axes.set(xlabel=quality_label(study, i), ylabel=quality_label(study, j))
        finish(axes)
    handles = [
        Line2D([], [], color=BEST, marker="o", linestyle="none", label=f"Pareto front ({len(front)})"),
        Line2D([], [], color=_BARS, marker="o", linestyle="none", markersize=5, alpha=0.6, label="other points"),
    ]
    _legend(figure, [*handles, *point_keys(study, replace(points, failed=()))])
    if points.failed:
        figure.suptitle(f"not shown: {len(points.failed)} points whose simulation failed", fontsize="medium")
    return figure


def _draw_pair(axes: Axes, study: StudyRecord, points: Points, pair: tuple[int, int]) -> None:
    i, j = pair
    axes.scatter(values(points.kept, i), values(points.kept, j), s=22, color=_BARS, alpha=0.6, linewidths=0, gid="kept")
    axes.plot(values(points.broken, i), values(points.broken, j), gid="broken", **BROKEN_STYLE)


def _best_key(points: Points) -> list[Line2D]:
    if not points.kept:
        return []
    return [
        Line2D([], [], marker="*", linestyle="none", color=BEST, markersize=11, markeredgecolor="white", label="best")
    ]


def _legend(figure: Figure, handles: list[Line2D]) -> None:
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize="small", frameon=False)
