"""Equations that filters share: the gate of an innovation, and the assignment of measurements.

An innovation ν is a measurement less its expectation, and S its covariance. If the measurement is what it is taken for,
d² = νᵀ S⁻¹ ν (the squared Mahalanobis distance) is chi-square distributed with the dimension of ν as degrees of
freedom.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.special import gammaincinv

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


def chi_square_quantile(probability: float, degrees: int) -> float:
    """Return the value below which a chi-square variable of ``degrees`` of freedom lies with ``probability``."""
    return 2.0 * float(gammaincinv(0.5 * degrees, probability))


def squared_distances(nu: Array, S: Array) -> Array:
    """Return d² = νᵀ S⁻¹ ν, (...), of innovations in the plane, (..., 2) in m, with covariances (..., 2, 2)."""
    x, y = nu[..., 0], nu[..., 1]
    determinant = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]
    squares: Array = S[..., 1, 1] * x**2 - (S[..., 0, 1] + S[..., 1, 0]) * x * y + S[..., 0, 0] * y**2
    return squares / np.maximum(determinant, 1e-12)


def one_to_one(gain: Array) -> tuple[Indices, Indices]:
    """Return the rows and the columns, (k,) each, of the one-to-one assignment with the largest sum of gains.

    Args:
        gain: What each pair of row and column gains, (n, m); pairs with a gain of 0 are not assigned. With the gate
            less d² as the gain, the assignment is that of the global nearest neighbours.
    """
    rows, columns = linear_sum_assignment(gain, maximize=True)
    is_pair = gain[rows, columns] > 0.0
    return rows[is_pair], columns[is_pair]
