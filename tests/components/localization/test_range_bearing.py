"""Landmarks from the detections of another detector."""

import numpy as np
import pytest

from vtbdrake.components.localization.range_bearing import RangeBearingConfig, range_bearing_landmarks

pytestmark = pytest.mark.one_python


def test_detections_stand_where_the_sensor_saw_them():
    config = RangeBearingConfig(x=3.0, y=0.5, heading=np.pi / 2.0)
    landmarks = range_bearing_landmarks([[10.0, 0.0, 0.3], [5.0, np.pi / 2.0, 0.6]], config)
    np.testing.assert_allclose(landmarks.positions, [[3.0, 10.5], [-2.0, 0.5]], atol=1e-12)
    np.testing.assert_array_equal(landmarks.diameters, [0.3, 0.6])
    assert landmarks.diameter_deviations[1] == pytest.approx(np.hypot(0.05, 0.12))


def test_covariances_are_those_of_samples():
    config, rng = RangeBearingConfig(range_noise=0.1, range_share=0.01, bearing_noise=0.02), np.random.default_rng(1)
    r, bearing, n = 20.0, 0.7, 40_000
    landmarks = range_bearing_landmarks([[r, bearing, 0.3]], config)
    ranges = r + np.hypot(0.1, 0.01 * r) * rng.normal(size=n)
    angles = bearing + np.hypot(0.05 / r, 0.02) * rng.normal(size=n)
    samples = np.stack([ranges * np.cos(angles), ranges * np.sin(angles)])
    np.testing.assert_allclose(
        landmarks.covariances[0], np.cov(samples), atol=0.02 * np.trace(landmarks.covariances[0])
    )


def test_rows_without_a_detection_are_left_out():
    rows = [[0.0, 0.0, 0.0], [10.0, 0.1, 0.3], [np.nan, 0.1, 0.3], [41.0, 0.1, 0.3], [-1.0, 0.1, 0.3]]
    config = RangeBearingConfig()
    assert len(range_bearing_landmarks(rows, config)) == 1
    assert len(range_bearing_landmarks(np.ravel(rows), config)) == 1
    assert not len(range_bearing_landmarks(np.zeros((0, 3)), config))
    assert not len(range_bearing_landmarks(np.zeros(96), config))
