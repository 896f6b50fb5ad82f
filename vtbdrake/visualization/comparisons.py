"""Plots and pages of recordings beside their simulations."""

from __future__ import annotations

from html import escape

from matplotlib.figure import Figure

from vtbdrake.calibration.validation import COLUMNS, Comparison
from vtbdrake.common.summary_html import image_html
from vtbdrake.visualization.plots import Picture, finish

_RECORDED = "0.2"
_SIMULATED = "tab:orange"


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
    """Return HTML with the verdict, a table of the numbers and the plot."""
    head = "".join(f"<th>{escape(title)}</th>" for title in ("signal", "verdict", *COLUMNS, "samples"))
    rows = []
    for name, result in comparison.signals.items():
        reasons = "".join(f"<br>{escape(reason)}" for reason in result.beyond)
        cells = "".join(f"<td>{number}</td>" for number in (*result.cells, result.samples))
        rows.append(f"<tr><td>{escape(name)}</td><td>{result.verdict}{reasons}</td>{cells}</tr>")
    return (
        f"<div><b>{escape(f'{comparison.source}: {comparison.verdict}')}</b>"
        f"<table><tr>{head}</tr>{''.join(rows)}</table>{image_html(plot_comparison(comparison))}</div>"
    )
