"""Point clouds of real forests: the scans that a carrier would take in them, and the stems that their full rings show.

The clouds are merged from many scans or along a path, so they show trunks from all sides. A scan that is cut out of
them (`virtual_scan`) has the points that a scanner at one place would see: bark, branches, undergrowth and the noise of
ranges come from the recording. The stems that are the reference (`rings`) are circles around hollow rings of points,
seen from all sides at several heights: nothing of the detector takes part.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.trunks import TrunkDetectorConfig

# Edge length of the cells whose lowest points are the ground, in m.
_CELL = 1.0
# Number of cells, the cell itself among them, whose median the ground of a cell is compared with.
_NEIGHBOURS = 9
# The ground of a cell lies at most this far above that median, in m.
_STEP = 0.3

# A point hides what is farther away by more than `_THICKNESS` within this half width and half height around it.
# Clouds are thin: 60 points per square metre of bark are 0.13 m apart. Trunks are upright, so the height is larger.
# Half width, in m.
_HALF_WIDTH = 0.06
# Half height, in m.
_HALF_HEIGHT = 0.3
# Thickness, in m.
_THICKNESS = 0.15

# Heights over the ground of the slices in which rings are searched for, in m.
_SLICES = (0.9, 1.3, 1.7, 2.1, 2.5)
# Thickness of a slice, in m.
_SLICE = 0.4
# Half width of the line of a ring, in m.
_LINE = 0.02
# Least and largest radius of a ring, in m.
_RADII = (0.03, 0.5)
# Number of slices that must show a ring.
_LEAST_SLICES = 3
_SECTORS = 20
# Circles through triples of points near each other, per point.
_TRIES = 30


FULL = 0.6
"""The share of a circle on which a full ring has points."""
PARTIAL = 0.35
"""The share of a circle on which a ring has points that was seen from one side."""
STEM = 0.6
"""A detection within this distance of any ring, in m, belongs to a stem."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """A point cloud of a forest.

    Attributes:
        points: Positions in m, z up, (n, 3).
        heights: Heights over the ground in m, (n,).
    """

    points: Array
    heights: Array

    @classmethod
    def of(cls, points: Array) -> Cloud:
        """Return the cloud of points (n, 3), with heights over the lowest points around each."""
        corner = points[:, :2].min(axis=0)
        cells = ((points[:, :2] - corner) / _CELL).astype(np.intp)
        lowest = np.full(cells.max(axis=0) + 1, np.inf)
        np.minimum.at(lowest, (cells[:, 0], cells[:, 1]), points[:, 2])
        filled = np.argwhere(np.isfinite(lowest))
        ground, tree = lowest[tuple(filled.T)], cKDTree(corner + _CELL * (filled + 0.5))
        _, near = tree.query(tree.data, min(_NEIGHBOURS, len(ground)))
        for _ in range(3):  # Cells in which no ray reached the ground.
            ground = np.minimum(ground, np.median(ground[near], axis=1) + _STEP)
        distances, near = tree.query(points[:, :2], min(4, len(ground)))
        weights = 1.0 / (distances**2 + 0.1)
        return cls(points, points[:, 2] - (weights * ground[near]).sum(axis=1) / weights.sum(axis=1))

    @classmethod
    def read(cls, path: Path) -> Cloud:
        """Return the cloud in a LAS or LAZ file, with its origin at its least coordinates; this needs ``laspy``."""
        import laspy

        points = np.asarray(laspy.read(path).xyz, dtype=float)
        return cls.of(points - np.floor(points.min(axis=0)))

    def ground(self, place: Array) -> float:
        """Return the z of the ground at a place (2,), in m."""
        nearest = np.linalg.norm(self.points[:, :2] - place, axis=1).argsort()[:50]
        return float(np.median(self.points[nearest, 2] - self.heights[nearest]))


@dataclass(frozen=True)
class Scanner:
    """A spinning scanner.

    Attributes:
        rows: Number of rows of rays.
        columns: Number of rays of a row, all around.
        elevation: Angle between the top and the bottom of the rows, symmetric about the horizontal, in rad.
        reach: Largest range in m.
    """

    rows: int = 16
    columns: int = 1250
    elevation: float = np.pi / 6.0
    reach: float = 25.0

    def detector(self, noise: float) -> TrunkDetectorConfig:
        """Return the settings of the detector of trunks for this scanner with a range noise in m."""
        return TrunkDetectorConfig(
            azimuth_step=2.0 * np.pi / self.columns, elevation_step=self.elevation / self.rows, range_noise=noise
        )


def virtual_scan(cloud: Cloud, eye: Array, scanner: Scanner) -> Array:
    """Return the points of a cloud that a scanner at ``eye`` (3,) sees, (n, 3): the nearest one of each ray.

    A ray takes a point whose direction is within half a step of its own, where the point is, with its error. What lies
    behind other points is hidden, although the cloud has gaps between them.
    """
    delta = cloud.points - eye
    ranges = np.linalg.norm(delta, axis=1)
    elevations = np.arcsin(np.clip(delta[:, 2] / np.maximum(ranges, 1e-9), -1.0, 1.0))
    up, left = scanner.elevation / scanner.rows, 2.0 * np.pi / scanner.columns
    row = np.floor((elevations + 0.5 * scanner.elevation) / up).astype(np.intp)
    # Rows above and below the field of view hide, too.
    margin = 8
    row += margin
    rows = scanner.rows + 2 * margin
    column = np.floor((np.arctan2(delta[:, 1], delta[:, 0]) + np.pi) / left).astype(np.intp) % scanner.columns
    usable = (row >= 0) & (row < rows) & (ranges > 0.3) & (ranges < scanner.reach)
    depth = np.full((rows, scanner.columns), np.inf)
    nearest, edges = depth.copy(), np.geomspace(0.3, max(scanner.reach, 1.0), 24)
    for low, high in pairwise(edges):
        shell = np.flatnonzero(usable & (ranges >= low) & (ranges < high))
        image = np.full_like(depth, np.inf)
        np.minimum.at(image, (row[shell], column[shell]), ranges[shell])
        np.minimum(nearest, image, out=nearest)
        size = [2 * int(half / (high * step) + 0.5) + 1 for half, step in ((_HALF_HEIGHT, up), (_HALF_WIDTH, left))]
        np.minimum(depth, minimum_filter(image, size, mode=("nearest", "wrap")), out=depth)
    seen = usable & (row >= margin) & (row < rows - margin)
    at = np.flatnonzero(seen)
    first = ranges[at] <= np.minimum(nearest[row[at], column[at]], depth[row[at], column[at]] + _THICKNESS)
    return cloud.points[at[first]]


def rings(cloud: Cloud, *, arc: float = FULL, fewest: int = 15, seed: int = 0) -> Array:
    """Return the stems of a cloud: x, y and diameter at 1.3 m over the ground in m, (k, 3).

    In each slice, circles through triples of near points are refined where they have many points on their line and few
    within. A stem is a pile of such rings in at least three slices.
    """
    rng = np.random.default_rng(seed)
    circles = np.vstack([_rings_of_slice(cloud, height, arc, fewest, rng) for height in _SLICES])
    stems = []
    order = circles[:, 4].argsort()[::-1]
    left = np.ones(len(circles), dtype=bool)
    for k in order:
        if not left[k]:
            continue
        near = left & (np.linalg.norm(circles[:, :2] - circles[k, :2], axis=1) < 0.15)
        near &= np.abs(circles[:, 2] - circles[k, 2]) < 0.25 * circles[k, 2] + 0.02
        left &= np.linalg.norm(circles[:, :2] - circles[k, :2], axis=1) >= 0.15
        if len(set(circles[near, 3])) < _LEAST_SLICES:
            continue
        A = np.column_stack([np.ones(near.sum()), circles[near, 3] - 1.3])
        line = np.linalg.lstsq(A, circles[near, :3], rcond=None)[0]
        stems.append(line[0] * [1.0, 1.0, 2.0])
    return np.array(stems).reshape(-1, 3)


def _rings_of_slice(cloud: Cloud, height: float, arc: float, fewest: int, rng: np.random.Generator) -> Array:
    """Return x, y, radius, the height and the number of points of the rings in a slice, (k, 5)."""
    places = cloud.points[np.abs(cloud.heights - height) < 0.5 * _SLICE, :2]
    tree = cKDTree(places)
    candidates: list[Array] = []
    for place, near in zip(places, tree.query_ball_point(places, 0.6), strict=True):
        if len(near) < fewest:
            continue
        partners = places[rng.choice(near, (_TRIES, 2))]
        A = 2.0 * (partners - place)
        det = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
        good = np.abs(det) > 1e-6
        b = np.sum(partners[good] ** 2 - place**2, axis=2)
        if not len(b):
            continue
        centers = np.linalg.solve(A[good], b[:, :, None])[:, :, 0]
        radii = np.linalg.norm(centers - place, axis=1)
        inner = (radii > _RADII[0]) & (radii < _RADII[1])
        if not inner.any():
            continue
        centers, radii = centers[inner], radii[inner]
        offsets = np.linalg.norm(places[near][None] - centers[:, None], axis=2) - radii[:, None]
        scores = (np.abs(offsets) < _LINE).sum(axis=1) - 2.0 * (offsets < -1.5 * _LINE).sum(axis=1)
        best = scores.argmax()
        if scores[best] >= 0.6 * fewest:
            candidates.append(np.array([*centers[best], radii[best], scores[best]]))
    refined: list[Array] = []
    for x, y, radius, _ in sorted(candidates, key=lambda row: -row[3]):
        if any(np.hypot(x - ring[0], y - ring[1]) < 0.15 for ring in refined):
            continue
        ring = _refined(places, np.array([x, y]), radius, arc, fewest)
        if ring is not None:
            refined.append(np.array([*ring[:3], height, ring[3]]))
    return np.array(refined).reshape(-1, 5)


def _refined(places: Array, center: Array, radius: float, arc: float, fewest: int) -> Array | None:
    """Return x, y, the radius and the number of points of the circle nearest to the points on a line; None: no ring."""
    on: NDArray[np.bool_]
    for _ in range(8):
        delta = places - center
        distances = np.linalg.norm(delta, axis=1)
        on = np.abs(distances - radius) < 1.5 * _LINE
        if on.sum() < fewest:
            return None
        J = np.column_stack([-delta[on] / distances[on, None], -np.ones(on.sum())])
        step = np.linalg.lstsq(J, radius - distances[on], rcond=None)[0]
        center, radius = center + step[:2], radius + step[2]
        if not _RADII[0] < radius < _RADII[1]:
            return None
    sectors = np.floor((np.arctan2(delta[on, 1], delta[on, 0]) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
    within = (distances < radius - 2.0 * _LINE).sum()
    if len(set(sectors)) < arc * _SECTORS or within > 0.35 * on.sum():
        return None
    return np.array([*center, radius, on.sum()])
