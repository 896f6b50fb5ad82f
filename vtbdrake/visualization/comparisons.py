"""Plots and pages of recordings beside their simulations."""

from __future__ import annotations

from math import isnan
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from vtbdrake.visualization.plots import Picture, finish, summary_html

if TYPE_CHECKING:
    from vtbdrake.calibration import Comparison

_RECORDED, _SIMULATED = "0.2", "tab:orange"


def plot_comparison(comparison: Comparison) -> Figure:
    """Return a figure with a row per signal: recording, simulation and band, and the residuals beside them."""
    figure = Picture(9.0, 1.0 + 1.8 * len(comparison.curves))
    grid = figure.subplots(len(comparison.curves), 2, squeeze=False, sharex="row")
    for (name, (times, r, s, lower, upper)), (left, right) in zip(comparison.curves.items(), grid, strict=True):
        result = comparison.signals[name]
        left.plot(times, r, color=_RECORDED, lw=1.4, label="recorded")
        left.plot(times, s, color=_SIMULATED, lw=1.2, label="simulated")
        if (upper > lower).any():
            left.fill_between(
                times, lower, upper, color=_SIMULATED, alpha=0.25, lw=0.0, label="95 % of the simulations"
            )
        left.set_title(f"{name}: {result.verdict}", loc="left", fontsize="medium")
        right.plot(times, s - r, color=_SIMULATED, lw=1.0)
        right.axvline(result.largest_at, color="0.6", lw=0.8, ls=":")
        right.set_title("simulated - recorded", loc="left", fontsize="medium")
        for axes in (left, right):
            finish(axes)
    grid[0, 0].legend(fontsize="small")
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    return figure


def comparison_html(comparison: Comparison) -> str:
    """Return HTML with the verdict, the numbers and the plot."""
    rows = {}
    for name, result in comparison.signals.items():
        reasons = f" ({'; '.join(result.beyond)})" if result.beyond else ""
        coverage = "" if isnan(result.coverage) else f"coverage {result.coverage:.3g}, "
        rows[name] = (
            f"{result.verdict}{reasons}: rmse {result.rmse:.4g} ({100.0 * result.normalized:.3g} % of the range), "
            f"largest {result.largest:.4g} at {result.largest_at:.4g} s, late by {1e3 * result.delay:.3g} ms, "
            f"Sprague-Geers magnitude {result.magnitude:+.3f} and phase {result.phase:.3f}, {coverage}whiteness "
            f"p = {result.whiteness:.2g}, {result.samples} samples"
        )
    return summary_html(f"{comparison.source}: {comparison.verdict}", rows, plot_comparison(comparison))
