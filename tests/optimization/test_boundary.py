"""The boundary: refined where it must be, and not fooled by an outcome that is not monotonic."""

from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vtbdrake.optimization import Parameter, Sweep
from vtbdrake.optimization.boundary import Refinement, find_boundary
from vtbdrake.rollout import RolloutResult


def _examine(refinement, fails, conditions=1):
    """Runs the refinement on an outcome given as a function; what was examined, and how it went."""
    outcomes, rounds = {}, []

    def examine(trials):
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
        )
        for value, condition in rows
    ]
    return Sweep(
        parameters=(Parameter("m", 0.0, 60.0),),
        units=("kg",),
        conditions=tuple({} for _ in range(conditions)),
        points=np.array([[value] for value, _ in rows]),
        condition=np.array([condition for _, condition in rows]),
        rollouts=tuple(results),
    )


@given(st.integers(0, 61))
def test_a_monotonic_boundary_is_found_to_the_resolution(first):
    outcomes, _ = _examine(Refinement(0.0, 60.0, resolution=1.0, coarse=5.0), lambda m, _: m >= first)
    boundary = _sweep(outcomes).boundary()
    expected = (first - 1.0 if first > 0 else -inf, float(first) if first <= 60 else inf)
    assert (boundary.lower, boundary.upper) == expected
    assert len(outcomes) <= 13 + 8


@given(st.sets(st.integers(0, 60), min_size=1))
def test_what_lies_below_the_answer_was_examined_two_cells_deep(bad):
    outcomes, _ = _examine(Refinement(0.0, 60.0, resolution=1.0, coarse=5.0), lambda m, _: int(m) in bad)
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
    outcomes, _ = _examine(Refinement(0.0, 60.0, resolution=1.0, coarse=5.0), tips)
    boundary = _sweep(outcomes).boundary()
    assert (boundary.lower, boundary.upper) == (39.0, 40.0)
    assert 45.0 in boundary.safe_beyond


def test_every_condition_has_its_own_interval_and_the_least_counts():
    outcomes, _ = _examine(
        Refinement(0.0, 60.0, resolution=1.0, coarse=5.0), lambda m, c: m >= (44.0, 41.0, 47.0)[c], conditions=3
    )
    boundary = _sweep(outcomes, 3).boundary()
    np.testing.assert_array_equal(boundary.by_condition, [[43, 44], [40, 41], [46, 47]])
    assert (boundary.lower, boundary.upper) == (40.0, 41.0)
    assert str(boundary) == "m: safe up to 40 kg, not at 41 kg"


def test_the_ends_of_the_range_are_told_as_such():
    safe, _ = _examine(Refinement(0.0, 60.0, resolution=1.0, coarse=5.0), lambda m, _: False)
    assert str(_sweep(safe).boundary()) == "m: safe up to 60 kg, the largest value examined"
    unsafe, _ = _examine(Refinement(0.0, 60.0, resolution=1.0, coarse=5.0), lambda m, _: True)
    assert str(_sweep(unsafe).boundary()) == "m: not safe at 0 kg, the smallest value examined"


def test_a_simulation_that_fails_is_not_safe():
    boundary = _sweep({(0.0, 0): False, (5.0, 0): None, (10.0, 0): True}).boundary()
    assert (boundary.lower, boundary.upper, boundary.undecided) == (0.0, 5.0, (5.0,))


def test_a_range_that_is_no_multiple_of_the_resolution_ends_at_its_end():
    outcomes, _ = _examine(Refinement(0.0, 1.0, resolution=0.3, coarse=0.6), lambda m, _: m > 0.95)
    boundary = _sweep(outcomes).boundary()
    assert (boundary.lower, boundary.upper) == (pytest.approx(0.9), 1.0)


@pytest.mark.parametrize(("resolution", "coarse"), [(0.0, 5.0), (5.0, 1.0), (1.0, 100.0), (-1.0, 5.0)])
def test_steps_that_do_not_fit_are_refused(resolution, coarse):
    with pytest.raises(ValueError, match="0 < resolution <= coarse <= 60"):
        Refinement(0.0, 60.0, resolution=resolution, coarse=coarse)
