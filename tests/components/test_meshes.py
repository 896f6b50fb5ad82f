"""Tests of meshes against the volumes and radii of the shapes that they stand for."""

import numpy as np
import pytest
from pydrake.geometry import Mesh

from vtbdrake.components.meshes import (
    Surface,
    copies,
    joined,
    obj_mesh,
    surface_mesh,
    unit_cone,
    unit_sphere,
    vertex_normals,
)


def volume(surface: Surface) -> float:
    """By the divergence theorem; positive if the triangles are counterclockwise from outside."""
    vertices, triangles = surface
    return float(np.linalg.det(vertices[triangles]).sum() / 6.0)


@pytest.mark.parametrize("subdivisions", [0, 1, 2])
def test_sphere_is_closed_and_round(subdivisions: int) -> None:
    vertices, triangles = sphere = unit_sphere(subdivisions)
    assert len(triangles) == 20 * 4**subdivisions
    # Euler's formula; every edge has two triangles.
    assert len(vertices) - 3 * len(triangles) // 2 + len(triangles) == 2
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0)
    assert volume(sphere) == pytest.approx(4.0 / 3.0 * np.pi, rel=[0.4, 0.13, 0.04][subdivisions])


def test_facets_of_a_cone_have_its_mean_radius() -> None:
    vertices, triangles = unit_cone(24)
    corners = vertices[triangles[:, :2]][:, :, :2]
    along = np.linspace(0.0, 1.0, 201)[:, np.newaxis, np.newaxis]
    points = corners[:, 0] + along * (corners[:, 1] - corners[:, 0])
    radii = np.linalg.norm(points, axis=-1)
    assert radii.mean() == pytest.approx(1.0, abs=1e-4)
    assert volume((vertices, triangles)) == pytest.approx(np.pi / 3.0, rel=0.01)


def test_copies_scale_turn_and_move() -> None:
    shapes = np.array([np.diag([2.0, 2.0, 3.0]), [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    positions = np.array([[1.0, 2.0, 3.0], [-5.0, 0.0, 0.0]])
    one = unit_sphere()
    several = copies(one, shapes, positions)
    assert volume(several) == pytest.approx(13.0 * volume(one))
    np.testing.assert_allclose(several[0][: len(one[0])], one[0] * [2.0, 2.0, 3.0] + positions[0])
    assert volume(joined([several, one])) == pytest.approx(14.0 * volume(one))


def test_normals_of_a_sphere_are_its_radii() -> None:
    vertices, triangles = unit_sphere(3)
    normals = vertex_normals((3.0 * vertices + np.array([1.0, 2.0, 3.0]), triangles))
    np.testing.assert_allclose(normals, vertices, atol=0.01)


def test_drake_reads_the_mesh() -> None:
    vertices, triangles = unit_sphere(2)
    hull = Mesh(obj_mesh(vertices + np.array([5.0, 0.0, 0.0]), triangles), 1.0).GetConvexHull()
    assert hull.num_vertices() == len(vertices)
    with_normals = Mesh(surface_mesh((vertices, triangles)), 1.0)
    assert with_normals.GetConvexHull().num_vertices() == len(vertices)
    assert np.mean([hull.vertex(k) for k in range(len(vertices))], axis=0) == pytest.approx([5.0, 0.0, 0.0])
