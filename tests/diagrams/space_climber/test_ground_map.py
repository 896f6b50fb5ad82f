"""The believed ground against dense linear algebra, and surveys against their stated errors."""

from __future__ import annotations

import numpy as np
import pytest

from vtbdrake_diagrams.space_climber.ground_map import POINT_DEVIATION, GroundMap, OffTheMapError
from vtbdrake_diagrams.space_climber.survey import (
    CORRELATION,
    HEIGHT_ERROR,
    INVENTED,
    LEAST_DIAMETER,
    MISSING,
    survey,
)
from vtbdrake_diagrams.space_climber.terrain import ROCK_DIAMETER, ROCK_DISTANCE, SECTOR, Crater


def small_map() -> GroundMap:
    survey = np.add.outer(np.arange(6.0), 0.1 * np.arange(5.0))
    return GroundMap.surveyed((1.0, -2.0), 0.5, survey, deviation=0.3, range=3.0)


def points(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform([1.0, -2.0], [3.5, 0.0], (count, 2)), rng.normal(size=count)])


def prior_covariance(ground: GroundMap) -> np.ndarray:
    """Return the covariance of the survey's error, from what a height that is nearly exact changes elsewhere."""
    columns = []
    for vertex in ground.vertices():
        exact = ground.measured(np.array([[*vertex, ground.height([vertex])[0] + 1.0]]), deviation=1e-5)
        columns.append((exact.heights - ground.survey).ravel())
    variances = ground.deviations(np.arange(ground.survey.size)) ** 2
    return np.array(columns) * variances[:, None]


def test_measured_heights_are_the_gaussian_conditional() -> None:
    """z + C A^T (A C A^T + R)^-1 (m - A z), with dense matrices."""
    ground, seen = small_map(), points(12)
    C = prior_covariance(ground)
    np.testing.assert_allclose(C, C.T, atol=1e-6)
    A = np.array([ground.height(seen[:, :2], np.eye(30)[k].reshape(6, 5)) for k in range(30)]).T
    gain = C @ A.T @ np.linalg.inv(A @ C @ A.T + POINT_DEVIATION**2 * np.eye(12))
    expected = ground.survey.ravel() + gain @ (seen[:, 2] - A @ ground.survey.ravel())
    after = ground.measured(seen[:7]).measured(seen[7:])
    np.testing.assert_allclose(after.heights.ravel(), expected, atol=1e-5)
    np.testing.assert_allclose(after.deviations(np.arange(30)) ** 2, np.diag(C - gain @ A @ C), atol=1e-5)


def test_draws_have_the_covariance_of_the_belief() -> None:
    ground = small_map().measured(points(10))
    draws = np.array([ground.draw(np.random.default_rng(k)).ravel() for k in range(300)])
    np.testing.assert_allclose(draws.mean(axis=0), ground.heights.ravel(), atol=0.08)
    np.testing.assert_allclose(draws.std(axis=0), ground.deviations(np.arange(30)), rtol=0.15)


def test_the_survey_is_as_uncertain_as_stated() -> None:
    ground = GroundMap.surveyed((0.0, 0.0), 1.0, np.zeros((41, 41)), deviation=0.3, range=6.0)
    middle = 20 * 41 + 20
    assert ground.deviations(np.array([middle]))[0] == pytest.approx(0.3, rel=0.1)
    # What is learnt about one height is learnt about others as they are correlated.
    learnt = ground.measured(np.array([[20.0, 20.0, 1.0]]), deviation=1e-5).heights
    assert learnt[20, 20] == pytest.approx(1.0, abs=1e-6)
    assert learnt[26, 20] == pytest.approx(0.14, abs=0.05)
    assert 0.7 < learnt[21, 20] < 0.9


def test_a_place_beside_the_map_is_named() -> None:
    with pytest.raises(OffTheMapError, match=r"\[9. 0.\] m is beside the map"):
        small_map().height([[9.0, 0.0]])


def test_heights_from_orbit_have_the_stated_error() -> None:
    errors = []
    for seed in range(3):
        ground = survey(Crater(seed), seed=1).ground
        errors.append(ground.survey - Crater(seed).mesh_height(ground.vertices()).reshape(ground.survey.shape))
    assert np.std(errors) == pytest.approx(HEIGHT_ERROR, rel=0.1)
    shift = round(CORRELATION)
    alike = np.mean([(e[shift:] * e[:-shift]).mean() / e.var() for e in errors])
    assert alike == pytest.approx(np.exp(-1.0), abs=0.15)


def test_a_third_of_the_boulders_is_missing_and_some_are_invented() -> None:
    listed = true = 0
    for seed in range(6):
        crater = Crater(seed, rock_cover=0.03)
        listed += len(survey(crater, seed=2).rocks)
        true += sum(np.mean(block.size[:2]) >= LEAST_DIAMETER for block in crater.blocks)
    assert listed / true == pytest.approx((1.0 - MISSING) * (1.0 + INVENTED), rel=0.12)
    crater = Crater(1, rock_cover=0.03)
    assert [o.p_WoOo_W[0] for o in survey(crater, seed=2).rocks] == [
        o.p_WoOo_W[0] for o in survey(crater, seed=2).rocks
    ]


def test_rocks_cover_the_ground_by_the_law() -> None:
    """F(D) = k exp(-q D) of Golombek and Rapp (1997), here within the bounds of the diameters."""
    k, area = 0.04, SECTOR * (ROCK_DISTANCE[1] ** 2 - ROCK_DISTANCE[0] ** 2)
    q = 1.79 + 0.152 / k
    diameters = []
    for seed in range(6):
        fields = len(Crater(seed).blocks)
        diameters += [np.mean(b.size[:2]) for b in Crater(seed, rock_cover=k).blocks[fields:]]
    D = np.array(diameters)
    for least in (0.2, 0.4):
        cover = 0.25 * np.pi * (D[least <= D] ** 2).sum() / (6 * area)
        assert cover == pytest.approx(k * (np.exp(-q * least) - np.exp(-q * ROCK_DIAMETER[1])), rel=0.1)
