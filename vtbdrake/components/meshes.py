"""Meshes of triangles made in memory: many copies of one shape in a single mesh, and shapes that Drake reads."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, pi, sin
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array

if TYPE_CHECKING:
    from pydrake.geometry import InMemoryMesh

Triangles = NDArray[np.int64]
# Vertices in m, shape (v, 3), and triangles of vertices counted from 0, shape (t, 3), counterclockwise from outside.
Surface = tuple[Array, Triangles]


def obj_mesh(
    vertices: Array, faces: Sequence[Sequence[int]] | Triangles, *, normals: Array | None = None, name: str = "mesh"
) -> InMemoryMesh:
    """Return a mesh in Wavefront's format, which Drake's `Mesh` and `Convex` read.

    Args:
        vertices: The vertices in m, shape (n, 3).
        faces: The vertices of each face, counted from 0, counterclockwise from outside.
        normals: The normal of the surface at each vertex, shape (n, 3). Cameras need them.
        name: A hint that appears in Drake's messages.
    """
    from pydrake.common import MemoryFile
    from pydrake.geometry import InMemoryMesh

    corner = "%d" if normals is None else "%d//%d"
    text = obj_lines("v %.9g %.9g %.9g", np.asarray(vertices))
    if normals is not None:
        text += obj_lines("vn %.3g %.3g %.3g", normals)
    # Faces with equally many vertices at once.
    for rows in [faces] if isinstance(faces, np.ndarray) else [np.array([face]) for face in faces]:
        numbers = np.repeat(rows + 1, 1 if normals is None else 2, axis=1)
        text += obj_lines(" ".join(["f", *[corner] * rows.shape[1]]), numbers)
    return InMemoryMesh(mesh_file=MemoryFile(text, ".obj", name))


def obj_lines(form: str, rows: NDArray[Any]) -> str:
    """Return a line of text for each row of numbers, (n, k), formatted at once, which is faster.

    Args:
        form: The line, with a %-format for each of the k numbers.
        rows: The numbers of the lines.
    """
    return (form + "\n") * len(rows) % tuple(rows.ravel().tolist())


def surface_mesh(surface: Surface, *, name: str = "mesh") -> InMemoryMesh:
    """Return a surface as a mesh that cameras, scanners and Meshcat show, smoothly shaded.

    Args:
        surface: Vertices in m, (n, 3), and the vertices of each triangle, (m, 3), counterclockwise from outside.
        name: A hint that appears in Drake's messages.
    """
    vertices, triangles = surface
    return obj_mesh(vertices, triangles, normals=vertex_normals(surface), name=name)


def vertex_normals(surface: Surface) -> Array:
    """Return the unit normals at the vertices, (v, 3): means over the triangles around, weighted by area."""
    vertices, triangles = surface
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    weighted = np.cross(b - a, c - a)
    corners = triangles.T.ravel()
    sums = [np.bincount(corners, np.tile(weighted[:, k], 3), len(vertices)) for k in range(3)]
    normals = np.column_stack(sums)
    unit: Array = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return unit


def copies(surface: Surface, shapes: Array, positions: Array) -> Surface:
    """Return n copies of a surface as one surface; copy k has the vertices A_k p + b_k for the vertices p.

    Args:
        surface: The surface to copy. The copies are one mesh, because each geometry costs Drake time.
        shapes: The matrices A_k, which scale, shear and turn, shape (n, 3, 3), with positive determinants.
        positions: The vectors b_k in m, shape (n, 3).
    """
    vertices, triangles = surface
    moved = np.einsum("nij,vj->nvi", shapes, vertices) + np.asarray(positions)[:, np.newaxis]
    first = len(vertices) * np.arange(len(moved))[:, np.newaxis, np.newaxis]
    return moved.reshape(-1, 3), (triangles + first).reshape(-1, 3)


def joined(surfaces: Sequence[Surface]) -> Surface:
    """Return several surfaces as one."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in surfaces)])
    triangles = [part + k for (_, part), k in zip(surfaces, first, strict=False)]
    return np.concatenate([vertices for vertices, _ in surfaces]), np.concatenate(triangles)


def unit_cone(sides: int) -> Surface:
    """Return a cone, open below, whose base is a circle of mean radius 1 around the origin and whose tip is at z = 1.

    Args:
        sides: The number of facets. Half of the polygon lies outside of the circle, half within, so that what is fitted
            to points on the facets has no bias.
    """
    # The mean radius of a polygon between corners at the radius r is r (1 - (pi / sides)^2 / 3) to second order.
    r = 1.0 / (1.0 - (pi / sides) ** 2 / 3.0)
    angles = [2.0 * pi * k / sides for k in range(sides)]
    vertices = np.array([*((r * cos(a), r * sin(a), 0.0) for a in angles), (0.0, 0.0, 1.0)])
    return vertices, np.array([(k, (k + 1) % sides, sides) for k in range(sides)])


def unit_sphere(subdivisions: int = 1) -> Surface:
    """Return a sphere of radius 1 around the origin: an icosahedron, each of whose triangles is divided repeatedly."""
    from scipy.spatial import ConvexHull

    g = (1.0 + 5.0**0.5) / 2.0
    corners = np.array([(a, b, 0.0) for b in (-g, g) for a in (-1.0, 1.0)])
    vertices = np.concatenate([np.roll(corners, k, axis=1) for k in range(3)])
    triangles = _outward(vertices, ConvexHull(vertices).simplices.astype(np.int64))
    for _ in range(subdivisions):
        vertices, triangles = _divided(vertices, triangles)
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), triangles


def _divided(vertices: Array, triangles: Triangles) -> Surface:
    """Return the surface with four triangles for each; the middles of the edges are new vertices."""
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    unique, places = np.unique(edges, axis=0, return_inverse=True)
    ab, bc, ca = (len(vertices) + places.reshape(3, -1)).astype(np.int64)
    a, b, c = triangles.T
    parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return (
        np.concatenate([vertices, vertices[unique].mean(axis=1)]),
        np.concatenate([np.column_stack(part) for part in parts]),
    )


def _outward(vertices: Array, triangles: Triangles) -> Triangles:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0.0
    return np.where(inward[:, np.newaxis], triangles[:, ::-1], triangles)
