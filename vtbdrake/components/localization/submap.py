"""The local map: landmarks gathered along the odometry, as a carrier without a pose sees its surroundings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import inverse, rotation
from vtbdrake.components.world_model.association import chi_square_quantile

Array = NDArray[np.float64]

# The share of right pairs that the gate of the association lets pass.
_GATE = 0.997

# Standard deviation in m that is added to that of each position, per axis: a trunk is no point.
_LEAST_DEVIATION = 0.02

# What was in view so often is a landmark only if it was seen twice at least.
_CHANCES = 3

# Beyond this share of the farthest detection, landmarks come and go.
_IN_VIEW = 0.7


@dataclass(frozen=True, eq=False)
class Submap:
    """Landmarks seen so far, relative to the carrier. Immutable, with read-only arrays.

    The covariances are those of the positions relative to the present carrier: they grow with each motion by its
    covariance, also by the lever arm of the heading. What neighbours have in common of it is not kept.

    Attributes:
        X_OH: The carrier in the frame of the odometry, shape (3,) in m and rad.
        distance: The distance travelled in m.
        positions: In O, shape (n, 2) in m.
        covariances: In the axes of O, shape (n, 2, 2) in m^2.
        diameters: Shape (n,) in m.
        diameter_deviations: Shape (n,) in m.
        seen: How often each was seen, shape (n,).
        chances: How many scans had it in view, shape (n,).
        last: The distance travelled when it was seen last, shape (n,) in m.
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

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                array = np.array(value, dtype=float)
                array.flags.writeable = False
                object.__setattr__(self, name, array)

    @classmethod
    def empty(cls, X_OH: ArrayLike = (0.0, 0.0, 0.0)) -> Submap:
        """Return a map without landmarks that begins at a pose (3,)."""
        none = np.zeros(0)
        return cls(np.asarray(X_OH), 0.0, np.zeros((0, 2)), np.zeros((0, 2, 2)), none, none, none, none, none)

    def __deepcopy__(self, memo: object) -> Submap:
        return self

    def __len__(self) -> int:
        return len(self.diameters)

    def moved(self, X_OH: ArrayLike, covariance: ArrayLike, *, length: float = 40.0) -> Submap:
        """Return the map after a motion.

        Args:
            X_OH: The pose afterwards, shape (3,).
            covariance: Of the motion, in the axes of H before, shape (3, 3).
            length: Landmarks that were last seen longer ago than this distance travelled, in m, are dropped.
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

    def with_scan(self, landmarks: Landmarks) -> Submap:
        """Return the map with what is detected at its pose, in H: merged with what is known, or new."""
        if not len(landmarks):
            return self
        scan = landmarks.seen_from(self.X_OH)
        noise = scan.covariances + _LEAST_DEVIATION**2 * np.eye(2)
        S = self.covariances[:, None] + noise
        nu = scan.positions - self.positions[:, None]
        squares = np.einsum("nmi,nmij,nmj->nm", nu, np.linalg.inv(S), nu)
        value = np.maximum(chi_square_quantile(_GATE, 2) - squares, 0.0)
        old, new = linear_sum_assignment(value, maximize=True)
        paired = value[old, new] > 0.0
        old, new = old[paired], new[paired]
        gain = self.covariances[old] @ np.linalg.inv(S[old, new])
        positions, covariances = self.positions.copy(), self.covariances.copy()
        positions[old] += np.einsum("nij,nj->ni", gain, nu[old, new])
        covariances[old] -= gain @ self.covariances[old]
        diameters, deviations = self.diameters.copy(), self.diameter_deviations.copy()
        diameters[old], deviations[old] = _mean(
            diameters[old], deviations[old], scan.diameters[new], scan.diameter_deviations[new]
        )
        seen, last = self.seen.copy(), self.last.copy()
        seen[old] += 1.0
        last[old] = self.distance
        in_view = np.hypot(*(positions - self.X_OH[:2]).T) < _IN_VIEW * np.hypot(*landmarks.positions.T).max()
        in_view[old] = True
        rest = np.setdiff1d(np.arange(len(landmarks)), new)
        once = np.ones(len(rest))
        return Submap(
            self.X_OH,
            self.distance,
            np.concatenate([positions, scan.positions[rest]]),
            np.concatenate([covariances, noise[rest]]),
            np.concatenate([diameters, scan.diameters[rest]]),
            np.concatenate([deviations, scan.diameter_deviations[rest]]),
            np.concatenate([seen, once]),
            np.concatenate([self.chances + in_view, once]),
            np.concatenate([last, self.distance * once]),
        )

    def landmarks(self) -> Landmarks:
        """Return the landmarks in the present H; what was in view several times, but seen once only, is left out."""
        kept = self._select((self.seen >= 2.0) | (self.chances < _CHANCES))
        return Landmarks(kept.positions, kept.covariances, kept.diameters, kept.diameter_deviations).seen_from(
            inverse(self.X_OH)
        )

    def _select(self, mask: NDArray[np.bool_]) -> Submap:
        names = ("positions", "covariances", "diameters", "diameter_deviations", "seen", "chances", "last")
        return replace(self, **{name: getattr(self, name)[mask] for name in names})


def _mean(one: Array, one_deviation: Array, two: Array, two_deviation: Array) -> tuple[Array, Array]:
    """Return the mean of two measurements, weighted by their variances, and its deviation.

    Infinite deviations count as a thousand metres.
    """
    first, second = (1.0 / np.clip(deviation, 1e-4, 1e3) ** 2 for deviation in (one_deviation, two_deviation))
    known = np.isfinite(one_deviation) | np.isfinite(two_deviation)
    return (first * one + second * two) / (first + second), np.where(known, (first + second) ** -0.5, np.inf)
