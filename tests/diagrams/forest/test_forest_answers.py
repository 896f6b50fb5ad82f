"""Tests of row C2: the unit over LCM, and the displacement of a map that nothing shows."""

from dataclasses import replace

import numpy as np
import pytest

from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.studies.answers import over_lcm
from vtbdrake_diagrams.forest.studies.drives import (
    REACH,
    Drive,
    best_error_along,
    forest,
    least_error,
    least_error_along,
)
from vtbdrake_diagrams.forest.world.stand import MAPS, MapErrors, Stand


@pytest.mark.one_python
def test_unit_over_lcm_finds_the_simulated_pose() -> None:
    found = over_lcm(ForestScenario(seed=1, length=50.0, width=50.0, start=12.0), cycles=40)
    assert found.agrees
    # Points are sent with 32 bits, so that the two poses differ.
    assert found.difference > 0.0


@pytest.mark.one_python
def test_least_error_is_that_of_generalized_least_squares() -> None:
    """The mean of draws, weighted by their covariance: two trees, and the trees of a stand."""
    two = np.array([[0.0, 0.0], [30.0, 0.0]])
    errors, shared = MapErrors(position=0.7, correlation=40.0), np.exp(-(30.0**2) / (2.0 * 40.0**2))
    # By symmetry, both have the same weight: each axis has the variance of the mean of both.
    variance = 0.7**2 * (1.0 + shared) / 2.0 + 0.1**2 / 2.0
    assert least_error(errors, two, noise=0.1) == pytest.approx(np.sqrt(2.0 * variance))
    places = Stand(seed=1, length=60.0, width=40.0, density=300.0).trees().positions()[:, :2]
    independent = least_error(MapErrors(position=0.3), places, noise=0.4)
    assert independent == pytest.approx(np.sqrt(2.0) * 0.5 / np.sqrt(len(places)))
    # More trees reduce the error, but far less than independent ones would; the estimate is better than their mean.
    assert least_error(MAPS["poor"], places) < least_error(MAPS["poor"], places[:20]) < 0.7 * np.sqrt(2.0)
    assert least_error(MAPS["poor"], places) > 0.5


@pytest.mark.one_python
def test_no_mean_of_maps_errs_by_less() -> None:
    stand = Stand(seed=2, length=60.0, width=40.0, density=300.0)
    places, errors = stand.trees().positions()[:, :2], MapErrors(position=0.7, correlation=40.0)
    means = [stand.map(errors, seed=k).positions()[:, :2].mean(axis=0) - places.mean(axis=0) for k in range(150)]
    rms = np.sqrt((np.array(means) ** 2).sum(axis=1).mean())
    assert least_error(errors, places) < rms < np.sqrt(2.0) * 0.7


@pytest.mark.one_python
def test_least_error_is_by_the_trees_beside_the_path() -> None:
    stand, path = forest(5).stand(), np.array([[50.0 + k, 50.0, 0.0] for k in range(10)])
    drive = Drive(np.arange(10.0), path, path, (Landmarks.empty(),) * 10)
    places = stand.trees().positions()[:, :2]
    near = np.hypot(places[:, 0] - np.clip(np.round(places[:, 0]), 50.0, 59.0), places[:, 1] - 50.0) < REACH
    assert least_error_along({5: drive}, MAPS["poor"]) == pytest.approx(least_error(MAPS["poor"], places[near]))


@pytest.mark.one_python
def test_best_estimates_on_maps_err_as_expected_over_many_maps() -> None:
    """The RMS over 80 maps of one stand against the formula of Gauss and Markov, for the trees on each map."""
    scenario = ForestScenario(seed=2, length=60.0, width=60.0, density=300.0)
    path = np.array([[20.0 + k, 30.0, 0.0] for k in range(20)])
    drive = Drive(np.arange(20.0), path, path, (Landmarks.empty(),) * 20)
    surveys = {k: replace(scenario, map_seed=k) for k in range(80)}
    best = best_error_along(dict.fromkeys(surveys, drive), "poor", scenario=surveys.__getitem__)
    places = scenario.stand().trees().positions()[:, :2]
    near = places[np.hypot(places[:, 0] - np.clip(np.round(places[:, 0]), 20.0, 39.0), places[:, 1] - 30.0) < REACH]
    # A third of the trees is missing on each map: the error is between those by all, and by half of them.
    assert 0.9 * least_error(MAPS["poor"], near) < best < 1.1 * least_error(MAPS["poor"], near[::2])


@pytest.mark.one_python
def test_of_independent_errors_the_best_estimate_is_the_mean() -> None:
    scenario = ForestScenario(seed=2, length=60.0, width=60.0, density=300.0)
    path = np.array([[20.0 + k, 30.0, 0.0] for k in range(20)])
    drive = Drive(np.arange(20.0), path, path, (Landmarks.empty(),) * 20)
    errors, exact = (
        scenario.surveyed_map(one).positions()[:, :2]
        for one in (MAPS["accurate"], replace(MAPS["accurate"], position=0.0))
    )
    near = np.hypot(exact[:, 0] - np.clip(np.round(exact[:, 0]), 20.0, 39.0), exact[:, 1] - 30.0) < REACH
    mean = np.hypot(*(errors - exact)[near].mean(axis=0))
    assert best_error_along({2: drive}, "accurate", scenario=lambda seed: scenario) == pytest.approx(mean, rel=1e-9)
