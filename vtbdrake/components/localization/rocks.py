"""Rocks on a plain from the points of one scan: where their middles are, and how wide they are.

A rock is a cluster of points that stands out of the ground, bulges towards the scanner as a circle does, and ends on
both sides where nothing nearer hides it. A scan shows only the side that faces the scanner. If its outline is taken for
a circle of the diameter w that is seen, its points lie w pi / 8 in front of its middle on average. Rocks are no
circles: their outlines are taken to be longer or shorter in the other direction by a share of w, which gives most of
the covariance. And what the rows of rays meet may be little more than the top, so that a rock may be wider on the
ground by about the distance of two rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.components.localization.ground import fit_ground
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.scene import Cells, Clusters, Scene
from vtbdrake.components.settings import check_settings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RockDetector:
    """How rocks are found. The steps must be those of the scanner.

    Attributes:
        azimuth_step: Angle between neighbouring rays of a row in rad.
        elevation_step: Angle between neighbouring rows in rad.
        range_noise: Standard deviation of a range in m.
        reach: Distance in m from the scanner up to which rocks are looked for.
        least_height: How far a point must be over the ground to belong to a rock, in m; more than waves of the ground
            that are too short for `fit_ground` to follow.
        least_roundness: How much of the roundness of a circle its outline must have on the visible side.
        least_width: The least width of a rock in m.
        largest_width: The largest width of a rock in m.
        least_points: The least number of its points.
        ground_height: The z in H of the ground under the scanner in m: 0 if the origin of B is on the ground.
        cell: Edge length in m of the cells in which points are gathered; two rocks closer than this become one.
        elongation: Standard deviation of the diameters of a rock's outline, as a share of their mean.

    Raises:
        ValueError: A value that no detector can have.
    """

    azimuth_step: float = 2.0 * pi / 1250
    elevation_step: float = pi / 6.0 / 16
    range_noise: float = 0.02
    reach: float = 25.0
    least_height: float = 0.06
    least_roundness: float = 0.4
    least_width: float = 0.2
    largest_width: float = 3.0
    least_points: int = 3
    ground_height: float = 0.0
    cell: float = 0.2
    elongation: float = 0.25

    def __post_init__(self) -> None:
        checks = {
            "azimuth_step": (0.0 < self.azimuth_step < 0.1, "in rad, above 0 and below 0.1"),
            "elevation_step": (0.0 < self.elevation_step < 0.5, "in rad, above 0 and below 0.5"),
            "range_noise": (0.0 < self.range_noise < inf, "in m, positive"),
            "reach": (0.0 < self.reach <= 200.0, "in m, positive and at most 200"),
            "least_height": (0.0 < self.least_height < inf, "in m, positive"),
            "least_roundness": (0.0 <= self.least_roundness < 1.0, "a share from 0 to below 1"),
            "least_width": (0.0 < self.least_width < self.largest_width, "in m, below the largest_width"),
            "largest_width": (self.largest_width < inf, "in m, finite"),
            "least_points": (self.least_points >= 2, "at least 2"),
            "ground_height": (-inf < self.ground_height < inf, "in m, finite"),
            "cell": (self.reach / 2000.0 <= self.cell < inf, "in m, at least a 2000th of the reach"),
            "elongation": (0.0 <= self.elongation < 1.0, "a share from 0 to below 1"),
        }
        check_settings("RockDetector", self, checks)


def detect_rocks(points_H: ArrayLike, detector: RockDetector, *, p_HoLo_H: ArrayLike) -> Landmarks:
    """Find the rocks in the points of a scan.

    Args:
        points_H: The points in the level frame H of the carrier, de-skewed, shape (n, 3) in m, in any order.
        detector: How rocks are found.
        p_HoLo_H: Where the scanner was at the time of H, shape (3,) in m.

    Returns:
        The rocks in H: the middles of their outlines, and their widths as diameters.

    Raises:
        ValueError: The points have another shape, or are not finite.
    """
    eye = np.asarray(p_HoLo_H, dtype=float)
    scene = Scene.of(points_H, eye, reach=detector.reach)
    if not len(scene):
        return Landmarks.empty()
    ground = fit_ground(scene.points, np.array([0.0, 0.0, detector.ground_height - eye[2]]), reach=detector.reach)
    over = scene.points[:, 2] - ground.at(scene.points[:, :2])
    standing = scene.select(np.flatnonzero(over > detector.least_height))
    cells = Cells.of(standing.points, size=detector.cell, reach=detector.reach)
    rows, owners = cells.connected(np.arange(len(standing)))
    if not len(rows):
        return Landmarks.empty()
    return _outlines(Clusters(standing, rows, owners), detector, eye[:2])


def _outlines(clusters: Clusters, detector: RockDetector, origin: Array) -> Landmarks:
    """Return the clusters that are rocks, if the scanner is at ``origin`` (2,)."""
    step, starts = detector.azimuth_step, clusters.starts
    right, left = (extreme.reduceat(clusters.azimuths, starts) for extreme in (np.minimum, np.maximum))
    near, far = (extreme.reduceat(clusters.distances, starts) for extreme in (np.minimum, np.maximum))
    mean = clusters.sums(clusters.distances) / clusters.counts
    # The edges are half a step beyond the outer rays. The sine is radius / distance of the middle.
    sine = np.sin(np.minimum(0.5 * (left - right + step), 1.0))
    radius = mean * sine / (1.0 - 0.25 * pi * sine)
    width, distance = 2.0 * radius, mean + 0.25 * pi * radius
    hidden = clusters.hidden_edges(
        azimuth_step=step,
        elevation_step=detector.elevation_step,
        gap=detector.cell + 4.0 * detector.range_noise,
    )
    good = (clusters.counts >= detector.least_points) & ~hidden.any(axis=1)
    good &= (width >= detector.least_width) & (width <= detector.largest_width)
    # How much farther the sides are than the middle, in comparison with a circle.
    middle, half = 0.5 * (left + right), 0.5 * (left - right + step)
    turned = (clusters.azimuths - middle[clusters.owners]) / half[clusters.owners]
    bulge = np.sqrt(np.maximum(1.0 - turned**2, 0.0)) * radius[clusters.owners]
    bulge -= (clusters.sums(bulge) / clusters.counts)[clusters.owners]
    roundness = -clusters.sums(bulge * clusters.distances) / np.maximum(clusters.sums(bulge**2), 1e-9)
    good &= (roundness > detector.least_roundness) & (far - near < width + detector.cell)
    bearings = (clusters.bearings + middle)[good]
    width, distance = width[good], distance[good]
    # Of both edges together, each known to a step / sqrt(12).
    edge = (step * distance) ** 2 / 24.0
    shape = (detector.elongation * width) ** 2
    along = 0.25 * shape + detector.range_noise**2 + edge
    across = shape / 16.0 + edge
    c, s = np.cos(bearings), np.sin(bearings)
    R = np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2)
    P = (R * np.stack([along, across], axis=1)[:, None, :]) @ R.transpose(0, 2, 1)
    positions = origin + distance[:, None] * np.stack([c, s], axis=1)
    rows = (0.5 * detector.elevation_step * distance) ** 2
    return Landmarks(positions, P, width, np.sqrt(shape + rows + 4.0 * edge))
