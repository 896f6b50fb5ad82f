"""A map of trees from a drive with satellite positions: poses and trees by one least squares, after the drive.

Unknown are the pose X_WH of the car at each scan and the position of each tree. The squares are those of

    odometry:    R_iᵀ (p_i+1 - p_i) - t_i  and  θ_i+1 - θ_i - φ_i,     with the covariance of the drift model,
    detections:  R_iᵀ (l - p_i) - z,                                   with the detector's,
    positions:   p_i + R_i a - g,                                      with the antenna a in H,

each weighted with its distance (Cauchy's weights), as detections may be of something else, and positions jump. Errors
of satellite positions last for some ten seconds: only one position in this number of seconds counts as independent.

Which tree each detection shows is decided anew between the steps: the nearest tree within a gate, one to one in a
scan. What was detected too rarely is no tree. (Grisetti, Kümmerle, Stachniss and Burgard, "A tutorial on graph-based
SLAM", IEEE Intelligent Transportation Systems Magazine 2, 2010.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix
from scipy.sparse import eye as sparse_eye
from scipy.sparse.linalg import splu
from threadpoolctl import threadpool_limits

from vtbdrake.common.arrays import Array, Indices
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.localization.dead_reckoning import DriftModel
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import compose, inverse, rotation, rotations, transform, wrap

# The gates of the association in m, one for each round: as long as the poses are uncertain, they are wide.
_GATES = (2.5, 2.0, 1.5, 1.5, 1.2, 1.2)
# Steps of Gauss and Newton in each round.
_STEPS = 3
# The first seconds, in which the odometry is laid onto the positions for the start.
_ALIGNED = 300.0
# Cauchy's weights are one half at this many deviations.
_HALF = 3.0
# Standard deviations of a motion [m, m, rad] beside its drift: least squares need them.
_LEAST_MOTION = np.array([0.005, 0.005, 5e-4])
# Standard deviation of a tree's axis, in m.
_AXIS = 0.05
# Standard deviation in m that is added to the trees': a trunk is no point.
_FLOOR = 0.03


@dataclass(frozen=True)
class SurveyConfig:
    """Settings of a survey."""

    antenna_x: float = setting(0.0, "Position of the antenna in H, ahead of its origin.", unit="m")
    antenna_y: float = setting(0.0, "Position of the antenna in H, to the left.", unit="m")
    deviation: float = setting(1.0, "Standard deviation of a satellite position, per axis.", unit="m", gt=0)
    memory: float = setting(10.0, "Time over which errors of satellite positions last.", unit="s", gt=0)
    largest_range: float = setting(40.0, "Detections beyond are not used.", unit="m", gt=0)
    fewest: int = setting(8, "The number of scans in which a tree must be detected.", ge=2)

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, eq=False)
class Survey:
    """The result of a survey.

    Attributes:
        times: The times of the scans in s, (n,).
        poses: The poses X_WH at these times, (n, 3).
        trees: The trees in W, with covariances and median diameters.
        correlation: The length in m over which the errors of the trees are shared; 0 if they are hardly.
    """

    times: Array
    poses: Array
    trees: Landmarks
    correlation: float

    def antenna_at(self, times: ArrayLike, config: SurveyConfig) -> Array:
        """Return the positions of the antenna at some times, (m, 2)."""
        at = np.column_stack([np.interp(times, self.times, self.poses[:, k]) for k in range(3)])
        antenna = np.array([config.antenna_x, config.antenna_y])
        return at[:, :2] + rotations(at[:, 2]) @ antenna


class _Squares:
    """Weighted residuals and their derivatives, as sparse rows."""

    def __init__(self) -> None:
        self.residuals: list[Array] = []
        self._parts: list[tuple[Array, Array, Array]] = []
        self._rows = 0

    def add(self, residual: Array, whitening: Array, *blocks: tuple[Array, Array]) -> None:
        """Add residuals (k, d), whitened by (k, d, d), with derivatives by blocks of unknowns.

        Args:
            residual: The residuals, (k, d).
            whitening: The inverse roots of their covariances, (k, d, d).
            blocks: The first unknowns (k,) and the derivatives (k, d, w) with respect to w unknowns from there on.
        """
        white = np.einsum("kij,kj->ki", whitening, residual)
        weight = (1.0 + (white**2).sum(axis=1) / _HALF**2) ** -0.5
        k, d = residual.shape
        rows = self._rows + np.arange(k * d).reshape(k, d)
        for first, derivative in blocks:
            values = weight[:, None, None] * (whitening @ derivative)
            columns = np.broadcast_to((first[:, None] + np.arange(derivative.shape[2]))[:, None], values.shape)
            self._parts.append((values.ravel(), np.repeat(rows.ravel(), derivative.shape[2]), columns.ravel()))
        self.residuals.append((weight[:, None] * white).ravel())
        self._rows += k * d

    def step(self, unknowns: int, wanted_from: int) -> tuple[Array, Array]:
        """Return the step of Gauss and Newton (N,), and the covariance of the unknowns from an index on."""
        values, rows, columns = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        J = coo_matrix((values, (rows, columns)), shape=(self._rows, unknowns)).tocsc()
        information = (J.T @ J + 1e-9 * sparse_eye(unknowns, format="csc")).tocsc()
        factor = splu(information, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        step = -factor.solve(J.T @ np.concatenate(self.residuals))
        last = np.zeros((unknowns, unknowns - wanted_from))
        last[np.arange(wanted_from, unknowns), np.arange(unknowns - wanted_from)] = 1.0
        return step, factor.solve(last)[wanted_from:] if wanted_from < unknowns else np.zeros((0, 0))


def survey(
    times: Array,
    reckoned: Array,
    scans: Sequence[Landmarks],
    positions: Array,
    *,
    drift: DriftModel,
    config: SurveyConfig,
) -> Survey:
    """Return the trees and the poses of a drive.

    Args:
        times: The times of the scans in s, (n,).
        reckoned: The poses X_OH by dead reckoning, (n, 3).
        scans: The detections of each scan, in H.
        positions: Rows of [time (s), x (m), y (m)] by satellites, in W, (m, 3).
        drift: The drift of the dead reckoning.
        config: The settings.

    Raises:
        ValueError: Fewer than two positions lie within the drive.
    """
    scans = [scan.select(np.hypot(*scan.positions.T) < config.largest_range) for scan in scans]
    inside = positions[(positions[:, 0] >= times[0]) & (positions[:, 0] < times[-1])]
    fixes = inside[np.unique(inside[:, 0] // config.memory, return_index=True)[1]]
    if len(fixes) < 2:
        raise ValueError(f"a survey needs at least 2 positions within the drive, not {len(fixes)}")
    motions = np.array([compose(inverse(a), b) for a, b in pairwise(reckoned)])
    noise = np.array([drift.covariance(m, t) for m, t in zip(motions, np.diff(times), strict=True)])
    motion_whitening = np.linalg.inv(np.linalg.cholesky(noise + np.diag(_LEAST_MOTION**2)))
    poses = _laid_onto(times, reckoned, fixes)
    n, marks, pairs = len(times), np.zeros((0, 2)), np.zeros((0, 3), dtype=np.intp)
    detections = np.concatenate([scan.positions for scan in scans])
    first = np.cumsum([0, *(len(scan) for scan in scans)])
    spread = np.concatenate([scan.covariances for scan in scans]) + _AXIS**2 * np.eye(2)
    whitening = np.linalg.inv(np.linalg.cholesky(spread))
    covariance = np.zeros((0, 0))
    # With several threads, sparse matrices take longer.
    with threadpool_limits(1):
        for number, gate in enumerate((None, None, *_GATES)):
            if gate is not None:
                marks, pairs = _associated(poses, scans, gate, config.fewest)
            for step in range(_STEPS):
                squares = _Squares()
                _add_motions(squares, poses, motions, motion_whitening)
                _add_fixes(squares, poses, times, fixes, config)
                if len(pairs):
                    rows = first[pairs[:, 0]] + pairs[:, 1]
                    _add_detections(squares, poses, marks, pairs, detections[rows], whitening[rows])
                unknowns = 3 * n + 2 * len(marks)
                is_last = number == len(_GATES) + 1 and step == _STEPS - 1
                change, covariance = squares.step(unknowns, 3 * n if is_last else unknowns)
                poses = poses + change[: 3 * n].reshape(-1, 3)
                marks = marks + change[3 * n :].reshape(-1, 2)
    diameters = np.concatenate([scan.diameters for scan in scans])[first[pairs[:, 0]] + pairs[:, 1]]
    trees = _trees(marks, covariance, [diameters[pairs[:, 2] == k] for k in range(len(marks))])
    return Survey(times, poses, trees, _correlation_length(marks, covariance))


def _laid_onto(times: Array, reckoned: Array, fixes: Array) -> Array:
    """Return the poses by dead reckoning in W, such that they begin near the positions by satellites."""
    early = fixes[fixes[:, 0] < times[0] + _ALIGNED]
    at = np.column_stack([np.interp(early[:, 0], times, reckoned[:, k]) for k in range(2)])
    a, b = at - at.mean(axis=0), early[:, 1:] - early[:, 1:].mean(axis=0)
    turn = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()))
    p_WoOo_W = early[:, 1:].mean(axis=0) - rotation(turn) @ at.mean(axis=0)
    return np.column_stack([transform([*p_WoOo_W, turn], reckoned[:, :2]), reckoned[:, 2] + turn])


def _associated(poses: Array, scans: Sequence[Landmarks], gate: float, fewest: int) -> tuple[Array, Indices]:
    """Return the trees (m, 2), and the scan, the detection and the tree of each pair, (k, 3)."""
    places, counts = np.zeros((10_000, 2)), np.zeros(10_000, dtype=np.int64)
    size, pairs = 0, []
    for i, (pose, scan) in enumerate(zip(poses, scans, strict=True)):
        points = transform(pose, scan.positions)
        gaps = np.linalg.norm(points[:, None] - places[:size], axis=2)
        matched: set[int] = set()
        for j in np.argsort(gaps.min(axis=1)) if size else range(len(points)):
            nearest = int(np.argmin(gaps[j])) if gaps.shape[1] else -1
            if nearest >= 0 and gaps[j, nearest] < gate:
                if nearest in matched:
                    continue
                places[nearest] += (points[j] - places[nearest]) / min(counts[nearest] + 1, 20)
            elif size < len(places):
                nearest, size = size, size + 1
                places[nearest] = points[j]
            else:
                continue
            matched.add(nearest)
            counts[nearest] += 1
            pairs.append((i, int(j), nearest))
    is_tree = counts[:size] >= fewest
    number = np.cumsum(is_tree) - 1
    rows = np.array([(i, j, number[k]) for i, j, k in pairs if is_tree[k]], dtype=np.intp).reshape(-1, 3)
    return places[:size][is_tree], rows


def _add_motions(squares: _Squares, poses: Array, motions: Array, whitening: Array) -> None:
    R_HW = rotations(-poses[:-1, 2])
    way = np.einsum("kij,kj->ki", R_HW, np.diff(poses[:, :2], axis=0))
    turn = wrap(np.diff(poses[:, 2]) - motions[:, 2])
    before, after = np.zeros((2, len(motions), 3, 3))
    before[:, :2, :2], before[:, 2, 2] = -R_HW, -1.0
    before[:, 0, 2], before[:, 1, 2] = way[:, 1], -way[:, 0]
    after[:, :2, :2], after[:, 2, 2] = R_HW, 1.0
    first = 3 * np.arange(len(motions))
    squares.add(np.column_stack([way - motions[:, :2], turn]), whitening, (first, before), (first + 3, after))


def _add_fixes(squares: _Squares, poses: Array, times: Array, fixes: Array, config: SurveyConfig) -> None:
    last = np.clip(np.searchsorted(times, fixes[:, 0]), 1, len(times) - 1)
    share = ((fixes[:, 0] - times[last - 1]) / (times[last] - times[last - 1]))[:, None]
    arm = rotations(poses[last, 2]) @ np.array([config.antenna_x, config.antenna_y])
    place = (1.0 - share) * poses[last - 1, :2] + share * poses[last, :2] + arm
    before = (1.0 - share)[:, :, None] * np.eye(2)
    after = np.concatenate([share[:, :, None] * np.eye(2), (arm[:, ::-1] * [-1.0, 1.0])[:, :, None]], axis=2)
    whitening = np.tile(np.eye(2) / config.deviation, (len(fixes), 1, 1))
    squares.add(place - fixes[:, 1:], whitening, (3 * (last - 1), before), (3 * last, after))


def _add_detections(
    squares: _Squares, poses: Array, marks: Array, pairs: Indices, detected: Array, whitening: Array
) -> None:
    pose, mark = pairs[:, 0], pairs[:, 2]
    R_HW = rotations(-poses[pose, 2])
    expected = np.einsum("kij,kj->ki", R_HW, marks[mark] - poses[pose, :2])
    by_pose = np.concatenate([-R_HW, (expected[:, ::-1] * [1.0, -1.0])[:, :, None]], axis=2)
    squares.add(expected - detected, whitening, (3 * pose, by_pose), (3 * len(poses) + 2 * mark, R_HW))


def _trees(marks: Array, covariance: Array, diameters: Sequence[Array]) -> Landmarks:
    n = len(marks)
    blocks = covariance.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)]
    medians = np.array([np.median(values) for values in diameters])
    spread = [1.48 * np.median(abs(values - median)) for values, median in zip(diameters, medians, strict=True)]
    blocks = 0.5 * (blocks + blocks.transpose(0, 2, 1)) + _FLOOR**2 * np.eye(2)
    return Landmarks(marks, blocks, medians, np.hypot(np.array(spread), _FLOOR))


def _correlation_length(marks: Array, covariance: Array) -> float:
    """Return the length L (m) for which exp(-r² / (2 L²)) fits the correlations of the trees best."""
    gaps = np.linalg.norm(marks[:, None] - marks, axis=2)
    deviations = np.sqrt(np.diagonal(covariance))
    correlations = covariance / np.outer(deviations, deviations)
    mean = 0.5 * (correlations[::2, ::2] + correlations[1::2, 1::2])
    near = mean[(gaps > 0.0) & (gaps < 20.0)].mean()
    lengths = np.geomspace(10.0, 1000.0, 60)
    errors = [((mean - near * np.exp(-0.5 * (gaps / L) ** 2))[gaps > 0.0] ** 2).sum() for L in lengths]
    return float(lengths[int(np.argmin(errors))]) if near > 0.2 else 0.0
