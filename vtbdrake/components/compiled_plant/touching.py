"""The point where two shapes touch in Drake's point contact, as expressions: the deepest of one, seen by the other.

Compiled is what Drake computes in closed form: a sphere against the nearest point of another shape, and the deepest
point of any shape against a half-space. For all other pairs Drake iterates (MPR, of libccd), and the normals that come
out may be far from those at the nearest points. Compiled are a sphere against a mesh's hull, and two capsules, whose
results do not jump. Edges and faces of other pairs make facets of their Minkowski difference, and rounding decides in
which triangle of a facet the iteration ends.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, Capsule, Convex, Cylinder, HalfSpace, Mesh, Shape, Sphere

from vtbdrake.components.compiled_plant.links import Pose
from vtbdrake.components.compiled_plant.mpr import penetration

Expression = Any  # casadi.SX
Touch = tuple[Expression, Expression, Expression]

# A cosine between a half-space's normal and an axis of a shape that differs from 0, 1 or -1 by less is taken for it.
_PARALLEL = 1e-7


def can_touch(first: Shape, second: Shape) -> bool:
    """Return whether contact of one shape with another is compiled.

    Args:
        first: A sphere, or any shape with a deepest point if the second one is a half-space. The shape whose geometry
            has the smaller id if Drake iterates.
        second: The other shape.
    """
    if is_iterated(first, second):
        return True
    if isinstance(first, Sphere):
        return type(second) in (HalfSpace, *_NEAREST)
    return isinstance(second, HalfSpace) and type(first) in _DEEPEST


def is_iterated(first: Shape, second: Shape) -> bool:
    """Return whether Drake iterates for the contact of two shapes, in a way that is compiled.

    Args:
        first: A shape.
        second: The other shape.
    """
    kinds = {type(first), type(second)}
    return kinds in ({Capsule}, {Sphere, Convex}, {Sphere, Mesh})


def touch(first: Shape, X_WA: Pose, second: Shape, X_WB: Pose, hulls: tuple[NDArray[np.float64], ...]) -> Touch:
    """Return the deepest point of one shape in the other.

    Args:
        first: The shape A; see `can_touch`.
        X_WA: Its pose in the world.
        second: The shape B.
        X_WB: Its pose in the world.
        hulls: The vertices of the convex hulls of A and B in their frames, shape (n, 3), if they are meshes.

    Returns:
        The point on A, shape (3, 1); B's normal there, out of B, shape (3, 1), both in the world; and the distance
        in m, below 0 in contact.
    """
    R_A, p_A = X_WA
    R_B, p_B = X_WB
    if is_iterated(first, second):
        poses = (casadi.densify(each) for each in (R_A, p_A, R_B, p_B))
        distance, normal, middle = penetration(first, second, hulls)(*poses)
        return middle - distance / 2 * normal, -normal, distance
    if isinstance(first, Sphere):
        if isinstance(second, HalfSpace):
            n, distance = R_B[:, 2], casadi.dot(R_B[:, 2], p_A - p_B)
        else:
            n, distance = _NEAREST[type(second)](second, R_B.T @ (p_A - p_B))
            n = R_B @ n
        return p_A - first.radius() * n, n, distance - first.radius()
    n = R_B[:, 2]
    point, height = _DEEPEST[type(first)](first, R_A.T @ n, hulls[0])
    return p_A + R_A @ point, n, casadi.dot(n, p_A - p_B) + height


# -- the normal of a shape at its point that is nearest to p, and the distance of p, below 0 inside; in its frame


def _from_point(d: Expression) -> tuple[Expression, Expression]:
    """Return the direction of d, and its length."""
    length = casadi.sqrt(casadi.sumsqr(d))
    return d / length, length


def _from_sphere(shape: Sphere, p: Expression) -> tuple[Expression, Expression]:
    n, distance = _from_point(p)
    return n, distance - shape.radius()


def _from_capsule(shape: Capsule, p: Expression) -> tuple[Expression, Expression]:
    half = shape.length() / 2
    n, distance = _from_point(casadi.vertcat(p[:2], p[2] - casadi.fmin(casadi.fmax(p[2], -half), half)))
    return n, distance - shape.radius()


def _from_cylinder(shape: Cylinder, p: Expression) -> tuple[Expression, Expression]:
    """Return normal and distance of a cylinder: a box in the plane of its axis and p."""
    r = casadi.sqrt(casadi.sumsqr(p[:2]))
    outward = casadi.if_else(r > 0, p[:2] / r, casadi.SX([1, 0]))
    n, distance = _from_sides(casadi.vertcat(r, p[2]), np.array([shape.radius(), shape.length() / 2]))
    return casadi.vertcat(n[0] * outward, n[1]), distance


def _from_box(shape: Box, p: Expression) -> tuple[Expression, Expression]:
    return _from_sides(p, shape.size() / 2)


def _from_sides(p: Expression, half: NDArray[np.float64]) -> tuple[Expression, Expression]:
    """Return the normal of a box or rectangle at its point that is nearest to p, and the distance of p.

    Args:
        p: The point in the box's frame, shape (n, 1).
        half: Half of the box's size, shape (n,), in m.
    """
    nearest = casadi.fmin(casadi.fmax(p, -half), half)
    outside, length = _from_point(p - nearest)
    # Inside, it is the nearest face.
    depth, inside = casadi.SX(np.inf), casadi.SX(len(half), 1)
    for axis in range(len(half)):
        below = half[axis] - casadi.fabs(p[axis])
        face = casadi.SX(casadi.DM(np.eye(len(half))[axis])) * casadi.if_else(p[axis] < 0, -1, 1)
        inside = casadi.if_else(below < depth, face, inside)
        depth = casadi.fmin(depth, below)
    is_inside = depth >= 0
    return casadi.if_else(is_inside, inside, outside), casadi.if_else(is_inside, -depth, length)


# -- the point of a shape that is deepest in a half-space with the normal n, and its height along n; in its frame


def _deepest_of_box(shape: Box, n: Expression, vertices: NDArray[np.float64]) -> tuple[Expression, Expression]:
    """Return a corner, or the middle of a face that lies flat, with the height of the corner."""
    corner = casadi.if_else(n > 0, -1, 1) * casadi.DM(shape.size() / 2)
    deepest = corner
    for axis in reversed(range(3)):
        face = casadi.SX(casadi.DM(np.eye(3)[axis])) * corner[axis]
        deepest = casadi.if_else(casadi.fabs(casadi.fabs(n[axis]) - 1) < _PARALLEL, face, deepest)
    return deepest, casadi.dot(n, corner)


def _lower_end(length: float, cosine: Expression) -> Expression:
    """Return the place of the lower end of an axis along it, or of its middle if it lies flat."""
    end = casadi.if_else(cosine > 0, -length / 2, length / 2)
    return casadi.if_else(casadi.fabs(cosine) < _PARALLEL, 0.0, end)


def _deepest_of_capsule(shape: Capsule, n: Expression, vertices: NDArray[np.float64]) -> tuple[Expression, Expression]:
    deepest = casadi.vertcat(0, 0, _lower_end(shape.length(), n[2])) - shape.radius() * n
    return deepest, casadi.dot(n, deepest)


def _deepest_of_cylinder(
    shape: Cylinder, n: Expression, vertices: NDArray[np.float64]
) -> tuple[Expression, Expression]:
    """Return a point of a rim, or the middle of a cap that lies flat, or of the lowest line."""
    across, _ = _from_point(n[:2])
    lies_flat = casadi.fabs(casadi.fabs(n[2]) - 1) < _PARALLEL
    rim = casadi.if_else(lies_flat, casadi.SX(2, 1), -shape.radius() * across)
    deepest = casadi.vertcat(rim, _lower_end(shape.length(), n[2]))
    return deepest, casadi.dot(n, deepest)


def _deepest_of_hull(
    shape: Convex | Mesh, n: Expression, vertices: NDArray[np.float64]
) -> tuple[Expression, Expression]:
    """Return the deepest vertex, the first one of several."""
    deepest, lowest = casadi.SX.zeros(3, 1), casadi.SX(np.inf)
    for vertex in vertices:
        height = casadi.dot(casadi.DM(vertex), n)
        deepest = casadi.if_else(height < lowest, casadi.SX(casadi.DM(vertex)), deepest)
        lowest = casadi.fmin(lowest, height)
    return deepest, lowest


_NEAREST: dict[type, Callable[[Any, Expression], tuple[Expression, Expression]]] = {
    Box: _from_box,
    Capsule: _from_capsule,
    Cylinder: _from_cylinder,
    Sphere: _from_sphere,
}
_DEEPEST: dict[type, Callable[[Any, Expression, NDArray[np.float64]], tuple[Expression, Expression]]] = {
    Box: _deepest_of_box,
    Capsule: _deepest_of_capsule,
    Convex: _deepest_of_hull,
    Cylinder: _deepest_of_cylinder,
    Mesh: _deepest_of_hull,
}
