"""Contact of spheres with many fixed shapes, such as the pieces of a terrain, as one function of their poses."""

from __future__ import annotations

import hashlib
import threading
import weakref
from collections.abc import Callable, Sequence
from ctypes import CDLL, Structure, byref, c_double, c_longlong, c_void_p
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Box, Shape, Sphere

from vtbdrake.components.casadi_system.compiler import compiled_kernel, kernel_library, kernel_signature

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


class GroundContact:
    """The contact of spheres with the pieces of a terrain, or of other terrains, without another compilation.

    Args:
        spheres: Drake's number of each sphere, and its shape.
        pieces: The fixed shapes of terrain 0, in the order of their numbers.
        materials: Stiffness, dissipation and friction of each sphere and piece together, and the share of the sphere
            in the stiffness, shape (spheres, pieces, 4).

    Attributes:
        function: (rotations, centres, number) -> distances, normals, offsets, materials (3), doubt; see ground.c.

    Raises:
        CompilerError: There is no C compiler, or it fails.
    """

    def __init__(
        self, spheres: Sequence[tuple[int, Sphere]], pieces: Sequence[Piece], materials: NDArray[np.float64]
    ) -> None:
        self._radius = max(sphere.radius() for _, sphere in spheres)
        # Drake counts geometries over all Diagrams of a process; their order alone matters.
        numbers = sorted({*(number for number, _ in spheres), *(piece.geometry for piece in pieces)})
        self._ranks = {number: rank for rank, number in enumerate(numbers)}
        text = "".join(
            (
                f"#define NF {len(spheres)}\n#define SLOTS {SLOTS}\n#define MOST_TERRAINS {_MOST_TERRAINS}\n",
                _array("double RADIUS", [sphere.radius() for _, sphere in spheres]),
                _array("long long SPHERE_ID", [self._ranks[number] for number, _ in spheres]),
                _source(self._arrays(pieces, materials)),
                *(files(__package__).joinpath(name).read_text(encoding="utf-8") for name in ("mpr.c", "ground.c")),
            )
        )
        name = f"ground_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
        count, places = len(spheres), len(spheres) * SLOTS
        shapes_in = [(3, 3 * count), (3, count), (1, 1)]
        shapes_out = [(places, 1), (3, places), (3, places), *[(places, 1)] * 3, (1, 1)]
        signature = kernel_signature(name, shapes_in, shapes_out)
        source = f"#define NAME {name}\n#define SET set_{name}\n{text}{signature}"
        self.function = compiled_kernel(name, source)
        self._name, self._set = name, getattr(CDLL(str(kernel_library(name))), f"set_{name}")
        self._set.argtypes, self._set.restype = (c_longlong, c_void_p), None

    def terrain(self, pieces: Sequence[Piece], materials: NDArray[np.float64]) -> Terrain:
        """Return another terrain, which has a number as long as it is there.

        Args:
            pieces: The fixed shapes, each with the number of a piece of terrain 0.
            materials: See the class.

        Raises:
            RuntimeError: There are too many terrains.
        """
        return Terrain(self._name, self._set, self._arrays(pieces, materials))

    def _arrays(self, pieces: Sequence[Piece], materials: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
        return _arrays(pieces, materials, [self._ranks[piece.geometry] for piece in pieces], self._radius)


class Terrain:
    """A terrain that spheres may touch beside the one that is compiled in.

    Attributes:
        number: The number under which `GroundContact.function` finds it in this process, as long as this object lives.
    """

    def __init__(self, kernel: str, assign: Callable[[int, Any], None], arrays: dict[str, NDArray[Any]]) -> None:
        """Give a terrain a number.

        Args:
            kernel: The name of the kernel that is to find it.
            assign: Its function SET.
            arrays: The arrays of the terrain, see `_arrays`.
        """
        with _ASSIGNING:
            taken = _TAKEN.setdefault(kernel, set())
            free = set(range(1, _MOST_TERRAINS)) - taken
            if not free:
                raise RuntimeError(f"{_MOST_TERRAINS - 1} terrains are in use: let go of some before you add another")
            self.number: int = min(free)
            taken.add(self.number)
        self._arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        record = _Record(**{name: array.ctypes.data for name, array in self._arrays.items() if name in _POINTERS})
        record.origin, record.cell = tuple(arrays["origin"]), float(arrays["cell"])
        record.count, (record.nx, record.ny) = len(arrays["id"]), arrays["cells"].tolist()
        self._record = record
        assign(self.number, byref(record))
        weakref.finalize(self, _release, assign, self.number, taken)


_MOST_TERRAINS = 1024
# The numbers in use of each kernel, by its name.
_TAKEN: dict[str, set[int]] = {}
_ASSIGNING = threading.Lock()
_POINTERS = (
    *("id", "is_box", "first", "cell_first", "cell_shapes"),
    *("half", "pose", "center", "reach", "low", "high", "vertices", "materials"),
)


class _Record(Structure):
    """The struct Terrain of ground.c."""

    _fields_ = (
        *((name, c_void_p) for name in _POINTERS),
        *(("origin", c_double * 2), ("cell", c_double)),
        *((name, c_longlong) for name in ("count", "nx", "ny")),
    )


def _release(assign: Callable[[int, Any], None], number: int, taken: set[int]) -> None:
    assign(number, None)
    with _ASSIGNING:
        taken.discard(number)


def _arrays(
    pieces: Sequence[Piece], materials: NDArray[np.float64], ranks: Sequence[int], radius: float
) -> dict[str, NDArray[Any]]:
    """Return the arrays of the struct Terrain of ground.c by name, with ``origin``, ``cell`` and ``cells``."""
    corners = [piece.corners for piece in pieces]
    in_world = [each @ piece.R.T + piece.p for each, piece in zip(corners, pieces, strict=True)]
    centers = np.array([np.mean(each, axis=0) for each in corners])
    reach = [
        1.001 * np.max(np.linalg.norm(each - center, axis=1)) for each, center in zip(corners, centers, strict=True)
    ]
    is_box = np.array([isinstance(piece.shape, Box) for piece in pieces])
    half = [piece.shape.size() / 2 if isinstance(piece.shape, Box) else np.zeros(3) for piece in pieces]
    return {
        "id": np.array(ranks, dtype=np.int64),
        "is_box": is_box.astype(np.int64),
        "first": np.cumsum([0, *map(len, corners)], dtype=np.int64),
        "half": np.array(half),
        "pose": np.array([np.concatenate([piece.R.T.ravel(), piece.p]) for piece in pieces]),
        "center": centers,
        "reach": np.array(reach),
        "low": np.array([each.min(axis=0) for each in in_world]),
        "high": np.array([each.max(axis=0) for each in in_world]),
        "vertices": np.concatenate(corners),
        "materials": materials.reshape(-1, 4).astype(float),
        **_grid(in_world, radius),
    }


def _grid(shapes: Sequence[NDArray[np.float64]], radius: float) -> dict[str, NDArray[Any]]:
    """Return the shapes in each cell of a grid over the map, see ground.c; shapes are given by their corners."""
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
    return {
        "origin": origin,
        "cell": np.array(size),
        "cells": count.astype(np.int64),
        "cell_first": np.cumsum([0, *map(len, members)], dtype=np.int64),
        "cell_shapes": np.array([n for each in members for n in each] or [0], dtype=np.int64),
    }


def _source(arrays: dict[str, NDArray[Any]]) -> str:
    """Return the C definitions of the arrays of terrain 0."""
    tables = "".join(
        _array(f"{'double' if arrays[name].dtype == float else 'long long'} {name.upper()}", arrays[name])
        for name in _POINTERS
    )
    (x, y), (nx, ny) = arrays["origin"].tolist(), arrays["cells"].tolist()
    numbers = {"ORIGIN_X": x, "ORIGIN_Y": y, "CELL": float(arrays["cell"]), "N": len(arrays["id"]), "NX": nx, "NY": ny}
    return tables + "".join(f"#define {name} ({value!r})\n" for name, value in numbers.items())


def _array(declarator: str, numbers: ArrayLike) -> str:
    """Return the C definition of a constant array."""
    values = np.asarray(numbers)
    sizes = "".join(f"[{size}]" for size in values.shape)
    return f"static const {declarator}{sizes} = {_initializer(values.tolist())};\n"


def _initializer(values: float | list[float]) -> str:
    return f"{{{', '.join(map(_initializer, values))}}}" if isinstance(values, list) else repr(values)
