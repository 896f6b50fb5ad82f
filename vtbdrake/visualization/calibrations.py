"""Plots and pages of calibrations: the numbers with their verdicts, and recordings beside the calibrated model."""

from __future__ import annotations

from html import escape
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vtbdrake.calibration.calibration_result import Calibration
from vtbdrake.calibration.fit_curves import FitCurves
from vtbdrake.common.summary_html import image_html
from vtbdrake.visualization.plots import Picture, finish

_RECORDED = "0.2"
_MODEL = "tab:orange"
_COLUMNS = ("start", "value", "deviation", "interval of 95 %", "verdict")


def plot_calibration(calibration: Calibration) -> Figure:
    """Return a figure with a row per joint: torques beside those that the model needs, and the filter's errors.

    Raises:
        ValueError: The calibration has no recordings to show; one by rollouts has none.
    """
    curves = calibration.curves
    if curves is None:
        raise ValueError("this calibration has no curves: those by `calibrate` have some, those by rollouts have none")
    figure = Picture(9.0, 1.0 + 1.8 * len(curves.joints))
    grid = figure.subplots(len(curves.joints), 2, squeeze=False, sharex=True)
    for j, (left, right) in enumerate(grid):
        left.plot(curves.times, curves.torque[:, j], color=_RECORDED, lw=1.2, label="of the motor")
        left.plot(curves.times, curves.needed[:, j], color=_MODEL, lw=1.0, label="needed by the model")
        left.set_title(f"{curves.joints[j]}: torque [N m or N]", loc="left", fontsize="medium")
        right.plot(curves.error_times, curves.errors[:, j], color=_MODEL, lw=0.0, marker=".", ms=2.0)
        right.set_title("position error of the filter [deviations]", loc="left", fontsize="medium")
        _shade_held_back(right, curves)
        for axes in (left, right):
            finish(axes)
    grid[0, 0].legend(fontsize="small")
    for axes in grid[-1]:
        axes.set_xlabel("time [s]; gray: kept back from the fit" if axes is grid[-1, 1] else "time [s]")
    return figure


def _shade_held_back(axes: Axes, curves: FitCurves) -> None:
    marks = np.concatenate([[False], curves.held_back, [False]])
    changes = np.flatnonzero(marks[1:] != marks[:-1])
    for begin, end in list(pairwise(changes))[::2]:
        axes.axvspan(curves.error_times[begin], curves.error_times[end - 1], color="0.9", lw=0.0)


def calibration_html(calibration: Calibration) -> str:
    """Return HTML with the verdicts, a table of the numbers, reasons and remarks, and the plot."""
    head = "".join(f"<th>{escape(title)}</th>" for title in ("", *_COLUMNS))
    rows = []
    for address, each in calibration.parameters.items():
        cells = (
            f"{each.start:.5g}",
            f"{each.value:.5g}",
            f"{each.deviation:.2g}",
            f"[{each.lower:.5g}, {each.upper:.5g}]",
            str(each.verdict),
        )
        rows.append(f"<tr><td>{escape(address)}</td>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>")
    sentences = (*calibration.reasons, *calibration.combinations, *calibration.remarks)
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)
    image = "" if calibration.curves is None else image_html(plot_calibration(calibration))
    return (
        f"<div><b>{escape(calibration.summary)}</b><table><tr>{head}</tr>{''.join(rows)}</table><ul>{items}</ul>"
        f"{image}</div>"
    )
