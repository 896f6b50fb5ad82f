"""Equations that filters share: gates of innovations, the assignment of measurements, and the update of an estimate.

An innovation ν is a measurement less its expectation, and S its covariance. If the measurement is what it is taken for,
d² = νᵀ S⁻¹ ν (the squared Mahalanobis distance) is chi-square distributed with the dimension of ν as degrees of
freedom.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
import scipy

from vtbdrake.common.arrays import Array, Indices

Numbers = TypeVar("Numbers", float, Array)


def chi_square_quantile(probability: float, degrees: int) -> float:
    """Return the value below which a chi-square variable of ``degrees`` of freedom lies with ``probability``.

    Args:
        probability: The probability, in [0, 1].
        degrees: The number of degrees of freedom, at least 1.
    """
    return 2.0 * float(scipy.special.gammaincinv(0.5 * degrees, probability))


def squared_distances(nu: Array, S: Array) -> Array:
    """Return d² = νᵀ S⁻¹ ν, (...), of innovations (..., n) with covariances (..., n, n).

    Args:
        nu: The innovations ν.
        S: Their covariances, in the squared unit of ν; the leading axes are broadcast.
    """
    if nu.shape[-1] != 2:
        weighted = np.linalg.solve(S, nu[..., np.newaxis])[..., 0]
        return np.asarray((nu * weighted).sum(axis=-1))
    # In the plane, all detections of a scan are compared with all landmarks around: written out, it is much faster.
    x, y = nu[..., 0], nu[..., 1]
    determinant = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]
    squares: Array = S[..., 1, 1] * x**2 - (S[..., 0, 1] + S[..., 1, 0]) * x * y + S[..., 0, 0] * y**2
    return squares / np.maximum(determinant, 1e-12)


def one_to_one(gain: Array) -> tuple[Indices, Indices]:
    """Return the rows and the columns, (k,) each, of the one-to-one assignment with the largest sum of gains.

    Args:
        gain: What each pair of row and column gains, (n, m); pairs that gain nothing are not assigned. With the gate
            less d² as the gain, this is the assignment of the global nearest neighbours.
    """
    rows, columns = scipy.optimize.linear_sum_assignment(np.maximum(gain, 0.0), maximize=True)
    is_pair = gain[rows, columns] > 0.0
    return rows[is_pair], columns[is_pair]


class KalmanUpdate(NamedTuple):
    """The update of an estimate by a measurement.

    Attributes:
        step: The correction of the estimate, K ν, (..., n).
        P: The covariance after it, (..., n, n).
        squares: d² of the innovation, (...).
    """

    step: Array
    P: Array
    squares: Array


def kalman_update(P: Array, nu: Array, *, H: Array, R: Array) -> KalmanUpdate:
    """Return the update of an estimate of n numbers by a measurement of m.

        S = H P Hᵀ + R,    K = P Hᵀ S⁻¹,    P ← (I - K H) P (I - K H)ᵀ + K R Kᵀ.

    In this form, Joseph's, the covariance stays symmetric and positive semidefinite.

    Args:
        P: The covariance before, (..., n, n).
        nu: The innovation, (..., m).
        H: The derivatives of the measurement with respect to the estimate, (m, n).
        R: The covariance of the measurement's noise, (..., m, m).
    """
    PHt = P @ H.T
    S = H @ PHt + R
    K = np.linalg.solve(S, PHt.swapaxes(-1, -2)).swapaxes(-1, -2)
    step = (K @ nu[..., np.newaxis])[..., 0]
    left = np.eye(P.shape[-1]) - K @ H
    P = left @ P @ left.swapaxes(-1, -2) + K @ R @ K.swapaxes(-1, -2)
    return KalmanUpdate(step, 0.5 * (P + P.swapaxes(-1, -2)), squared_distances(nu, S))


def weighted_mean(x: Numbers, deviation_x: Numbers, y: Numbers, deviation_y: Numbers) -> tuple[Numbers, Numbers]:
    """Return the mean of two measurements of a number by their inverse variances, and its deviation; also of arrays.

    Args:
        x: The first measurement.
        deviation_x: Its standard deviation, in the same unit.
        y: The second measurement, in the same unit.
        deviation_y: Its standard deviation; at most one of the two is 0.
    """
    K = deviation_x**2 / (deviation_x**2 + deviation_y**2)
    return x + K * (y - x), K**0.5 * deviation_y
