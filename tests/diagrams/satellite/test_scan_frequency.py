"""O2: the error of the perceived pose over the scan frequency, and where it comes from."""

from math import inf

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from vtbdrake.state.systems import pose_to_array
from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.satellite.bodies import Target
from vtbdrake_diagrams.satellite.scan_frequency import (
    CLOSING_SPEED,
    SETTLING,
    TOLERANCE,
    ApproachScenario,
    FrequencyAnswer,
    grip_error,
    skew,
)

pytestmark = pytest.mark.one_python

FREQUENCY = 2.0


@pytest.mark.parametrize("deskew", [False, True])
def test_target_seems_half_a_scan_behind_without_deskewing(deskew: bool) -> None:
    testbed = ApproachScenario(tumble_deg=1.0, deskew=deskew).build()
    context = testbed.default_context()
    testbed.write(context, {"sim.sense.scanner.frequency": FREQUENCY})
    simulator = testbed.simulator(context)
    behind = []
    for time in (5.5, 6.0, 6.5, 7.0):
        simulator.AdvanceTo(time)
        perceived, true = (testbed.read(context, a) for a in ("dps.env.target.pose", "sim.sys.target.body.pose"))
        behind.append(perceived[0] - true[0])
    expected = 0.0 if deskew else CLOSING_SPEED / (2.0 * FREQUENCY)
    assert np.mean(behind) == pytest.approx(expected, abs=0.004)


def test_error_is_that_of_the_end_of_the_bar() -> None:
    true = RigidTransform(RollPitchYaw(0.3, -0.2, 0.1), [2.0, 0.1, -0.1])
    moved = RigidTransform([0.0, 0.0, 0.01]) @ true
    assert grip_error(SETTLING, pose_to_array(moved), pose_to_array(true)) == pytest.approx(0.01)
    # About the line between the bar's middle and the target's centre, its ends move on circles.
    turned = true @ RigidTransform(RollPitchYaw(0.02, 0.0, 0.0), np.zeros(3))
    chord = 2.0 * np.sin(0.01) * Target().bar_length / 2.0
    assert grip_error(SETTLING, pose_to_array(turned), pose_to_array(true)) == pytest.approx(chord)
    assert grip_error(SETTLING - 0.1, pose_to_array(turned), pose_to_array(true)) == 0.0


def answer(raw: list[float], deskewed: list[float]) -> FrequencyAnswer:
    return FrequencyAnswer(np.array([1.0]), np.array([0.5, 1.0, 4.0]), np.array([raw]), np.array([deskewed]))


def test_least_frequency_is_the_first_below_the_tolerance() -> None:
    good, bad = 0.5 * TOLERANCE, 2.0 * TOLERANCE
    found = answer([bad, bad, bad], [bad, good, bad])
    assert found.least(found.raw) == [(4.0, inf)]
    assert found.least(found.deskewed) == [(0.5, 1.0)]
    assert found.least(np.array([[good, bad, bad]])) == [(0.0, 0.5)]


def test_trend_is_explained_only_where_errors_follow_the_skew() -> None:
    at_1_hz = float(skew(1.0))
    raw, deskewed = [0.3, 1.2 * at_1_hz, 0.5 * TOLERANCE], [0.3, 0.4 * TOLERANCE, 0.5 * TOLERANCE]
    assert answer(raw, deskewed).holds
    assert not answer([0.3, 0.9 * at_1_hz, 0.5 * TOLERANCE], deskewed).explained
    assert not answer(raw, raw).explained
    assert not answer(raw, [0.3, 0.4 * TOLERANCE, 0.3 * TOLERANCE]).explained


def test_tumbles_that_hide_the_front_are_refused() -> None:
    with pytest.raises(ScenarioError, match="tumble_deg must be within"):
        ApproachScenario(tumble_deg=10.0).build()
