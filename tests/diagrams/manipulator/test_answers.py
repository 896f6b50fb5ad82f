"""Row C1 of the table of answers can say no, for each of its parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vtbdrake_diagrams.manipulator.studies.answers import COMPARED, Baseline, Trials
from vtbdrake_diagrams.manipulator.studies.trials import FREE, RestingForce, Track

pytestmark = pytest.mark.one_python


def track(error: float) -> Track:
    """Return a track whose tip is off by an error in m in each sample."""
    n = 10
    wanted = np.zeros((n, 3))
    motion = np.full(n, float(FREE[0]))
    tip = wanted + np.array([error, 0.0, 0.0])
    return Track(motion, 0.001 * np.arange(n), wanted, tip, np.zeros((n, 3)), np.zeros((n, 7)))


FORCES = (RestingForce(50.0, 50.5), RestingForce(50.0, 48.0))
GOOD = Trials(track(0.002), track(0.003), FORCES, COMPARED, identical=True, latched="")


def test_an_arm_that_follows_holds() -> None:
    assert GOOD.errors == pytest.approx((0.002, 0.003))
    assert GOOD.holds


def test_a_baseline_is_tuned_in_simulation_and_judged_on_the_machine() -> None:
    scores = {1.0: 0.004, 1.5: 0.002, 2.0: np.nan}
    baseline = Baseline(scores, track(0.003), latched="")
    assert baseline.scale == 1.5
    assert str(baseline) == "3.00 mm, gains x 1.5, 0 N m"
    assert "LATCHED" in str(replace(baseline, latched="the torque is not finite"))


@pytest.mark.parametrize(
    "change",
    [
        {"simulated": track(0.006), "real": track(0.004)},
        {"simulated": track(np.nan)},
        {"real": track(0.006), "simulated": track(0.004)},
        {"real": track(0.0041)},
        {"pressed": (FORCES[0], RestingForce(50.0, 52.6))},
        {"pressed": (RestingForce(50.0, 47.4), FORCES[1])},
        {"pressed": (FORCES[0], RestingForce(50.0, np.nan))},
        {"identical": False},
        {"compared": 0},
        {"latched": "the torque is not finite"},
    ],
)
def test_each_part_of_the_answer_can_fail(change: dict[str, object]) -> None:
    assert not replace(GOOD, **change).holds
