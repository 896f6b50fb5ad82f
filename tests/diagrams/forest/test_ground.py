"""Tests of the ground: slopes against finite differences, the mesh against the height, and its statistics."""

import numpy as np
import pytest

from vtbdrake_diagrams.forest.world.ground import Ground

pytestmark = pytest.mark.one_python

X, Y = np.random.default_rng(0).uniform(0.0, 100.0, (2, 50))


def test_slope_is_the_derivative_of_height() -> None:
    ground, h = Ground(seed=3), 1e-5
    numerical = [
        (ground.height(X + h, Y) - ground.height(X - h, Y)) / (2.0 * h),
        (ground.height(X, Y + h) - ground.height(X, Y - h)) / (2.0 * h),
    ]
    height, slope = ground.height_and_slope(X, Y)
    np.testing.assert_allclose(slope, np.column_stack(numerical), atol=1e-7)
    np.testing.assert_array_equal(height, ground.height(X, Y))


def test_mesh_lies_on_the_ground() -> None:
    ground = Ground(seed=5)
    vertices, triangles = ground.mesh([-5.0, 0.0], [7.0, 20.0])
    np.testing.assert_allclose(vertices[:, 2], ground.height(*vertices[:, :2].T), atol=1e-12)
    corners = vertices[triangles]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2.0
    assert (area > 0.0).all() and area.sum() == pytest.approx(240.0)
    # Between the vertices, the error is less than the noise of a scanner.
    middles = corners.mean(axis=1)
    assert np.abs(middles[:, 2] - ground.height(*middles[:, :2].T)).max() < 0.02


def test_heights_have_the_given_deviations() -> None:
    x, y = np.random.default_rng(1).uniform(0.0, 2000.0, (2, 20_000))
    assert Ground(bumps=0.0).height(x, y).std() == pytest.approx(0.8, rel=0.1)
    assert Ground(relief=0.0).height(x, y).std() == pytest.approx(0.04, rel=0.1)
    assert not Ground(relief=0.0, bumps=0.0).height(x, y).any()


def test_seed_determines_the_ground() -> None:
    assert np.array_equal(Ground(seed=1).height(X, Y), Ground(seed=1).height(X, Y))
    assert not np.allclose(Ground(seed=1).height(X, Y), Ground(seed=2).height(X, Y))


def test_impassable_ground_is_refused() -> None:
    with pytest.raises(ValueError, match="bumps must be a number from 0 to 0.08 m, not 0.5: a carrier"):
        Ground(relief=1.0, bumps=0.5)
