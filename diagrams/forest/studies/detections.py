"""Simulated detections of trunks at a place in a stand, without a scanner.

They serve for thousands of trials, and as an independent check of matching and tracking. False trunks (bushes,
boulders, snags) stand at fixed places like trees: they are detected again from the next place, but no map has them. All
rates and deviations are assumed; more realistic detections come from the simulated scanner.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import chord, compose, inverse, rotations, transform, wrap
from vtbdrake_diagrams.forest.world.stand import Stand

# The number of rays across each trunk that determine how much of it is visible.
_RAYS = 9

# A trunk is detected if at least this share of its width is visible.
_LEAST_VISIBLE = 0.5


@dataclass(frozen=True)
class Detector:
    """The assumed performance of a detector of trunks in one scan.

    Attributes:
        reach: The largest distance of a detection in m.
        missed: The share of the visible trunks that are not detected.
        false: The share of the trunks in a stand that are no trees, from 0 to below 1.
        along: Standard deviation of a position along the ray in m.
        across: Standard deviation of a position across the ray in m, at any distance.
        diameter: Standard deviation of a diameter in m.
        range_bias: A constant error of the positions along the ray in m, which the covariances do not contain.
    """

    reach: float = 20.0
    missed: float = 0.1
    false: float = 0.35
    along: float = 0.03
    across: float = 0.02
    diameter: float = 0.02
    range_bias: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.missed <= 1.0 or not 0.0 <= self.false < 1.0:
            raise ValueError(f"missed and false are shares from 0 to 1, not {self.missed} and {self.false}")
        if not self.reach > 0.0 or min(self.along, self.across, self.diameter) < 0.0:
            raise ValueError("the reach of a detector is positive, its deviations are at least 0")


@dataclass(frozen=True)
class Odometry:
    """The assumed drift of dead reckoning.

    Attributes:
        scale: Standard deviation of the factor of the distance travelled, which is constant during a drive.
        position: Random walk of the position in m per square root of a metre travelled, per axis.
        heading: Random walk of the heading in rad per square root of a metre travelled.
    """

    scale: float = 0.01
    position: float = 0.01
    heading: float = 0.001


@dataclass(frozen=True, eq=False)
class Wood:
    """The trunks of a stand: its trees, and false trunks.

    Attributes:
        trunks: True positions and diameters in W, without covariances.
        is_tree: Whether each is a tree, shape (n,).
    """

    trunks: Landmarks
    is_tree: NDArray[np.bool_]

    @classmethod
    def of(cls, stand: Stand, *, false: float, rng: np.random.Generator) -> Wood:
        """Return the trees of a stand, and among them as many false trunks as make up the share ``false`` of all."""
        trees = stand.trees()
        false_count = round(len(trees) * false / (1.0 - false))
        places = np.vstack([trees.positions()[:, :2], rng.random((false_count, 2)) * [stand.length, stand.width]])
        true = [tree.number("trunk_diameter", unit="m") for tree in trees]
        diameters = np.concatenate([true, stand.diameters(rng.random(false_count))])
        n = len(places)
        return cls(Landmarks(places, np.zeros((n, 2, 2)), diameters, np.zeros(n)), np.arange(n) < len(trees))

    def detected(self, X_WH: ArrayLike, detector: Detector, rng: np.random.Generator) -> tuple[Landmarks, Array]:
        """Return the detections from a pose (3,), as landmarks in H, and the indices of their trunks."""
        indices = visible(self.trunks, np.asarray(X_WH)[:2], reach=detector.reach)
        indices = indices[rng.random(len(indices)) >= detector.missed]
        places = transform(inverse(X_WH), self.trunks.positions[indices])
        bearings = np.arctan2(places[:, 1], places[:, 0])
        R_HRay = rotations(bearings)
        deviations = np.array([detector.along, detector.across])
        errors_Ray = rng.normal(size=(len(indices), 2)) * deviations + [detector.range_bias, 0.0]
        detections = Landmarks(
            places + np.einsum("nij,nj->ni", R_HRay, errors_Ray),
            R_HRay @ np.diag(deviations**2) @ R_HRay.transpose(0, 2, 1),
            np.maximum(self.trunks.diameters[indices] + detector.diameter * rng.normal(size=len(indices)), 0.01),
            np.full(len(indices), detector.diameter),
        )
        return detections, indices


def visible(trunks: Landmarks, place: ArrayLike, *, reach: float) -> Array:
    """Return the indices of the trunks that are within reach and not hidden behind nearer ones, nearest first.

    Args:
        trunks: The trunks, in W.
        place: The position of the scanner in W in m, shape (2,).
        reach: The largest distance to an axis in m.
    """
    offsets = trunks.positions - np.asarray(place)
    distances = np.hypot(*offsets.T)
    radii = trunks.diameters / 2.0
    near = np.flatnonzero((distances < reach) & (distances > radii))
    near = near[np.argsort(distances[near])]
    bearings = np.arctan2(offsets[near, 1], offsets[near, 0])
    half_widths = np.arcsin(radii[near] / distances[near])
    rays = bearings[:, np.newaxis] + half_widths[:, np.newaxis] * np.linspace(-0.9, 0.9, _RAYS)
    # [trunk, ray, other]: the nearer other trunk covers the ray.
    apart = np.abs(wrap(rays[:, :, np.newaxis] - bearings))
    nearer = np.tri(len(near), k=-1, dtype=bool)[:, np.newaxis, :]
    hidden = ((apart < half_widths) & nearer).any(axis=2)
    return near[(~hidden).mean(axis=1) >= _LEAST_VISIBLE]


def arc(X_WH: ArrayLike, *, length: float, curvature: float, step: float) -> Array:
    """Return poses (n, 3) along an arc that begins at a pose: every ``step`` m, for a ``length`` in m.

    Args:
        X_WH: The first pose, shape (3,).
        length: The length of the arc in m.
        curvature: The curvature in 1/m; positive to the left.
        step: The distance of successive poses along the arc in m.
    """
    poses = [np.asarray(X_WH, dtype=float)]
    turn = curvature * step
    move = chord(step * np.sinc(turn / 2.0 / np.pi), turn)
    for _ in range(round(length / step)):
        poses.append(compose(poses[-1], move))
    return np.array(poses)


def dead_reckoned(poses: Array, odometry: Odometry, rng: np.random.Generator) -> Array:
    """Return the poses X_OH (n, 3) by dead reckoning along true poses X_WH (n, 3); O is H at the first one."""
    factor = 1.0 + odometry.scale * rng.normal()
    reckoned = [np.zeros(3)]
    for before, after in pairwise(poses):
        move = compose(inverse(before), after)
        root = np.sqrt(np.hypot(*move[:2]))
        noise = root * rng.normal(size=3) * [odometry.position, odometry.position, odometry.heading]
        reckoned.append(compose(reckoned[-1], move * [factor, factor, 1.0] + noise))
    return np.array(reckoned)


def gathered(
    wood: Wood, poses: Array, detector: Detector, odometry: Odometry, rng: np.random.Generator
) -> tuple[Landmarks, Array]:
    """Return the detections along a drive, merged to landmarks in the last H, and the indices of their trunks.

    Each trunk gives one landmark, at the mean of its positions by dead reckoning: the association is assumed perfect.
    Its covariance is one detection's plus the drift since the trunk was seen.

    Args:
        wood: The trunks.
        poses: The true poses X_WH of the carrier at its detections, shape (n, 3).
        detector: The performance of the detector.
        odometry: The drift of the dead reckoning.
        rng: The generator of the random numbers.
    """
    reckoned = dead_reckoned(poses, odometry, rng)
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    since = steps.sum() - np.concatenate([[0.0], np.cumsum(steps)])
    sightings_by_trunk: dict[int, list[tuple[Array, Array, float, float]]] = {}
    for X_WH, X_OH, travelled in zip(poses, reckoned, since, strict=True):
        landmarks, trunks = wood.detected(X_WH, detector, rng)
        local = landmarks.seen_from(compose(inverse(reckoned[-1]), X_OH))
        for row, trunk in enumerate(trunks):
            sighting = (local.positions[row], local.covariances[row], local.diameters[row], float(travelled))
            sightings_by_trunk.setdefault(int(trunk), []).append(sighting)
    parts = [_merged(sightings, detector, odometry) for sightings in sightings_by_trunk.values()]
    return Landmarks.joined(parts), np.array(list(sightings_by_trunk), dtype=int)


def _merged(sightings: list[tuple[Array, Array, float, float]], detector: Detector, odometry: Odometry) -> Landmarks:
    positions, covariances, diameters, travelled = (np.array(column) for column in zip(*sightings, strict=True))
    place, distance = positions.mean(axis=0), travelled.mean()
    around = np.array([-place[1], place[0]])
    drift = (odometry.position**2 * distance + (odometry.scale * distance) ** 2) * np.eye(2)
    drift += odometry.heading**2 * distance * np.outer(around, around)
    deviation = detector.diameter / np.sqrt(len(sightings))
    return Landmarks([place], [covariances.mean(axis=0) + drift], [diameters.mean()], [deviation])
