"""The ground from points of scans, against the ground that was scanned."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from tests.components.localization.scans import Scene, hills
from vtbdrake.components.localization.ground import fit_ground

pytestmark = pytest.mark.one_python

EYE = np.array([0.0, 0.0, 2.0])


def fitted(points, reach=20.0):
    near = points[np.linalg.norm(points[:, :2], axis=1) < reach]
    return fit_ground(near, np.zeros(3), reach=reach)


def test_a_slope_is_fitted_exactly():
    places = np.random.default_rng(0).uniform(-20.0, 20.0, (4000, 2))
    points = np.column_stack([places, 0.2 * places[:, 0] - 0.1 * places[:, 1]])
    queries = np.random.default_rng(1).uniform(-18.0, 18.0, (500, 2))
    np.testing.assert_allclose(fitted(points).at(queries), 0.2 * queries[:, 0] - 0.1 * queries[:, 1], atol=1e-3)


def test_trunks_do_not_lift_the_ground():
    rng = np.random.default_rng(2)
    places = rng.uniform(-20.0, 20.0, (150, 2))
    places = places[np.linalg.norm(places, axis=1) > 2.0]
    scene = Scene(places, np.full(len(places), 0.3), height=hills)
    points, _ = scene.scan(EYE, noise=0.02)
    # And crowns of bushes, under which no ground is seen.
    crowns = np.column_stack([rng.uniform(-18.0, 18.0, (400, 2)), np.full(400, 1.0)])
    crowns[:, 2] += hills(crowns[:, :2])
    queries = rng.uniform(-12.0, 12.0, (500, 2))
    for seen in (points, np.vstack([points, crowns])):
        errors = fitted(seen).at(queries) - hills(queries)
        # The waves of 15 m are a little short for nodes at a distance of 4 m.
        assert abs(errors.mean()) < 0.1
        assert errors.std() < 0.3


def test_beyond_the_border_the_ground_goes_on_level():
    places = np.random.default_rng(3).uniform(-20.0, 20.0, (2000, 2))
    ground = fitted(np.column_stack([places, 0.1 * places[:, 0]]))
    np.testing.assert_allclose(*ground.at([[22.0, 0.0], [80.0, 0.0]]), atol=1e-6)


def test_far_reaching_scanners_need_no_more_memory_than_their_surface():
    """A square of 400 m has 10,000 nodes: a matrix of these would have 866 MB."""
    places = np.random.default_rng(4).uniform(-190.0, 190.0, (40_000, 2))
    points = np.column_stack([places, 0.05 * places[:, 0]])
    tracemalloc.start()
    ground = fitted(points, reach=200.0)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_allclose(ground.at([[100.0, 20.0], [-80.0, 0.0]]), [5.0, -4.0], atol=0.02)
    assert peak < 300e6
