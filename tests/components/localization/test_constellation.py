"""Tests of global localization, against exhaustive search, and for what it must not claim."""

import numpy as np
import pytest

from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.planar import inverse, transform, wrap
from vtbdrake_diagrams.forest.stand import ACCURATE, Stand


def landmarks(places, *, deviation=0.05, diameters=None, diameter_deviation=np.inf):
    places = np.asarray(places, dtype=float)
    n = len(places)
    thick = np.full(n, 0.2) if diameters is None else diameters
    return Landmarks(places, np.tile(deviation**2 * np.eye(2), (n, 1, 1)), thick, np.full(n, diameter_deviation))


def seen(places_W, X_WH, rng, *, reach=20.0, deviation=0.05, false=10):
    """Nine tenths of the landmarks around a pose, displaced, and false ones among them."""
    around = transform(inverse(X_WH), places_W)
    around = around[np.hypot(*around.T) < reach]
    around = around[rng.random(len(around)) < 0.9] + 0.0
    around = around + deviation * rng.normal(size=around.shape)
    return landmarks(np.vstack([around, rng.uniform(-14.0, 14.0, (false, 2))]), deviation=deviation)


def errors(fix, X_WH):
    return np.append(fix.pose[:2] - X_WH[:2], wrap(fix.pose[2] - X_WH[2]))


def test_a_place_is_recognized_in_a_stand():
    stand = Stand(seed=1, density=600.0)
    constellation = ConstellationMap(map_landmarks(stand.map(ACCURATE)))
    rng = np.random.default_rng(1)
    for X_WH in ([30.0, 40.0, 2.0], [60.0, 70.0, -3.0], [50.0, 25.0, 0.1]):
        fix = constellation.locate(seen(stand.trees().positions()[:, :2], X_WH, rng))
        assert fix.is_sure and fix.margin >= 5.0 and fix.fit >= 0.6
        assert np.hypot(*errors(fix, X_WH)[:2]) < 0.15 and abs(errors(fix, X_WH)[2]) < 0.01


def test_another_stand_is_not_recognized():
    constellation = ConstellationMap(map_landmarks(Stand(seed=1, density=600.0).map(ACCURATE)))
    other = Stand(seed=2, density=600.0).trees().positions()[:, :2]
    for seed in range(5):
        assert not constellation.locate(seen(other, [50.0, 50.0, 1.0], np.random.default_rng(seed))).is_sure


def test_too_few_landmarks_are_never_sure():
    constellation = ConstellationMap(map_landmarks(Stand(seed=1).map(ACCURATE)))
    for local in (Landmarks.empty(), landmarks([[1.0, 2.0]]), landmarks([[1.0, 2.0], [5.0, 5.0]])):
        fix = constellation.locate(local)
        assert not fix.is_sure and np.isfinite(fix.pose).all() and np.linalg.eigvalsh(fix.covariance)[0] > 0.0


def test_maps_and_parameters_are_checked():
    with pytest.raises(ValueError, match="at least 3 landmarks, not 2"):
        ConstellationMap(landmarks([[0.0, 0.0], [1.0, 1.0]]))
    with pytest.raises(ValueError, match="share lies between 0 and 1"):
        ConstellationMap(landmarks(np.eye(3, 2)), share=1.0)
