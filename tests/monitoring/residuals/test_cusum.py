"""The cumulative sum test, against its definition and against many runs."""

from __future__ import annotations

import numpy as np
import pytest

from vtbdrake.monitoring.residuals.alarms import Cusum, run_length, threshold_for


def test_sums_are_those_of_the_definition() -> None:
    random = np.random.default_rng(1)
    values = random.normal(0.3, 1.0, 200)
    cusum = Cusum(1, threshold=1e9, allowance=0.5)
    upper = lower = highest = 0.0
    for z in values:
        upper, lower = max(0.0, upper + z - 0.5), max(0.0, lower - z - 0.5)
        assert cusum.take(np.array([z])) == pytest.approx(max(upper, lower))
        highest = max(highest, upper, lower)
    assert highest > 2.0


def test_values_stand_for_themselves_and_a_missing_one_changes_nothing() -> None:
    cusum = Cusum(3, threshold=10.0, allowance=0.5)
    cusum.take(np.array([2.0, -2.0, np.nan]))
    np.testing.assert_array_equal(cusum.take(np.array([np.nan, -2.0, np.nan])), [1.5, 3.0, 0.0])


def test_sums_go_no_further_than_twice_the_threshold() -> None:
    cusum = Cusum(2, threshold=10.0, allowance=0.5)
    np.testing.assert_array_equal(cusum.take(np.array([1e6, -1e6])), [20.0, 20.0])


@pytest.mark.parametrize(("threshold", "allowance"), [(3.0, 0.5), (4.0, 0.25)])
def test_mean_run_length_is_that_of_many_runs(threshold: float, allowance: float) -> None:
    random = np.random.default_rng(2)
    runs = 4000
    upper, lower, alive = np.zeros(runs), np.zeros(runs), np.ones(runs, dtype=bool)
    lengths = np.zeros(runs)
    while alive.any():
        z = random.standard_normal(runs)
        upper, lower = np.maximum(0.0, upper + z - allowance), np.maximum(0.0, lower - z - allowance)
        lengths += alive
        alive &= np.maximum(upper, lower) <= threshold
    # The mean of 4000 exponential lengths is known to 1.6 %; Siegmund's formula is good to a few percent.
    assert run_length(threshold, allowance) == pytest.approx(lengths.mean(), rel=0.1)


@pytest.mark.parametrize("length", [10.0, 1e4, 1e12])
def test_threshold_belongs_to_its_run_length(length: float) -> None:
    assert run_length(threshold_for(length, 0.5), 0.5) == pytest.approx(length, rel=1e-6)


def test_no_threshold_is_needed_for_a_run_that_is_short_anyway() -> None:
    assert threshold_for(1.0, 0.5) == 0.0
