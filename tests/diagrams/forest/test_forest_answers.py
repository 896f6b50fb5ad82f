"""Tests of row C2: the unit over LCM, and the displacement of a map that nothing shows."""

from dataclasses import replace

import numpy as np
import pytest

from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.unit import SEARCHING, TRACKING
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.studies.answers import LocalizationAnswer, OverLcm, over_lcm
from vtbdrake_diagrams.forest.studies.best_estimate import REACH, BestError, against_best, best_estimates
from vtbdrake_diagrams.forest.studies.drive import Drive, Track
from vtbdrake_diagrams.forest.studies.drives import GOALS, Score
from vtbdrake_diagrams.forest.world.stand import MAPS, MapErrors

POOR = MAPS["poor"]


@pytest.mark.slow
@pytest.mark.one_python
def test_unit_over_lcm_finds_the_simulated_pose() -> None:
    found = over_lcm(ForestScenario(seed=1, length=50.0, width=50.0, start=12.0), cycles=40)
    assert found.agrees
    # Points are sent with 32 bits, so that the two poses differ.
    assert found.difference > 0.0


@pytest.mark.one_python
def test_best_estimate_by_two_trees_is_known() -> None:
    """Independent errors of two trees, 10 m apart: their mean, and the direction from one to the other."""
    places, errors = np.array([[-5.0, 0.0], [5.0, 0.0]]), np.array([[0.2, 0.1], [0.4, -0.3]])
    path = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 2.0]])
    estimates, variances = best_estimates(path, places, errors, MapErrors(position=0.3), noise=0.4)
    # The deviation of an error of a tree is 0.5; an error theta of the heading has the variance 2 0.5^2 / 10^2.
    mean, turn = 0.5**2 / 2.0, 2.0 * 0.5**2 / 10.0**2
    assert variances == pytest.approx([2.0 * mean, 2.0 * mean + 9.0 * turn, 2.0 * mean + 13.0 * turn])
    theta = (-0.3 - 0.1) / 10.0
    expected = [[0.3, -0.1], [0.3, -0.1 + 3.0 * theta], [0.3 - 2.0 * theta, -0.1 + 3.0 * theta]]
    assert estimates == pytest.approx(np.array(expected))


@pytest.mark.one_python
def test_best_estimate_is_that_of_whitened_least_squares_by_what_was_seen() -> None:
    rng = np.random.default_rng(1)
    places, path = rng.uniform(0.0, 60.0, (40, 2)), np.array([[5.0 + k, 20.0 + 0.2 * k] for k in range(45)])
    displacements = rng.normal(size=(40, 2))
    estimates, variances = best_estimates(path, places, displacements, POOR)
    for k in (0, 7, 44):
        seen = [i for i, place in enumerate(places) if min(np.hypot(*(place - path[: k + 1]).T)) < REACH]
        d = places[seen] - path[k]
        r = np.hypot(*(d[:, None] - d).transpose(2, 0, 1))
        C = 0.7**2 * np.exp(-(r**2) / (2.0 * 40.0**2)) + 0.02**2 * np.eye(len(d))
        W = np.kron(np.linalg.inv(np.linalg.cholesky(C)), np.eye(2))
        X = np.vstack([[[1.0, 0.0, -y], [0.0, 1.0, x]] for x, y in d])
        solution, *_ = np.linalg.lstsq(W @ X, W @ displacements[seen].ravel(), rcond=None)
        assert estimates[k] == pytest.approx(solution[:2], rel=1e-6)
        covariance = np.linalg.pinv(W @ X) @ np.linalg.pinv(W @ X).T
        assert variances[k] == pytest.approx(covariance[0, 0] + covariance[1, 1], rel=1e-6)
    assert 2.0 * 0.49 > variances[0] > variances[44] > 0.5**2


@pytest.mark.one_python
def test_nothing_is_estimated_before_two_trees_are_seen() -> None:
    path, places = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]]), np.array([[5.0, 0.0], [35.0, 0.0], [99.0, 0.0]])
    estimates, variances = best_estimates(path, places, np.ones((3, 2)), POOR)
    assert np.isfinite(variances).tolist() == [False, False, True]
    assert np.isnan(estimates[:2]).all() and estimates[2] == pytest.approx([1.0, 1.0])


def straight(*, claimed: int = 20, offset: float = 0.0) -> Track:
    """A drive of 20 m along x, whose last poses are claimed, off by ``offset`` along x."""
    truth = np.array([[20.0 + k, 30.0, 0.0] for k in range(20)])
    drive = Drive(np.arange(20.0), truth, truth, (Landmarks.empty(),) * 20)
    status = np.where(np.arange(20) < 20 - claimed, SEARCHING, TRACKING)
    return Track(drive, truth + np.array([offset, 0.0, 0.0]), np.tile(np.eye(3), (20, 1, 1)), status)


@pytest.mark.slow
@pytest.mark.one_python
def test_best_estimates_on_maps_err_as_expected_over_many_maps() -> None:
    """The RMS over 40 maps of one stand against the formula of Gauss and Markov."""
    scenario = ForestScenario(seed=2, length=60.0, width=60.0, density=300.0)
    surveys = {k: replace(scenario, map_seed=k) for k in range(40)}
    error = against_best(dict.fromkeys(surveys, straight(offset=0.5)), "poor", scenario=surveys.__getitem__)
    assert error.on_maps == pytest.approx(error.least, rel=0.15)
    assert error.ratio == pytest.approx(0.5 / error.on_maps)
    assert error.interval[0] < error.ratio < error.interval[1] < 1.3 * error.ratio
    # The mean of the trees' errors is no better.
    means = []
    for survey in surveys.values():
        mapped, places = (survey.surveyed_map(e).positions()[:, :2] for e in (POOR, replace(POOR, position=0.0)))
        near = (mapped != places).any(axis=1) & (np.abs(places - [30.0, 30.0]) < [20.0, 15.0]).all(axis=1)
        means.append((mapped - places)[near].mean(axis=0))
    assert error.least < np.sqrt((np.array(means) ** 2).sum(axis=1).mean())


@pytest.mark.one_python
def test_only_scans_with_a_pose_are_compared() -> None:
    scenario = ForestScenario(seed=2, length=60.0, width=60.0, density=300.0)
    late, whole = (
        against_best({2: straight(claimed=count, offset=0.1)}, "accurate", scenario=lambda seed: scenario)
        for count in (5, 20)
    )
    # Later, more trees have been seen.
    assert late.least < whole.least
    assert late.interval == (late.ratio, late.ratio)  # One forest tells nothing about others.


SCORES = {
    name: Score(
        forests=4,
        path=100.0,
        position=0.9 * goal.position,
        heading=0.9 * goal.heading,
        wrong=0,
        nees=3.0,
        independent_nees=3.0,
        bounds=(2.0, 4.0),
        first_fix=(1.0, 2.0),
        localized=0.95,
        losses=0,
    )
    for name, goal in GOALS.items()
}
KNOWN = LocalizationAnswer(
    SCORES, BestError(0.4, 0.4, 1.05, (1.0, 1.1)), OverLcm(is_tracking=True, difference=1e-5), fused=True
)


def score(name: str, **changed: object) -> dict[str, object]:
    return {"scores": SCORES | {name: replace(SCORES[name], **changed)}}


@pytest.mark.one_python
def test_unit_that_knows_where_it_is_holds() -> None:
    assert KNOWN.holds
    assert replace(KNOWN, **score("poor", position=9.0)).holds  # Judged by the best estimate.


@pytest.mark.one_python
@pytest.mark.parametrize(
    "change",
    [
        score("accurate", position=9.0),
        score("accurate", heading=9.0),
        score("accurate", wrong=1),
        score("poor", wrong=1),
        score("poor", independent_nees=4.1),
        score("poor", localized=0.89),
        {"best": BestError(0.4, 0.4, 1.11, (1.0, 1.2))},
        {"machine": OverLcm(is_tracking=False, difference=0.0)},
        {"machine": OverLcm(is_tracking=True, difference=0.01)},
        {"fused": False},
    ],
)
def test_each_part_of_the_localization_can_fail(change: dict[str, object]) -> None:
    assert not replace(KNOWN, **change).holds
