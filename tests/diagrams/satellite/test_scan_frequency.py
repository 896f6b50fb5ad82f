"""O2: the error of the perceived pose over the scan frequency, and where it comes from."""

from math import inf
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from vtbdrake.state.systems import pose_to_array
from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.satellite.bodies import Target
from vtbdrake_diagrams.satellite.studies.scan_frequency import (
    BLOCK,
    CLOSING_SPEED,
    DESKEWED,
    FREQUENCIES,
    QUANTILE,
    RAW,
    SETTLING,
    STARTS,
    TOLERANCE,
    TUMBLES,
    ApproachScenario,
    FrequencyAnswer,
    agree,
    frequency_problem,
    grip_error,
    keep,
    next_block,
    quantile_bounds,
    read_answer,
    skew,
    window,
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


def test_approaches_start_as_their_scenarios_do() -> None:
    problem = frequency_problem(tumble_deg=4.0, deskew=True, starts=[7])
    context, other = problem.testbed.default_context(), ApproachScenario(seed=7, tumble_deg=4.0).build()
    problem.testbed.write(context, dict(problem.conditions[0]))
    for address in ("sim.sys.target.body.pose", "sim.env.release.velocity"):
        there = other.read(other.default_context(), address)
        np.testing.assert_allclose(problem.testbed.read(context, address), there, atol=1e-12)


GOOD, BAD = 0.5 * TOLERANCE, 2.0 * TOLERANCE


@pytest.mark.parametrize("starts", [10, 30, 60])
def test_interval_holds_the_quantile_as_often_as_it_says(starts: int) -> None:
    # Errors that are exponentially distributed: 4,000 experiments.
    experiments = np.random.default_rng(0).exponential(size=(4000, starts))
    lower, estimate, upper = np.array([quantile_bounds(errors) for errors in experiments]).T
    true = -np.log(1.0 - QUANTILE)
    assert (lower <= true).mean() > 0.94
    assert (upper >= true).mean() > 0.94
    assert (lower <= estimate).all() and (estimate <= upper).all()
    # Ten approaches cannot bound the quantile from above, thirty can.
    assert np.isinf(upper).all() == (starts == 10)
    # Nine of ten approaches are within the estimate, and no more.
    assert ((experiments <= estimate[:, None]).sum(axis=1) == np.ceil(QUANTILE * starts)).all()


def bounds(good: int, bad: int) -> tuple[float, float, float]:
    return quantile_bounds([GOOD] * good + [BAD] * bad)


def test_window_has_two_ends_with_what_is_sure_of_them() -> None:
    frequencies = (0.5, 1.0, 2.0, 4.0, 8.0)
    rows = [bounds(0, 10), bounds(28, 2), bounds(30, 0), bounds(27, 3), bounds(0, 10)]
    both = window(frequencies, rows)
    assert both.lower == (0.5, 1.0, 2.0)
    assert both.upper == (2.0, 4.0, 8.0)
    assert both.is_bounded
    # Three of thirty are too many to be sure, and too few to be sure of the contrary.
    assert window(frequencies[:4], rows[:4]).upper == (2.0, 4.0, inf)
    assert window(frequencies[1:], rows[1:]).lower == (0.0, 1.0, 2.0)
    none = window(frequencies[:1], rows[:1])
    assert np.isnan(none.lower[1]) and str(none) == "none of the grid"


def test_ten_approaches_show_what_fails_but_not_what_suffices() -> None:
    few = window((0.5, 1.0, 2.0), [bounds(0, 10), bounds(10, 0), bounds(0, 10)])
    assert few.lower[:2] == (0.5, 1.0) and few.upper[1:] == (1.0, 2.0)
    assert np.isnan([few.lower[2], few.upper[0]]).all()
    assert not few.is_bounded
    assert str(few) == "1 Hz (none surely; not at 0.5 Hz and 2 Hz)"


def test_one_bad_approach_of_ten_does_not_count() -> None:
    assert window((1.0,), [bounds(9, 1)]).lower[1] == 1.0
    assert np.isnan(window((1.0,), [bounds(8, 2)]).lower[1])


def answer(raw: list[float], deskewed: list[float], count: int = 30) -> FrequencyAnswer:
    """Return the answer of errors that are the same in all approaches, at one tumble rate."""
    frequencies = (0.5, 1.0, 4.0, 16.0)
    return FrequencyAnswer(
        {
            (kind, 1.0, f): [value] * count
            for kind, row in ((RAW, raw), (DESKEWED, deskewed))
            for f, value in zip(frequencies, row, strict=True)
        }
    )


AT_1_HZ = float(skew(1.0))
RAW_ERRORS = [0.3, 1.2 * AT_1_HZ, GOOD, BAD]
DESKEWED_ERRORS = [0.3, GOOD, GOOD, BAD]


def test_bounded_window_that_is_explained_holds() -> None:
    shown = answer(RAW_ERRORS, DESKEWED_ERRORS)
    assert shown.holds
    assert shown.everywhere.lower == (0.5, 1.0, 1.0)
    assert shown.everywhere.upper == (4.0, 4.0, 16.0)
    # Few approaches say nothing of what surely suffices; where the ends are not, they do say.
    assert answer(RAW_ERRORS, DESKEWED_ERRORS, count=6).holds


@pytest.mark.parametrize(
    ("raw", "deskewed"),
    [
        pytest.param([0.3, 0.9 * AT_1_HZ, GOOD, BAD], DESKEWED_ERRORS, id="the skew does not explain the error"),
        pytest.param([0.3, 1.2 * AT_1_HZ, GOOD, BAD], [0.3, BAD, GOOD, BAD], id="de-skewing does not help"),
        pytest.param(RAW_ERRORS, [GOOD, GOOD, GOOD, BAD], id="no lower end"),
        pytest.param(RAW_ERRORS, [0.3, GOOD, GOOD, GOOD], id="no upper end"),
        pytest.param(RAW_ERRORS, [0.3, BAD, BAD, BAD], id="no frequency suffices"),
    ],
)
def test_every_part_of_holds_can_fail(raw: list[float], deskewed: list[float]) -> None:
    assert not answer(raw, deskewed).holds


def test_windows_that_share_no_frequency_do_not_hold() -> None:
    first = answer(RAW_ERRORS, [0.3, GOOD, BAD, BAD]).errors
    second = answer(RAW_ERRORS, [0.3, BAD, GOOD, BAD]).errors
    both = FrequencyAnswer({**first, **{(kind, 2.0, f): row for (kind, _, f), row in second.items()}})
    assert not both.holds


def test_undecided_frequencies_get_their_approaches_first() -> None:
    first, starts = next_block({})
    assert first[0] == DESKEWED and starts == STARTS[:BLOCK]
    every = {(kind, t, f): [BAD] * 10 for kind in (RAW, DESKEWED) for t in TUMBLES for f in FREQUENCIES}
    undecided = (RAW, TUMBLES[0], 4.0)
    assert next_block({**every, undecided: [GOOD] * 10}) == (undecided, STARTS[10 : 10 + BLOCK])
    assert next_block({**every, undecided: [GOOD] * 30})[0] != undecided
    assert next_block({key: [BAD] * len(STARTS) for key in every}) is None


def test_kept_answer_comes_back(tmp_path: Path) -> None:
    before = answer([0.3, 0.06, inf, BAD], DESKEWED_ERRORS, count=2)
    keep(before, tmp_path / "kept.json")
    assert read_answer(tmp_path / "kept.json") == before


def test_approaches_again_agree_to_a_tenth_of_the_tolerance() -> None:
    assert agree(GOOD, GOOD + 0.05 * TOLERANCE)
    assert not agree(GOOD, GOOD + 0.2 * TOLERANCE)
    assert not agree(GOOD, 10.0 * TOLERANCE)
    assert agree(10.0 * TOLERANCE, 30.0 * TOLERANCE)


def test_tumbles_that_hide_the_front_are_refused() -> None:
    with pytest.raises(ScenarioError, match="tumble_deg must be a number from 0 to 4.5 deg/s"):
        ApproachScenario(tumble_deg=10.0).build()
