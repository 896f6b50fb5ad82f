"""Contact of two convex shapes for which Drake iterates, as a function of their poses."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from importlib.resources import files

import casadi
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, Capsule, Convex, Cylinder, Mesh, Shape, Sphere

from vtbdrake.components.casadi_system.compiler import compiled_kernel, kernel_signature

_KINDS: dict[type, str] = {
    Box: "BOX",
    Capsule: "CAPSULE",
    Convex: "HULL",
    Cylinder: "CYLINDER",
    Mesh: "HULL",
    Sphere: "SPHERE",
}


def penetration(first: Shape, second: Shape, vertices: tuple[NDArray[np.float64], ...]) -> casadi.Function:
    """Return the function (R_1, p_1, R_2, p_2) -> distance, normal, point of two shapes in contact.

    The distance (m) is below 0 in contact, else above; the normal points from the first shape into the second one, and
    the point (m) lies in the middle between both surfaces, in the world.

    Args:
        first: The shape whose geometry has the smaller id.
        second: The other shape.
        vertices: The vertices of their convex hulls, shape (n, 3), if they are meshes.

    Raises:
        CompilerError: There is no C compiler, or it fails.
    """
    return _compiled(_definitions(1, first, vertices[0]) + _definitions(2, second, vertices[1]))


@lru_cache(maxsize=256)
def _compiled(definitions: str) -> casadi.Function:
    text = definitions + "".join(
        files(__package__).joinpath(name).read_text(encoding="utf-8") for name in ("mpr.c", "mpr_pair.c")
    )
    name = f"mpr_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    signature = kernel_signature(name, [(3, 3), (3, 1), (3, 3), (3, 1)], [(1, 1), (3, 1), (3, 1)])
    return compiled_kernel(name, f"#define NAME {name}\n{text}{signature}")


def _definitions(k: int, shape: Shape, hull: NDArray[np.float64]) -> str:
    """Return the C text that defines a shape."""
    center = np.mean(hull, axis=0) if len(hull) else np.zeros(3)
    points = hull if len(hull) else np.zeros((1, 3))
    reach = float(np.max(np.linalg.norm(points - center, axis=1)))
    size = np.zeros(3)
    if isinstance(shape, Sphere):
        size[0] = reach = shape.radius()
    elif isinstance(shape, Capsule):
        size[:2] = shape.radius(), shape.length() / 2
        reach = float(np.sum(size))
    elif isinstance(shape, Cylinder):
        size[:2] = shape.radius(), shape.length() / 2
        reach = float(np.linalg.norm(size))
    elif isinstance(shape, Box):
        size = shape.size() / 2
        reach = float(np.linalg.norm(size))
    rows = ", ".join(_row(point) for point in points)
    return (
        f"#define KIND_{k} {_KINDS[type(shape)]}\n#define COUNT_{k} {len(points)}\n"
        f"#define REACH_{k} {1.001 * reach!r}\n"
        f"static const double SIZE_{k}[3] = {_row(size)}, CENTER_{k}[3] = {_row(center)};\n"
        f"static const double VERTICES_{k}[COUNT_{k}][3] = {{{rows}}};\n"
    )


def _row(numbers: NDArray[np.float64]) -> str:
    return f"{{{', '.join(map(repr, numbers.tolist()))}}}"
