import copy
from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.planar import compose, inverse, transform, wrap
from vtbdrake.components.localization.tracking import Tracker
from vtbdrake.components.world_model import AttributeValue, WorldModel, WorldObject, position_estimate
from vtbdrake.state.codecs import codec_of
from vtbdrake_diagrams.forest.world.stand import REMOTE, Stand

DIAMETER = AttributeValue(0.3, "m", 0.02)


def some(n=5, seed=0):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, 2, 2))
    return Landmarks(rng.normal(size=(n, 2)), root @ root.transpose(0, 2, 1), rng.random(n), rng.random(n))


def spatial(X):
    return RigidTransform(RotationMatrix.MakeZRotation(X[2]), [*X[:2], 0.0])


def test_planar_poses_are_those_of_drake():
    rng = np.random.default_rng(1)
    for _ in range(20):
        ab, bc = rng.uniform(-4, 4, (2, 3))
        assert spatial(compose(ab, bc)).IsNearlyEqualTo(spatial(ab) @ spatial(bc), 1e-12)
        assert spatial(inverse(ab)).IsNearlyEqualTo(spatial(ab).inverse(), 1e-12)
        points = rng.normal(size=(3, 2))
        lifted = spatial(ab) @ np.column_stack([points, np.zeros(3)]).T
        np.testing.assert_allclose(transform(ab, points), lifted[:2].T, atol=1e-12)


@pytest.mark.parametrize(("angle", "expected"), [(np.pi, -np.pi), (-np.pi, -np.pi), (7.0, 7.0 - 2 * np.pi), (0.5, 0.5)])
def test_angles_are_wrapped(angle, expected):
    assert wrap(angle) == pytest.approx(expected, abs=1e-12)


def test_covariances_turn_with_the_frame():
    landmarks, X_AB = some(), [1.0, 2.0, 0.7]
    turned = landmarks.seen_from(X_AB)
    # As samples do.
    samples = np.random.default_rng(0).multivariate_normal(landmarks.positions[0], landmarks.covariances[0], 200_000)
    np.testing.assert_allclose(np.cov(transform(X_AB, samples).T), turned.covariances[0], rtol=0.05, atol=0.02)
    back = turned.seen_from(inverse(X_AB))
    np.testing.assert_allclose(back.positions, landmarks.positions, atol=1e-12)
    np.testing.assert_allclose(back.covariances, landmarks.covariances, atol=1e-12)


def test_parts_are_joined_and_selected():
    one, other = some(2), some(3, seed=1)
    both = Landmarks.joined([one, other])
    assert len(both) == 5
    np.testing.assert_array_equal(both.select([3, 0]).diameters, [other.diameters[1], one.diameters[0]])
    np.testing.assert_array_equal(both.select(both.diameters > 2.0).positions, np.zeros((0, 2)))
    assert len(Landmarks.joined([])) == 0


def test_probabilities_are_1_unless_they_are_given_and_stay_with_their_landmarks():
    landmarks = some()
    np.testing.assert_array_equal(landmarks.probabilities, np.ones(len(landmarks)))
    unsure = replace(landmarks, probabilities=np.linspace(0.1, 0.9, len(landmarks)))
    moved = unsure.seen_from([1.0, -2.0, 0.3]).widened(0.1)
    np.testing.assert_array_equal(moved.probabilities, unsure.probabilities)
    np.testing.assert_array_equal(unsure.select([1]).probabilities, unsure.probabilities[1:2])
    both = Landmarks.joined([unsure, landmarks])
    np.testing.assert_array_equal(both.probabilities, [*unsure.probabilities, *np.ones(len(landmarks))])
    for bad in (-0.1, 1.5):
        with pytest.raises(ValueError, match="probabilities of landmarks are from 0 to 1"):
            replace(landmarks, probabilities=np.full(len(landmarks), bad))


def test_landmarks_are_values_with_a_codec():
    landmarks = some()
    assert copy.deepcopy(landmarks) is landmarks
    with pytest.raises(ValueError, match="read-only"):
        landmarks.positions[0] = 1.0
    codec = codec_of(Landmarks.empty(), varying=True)
    again = codec.decode(codec.encode(landmarks))
    for name in ("positions", "covariances", "diameters", "diameter_deviations", "probabilities"):
        np.testing.assert_array_equal(getattr(again, name), getattr(landmarks, name))


def test_a_map_becomes_landmarks():
    stand = Stand(seed=2, density=400.0)
    landmarks = map_landmarks(stand.map(REMOTE))
    assert len(landmarks) == len(stand.map(REMOTE))
    np.testing.assert_allclose(landmarks.covariances[0], 0.35**2 * np.eye(2))
    np.testing.assert_allclose(landmarks.diameter_deviations, 0.2 * landmarks.diameters)


def test_bad_landmarks_are_rejected():
    good = {"positions": [[0.0, 1.0]], "covariances": [np.eye(2)], "diameters": [0.2], "diameter_deviations": [0.1]}
    for name, value, message in (
        ("diameters", [0.2, 0.3], "diameters of 1 landmarks have the shape"),
        ("positions", [[0.0, np.nan]], "finite numbers"),
        ("diameter_deviations", [-0.1], "at least 0"),
    ):
        with pytest.raises(ValueError, match=message):
            Landmarks(**{**good, name: value})
    with pytest.raises(ValueError, match="tree or rock, not 'crater'"):
        map_landmarks(Stand(density=10.0).trees(), "crater")
    with pytest.raises(ValueError, match="no rock"):
        map_landmarks(Stand(density=10.0).trees(), "rock")
    with pytest.raises(ValueError, match="the map, <WorldModel: 1 Tree>, has no tree"):
        map_landmarks(WorldModel([WorldObject("t", "Tree", position_estimate(np.zeros(3)))]))
    nowhere = WorldObject("t7", "tree", position_estimate(np.zeros(3), deviation=np.inf), {"trunk_diameter": DIAMETER})
    with pytest.raises(ValueError, match="the tree t7 has an infinite variance in the plane"):
        map_landmarks(WorldModel([nowhere]))
    for diameter in (-0.3, 0.0, 31.0):
        tree = WorldObject(
            "t", "tree", position_estimate(np.zeros(3)), {"trunk_diameter": AttributeValue(diameter, "m")}
        )
        with pytest.raises(ValueError, match=f"of the tree t is {diameter:g} m, but must be .* at most 20 m: are its"):
            map_landmarks(WorldModel([tree]))


@pytest.mark.slow_cases
@pytest.mark.parametrize(("deviation", "bounds"), [(0.0, (8.0, np.inf)), (1.3 * 0.05, (2.0, 4.2))])
def test_leaning_trunks_need_their_deviation(deviation, bounds):
    """The map has the feet of 30 trees to 3 cm; they lean by 0.05 rad, and are seen at breast height to 1 cm."""
    rng, squares = np.random.default_rng(5), []
    for _ in range(30):
        places = rng.uniform(-12.0, 12.0, (30, 2))
        feet = WorldModel(
            WorldObject(f"t{k}", "tree", position_estimate([*foot, 0.0], deviation=0.03), {"trunk_diameter": DIAMETER})
            for k, foot in enumerate(places + rng.normal(0.0, 0.03, (30, 2)))
        )
        trunks = places + 1.3 * rng.normal(0.0, 0.05, (30, 2))
        seen = Landmarks(
            trunks + rng.normal(0.0, 0.01, (30, 2)),
            np.tile(1e-4 * np.eye(2), (30, 1, 1)),
            np.full(30, 0.3),
            np.ones(30),
        )
        tracker = Tracker(map_landmarks(feet, deviation=deviation), least_deviation=0.0, bias_deviation=1e-3)
        state, matches = tracker.start(np.zeros(3), np.diag([0.04, 0.04, 1e-4]), seen)
        assert len(matches.pairs) >= 8
        squares.append(state.pose @ np.linalg.solve(state.pose_covariance, state.pose))
    assert bounds[0] < np.mean(squares) < bounds[1]
