"""Tests of simulated detections against geometry and the deviations that they claim."""

import numpy as np
import pytest

from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import compose, inverse, transform
from vtbdrake_diagrams.forest.studies.detections import Detector, Odometry, Wood, arc, dead_reckoned, gathered, visible
from vtbdrake_diagrams.forest.world.stand import Stand

pytestmark = pytest.mark.one_python


def trunks(*rows: tuple[float, float, float]) -> Landmarks:
    """Return trunks of (x, y, diameter)."""
    x, y, diameter = np.array(rows).T
    n = len(x)
    return Landmarks(np.column_stack([x, y]), np.zeros((n, 2, 2)), diameter, np.zeros(n))


def squared_errors(found: Landmarks, true: np.ndarray) -> np.ndarray:
    errors = found.positions - true
    return np.einsum("ni,nij,nj->n", errors, np.linalg.inv(found.covariances), errors)


def test_nearer_trunk_hides_the_one_behind() -> None:
    # A shadow of half-width 0.2 / 4 covers 0.2 m at 8 m by half, and 0.5 m at 8 m not.
    stand = trunks((4.0, 0.0, 0.4), (8.0, 0.1, 0.2), (-8.0, 0.0, 0.2), (8.0, 0.8, 0.5), (0.0, 25.0, 0.4))
    assert sorted(visible(stand, [0.0, 0.0], reach=20.0)) == [0, 2, 3]


def test_hidden_share_of_a_stand_is_that_of_random_discs() -> None:
    # Discs of mean diameter d at n per m² leave a sight line of length r free with the chance exp(-n d r).
    wood = Wood.of(Stand(seed=1, density=1000.0, spacing=0.0), false=0.0, rng=np.random.default_rng(0))
    rng, distances = np.random.default_rng(1), []
    for place in rng.uniform(25.0, 75.0, size=(60, 2)):
        found = visible(wood.trunks, place, reach=20.0)
        distances.extend(np.hypot(*(wood.trunks.positions[found] - place).T))
    density, diameter = 0.1, wood.trunks.diameters.mean()
    r = np.linspace(0.0, 20.0, 2001)
    expected = 60 * np.trapezoid(2 * np.pi * r * density * np.exp(-density * diameter * r), r)
    assert len(distances) == pytest.approx(expected, rel=0.1)


def test_detections_have_the_errors_that_they_claim() -> None:
    wood = Wood.of(Stand(seed=2), false=0.35, rng=np.random.default_rng(0))
    X_WH, rng, squares, false = np.array([50.0, 40.0, 2.0]), np.random.default_rng(3), [], []
    for _ in range(40):
        found, which = wood.detected(X_WH, Detector(along=0.1, across=0.01), rng)
        squares.extend(squared_errors(found, transform(inverse(X_WH), wood.trunks.positions[which])))
        false.extend(~wood.is_tree[which])
    assert np.mean(squares) == pytest.approx(2.0, rel=0.05)
    assert np.mean(false) == pytest.approx(0.35, abs=0.05)


def test_range_bias_moves_detections_along_the_ray() -> None:
    wood = Wood(trunks((10.0, 0.0, 0.3)), np.array([True]))
    found, _ = wood.detected([0.0, 0.0, 1.0], Detector(missed=0.0, along=0.0, across=0.0, range_bias=0.02), rng(0))
    np.testing.assert_allclose(found.positions, [10.02 * np.array([np.cos(1.0), -np.sin(1.0)])])


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_arc_lies_on_its_circle() -> None:
    poses = arc([3.0, 1.0, 0.5], length=40.0, curvature=0.05, step=2.0)
    center = np.array([3.0, 1.0]) + 20.0 * np.array([-np.sin(0.5), np.cos(0.5)])
    np.testing.assert_allclose(np.hypot(*(poses[:, :2] - center).T), 20.0)
    assert len(poses) == 21
    assert compose(inverse(poses[0]), poses[-1])[2] == pytest.approx(40.0 / 20.0)


def test_drift_of_dead_reckoning_is_the_one_assumed() -> None:
    poses = arc(np.zeros(3), length=40.0, curvature=0.0, step=2.0)
    ends = np.array([dead_reckoned(poses, Odometry(), rng(seed))[-1] for seed in range(400)])
    assert ends[:, 2].std() == pytest.approx(0.001 * np.sqrt(40.0), rel=0.1)
    assert ends[:, 0].std() == pytest.approx(np.hypot(0.01 * 40.0, 0.01 * np.sqrt(40.0)), rel=0.1)


def test_gathered_landmarks_are_nearly_consistent() -> None:
    poses, squares = arc([30.0, 40.0, 0.2], length=40.0, curvature=0.01, step=2.0), []
    for seed in range(4):
        wood = Wood.of(Stand(seed=seed), false=0.35, rng=rng(seed))
        found, which = gathered(wood, poses, Detector(), Odometry(), rng(seed + 100))
        assert len(set(which)) == len(found)
        squares.extend(squared_errors(found, transform(inverse(poses[-1]), wood.trunks.positions[which])))
    # One landmark has the mean of several detections, and the deviation of one.
    assert 0.8 < np.mean(squares) < 3.0
