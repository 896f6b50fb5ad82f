"""O2: the error of the perceived pose over the scan frequency, and where it comes from."""

from math import inf

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from vtbdrake.state.systems import pose_to_array
from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.satellite.bodies import Target
from vtbdrake_diagrams.satellite.studies.scan_frequency import (
    CLOSING_SPEED,
    QUANTILE,
    SETTLING,
    TOLERANCE,
    ApproachScenario,
    Errors,
    FrequencyAnswer,
    grip_error,
    skew,
)

pytestmark = pytest.mark.one_python

FREQUENCY = 2.0


@pytest.mark.slow
@pytest.mark.parametrize("deskew", [False, pytest.param(True, marks=pytest.mark.slow)])
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


def errors(rows: list[list[float]], frequencies: tuple[float, ...] = (0.5, 1.0, 4.0)) -> Errors:
    """Return the errors at one tumble rate: for each frequency, the errors of some approaches."""
    return Errors(np.array(frequencies), np.array([rows]))


GOOD, BAD = 0.5 * TOLERANCE, 2.0 * TOLERANCE


@pytest.mark.parametrize("starts", [10, 30, 60])
def test_interval_holds_the_quantile_as_often_as_it_says(starts: int) -> None:
    # Errors that are exponentially distributed: 4,000 experiments.
    random = np.random.default_rng(0)
    found = Errors(np.ones(4000), random.exponential(size=(1, 4000, starts)))
    lower, estimate, upper = (bound[0] for bound in found.quantiles())
    true = -np.log(1.0 - QUANTILE)
    assert (lower <= true).mean() > 0.94
    assert (upper >= true).mean() > 0.94
    assert (lower <= estimate).all() and (estimate <= upper).all()
    # Ten approaches cannot bound the quantile from above, thirty can.
    assert np.isinf(upper).all() == (starts == 10)
    # Nine of ten approaches are within the estimate, and no more.
    assert ((found.values[0] <= estimate[:, None]).sum(axis=1) == np.ceil(QUANTILE * starts)).all()


def test_one_bad_approach_of_ten_does_not_count() -> None:
    once, twice = [GOOD] * 9 + [BAD], [GOOD] * 8 + [BAD] * 2
    assert errors([twice, once, once]).least() == [(0.0, 1.0, inf)]
    assert errors([[BAD] * 10, twice, twice]).least() == [(0.5, inf, inf)]
    assert errors([[BAD] * 30, [GOOD] * 28 + [BAD] * 2, [GOOD] * 30]).least() == [(0.5, 1.0, 4.0)]


def answer(raw: list[float], deskewed: list[float]) -> FrequencyAnswer:
    """Return the answer of errors that are the same in all approaches."""
    frequencies = (0.5, 1.0, 4.0)
    return FrequencyAnswer(
        np.array([1.0]), *(errors([[value] * 30 for value in row], frequencies) for row in (raw, deskewed))
    )


def test_every_printed_claim_can_be_refuted() -> None:
    at_1_hz = float(skew(1.0))
    raw, deskewed = [0.3, 1.2 * at_1_hz, GOOD], [0.3, 0.8 * GOOD, GOOD]
    assert answer(raw, deskewed).holds
    behind = answer([0.3, 0.9 * at_1_hz, GOOD], deskewed)
    assert not (behind.follows or behind.holds)
    alike = answer(raw, [0.3, BAD, GOOD])
    assert not (alike.helps or alike.holds)
    finer = answer(raw, [0.3, 0.8 * GOOD, 0.6 * GOOD])
    assert not (finer.thins or finer.holds)
    none = answer([0.3, 1.2 * at_1_hz, BAD], [0.3, BAD, 1.1 * BAD])
    assert not none.holds


def test_tumbles_that_hide_the_front_are_refused() -> None:
    with pytest.raises(ScenarioError, match="tumble_deg must be a number from 0 to 4.5 deg/s"):
        ApproachScenario(tumble_deg=10.0).build()
