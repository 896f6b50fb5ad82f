"""Rocks on a plain from the points of one scan: the positions of their middles, and their widths.

A rock is a cluster of points that stands out of the ground, bulges towards the scanner as a circle does, and ends on
both sides where nothing nearer hides it. A scan shows only the side that faces the scanner. If each row of rays meets
half a circle, the points of a row that is w wide lie w pi / 8 in front of the middle on average, and the variance of
their places across the view is w^2 / 12. A rock is narrower towards its top, so its widest row would place its middle
too far: the width of the rows is computed from the variance over all points. Rocks are not circular: along the view,
they are assumed to be longer or shorter by a share of the width, which gives most of the covariance. The rows may meet
little more than the top, so that a rock may be wider on the ground by about the distance of two rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import setting
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import rotations
from vtbdrake.components.localization.scan_scene import Cells, Clusters, ScanDetectorConfig, ScanPoints

# What goes on to this height in m above the largest one of a rock is connected with the ground, as a trunk.
_OVERHEAD = 0.5


@dataclass(frozen=True)
class RockDetectorConfig(ScanDetectorConfig):
    """Settings of the detector of rocks, in addition to `ScanDetectorConfig`.

    Raises:
        ValueError: A setting is outside of its range.
    """

    least_height: float = setting(
        0.06,
        "The least height over the ground of a point of a rock; more than the height of waves of the ground that "
        "are too short for `fit_ground` to follow.",
        unit="m",
        gt=0.0,
    )
    largest_height: float = setting(
        1.5,
        "The largest height over the ground of a point of a rock: what reaches above it, as a trunk, is none.",
        unit="m",
        gt=0.0,
    )
    least_roundness: float = setting(
        0.4,
        "The least bulge of the visible outline, as a share of the bulge of a circle of the same width.",
        ge=0.0,
        lt=1.0,
    )
    least_width: float = setting(0.2, "The least width of a rock.", unit="m", gt=0.0, below="largest_width")
    largest_width: float = setting(3.0, "The largest width of a rock.", unit="m", gt=0.0)
    least_points: int = setting(3, "The least number of points of a rock.", ge=2)
    cell: float = setting(
        0.2,
        "Edge length of the cells into which points are sorted; two rocks closer than this become one.",
        unit="m",
        gt=0.0,
    )
    elongation: float = setting(
        0.25, "Standard deviation of the diameters of a rock's outline, as a share of their mean.", ge=0.0, lt=1.0
    )


def detect_rocks(points_H: ArrayLike, detector: RockDetectorConfig, *, p_HoLo_H: ArrayLike) -> Landmarks:
    """Find the rocks in the points of a scan.

    Args:
        points_H: The points in the level frame H of the carrier, de-skewed, shape (n, 3) in m, in any order.
        detector: The settings.
        p_HoLo_H: The position of the scanner at the time of H, shape (3,) in m.

    Returns:
        The rocks in H: the middles of their outlines, and their widths as diameters.

    Raises:
        ValueError: The points have another shape, or are not finite.
    """
    scene = ScanPoints.of(points_H, p_HoLo_H, detector)
    # What hangs over a rock, as branches, is no part of it.
    is_low = scene.heights < detector.largest_height + _OVERHEAD
    standing = scene.select(np.flatnonzero((scene.heights > detector.least_height) & is_low))
    cells = Cells.of(standing.points, size=detector.cell, reach=detector.reach)
    rows, owners = cells.connected(np.arange(len(standing)))
    if not len(rows):
        return Landmarks.empty()
    return _outlines(Clusters(standing, rows, owners), detector, np.asarray(p_HoLo_H)[:2])


def _outlines(clusters: Clusters, detector: RockDetectorConfig, origin: Array) -> Landmarks:
    """Return the clusters that are rocks, if the scanner is at ``origin`` (2,)."""
    step, starts = detector.azimuth_step, clusters.starts
    right, left = (extreme.reduceat(clusters.azimuths, starts) for extreme in (np.minimum, np.maximum))
    near, far = (extreme.reduceat(clusters.distances, starts) for extreme in (np.minimum, np.maximum))
    mean = clusters.sums(clusters.distances) / clusters.counts
    # The edges are half a step beyond the outer rays. The sine is radius / distance of the middle.
    sine = np.sin(np.minimum(0.5 * (left - right + step), 1.0))
    radius = mean * sine / (1.0 - 0.25 * pi * sine)
    lateral = clusters.distances * clusters.azimuths
    centred = lateral - (clusters.sums(lateral) / clusters.counts)[clusters.owners]
    # Each ray stands for a step. The radius of the rows is sqrt(3) times the deviation.
    variance = clusters.sums(centred**2) / clusters.counts + (step * mean) ** 2 / 12.0
    width, distance = 2.0 * radius, mean + 0.25 * pi * np.sqrt(3.0 * variance)
    hidden = clusters.hidden_edges(detector, gap=detector.cell + 4.0 * detector.range_noise)
    heights = np.maximum.reduceat(clusters.scene.heights[clusters.rows], starts)
    good = (clusters.counts >= detector.least_points) & ~hidden.any(axis=1) & (heights < detector.largest_height)
    good &= (width >= detector.least_width) & (width <= detector.largest_width)
    # The distance of the sides beyond the middle, as a share of a circle's distance.
    middle, half = 0.5 * (left + right), 0.5 * (left - right + step)
    turned = (clusters.azimuths - middle[clusters.owners]) / half[clusters.owners]
    bulge = np.sqrt(np.maximum(1.0 - turned**2, 0.0)) * radius[clusters.owners]
    bulge -= (clusters.sums(bulge) / clusters.counts)[clusters.owners]
    roundness = -clusters.sums(bulge * clusters.distances) / np.maximum(clusters.sums(bulge**2), 1e-9)
    good &= (roundness > detector.least_roundness) & (far - near < width + detector.cell)
    bearings = (clusters.bearings + middle)[good]
    width, distance = width[good], distance[good]
    # The variance of the middle of both edges, each known to a step / sqrt(12).
    edge = (step * distance) ** 2 / 24.0
    shape = (detector.elongation * width) ** 2
    along = 0.25 * shape + detector.range_noise**2 + edge
    across = shape / 16.0 + edge
    R = rotations(bearings)
    P = (R * np.stack([along, across], axis=1)[:, None, :]) @ R.transpose(0, 2, 1)
    positions = origin + distance[:, None] * R[:, :, 0]
    rows = (0.5 * detector.elevation_step * distance) ** 2
    return Landmarks(positions, P, width, np.sqrt(shape + rows + 4.0 * edge))
