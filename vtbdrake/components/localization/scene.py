"""What a scanner sees around it: its points by direction and distance, and clusters of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import inf, pi

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# The share of a cluster's rows that must end before something nearer if its edge counts as hidden.
_HIDDEN = 0.25


@dataclass(frozen=True, eq=False)
class Scene:
    """The points of a scan, with the scanner at the origin.

    Attributes:
        points: In m, z up, (n, 3).
        distances: In the plane, in m, (n,).
        azimuths: Directions in the plane in rad, (n,).
        slopes: z / distance, (n,).
    """

    points: Array
    distances: Array
    azimuths: Array
    slopes: Array

    @classmethod
    def of(cls, points: ArrayLike, eye: ArrayLike, *, reach: float) -> Scene:
        """Return points (n, 3) as seen from ``eye`` (3,), up to a distance in the plane; all in m.

        Raises:
            ValueError: The points or the eye have another shape, or are not finite.
        """
        seen, origin = np.asarray(points, dtype=float), np.asarray(eye, dtype=float)
        if seen.ndim != 2 or seen.shape[1] != 3 or origin.shape != (3,):
            raise ValueError(
                f"points have the shape (n, 3), the scanner's place (3,), not {seen.shape}, {origin.shape}"
            )
        if not (np.isfinite(seen).all() and np.isfinite(origin).all()):
            raise ValueError("points and the scanner's place are finite numbers: leave rays without a return out")
        seen = seen - origin
        distances = np.hypot(seen[:, 0], seen[:, 1])
        near = np.flatnonzero((distances <= reach) & (distances > 0.0))
        seen, distances = seen[near], distances[near]
        return cls(seen, distances, np.arctan2(seen[:, 1], seen[:, 0]), seen[:, 2] / distances)

    def __len__(self) -> int:
        return len(self.distances)

    def select(self, rows: Indices) -> Scene:
        """Return the points with these indices."""
        return Scene(self.points[rows], self.distances[rows], self.azimuths[rows], self.slopes[rows])


@dataclass(frozen=True, eq=False)
class Cells:
    """Points in the square cells of a plane.

    Attributes:
        flat: The cell of each point, (n,), numbered by x and y.
        side: How many cells there are along each axis; those at the border are empty.
    """

    flat: Indices
    side: int

    @classmethod
    def of(cls, points: Array, *, size: float, reach: float) -> Cells:
        """Return points (n, 3), of which none is farther from the origin than ``reach``, in cells of a size in m."""
        index = ((points[:, :2] + reach) / size).astype(np.intp) + 1
        side = int(2.0 * reach / size) + 3
        return cls(index[:, 0] * side + index[:, 1], side)

    def connected(self, chosen: Indices) -> tuple[Indices, Indices]:
        """Return chosen points in the order of their clusters, and the cluster of each: a number, ascending from 0.

        The cells of a cluster touch each other at an edge or a corner.
        """
        occupied = np.zeros(self.side**2, dtype=bool)
        occupied[self.flat[chosen]] = True
        labels, _ = label(occupied.reshape(self.side, self.side), structure=np.ones((3, 3)))
        owners = labels.ravel()[self.flat[chosen]] - 1
        order = np.argsort(owners, kind="stable")
        return chosen[order], owners[order].astype(np.intp)


@dataclass(frozen=True, eq=False)
class Clusters:
    """Points of a scene, in k clusters.

    Attributes:
        scene: All points.
        rows: Those of the clusters, in their order, (n,).
        owners: The clusters of these, ascending from 0, (n,).
    """

    scene: Scene
    rows: Indices
    owners: Indices

    @cached_property
    def starts(self) -> Indices:
        """The first point of each cluster, (k,)."""
        return np.flatnonzero(np.diff(self.owners, prepend=-1))

    @cached_property
    def counts(self) -> Indices:
        """The number of points of each cluster, (k,)."""
        return np.diff(self.starts, append=len(self.owners))

    @cached_property
    def distances(self) -> Array:
        """The distances of the points in m, (n,)."""
        return self.scene.distances[self.rows]

    @cached_property
    def bearings(self) -> Array:
        """The direction in which each cluster is seen, in rad, (k,)."""
        places = self.sums(self.scene.points[self.rows, :2])
        return np.arctan2(places[:, 1], places[:, 0])

    @cached_property
    def azimuths(self) -> Array:
        """The directions of the points in rad, counted from those of their clusters, (n,)."""
        angles = self.scene.azimuths[self.rows] - self.bearings[self.owners]
        wrapped: Array = (angles + pi) % (2.0 * pi) - pi
        return wrapped

    def sums(self, values: Array) -> Array:
        """Return the sums over the clusters, (k, ...), of values of the points, (n, ...)."""
        total: Array = np.add.reduceat(values, self.starts, axis=0)
        return total

    def hidden_edges(self, *, azimuth_step: float, elevation_step: float, gap: float) -> NDArray[np.bool_]:
        """Return whether something nearer begins where a cluster ends, to the right and to the left, (k, 2).

        Args:
            azimuth_step: Angle between neighbouring rays of a row in rad.
            elevation_step: Angle between neighbouring rows in rad.
            gap: By how much it is nearer than the points of the cluster, in m.
        """
        columns, lowest = max(round(2.0 * pi / azimuth_step), 1), self.scene.slopes.min()
        lines = int((self.scene.slopes.max() - lowest) / elevation_step) + 1
        line = ((self.scene.slopes - lowest) / elevation_step).astype(np.intp)
        nearest = np.full(columns * lines, inf)
        column = np.floor((self.scene.azimuths + pi) / azimuth_step).astype(np.intp) % columns
        np.minimum.at(nearest, column * lines + line, self.scene.distances)
        limits, line = self.distances - gap, line[self.rows]
        sides = []
        for extreme, sign in ((np.minimum, -1.0), (np.maximum, 1.0)):
            edge = extreme.reduceat(self.azimuths, self.starts) + self.bearings
            before = np.zeros(len(self.rows), dtype=bool)
            for beyond in (1.0, 2.0):
                column = np.floor((edge + pi) / azimuth_step + sign * beyond).astype(np.intp) % columns
                before |= nearest[column[self.owners] * lines + line] < limits
            sides.append(self.sums(before.astype(float)) > _HIDDEN * self.counts)
        return np.stack(sides, axis=1)
