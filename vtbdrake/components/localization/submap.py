"""The local map of a carrier without a pose: landmarks that are gathered along the odometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.common.arrays import Array, immutable
from vtbdrake.components.estimation import (
    chi_square_quantile,
    kalman_update,
    one_to_one,
    squared_distances,
    weighted_mean,
)
from vtbdrake.components.localization.landmarks import Landmarks, SensorView
from vtbdrake.components.localization.planar import inverse, rotation, transform

# The share of right pairs that the gate of the association lets pass.
_GATE = 0.997

# A place that was in view of at least this number of scans is a landmark only if it was detected at least twice.
_CHANCES = 3

# A place is in view up to this share of the distance of the farthest detection: beyond, detections are unreliable.
_IN_VIEW = 0.7


@immutable
class Submap:
    """Landmarks detected so far, relative to the carrier. Immutable, with read-only arrays.

    The covariances belong to positions relative to the present carrier: they grow with the covariance of each
    motion, including the heading's covariance times the lever arm. Correlations between landmarks are not kept.

    Attributes:
        X_OH: The pose of the carrier in the odometry frame, shape (3,) in m and rad.
        distance: The distance travelled in m.
        positions: Positions in O, shape (n, 2) in m.
        covariances: Covariances of the positions in the axes of O, shape (n, 2, 2) in m^2.
        diameters: Diameters, shape (n,) in m.
        diameter_deviations: Standard deviations of the diameters, shape (n,) in m.
        seen: The number of scans in which each landmark was detected, shape (n,).
        chances: The number of scans that had each landmark in view, shape (n,).
        last: The distance travelled at the last detection of each landmark, shape (n,) in m.
    """

    X_OH: Array
    distance: float
    positions: Array
    covariances: Array
    diameters: Array
    diameter_deviations: Array
    seen: Array
    chances: Array
    last: Array

    @classmethod
    def empty(cls, X_OH: ArrayLike = (0.0, 0.0, 0.0)) -> Submap:
        """Return a map without landmarks that begins at a pose (3,)."""
        none = np.zeros(0)
        return cls(np.asarray(X_OH), 0.0, np.zeros((0, 2)), np.zeros((0, 2, 2)), none, none, none, none, none)

    def __len__(self) -> int:
        return len(self.diameters)

    def moved(self, X_OH: ArrayLike, covariance: ArrayLike, *, length: float = 40.0) -> Submap:
        """Return the map after a motion.

        Args:
            X_OH: The pose after the motion, shape (3,).
            covariance: The covariance of the motion, in the axes of H before it, shape (3, 3).
            length: The distance travelled since its last detection, in m, after which a landmark is dropped.
        """
        pose = np.asarray(X_OH, dtype=float)
        C_O = np.array(covariance, dtype=float)
        R_OH = rotation(self.X_OH[2])
        C_O[:2] = R_OH @ C_O[:2]
        C_O[:, :2] = C_O[:, :2] @ R_OH.T
        J = np.zeros((len(self), 2, 3))
        J[:, :, :2] = np.eye(2)
        J[:, :, 2] = (self.positions - pose[:2])[:, ::-1] * [-1.0, 1.0]
        distance = self.distance + float(np.hypot(*(pose[:2] - self.X_OH[:2])))
        grown = self.covariances + J @ C_O @ J.transpose(0, 2, 1)
        return replace(self, X_OH=pose, distance=distance, covariances=grown)._select(distance - self.last <= length)

    def with_scan(self, landmarks: Landmarks | SensorView, *, least_deviation: float) -> Submap:
        """Return the map after a scan at its pose: detections are merged with landmarks that it has, or added.

        Args:
            landmarks: The detections, in H.
            least_deviation: Standard deviation in m that is added to the deviations of positions, see
                `ConstellationMap`.
        """
        view = SensorView.of(landmarks)
        landmarks = view.landmarks
        if not len(landmarks):
            return self
        scan = landmarks.seen_from(self.X_OH)
        R = scan.covariances + least_deviation**2 * np.eye(2)
        nu = scan.positions - self.positions[:, None]
        squares = squared_distances(nu, self.covariances[:, None] + R)
        old, new = one_to_one(chi_square_quantile(_GATE, 2) - squares)
        update = kalman_update(self.covariances[old], nu[old, new], H=np.eye(2), R=R[new])
        positions, covariances = self.positions.copy(), self.covariances.copy()
        positions[old] += update.step
        covariances[old] = update.P
        diameters, deviations = self.diameters.copy(), self.diameter_deviations.copy()
        diameters[old], deviations[old] = _mean(
            diameters[old], deviations[old], scan.diameters[new], scan.diameter_deviations[new]
        )
        hits, last = self.seen.copy(), self.last.copy()
        hits[old] += 1.0
        last[old] = self.distance
        in_view = view.is_in_view(transform(inverse(self.X_OH), positions), share=_IN_VIEW)
        in_view[old] = True
        rest = np.setdiff1d(np.arange(len(landmarks)), new)
        once = np.ones(len(rest))
        return Submap(
            self.X_OH,
            self.distance,
            np.concatenate([positions, scan.positions[rest]]),
            np.concatenate([covariances, R[rest]]),
            np.concatenate([diameters, scan.diameters[rest]]),
            np.concatenate([deviations, scan.diameter_deviations[rest]]),
            np.concatenate([hits, once]),
            np.concatenate([self.chances + in_view, once]),
            np.concatenate([last, self.distance * once]),
        )

    def landmarks(self) -> Landmarks:
        """Return the landmarks in the present H; what was in view several times, but seen once only, is left out."""
        reliable = self._select((self.seen >= 2.0) | (self.chances < _CHANCES))
        return Landmarks(
            reliable.positions, reliable.covariances, reliable.diameters, reliable.diameter_deviations
        ).seen_from(inverse(self.X_OH))

    def _select(self, mask: NDArray[np.bool_]) -> Submap:
        names = ("positions", "covariances", "diameters", "diameter_deviations", "seen", "chances", "last")
        return replace(self, **{name: getattr(self, name)[mask] for name in names})


def _mean(x: Array, deviation_x: Array, y: Array, deviation_y: Array) -> tuple[Array, Array]:
    """Return the weighted means of two measurements and their deviations; an infinite deviation counts as 1,000 m."""
    mean, deviation = weighted_mean(x, np.clip(deviation_x, 1e-4, 1e3), y, np.clip(deviation_y, 1e-4, 1e3))
    return mean, np.where(np.isfinite(deviation_x) | np.isfinite(deviation_y), deviation, np.inf)
