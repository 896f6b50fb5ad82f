"""The probabilities of detections to be trunks, among exact trunks, bushes and walls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.components.localization.scans import Scene, flat
from vtbdrake.components.localization.trunk_evidence import TrunkEvidence
from vtbdrake.components.localization.trunks import TrunkDetectorConfig, detect_trunks, trunk_candidates

pytestmark = pytest.mark.one_python

EYE = np.array([0.2, -0.1, 2.0])
DETECTOR = TrunkDetectorConfig()
ANY = replace(DETECTOR, least_probability=0.0)
# A trunk that is partly hidden by twigs, and rough.
FAIR = {
    "opacity": 0.8,
    "uprightness": 0.8,
    "misfit": 1.5,
    "clutter": 0.2,
    "roundness": 0.5,
    "is_hidden": 0.0,
    "spread": 0.02,
}


def evidence(**values: float) -> TrunkEvidence:
    """Return the measures of one cylinder."""
    return TrunkEvidence(**{name: np.array([value]) for name, value in {**FAIR, **values}.items()})


@pytest.mark.parametrize(
    ("name", "worse", "better"),
    [
        ("opacity", 0.5, 0.95),
        ("uprightness", 0.5, 1.0),
        ("misfit", 4.0, 0.5),
        ("clutter", 0.9, 0.0),
        ("roundness", -0.5, 1.5),
        ("is_hidden", 1.0, 0.0),
        ("spread", 0.1, 0.005),
    ],
)
def test_each_measure_of_a_trunk_raises_its_probability(name, worse, better):
    values = np.linspace(worse, better, 5)
    probabilities = np.concatenate([evidence(**{name: value}).probabilities() for value in values])
    assert (np.diff(probabilities) > 0.0).all()
    assert probabilities[-1] - probabilities[0] > 0.03


def test_measures_of_an_exact_trunk_and_of_a_wall():
    """A trunk that stands alone, and a wall of 0.5 m, which a cylinder does not fit."""
    trunk = Scene(EYE[None, :2] + [[5.0, 0.0]], np.array([0.4]))
    points, _ = trunk.scan(EYE, noise=0.02, rows=32)
    (landmarks, measures) = trunk_candidates(points, ANY, p_HoLo_H=EYE)
    assert len(landmarks) == 1
    assert measures.opacity[0] > 0.95 and measures.uprightness[0] > 0.95 and measures.clutter[0] < 0.01
    assert 0.3 < measures.misfit[0] < 1.1 and measures.is_hidden[0] == 0.0
    # The ranges to a flat face are off by up to the depth of the arc, 0.2 m, those to the cylinder by the noise.
    assert measures.roundness[0] > 0.5
    np.testing.assert_allclose(measures.probabilities(), landmarks.probabilities)

    ground, _ = Scene(np.zeros((0, 2)), np.zeros(0), height=flat).scan(EYE, rows=32)
    y, z = np.meshgrid(np.arange(-0.25, 0.25, 0.025), np.arange(0.1, 3.0, 0.08))
    wall = np.column_stack([np.full(y.size, 5.0), y.ravel(), z.ravel()])
    wall += 0.02 * np.random.default_rng(0).normal(size=(len(wall), 1)) * [1.0, 0.0, 0.0]
    _, flat_face = trunk_candidates(np.vstack([ground, wall]), ANY, p_HoLo_H=EYE)
    assert (flat_face.roundness < 0.0).all()
    assert (flat_face.probabilities() < 0.5 * landmarks.probabilities[0]).all()


def test_probable_detections_are_trunks_and_improbable_ones_bushes():
    """High bushes among trunks, half of each; nothing of them had a part in the weights."""
    rows, trunk_count = [], 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        places = EYE[:2] + rng.uniform(-18.0, 18.0, (60, 2))
        places = places[np.linalg.norm(places - EYE[:2], axis=1) > 2.0]
        is_trunk = np.arange(len(places)) % 2 == 0
        bushes = places[~is_trunk]
        radii = rng.uniform(0.15, 0.6, len(bushes))
        shapes = np.column_stack([bushes, 0.0 * radii + 1.0, radii, radii, 0.0 * radii + 1.4, 0.0 * radii])
        scene = Scene(places[is_trunk], rng.uniform(0.1, 0.5, is_trunk.sum()), None, shapes)
        points, hit = scene.scan(EYE, noise=0.02, seed=seed)
        # Foliage: a ray ends anywhere within.
        arms = (points - EYE) / np.linalg.norm(points - EYE, axis=1)[:, None]
        depth = np.where(hit >= is_trunk.sum(), rng.uniform(0.0, 0.5, len(hit)), 0.0)
        points = points + depth[:, None] * arms
        landmarks = detect_trunks(points, ANY, p_HoLo_H=EYE)
        apart = np.linalg.norm(landmarks.positions[:, None] - scene.places, axis=2).min(axis=1)
        rows.append(np.column_stack([landmarks.probabilities, apart < 0.25]))
        fewer = detect_trunks(points, replace(DETECTOR, least_probability=0.9), p_HoLo_H=EYE)
        assert len(fewer) < len(landmarks) and (fewer.probabilities >= 0.9).all()
        trunk_count += len(scene.places)
    p, right = np.vstack(rows).T
    assert np.sum(p < 0.5) > 40 and np.mean(right[p < 0.5]) < 0.1
    assert np.mean(right[p >= 0.9]) > 0.97
    # Some trunks are hidden by others.
    assert np.sum(right[p >= 0.5]) > 0.75 * trunk_count


def test_bad_least_probability_is_refused():
    for value in (-0.1, 1.5, np.nan):
        with pytest.raises(ValueError, match="least_probability must be a number from 0 to 1, not"):
            TrunkDetectorConfig(least_probability=value)
