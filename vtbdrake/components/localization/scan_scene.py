"""The points of a scan as detectors of landmarks use them: by direction and distance, over the ground, in clusters."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from math import inf, pi

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label

from vtbdrake.common.arrays import Array, Indices
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.localization.ground import fit_ground
from vtbdrake.components.localization.planar import wrap

# An edge of a cluster is hidden if more than this share of its points are in rows that end at something nearer.
_HIDDEN = 0.25

# Points within this distance of the fitted ground lie on it, in m.
_ON_GROUND = 0.2
# A scan shows the ground if more than this share of its points lie on it: at least 0.2 do in scans of simulated
# forests, less than 0.1 in mirrored ones [calibrated].
_GROUND_SHARE = 0.15


@dataclass(frozen=True)
class ScanDetectorConfig:
    """Settings that all detectors of landmarks in scans have; angles and noise must equal the scanner's.

    Raises:
        ValueError: A setting is outside of its range.
    """

    azimuth_step: float = setting(
        2.0 * pi / 1250, "Angle between neighbouring rays of a row of the scanner.", unit="rad", gt=0.0, lt=0.1
    )
    elevation_step: float = setting(
        pi / 6.0 / 16, "Angle between neighbouring rows of the scanner.", unit="rad", gt=0.0, lt=0.5
    )
    range_noise: float = setting(0.02, "Standard deviation of the ranges.", unit="m", gt=0.0)
    reach: float = setting(
        25.0, "The largest distance from the scanner at which landmarks are searched for.", unit="m", gt=0.0, le=200.0
    )
    ground_height: float = setting(
        0.0, "The z in H of the ground under the scanner: 0 if the origin of B is on the ground.", unit="m"
    )
    cell: float = setting(0.15, "Edge length of the cells into which points are sorted.", unit="m", gt=0.0)

    def __post_init__(self) -> None:
        check_settings(self)
        if self.cell < self.reach / 2000.0:
            least = f"{self.reach / 2000.0:g} m, a 2000th of the reach"
            raise ValueError(f"{type(self).__name__}.cell must be at least {least}, not {self.cell!r}")


@dataclass(frozen=True, eq=False)
class ScanPoints:
    """The points of a scan, with the scanner at the origin.

    Attributes:
        points: Positions in m, z up, (n, 3).
        distances: Horizontal distances in m, (n,).
        azimuths: Directions in the plane in rad, (n,).
        slopes: The quotients z / distance, (n,).
        heights: Heights over the ground in m, (n,).
    """

    points: Array
    distances: Array
    azimuths: Array
    slopes: Array
    heights: Array

    @classmethod
    def of(cls, points_H: ArrayLike, p_HoLo_H: ArrayLike, detector: ScanDetectorConfig) -> ScanPoints:
        """Return the points within the reach of a detector, as the scanner sees them.

        If a scan shows the ground above the scanner, the scene is empty: the elevations have the wrong sign, as when
        the scanner is mounted upside down and its pose on the carrier says otherwise. Its trunks could be matched, but
        levelling would turn such a scan the wrong way, and displace them.

        Args:
            points_H: The points in the level frame H of the carrier in m, shape (n, 3).
            p_HoLo_H: The position of the scanner, shape (3,) in m.
            detector: The settings, for the reach and for the height of the ground beneath the scanner.

        Raises:
            ValueError: The points or the place of the scanner have another shape, or are not finite.
        """
        points, distances = _around(points_H, p_HoLo_H, detector.reach)
        feet = np.array([0.0, 0.0, detector.ground_height - float(np.asarray(p_HoLo_H)[2])])
        heights = _heights(points, feet, detector.reach)
        scene = cls(points, distances, np.arctan2(points[:, 1], points[:, 0]), points[:, 2] / distances, heights)
        if _shows_ground(heights) or not _shows_ground(_heights(points * [1.0, 1.0, -1.0], feet, detector.reach)):
            return scene
        return scene.select(np.zeros(0, dtype=np.intp))

    @classmethod
    def planar(
        cls, points_H: ArrayLike, p_HoLo_H: ArrayLike, detector: ScanDetectorConfig, *, height: float
    ) -> ScanPoints:
        """Return the points of a planar scan, which shows no ground: all are at one height (m) over it.

        Args:
            points_H: The points in the level frame H of the carrier in m, shape (n, 3); their z is not used.
            p_HoLo_H: The position of the scanner, shape (3,) in m.
            detector: The settings, for the reach.
            height: The height of the scanned plane over the ground, in m.

        Raises:
            ValueError: As in `of`.
        """
        points, distances = _around(points_H, p_HoLo_H, detector.reach)
        points = points * [1.0, 1.0, 0.0]
        azimuths, level = np.arctan2(points[:, 1], points[:, 0]), np.zeros(len(points))
        return cls(points, distances, azimuths, level, np.full(len(points), height))

    def __len__(self) -> int:
        return len(self.distances)

    def select(self, rows: Indices) -> ScanPoints:
        """Return the points with these indices."""
        return ScanPoints(*(getattr(self, field.name)[rows] for field in fields(self)))


def _around(points_H: ArrayLike, p_HoLo_H: ArrayLike, reach: float) -> tuple[Array, Array]:
    """Return the points (n, 3) within the reach of a scanner, from which they are counted, and their distances (n,)."""
    points, eye = np.asarray(points_H, dtype=float), np.asarray(p_HoLo_H, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3 or eye.shape != (3,):
        raise ValueError(f"points have the shape (n, 3), the scanner's place (3,), not {points.shape}, {eye.shape}")
    if not (np.isfinite(points).all() and np.isfinite(eye).all()):
        raise ValueError("points and the scanner's place are finite numbers: leave rays without a return out")
    points = points - eye
    distances = np.hypot(points[:, 0], points[:, 1])
    near = np.flatnonzero((distances <= reach) & (distances > 0.0))
    return points[near], distances[near]


def _heights(points: Array, feet: Array, reach: float) -> Array:
    """Return the heights of points over the ground that is fitted to them, (n,), see `fit_ground`."""
    heights: Array = points[:, 2] - fit_ground(points, feet, reach=reach).at(points[:, :2])
    return heights


def _shows_ground(heights: Array) -> bool:
    return bool((np.abs(heights) < _ON_GROUND).sum() > _GROUND_SHARE * len(heights))


@dataclass(frozen=True, eq=False)
class Cells:
    """Points in the square cells of a plane.

    Attributes:
        flat: The cell of each point, (n,), numbered by x and y.
        side: The number of cells along each axis; those at the border are empty.
    """

    flat: Indices
    side: int

    @classmethod
    def of(cls, points: Array, *, size: float, reach: float) -> Cells:
        """Return the cells of points.

        Args:
            points: The points, (n, 3) in m.
            size: Edge length of the cells in m.
            reach: The largest horizontal distance of a point from the origin in m.
        """
        index = ((points[:, :2] + reach) / size).astype(np.intp) + 1
        side = int(2.0 * reach / size) + 3
        return cls(index[:, 0] * side + index[:, 1], side)

    def connected(self, rows: Indices) -> tuple[Indices, Indices]:
        """Return chosen points in the order of their clusters, and the cluster of each: a number, ascending from 0.

        The cells of a cluster touch each other at an edge or a corner.
        """
        occupied = np.zeros(self.side**2, dtype=bool)
        occupied[self.flat[rows]] = True
        labels, _ = label(occupied.reshape(self.side, self.side), structure=np.ones((3, 3)))
        owners = labels.ravel()[self.flat[rows]] - 1
        order = np.argsort(owners, kind="stable")
        return rows[order], owners[order].astype(np.intp)


@dataclass(frozen=True, eq=False)
class Clusters:
    """Points of a scene, in k clusters.

    Attributes:
        scene: All points.
        rows: Indices of the points in clusters, cluster by cluster, (n,).
        owners: The cluster of each, a number that ascends from 0, (n,).
    """

    scene: ScanPoints
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
        """The directions of the points in rad, counted from the directions of their clusters, (n,)."""
        return wrap(self.scene.azimuths[self.rows] - self.bearings[self.owners])

    def select(self, keep: NDArray[np.bool_]) -> Clusters:
        """Return the clusters of a mask, (k,)."""
        rows = keep[self.owners]
        return Clusters(self.scene, self.rows[rows], (np.cumsum(keep) - 1)[self.owners[rows]])

    def sums(self, values: Array) -> Array:
        """Return the sums over the clusters, (k, ...), of values of the points, (n, ...)."""
        total: Array = np.add.reduceat(values, self.starts, axis=0)
        return total

    def hidden_edges(self, detector: ScanDetectorConfig, *, gap: float) -> NDArray[np.bool_]:
        """Return whether something nearer begins where a cluster ends, to the right and to the left, (k, 2).

        Args:
            detector: The settings, for the angles between rays.
            gap: The least distance in m between the points of the cluster and something nearer in front of them.
        """
        azimuth_step, elevation_step = detector.azimuth_step, detector.elevation_step
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
