"""Contact of spheres with many fixed shapes, such as the pieces of a terrain, as one function of their poses."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from importlib.resources import files
from typing import NamedTuple

import casadi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Box, Shape, Sphere

from vtbdrake.components.casadi_system.compiler import compiled_kernel, kernel_signature

SLOTS = 8
"""The most pieces of ground that a sphere touches at once; a rollout in which it touches more is not valid."""

# The most cells of the grid along an axis, which halves the time of a crater against half as many.
_MOST_CELLS = 96


class Piece(NamedTuple):
    """A fixed shape.

    Attributes:
        geometry: Drake's number of the geometry.
        shape: A box, or another shape with vertices.
        R: Its rotation in the world, shape (3, 3).
        p: Its position in the world, shape (3,), in m.
        vertices: The vertices of its hull in its frame, shape (n, 3), in m; none of a box.
    """

    geometry: int
    shape: Shape
    R: NDArray[np.float64]
    p: NDArray[np.float64]
    vertices: NDArray[np.float64]

    @property
    def corners(self) -> NDArray[np.float64]:
        """Return the corners in its frame, shape (n, 3), in m."""
        if isinstance(self.shape, Box):
            signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
            return signs * self.shape.size() / 2
        return self.vertices


def ground_contact(
    spheres: Sequence[tuple[int, Sphere]], pieces: Sequence[Piece], materials: NDArray[np.float64]
) -> casadi.Function:
    """Return the function (rotations, centres) -> distances, normals, offsets, materials (3), doubt; see ground.c.

    Args:
        spheres: Drake's number of each sphere, and its shape.
        pieces: The fixed shapes, in the order of their numbers.
        materials: Stiffness, dissipation and friction of each sphere and piece together, and the share of the sphere
            in the stiffness, shape (spheres, pieces, 4).

    Raises:
        CompilerError: There is no C compiler, or it fails.
    """
    corners = [piece.corners for piece in pieces]
    in_world = [each @ piece.R.T + piece.p for each, piece in zip(corners, pieces, strict=True)]
    centers = [np.mean(each, axis=0) for each in corners]
    different, numbers = np.unique(materials.reshape(-1, 4), axis=0, return_inverse=True)
    radii = [sphere.radius() for _, sphere in spheres]
    text = "".join(
        (
            f"#define NF {len(spheres)}\n#define N {len(pieces)}\n#define SLOTS {SLOTS}\n",
            _array("double RADIUS", radii),
            _array("long SPHERE_ID", [number for number, _ in spheres]),
            _array("long ID", [piece.geometry for piece in pieces]),
            _array("int IS_BOX", [int(isinstance(piece.shape, Box)) for piece in pieces]),
            _array(
                "double HALF",
                [piece.shape.size() / 2 if isinstance(piece.shape, Box) else np.zeros(3) for piece in pieces],
            ),
            _array("double POSE", [np.concatenate([piece.R.T.ravel(), piece.p]) for piece in pieces]),
            _array("double CENTER", centers),
            _array(
                "double REACH",
                [
                    1.001 * np.max(np.linalg.norm(each - center, axis=1))
                    for each, center in zip(corners, centers, strict=True)
                ],
            ),
            _array("double LOW", [each.min(axis=0) for each in in_world]),
            _array("double HIGH", [each.max(axis=0) for each in in_world]),
            _array("double VERTICES", np.concatenate(corners)),
            _array("int FIRST", np.cumsum([0, *map(len, corners)])),
            _array("int MATERIAL", numbers.reshape(len(spheres), len(pieces))),
            _array("double MATERIALS", different),
            _grid(in_world, max(radii)),
            *(files(__package__).joinpath(name).read_text(encoding="utf-8") for name in ("mpr.c", "ground.c")),
        )
    )
    name = f"ground_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    count, places = len(spheres), len(spheres) * SLOTS
    shapes_out = [(places, 1), (3, places), (3, places), *[(places, 1)] * 3, (1, 1)]
    signature = kernel_signature(name, [(3, 3 * count), (3, count)], shapes_out)
    return compiled_kernel(name, f"#define NAME {name}\n{text}{signature}")


def _grid(shapes: Sequence[NDArray[np.float64]], radius: float) -> str:
    """Return the C tables of the shapes in each cell of a grid over the map; shapes are given by their corners."""
    margin = 1.001 * radius + 1e-9
    lower = np.array([each[:, :2].min(axis=0) for each in shapes]) - margin
    upper = np.array([each[:, :2].max(axis=0) for each in shapes]) + margin
    origin, end = lower.min(axis=0), upper.max(axis=0)
    cells = min(_MOST_CELLS, 2 * int(np.ceil(np.sqrt(len(shapes)))))
    size = float(np.max(end - origin)) / cells * (1.0 + 1e-12)
    count = np.maximum(np.ceil((end - origin) / size).astype(int), 1)
    members: list[list[int]] = [[] for _ in range(int(np.prod(count)))]
    first = np.floor((lower - origin) / size).astype(int)
    last = np.minimum(np.floor((upper - origin) / size).astype(int), count - 1)
    for n, ((x0, y0), (x1, y1)) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                members[x + int(count[0]) * y].append(n)
    return "".join(
        (
            f"#define ORIGIN_X ({float(origin[0])!r})\n#define ORIGIN_Y ({float(origin[1])!r})\n",
            f"#define CELL {size!r}\n#define NX {count[0]}\n#define NY {count[1]}\n",
            _array("int CELL_FIRST", np.cumsum([0, *map(len, members)])),
            _array("int CELL_SHAPES", [n for each in members for n in each] or [0]),
        )
    )


def _array(declarator: str, numbers: ArrayLike) -> str:
    """Return the C definition of a constant array."""
    values = np.asarray(numbers)
    sizes = "".join(f"[{size}]" for size in values.shape)
    return f"static const {declarator}{sizes} = {_initializer(values.tolist())};\n"


def _initializer(values: float | list[float]) -> str:
    return f"{{{', '.join(map(_initializer, values))}}}" if isinstance(values, list) else repr(values)
