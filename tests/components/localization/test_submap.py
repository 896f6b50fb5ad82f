import numpy as np
import pytest

from tests.components.localization.drives import DRIFT, PERIOD, drive
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import compose, inverse, rotation, transform
from vtbdrake.components.localization.submap import Submap
from vtbdrake.state.codecs import codec_of
from vtbdrake_diagrams.forest.world.stand import ACCURATE

pytestmark = pytest.mark.one_python


def seen(places, deviation=0.02, diameter=0.3):
    n = len(places)
    return Landmarks(places, np.tile(deviation**2 * np.eye(2), (n, 1, 1)), np.full(n, diameter), np.full(n, 0.02))


def test_landmarks_of_a_drive_are_near_their_true_places():
    one = drive(0, ACCURATE, false=0.0)
    submap = Submap.empty(one.reckoned[0])
    for k, scan in enumerate(one.scans):
        motion = one.motion(k)[1] if k else np.zeros((3, 3))
        submap = submap.moved(one.reckoned[k], motion).with_scan(scan, least_deviation=0.02)
    landmarks = submap.landmarks()
    assert len(landmarks) > 2 * max(len(scan) for scan in one.scans) / 1.5
    places = transform(one.poses[-1], landmarks.positions)
    # Against the map, whose errors are 0.1 m per axis: each landmark once, and none that is not there.
    distances = np.linalg.norm(places[:, None] - one.map.positions, axis=2)
    assert (distances.min(axis=1) < 0.6).all()
    assert np.mean(np.bincount(distances.argmin(axis=1)) > 1) < 0.05


def test_covariances_grow_as_samples_of_the_odometry_do():
    rng = np.random.default_rng(0)
    places, motion = np.array([[8.0, 3.0], [-4.0, 6.0]]), np.array([2.0, 0.0, 0.3])
    C = DRIFT.covariance(motion, 10.0 * PERIOD)
    begin = np.array([5.0, 1.0, 0.7])
    submap = (
        Submap.empty(begin)
        .with_scan(seen(places, deviation=0.0), least_deviation=0.02)
        .moved(compose(begin, motion), C)
    )
    true_motions = rng.multivariate_normal(motion, C, 50_000)
    samples = np.array([[transform(inverse(true), places)] for true in true_motions[:5000]])[:, 0]
    for k, found in enumerate(submap.landmarks().covariances):
        np.testing.assert_allclose(found, np.cov(samples[:, k].T), atol=0.06 * np.trace(found) + 4e-4)


def test_a_landmark_seen_again_is_merged():
    submap = (
        Submap.empty()
        .with_scan(seen([[5.0, 0.0]]), least_deviation=0.02)
        .with_scan(seen([[5.03, 0.0], [7.0, 2.0]], diameter=0.34), least_deviation=0.02)
    )
    landmarks = submap.landmarks()
    assert len(landmarks) == 2
    np.testing.assert_allclose(landmarks.positions[0], [5.015, 0.0], atol=1e-9)
    assert landmarks.diameters[0] == pytest.approx(0.32)
    assert landmarks.diameter_deviations[0] == pytest.approx(0.02 / np.sqrt(2.0))


def test_detections_seen_once_in_many_scans_are_left_out():
    there, flicker = [[5.0, 0.0], [0.0, 9.0]], [[3.0, 3.0]]
    submap = Submap.empty().with_scan(seen(there + flicker), least_deviation=0.02)
    assert len(submap.landmarks()) == 3
    for _ in range(3):
        submap = submap.with_scan(seen(there), least_deviation=0.02)
    np.testing.assert_allclose(submap.landmarks().positions, there, atol=1e-9)


def test_landmarks_far_behind_are_dropped():
    submap = Submap.empty().with_scan(seen([[5.0, 0.0]]), least_deviation=0.02)
    for k in range(1, 12):
        submap = submap.moved([4.0 * k, 0.0, 0.0], np.zeros((3, 3)), length=40.0)
        assert len(submap) == (k <= 10)


def test_submaps_are_values_with_a_codec():
    submap = Submap.empty([1.0, 2.0, 0.5]).with_scan(seen([[5.0, 0.0]]), least_deviation=0.02)
    codec = codec_of(Submap.empty())
    arrays = codec.encode(submap)
    assert codec.encode(codec.decode(arrays)).keys() == arrays.keys()
    np.testing.assert_array_equal(codec.decode(arrays).positions, submap.positions)
    np.testing.assert_allclose(submap.positions[0], [1.0, 2.0] + rotation(0.5) @ [5.0, 0.0])
    with pytest.raises(ValueError):
        submap.positions[0] = 0.0
