"""The surface of uneven ground from the points of a scan."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solveh_banded
from scipy.sparse import kron

from vtbdrake.common.arrays import Array

# Distance of the nodes of the surface, in m.
_SPACING = 4.0
# Edge length of the cells whose lowest points count, in m.
_CELL = 1.5
# From stiff to soft: the weight of the squared second differences of neighbouring nodes (1/m^2), and how far (m) the
# lowest point of a cell may lie above the surface and still be taken for ground.
_STAGES = ((1e3, 2.0), (1e2, 1.0), (1e1, 0.5), (2.0, 0.3), (1.0, 0.2))
# The weight of the ground at the carrier, in lowest points of cells.
_ANCHOR = 20.0


@dataclass(frozen=True, eq=False)
class GroundSurface:
    """A surface over the plane, bilinear between the nodes of a square grid.

    Attributes:
        corner: The node with the least x and y, in m, (2,).
        heights: The heights of the nodes in m, (m, m), by x and y.
    """

    corner: Array
    heights: Array

    def at(self, places: ArrayLike) -> Array:
        """Return the heights (m), (n,), of the surface at places (n, 2); beyond its border, the border's heights."""
        heights, total = self.heights.ravel(), np.zeros(len(np.asarray(places)))
        for nodes, weights in self.support(np.asarray(places)):
            total += weights * heights[nodes]
        return total

    def support(self, places: Array) -> Iterator[tuple[NDArray[np.intp], Array]]:
        """Yield the four nodes around places (n, 2), one after the other: their indices and weights, (n,) each."""
        m = len(self.heights)
        scaled = np.clip((places - self.corner) / _SPACING, 0.0, m - 1.000001)
        column = scaled.astype(np.intp)
        right = scaled - column
        node = column[:, 0] * m + column[:, 1]
        for dx, dy in ((0, 0), (0, 1), (1, 0), (1, 1)):
            weights = (right[:, 0] if dx else 1.0 - right[:, 0]) * (right[:, 1] if dy else 1.0 - right[:, 1])
            yield node + dx * m + dy, weights


def fit_ground(points: Array, center: Array, *, reach: float) -> GroundSurface:
    """Fit a surface to the lowest points of a scan; where no ray reaches the ground, they are of trunks or undergrowth.

    The surface minimizes the sum of the weighted squares of its distances from the lowest points of all cells and of
    its own second differences. Points above it lose weight from stage to stage, while it becomes less stiff: it begins
    nearly as a plane, and ends as a surface that follows waves of some ten metres.

    Args:
        points: The points of the scan, (n, 3) in m, z up.
        center: The point on the ground beneath the scanner, (3,) in m, where the scanner sees no ground.
        reach: Half of the edge length of the surface around ``center``, in m.
    """
    m = int(2.0 * reach / _SPACING) + 2
    corner = center[:2] - 0.5 * (m - 1) * _SPACING
    lowest = _lowest(points, corner, cells=int((m - 1) * _SPACING / _CELL) + 1)
    lowest = np.vstack([center, lowest])
    surface = GroundSurface(corner, np.full((m, m), center[2]))
    support = list(surface.support(lowest[:, :2]))
    # The entries (row, column) of the upper band of the normal matrix, and what each point adds to them.
    rows = np.concatenate([a for a, _ in support for _ in support])
    columns = np.concatenate([b for _ in support for b, _ in support])
    shares = np.concatenate([u * v for _, u in support for _, v in support])
    nodes, parts = (np.concatenate(list(arrays)) for arrays in zip(*support, strict=True))
    upper = rows <= columns
    entries = (2 * m + rows - columns)[upper] * m * m + columns[upper]
    shares, owners = shares[upper], np.tile(np.arange(len(lowest)), 16)[upper]
    weights = np.ones(len(lowest))
    weights[0] = _ANCHOR
    for stiffness, tolerance in _STAGES:
        band = stiffness * _stiffness(m)
        band += np.bincount(entries, shares * weights[owners], band.size).reshape(band.shape)
        right = np.bincount(nodes, parts * np.tile(weights * lowest[:, 2], 4), m * m)
        surface = GroundSurface(corner, solveh_banded(band, right, check_finite=False).reshape(m, m))
        above = np.maximum(lowest[1:, 2] - surface.at(lowest[1:, :2]), 0.0)
        weights[1:] = np.exp(-((above / tolerance) ** 2))
    return surface


def _lowest(points: Array, corner: Array, *, cells: int) -> Array:
    """Return the lowest points of a square of ``cells`` times ``cells`` cells, (k, 3)."""
    index = np.floor((points[:, :2] - corner) / _CELL).astype(np.intp)
    inside = np.flatnonzero(((index >= 0) & (index < cells)).all(axis=1))
    flat = index[inside, 0] * cells + index[inside, 1]
    least = np.full(cells * cells, np.inf)
    z = points[inside, 2]
    np.minimum.at(least, flat, z)
    lowest: Array = points[inside[z == least[flat]]]
    return lowest


@lru_cache(8)
def _stiffness(m: int) -> Array:
    """Return the upper band (2 m + 1, m^2) of the matrix of the squared second differences of m times m nodes."""
    identity, first = np.eye(m), np.diff(np.eye(m), axis=0)
    second = np.diff(first, axis=0)
    factors = ((second, identity, 1.0), (identity, second, 1.0), (first, first, 2.0))
    matrix = sum(weight * kron(a.T @ a, b.T @ b, format="csr") for a, b, weight in factors)
    band = np.zeros((2 * m + 1, m * m))
    for k in range(2 * m + 1):
        band[2 * m - k, k:] = matrix.diagonal(k)
    band[-1] += 1e-9
    return band
