"""The plot and the page of a calibration, from curves that are written here."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.calibration.pendulum import PendulumScenario
from vtbdrake.calibration import Calibration
from vtbdrake.calibration.calibration_result import Calibrated, Verdict
from vtbdrake.calibration.fit_curves import FitCurves

pytestmark = pytest.mark.one_python

TIMES = 0.1 * np.arange(20)
CURVES = FitCurves(
    joints=("shoulder", "elbow"),
    times=TIMES,
    torque=np.stack([np.sin(TIMES), np.cos(TIMES)], axis=1),
    needed=np.stack([TIMES, -TIMES], axis=1),
    error_times=TIMES,
    errors=np.stack([TIMES - 1.0, 1.0 - TIMES], axis=1),
    held_back=(TIMES > 0.45) & (TIMES < 0.95),
)
CALIBRATION = Calibration(
    scenario=PendulumScenario(),
    parameters={"sim.a<b": Calibrated("sim.a<b", 1.0, 2.0, 0.1, 1.8, 2.2, Verdict.ACCEPTED)},
    combinations=(),
    noise=None,
    fit=1.0,
    holdout=1.1,
    correlation=0.1,
    reasons=("the model lacks a & b",),
    segments=3,
    sources=("log.csv",),
    curves=CURVES,
)


def test_plot_has_torques_and_errors_of_each_joint_and_what_was_kept_back() -> None:
    figure = CALIBRATION.plot()
    left, right = figure.axes[2:4]
    torque, needed = left.get_lines()
    np.testing.assert_array_equal(torque.get_ydata(), CURVES.torque[:, 1])
    np.testing.assert_array_equal(needed.get_ydata(), CURVES.needed[:, 1])
    np.testing.assert_array_equal(right.get_lines()[0].get_ydata(), CURVES.errors[:, 1])
    (span,) = right.patches
    assert (span.get_x(), span.get_x() + span.get_width()) == pytest.approx((0.5, 0.9))


def test_page_has_numbers_verdicts_and_reasons(tmp_path: Path) -> None:
    CALIBRATION.save_html(tmp_path / "fit.html")
    page = (tmp_path / "fit.html").read_text()
    for text in ("sim.a&lt;b", "[1.8, 2.2]", "accepted", "the model lacks a &amp; b", "hold-out 1.1", "data:image/png"):
        assert text in page


def test_calibration_without_curves_has_a_page_and_no_plot() -> None:
    without = replace(CALIBRATION, curves=None)
    assert "data:image" not in without._repr_html_()
    with pytest.raises(ValueError, match="has no curves"):
        without.plot()
