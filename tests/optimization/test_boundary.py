"""The boundary: refined where it must be, and not fooled by an outcome that is not monotonic."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import beta

from tests.testbeds import PendulumScenario
from vtbdrake.optimization import Parameter, Problem, Sweep
from vtbdrake.optimization.boundary import Chance, Refinement, find_boundary, repeat_around
from vtbdrake.rollout import Constraint, Quality, QualityError, RolloutResult

THETA = "sim.sys.Pendulum.theta.position"
OMEGA = "sim.sys.Pendulum.theta.velocity"
DAMPING = "sim.sys.Pendulum.theta.damping"


MASS = Parameter("m", 0.0, 60.0)


def _refinement(resolution=1.0, coarse=5.0, parameter=MASS):
    return Refinement(parameter, resolution=resolution, coarse=coarse)


def _examine(refinement, fails, conditions=1):
    """Runs the refinement on an outcome given as a function; what was examined, and how it went."""
    outcomes, rounds = {}, []

    def examine(candidates):
        trials = [(refinement.value(index), condition) for index, condition in candidates]
        assert not set(trials) & set(outcomes), "a trial was asked for twice"
        rounds.append(len(trials))
        outcomes.update({trial: fails(*trial) for trial in trials})
        return [outcomes[trial] for trial in trials]

    find_boundary(refinement, conditions, examine)
    return outcomes, rounds


def _sweep(outcomes, conditions=1):
    rows = sorted(outcomes)
    results = [
        RolloutResult(
            {"m": value},
            "failed" if outcomes[value, condition] is None else "horizon",
            np.array([0.0]),
            np.array([float(bool(outcomes[value, condition]))]),
            threshold=0.5,
            exceedances=np.zeros(int(bool(outcomes[value, condition]))),
        )
        for value, condition in rows
    ]
    return Sweep(
        parameters=(MASS,),
        units=("kg",),
        conditions=tuple({} for _ in range(conditions)),
        points=np.array([[value] for value, _ in rows]),
        condition=np.array([condition for _, condition in rows]),
        rollouts=tuple(results),
    )


@given(st.integers(0, 61))
def test_a_monotonic_boundary_is_found_to_the_resolution(first):
    outcomes, _ = _examine(_refinement(), lambda m, _: m >= first)
    boundary = _sweep(outcomes).boundary()
    expected = (first - 1.0 if first > 0 else -inf, float(first) if first <= 60 else inf)
    assert (boundary.lower, boundary.upper) == expected
    assert len(outcomes) <= 13 + 8


@given(st.sets(st.integers(0, 60), min_size=1))
def test_what_lies_below_the_answer_was_examined_two_cells_deep(bad):
    outcomes, _ = _examine(_refinement(), lambda m, _: int(m) in bad)
    boundary = _sweep(outcomes).boundary()
    if boundary.upper == inf:
        assert not bad & set(range(0, 61, 5))
        return
    assert int(boundary.upper) in bad
    # The cell of the first failure and the one below: none of their values bad, all examined; so is the coarse grid.
    cell = (int(boundary.upper) - 1) // 5 * 5
    margin = set(range(max(0, cell - 5), int(boundary.upper)))
    assert margin <= {int(m) for m, _ in outcomes}
    assert not margin & bad
    assert not bad & {m for m in range(0, 61, 5) if m < boundary.upper}


def test_bisection_would_have_been_fooled():
    # Tips at 40 to 42, stands at 43 to 46, tips from 47 on: bisection over [0, 60] ends between 46 and 47.
    def tips(m, _=0):
        return 40 <= m <= 42 or m >= 47

    low, high = 0.0, 60.0
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if tips(middle) else (middle, high)
    assert (low, high) == (46.0, 47.0)
    outcomes, _ = _examine(_refinement(), tips)
    boundary = _sweep(outcomes).boundary()
    assert (boundary.lower, boundary.upper) == (39.0, 40.0)
    assert 45.0 in boundary.safe_beyond


def test_every_condition_has_its_own_interval_and_the_least_counts():
    outcomes, _ = _examine(_refinement(), lambda m, c: m >= (44.0, 41.0, 47.0)[c], conditions=3)
    boundary = _sweep(outcomes, 3).boundary()
    np.testing.assert_array_equal(boundary.by_condition, [[43, 44], [40, 41], [46, 47]])
    assert (boundary.lower, boundary.upper) == (40.0, 41.0)
    assert str(boundary) == (
        "m: safe up to 40 kg, not at 41 kg; an unsafe range below that is narrower than 5 kg may have been missed"
    )


def test_the_ends_of_the_range_are_told_as_such():
    safe, _ = _examine(_refinement(), lambda m, _: False)
    assert str(_sweep(safe).boundary()) == (
        "m: safe up to 60 kg, the largest value examined; "
        "an unsafe range below that is narrower than 5 kg may have been missed"
    )
    unsafe, _ = _examine(_refinement(), lambda m, _: True)
    assert str(_sweep(unsafe).boundary()) == "m: not safe at 0 kg, the smallest value examined"


@pytest.mark.parametrize("unit", ["", "1"])
def test_a_boundary_without_unit_is_a_plain_number(unit):
    outcomes, _ = _examine(_refinement(), lambda m, _: m > 30.0)
    boundary = replace(_sweep(outcomes).boundary(), unit=unit)
    assert boundary.interval_text(30.0, 31.0) == "safe up to 30, not at 31"


def test_a_simulation_that_fails_is_not_safe():
    boundary = _sweep({(0.0, 0): False, (5.0, 0): None, (10.0, 0): True}).boundary()
    assert (boundary.lower, boundary.upper, boundary.failed_at) == (0.0, 5.0, (5.0,))


def test_uneven_range_ends_at_its_end():
    outcomes, _ = _examine(_refinement(0.3, 0.6, Parameter("m", 0.0, 1.0)), lambda m, _: m > 0.95)
    boundary = _sweep(outcomes).boundary()
    assert (boundary.lower, boundary.upper) == (pytest.approx(0.9), 1.0)


@pytest.mark.parametrize(("resolution", "coarse"), [(0.0, 5.0), (5.0, 1.0), (1.0, 100.0), (-1.0, 5.0)])
def test_steps_that_do_not_fit_are_refused(resolution, coarse):
    with pytest.raises(ValueError, match="0 < resolution <= coarse <= 60"):
        _refinement(resolution, coarse)


@given(st.sets(st.integers(0, 60)))
def test_every_unsafe_range_as_wide_as_the_gap_is_seen(bad):
    outcomes, _ = _examine(_refinement(), lambda m, _: int(m) in bad)
    boundary = _sweep(outcomes).boundary()
    missed = [m for m in bad if m < boundary.lower]
    runs = [k for k in range(1, 61) if any(set(range(m, m + k)) <= set(missed) for m in missed)]
    # k neighbouring values that are all unsafe are less than (k + 1) kg wide.
    assert max(runs, default=0) + 1 <= max(boundary.gap, 1.0)
    if missed:
        told = f"an unsafe range below that is narrower than {boundary.gap:g} kg may have been missed"
        assert told in str(boundary)


def test_a_fine_grid_misses_nothing_that_it_would_have_to_tell():
    outcomes, _ = _examine(_refinement(1.0, 1.0), lambda m, _: m >= 20.0)
    assert str(_sweep(outcomes).boundary()) == "m: safe up to 19 kg, not at 20 kg"


def test_the_steps_of_a_logarithmic_range_are_ratios():
    parameter = Parameter("m", 1e-3, 10.0, log=True)
    refinement = _refinement(10**0.1, 10**0.5, parameter)
    outcomes, _ = _examine(refinement, lambda m, _: m > 0.05)
    boundary = _sweep(outcomes).boundary()
    assert boundary.lower <= 0.05 < boundary.upper
    assert boundary.upper / boundary.lower == pytest.approx(10**0.1)
    coarse = [refinement.value(index) for index in refinement.start()]
    np.testing.assert_allclose(coarse, np.geomspace(1e-3, 10.0, 9))
    assert len(outcomes) <= 9 + 8


@pytest.mark.parametrize(
    ("parameter", "resolution", "coarse", "message"),
    [
        (Parameter("m", 1.0, 10.0, log=True), 0.5, 2.0, "are ratios of neighbouring values, 1 < resolution"),
        (Parameter("m", 1.0, 10.0, log=True), 2.0, 20.0, "<= coarse <= 10 .the ratio"),
        (
            Parameter("m", 1, 10, integer=True),
            0.5,
            2.0,
            "the resolution of m, an integer, must be a whole number, not 0.5",
        ),
        (Parameter("m", 1, 10, integer=True, log=True), 2.0, 4.0, "leave log out"),
    ],
)
def test_steps_that_do_not_suit_the_parameter_are_refused(parameter, resolution, coarse, message):
    with pytest.raises(ValueError, match=message):
        _refinement(resolution, coarse, parameter)


def test_an_integer_is_searched_in_whole_numbers():
    outcomes, _ = _examine(_refinement(2.0, 5.0, Parameter("m", 1, 20, integer=True)), lambda m, _: m >= 12)
    assert all(float(m).is_integer() for m, _ in outcomes)
    boundary = _sweep(outcomes).boundary()
    assert (boundary.lower, boundary.upper) == (11.0, 13.0)


@pytest.mark.parametrize(("unsafe", "rollouts"), [(0, 10), (3, 18), (10, 10), (1, 2)])
def test_the_interval_of_a_chance_is_that_of_clopper_and_pearson(unsafe, rollouts):
    low, high = Chance(34.0, 0, rollouts, unsafe).interval
    assert low == pytest.approx(beta.ppf(0.025, unsafe, rollouts - unsafe + 1) if unsafe else 0.0)
    assert high == pytest.approx(beta.ppf(0.975, unsafe + 1, rollouts - unsafe) if unsafe < rollouts else 1.0)


@given(
    st.lists(st.lists(st.sampled_from([0.0, 0.3, 1.0]), min_size=2, max_size=2), min_size=3, max_size=12),
    st.integers(0, 12),
)
def test_repeats_end_at_safe_and_unsafe_values(shares, first):
    last = len(shares) - 1
    first = min(first, last + 1)
    repeated = []

    def count(indices):
        repeated.extend(indices)
        return {index: shares[index] for index in indices}

    repeat_around(first, last, count)
    assert len(set(repeated)) == len(repeated)
    begin = min(first - 1, last)
    low = next((i for i in range(begin, -1, -1) if max(shares[i]) == 0.0), 0) if begin >= 0 else first
    high = next((i for i in range(first, last + 1) if max(shares[i]) == 1.0), last) if first <= last else begin
    assert sorted(repeated) == list(range(low, high + 1))


def _swing(**changes):
    """A pendulum that is safe as long as it does not swing beyond 1 rad."""
    arguments = {
        "scenario": PendulumScenario(),
        "parameters": [Parameter(OMEGA, 0.0, 8.0)],
        "quality": Quality(abs, THETA),
        "horizon": 0.5,
        "threshold": 1.0,
        "sample_period": 0.02,
        "conditions": [{DAMPING: 0.0}],
    }
    return Problem(**{**arguments, **changes})


def test_a_constraint_makes_a_rollout_unsafe_as_the_threshold_does():
    search = {"resolution": 1.0, "coarse": 2.0, "executor": "serial", "progress": False}
    by_threshold = _swing().boundary(**search)
    constraint = Constraint(abs, THETA, at_most=1.0)
    by_constraint = _swing(threshold=None, constraints=[constraint]).boundary(**search)
    assert (by_constraint.lower, by_constraint.upper) == (by_threshold.lower, by_threshold.upper)
    # Even where f is a cost, and says nothing.
    cost = Quality(abs, OMEGA, minimize=True)
    assert _swing(quality=cost, threshold=None, constraints=[constraint]).boundary(**search).upper == by_threshold.upper


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"threshold": None}, "needs a finite threshold or a constraint, but the problem has neither"),
        ({"quality": Quality(abs, THETA, minimize=True)}, "the threshold of a cost is a goal to be reached"),
    ],
)
def test_a_question_without_danger_is_refused_by_search_and_sweep(changes, message):
    problem = _swing(**changes)
    with pytest.raises(ValueError, match=message):
        problem.boundary(resolution=1.0, coarse=2.0, executor="serial", progress=False)
    with pytest.raises(ValueError, match=message):
        problem.sweep(values=[0.0, 1.0], executor="serial", progress=False).boundary()


# Unsafe with a chance that rises from 0 at 3 rad/s to 1 at 4: its last digits decide.
def _chaotic(omega, time):
    digits = (omega * 1e7) % 1.0
    return float(omega > 3.0 + digits and time == 0.0)


@pytest.mark.slow
def test_close_to_the_boundary_values_are_repeated_until_they_are_certain():
    problem = _swing(
        quality=Quality(_chaotic, [OMEGA, "time"]),
        horizon=0.01,
        sample_period=0.01,
        threshold=0.5,
        conditions=[{}, {DAMPING: 0.3}],
    )
    search = {"resolution": 0.1, "coarse": 1.0, "repeats": 20, "executor": "serial", "progress": False}
    boundary = problem.boundary(**search)
    assert 2.8 < boundary.lower < 3.3
    assert 3.7 < boundary.upper < 4.2
    # What was repeated is every value from the one end to the other, at least, under both conditions.
    counts = {(c.value, c.condition): c for c in boundary.chances}
    values = sorted({value for value, _ in counts})
    assert values[0] == boundary.lower and values[-1] == boundary.upper
    np.testing.assert_allclose(np.diff(values), 0.1)
    assert len(counts) == 2 * len(values)
    assert {c.rollouts for c in boundary.chances} == {21}
    for chance in boundary.chances:
        low, high = chance.interval
        assert low - 0.1 <= np.clip(chance.value - 3.0, 0.0, 1.0) <= high + 0.1
    # The jitter is small, and every rollout is there to be looked at.
    assert len(boundary.repeated) == 2 * 20 * len(values)
    off = np.abs(boundary.repeated.points - np.array(values)).min(axis=1)
    assert 0.0 < off.max() <= 8.0e-6
    assert boundary.repeated.unsafe.sum() + sum(
        bad for value, bad in zip(boundary.sweep.points[:, 0], boundary.sweep.unsafe, strict=True) if value in values
    ) == sum(c.unsafe for c in boundary.chances)
    assert "undecided between (" in str(boundary)
    again = problem.boundary(**search)
    assert again == boundary
    # Without, a single rollout decides.
    assert problem.boundary(**{**search, "repeats": 0}).chances == ()
    del search["repeats"]
    assert {c.rollouts for c in problem.boundary(**search).chances} == {6}


def test_a_boundary_beyond_the_range_is_told_with_repeats_too():
    search = {"resolution": 1.0, "coarse": 2.0, "repeats": 3, "executor": "serial", "progress": False}
    safe = _swing(threshold=10.0, horizon=0.1).boundary(**search)
    assert [(c.value, c.unsafe) for c in safe.chances] == [(8.0, 0)]
    assert "safe up to 8 rad/s, the largest value examined" in str(safe)
    unsafe = _swing(threshold=0.5, conditions=[{THETA: 0.6}], horizon=0.1).boundary(**search)
    assert [(c.value, c.unsafe) for c in unsafe.chances] == [(0.0, 4)]
    assert str(unsafe).endswith("not safe at 0 rad/s, the smallest value examined")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"repeats": -1}, "repeats >= 0"),
        ({"repeats": 2.5}, "the number of repeats must be a whole number"),
        ({"repeats": 2, "jitter": 0.0}, "0 < jitter <= 0.5"),
        ({"repeats": 2, "jitter": "x"}, "the jitter must be a number"),
    ],
)
def test_repeats_that_make_no_sense_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        _swing().boundary(resolution=1.0, coarse=2.0, progress=False, **options)


def test_a_boundary_that_is_none_is_told():
    # Unsafe where it is small: the question was asked the wrong way round.
    outcomes, _ = _examine(_refinement(), lambda m, _: m < 20.0)
    assert "not safe at 0 kg, the smallest value examined" in str(_sweep(outcomes).boundary())
    assert "not monotonic: safe again at 20, 25, 30 kg and 6 more values" in str(_sweep(outcomes).boundary())


def test_rollouts_that_the_testbed_ended_are_told():
    sweep = _sweep({(0.0, 0): False, (5.0, 0): False, (10.0, 0): True})
    rollouts = (sweep.rollouts[0], replace(sweep.rollouts[1], end="terminated"), sweep.rollouts[2])
    boundary = replace(sweep, rollouts=rollouts).boundary()
    assert (boundary.lower, boundary.ended_at) == (5.0, (5.0,))
    assert "ended early by the testbed at 5 kg" in str(boundary)


@pytest.mark.parametrize("of_constraint", [False, True])
def test_a_value_at_which_f_fails_is_unsafe(of_constraint):
    def fails_above_two(theta, omega):
        return np.nan if omega > 2.05 else abs(theta)

    failing = [fails_above_two, [THETA, OMEGA]]
    problem = Problem(
        scenario=PendulumScenario(),
        parameters=[Parameter(OMEGA, 0.0, 4.0)],
        quality=Quality(abs, THETA) if of_constraint else Quality(*failing),
        constraints=[Constraint(*failing, at_most=100.0)] if of_constraint else [],
        threshold=3.0,
        horizon=0.1,
        sample_period=0.1,
    )
    boundary = problem.boundary(resolution=0.25, coarse=1.0, executor="serial", progress=False)
    assert (boundary.lower, boundary.upper) == (2.0, 2.25)
    assert min(boundary.failed_at) > 2.24  # with jitter
    role = "constraint" if of_constraint else "quality"
    assert boundary.failure.startswith(f"QualityError: the {role} function fails_above_two at t = 0 s")
    assert f"values with failed rollouts: QualityError: the {role} function" in str(boundary)
    with pytest.raises(QualityError, match=f"the {role} function"):
        problem.boundary(resolution=0.25, coarse=1.0, executor="serial", progress=False, on_error="raise")
