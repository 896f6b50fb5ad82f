"""The errors of a map that the landmarks of a track show: whether it is distorted, or worse than it says.

They show it by their corrections c, the estimates less the positions on the map, per axis in units in which the
covariance M of the map's errors is 1. Let S be the covariance with which the landmarks entered the state, and P the one
that they have now. The detections determine the share K = (S - P) S⁻¹ of the errors e of the map: c = K (e + v), with
the errors v of the detections.

*Distortion.* A map that is bent, sheared or scaled fits everywhere nearly, and leads astray all the same. On a right
map c has the covariance 1, less what is not known yet; on a distorted one c changes with the position. With the
functions B = [1, x, y], the statistic T = Σ |(Bᵀ B)^(-1/2) Bᵀ c|² over both axes is at most chi-square distributed with
6 degrees of freedom on a right map.

*Scatter.* The variances of the map may be s² times as large as it says. With the errors of detections as the filter
takes them, c then has the covariance s² K Kᵀ + K S (1 - K)ᵀ. So, with the projection Π to what B leaves, the mean of
|Π c|² - tr(Π K S (1 - K)ᵀ) is s² k, where k = |Π K|² is the number of degrees of freedom that the detections determine.
Together with what is known before, s₀², which counts as much as a = 12 of them,

    s² = (a s₀² + |Π c|² - tr(Π K S (1 - K)ᵀ)) / (a + k),    at least 1.

s₀² comes in the same way from the landmarks that have left the state, and is 1 before. A landmark that came with too
small a variance is held near its place on the map, so that c is small; but so is k.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular

from vtbdrake.common.arrays import Array, immutable

# Degrees of freedom for which what is known before counts in the estimate of the scatter.
_AS_TOLD = 12.0


@immutable
class ShownErrors:
    """The errors of a map that its landmarks show.

    Attributes:
        distortion: The statistic T.
        excess: |Π c|² - tr(Π K S (1 - K)ᵀ), which is s² k in the mean.
        freedom: The degrees of freedom k.
    """

    distortion: float = 0.0
    excess: float = 0.0
    freedom: float = 0.0


def shown_errors(places: Array, corrections: Array, M: Array, P: Array, factors: Array) -> ShownErrors:
    """Return the errors of the map that corrections of its landmarks show.

    Args:
        places: The positions of landmarks on the map in m, (n, 2).
        corrections: Their estimates less these positions in m, (n, 2).
        M: The covariance of the map's errors per axis in m², (n, n), or its diagonal (n,) if they are independent.
        P: The covariance of the estimates in m², (2 n, 2 n).
        factors: The variance of each landmark when it entered the state, in units of the map's, (n,).
    """
    around = places - places.mean(axis=0)
    root = np.sqrt(M) if M.ndim == 1 else np.linalg.cholesky(M).astype(float)
    B = _whitened(root, np.column_stack([np.ones(len(places)), around / max(1.0, float(np.abs(around).max()))]))
    c = _whitened(root, corrections)
    Q, R = np.linalg.qr(B)
    # Landmarks on one line, or fewer than three, show fewer distortions.
    Q = Q[:, np.abs(np.diagonal(R)) > 1e-6 * np.abs(R).max()]
    distortion = _product(Q.T @ c, Q.T @ c)
    excess, freedom = _product(c, c) - distortion, 0.0
    S, deviations = np.diag(factors), np.sqrt(factors)
    if M.ndim == 2:
        S = _both_sides(root, deviations[:, None] * M * deviations)
    for axis in range(2):
        left = _both_sides(root, P[axis::2, axis::2])
        # What the detections leave unknown, 1 - K = P S⁻¹.
        unknown = left / factors if M.ndim == 1 else np.linalg.solve(S, left).T.astype(float)
        K = np.eye(len(places)) - unknown
        KS = S - left
        freedom += _product(K, K) - _product(Q.T @ K, Q.T @ K)
        excess -= _product(KS, unknown) - _product(Q.T @ KS, Q.T @ unknown)
    return ShownErrors(distortion, excess, freedom)


def scatter(shown: ShownErrors, before: float = 1.0) -> float:
    """Return the factor s² by which the variance of the map seems larger than it says, at least 1.

    Args:
        shown: What landmarks show.
        before: What the factor seemed without them, at least 1.
    """
    return max(1.0, (_AS_TOLD * before + shown.excess) / (_AS_TOLD + shown.freedom))


def _product(X: Array, Y: Array) -> float:
    """Return tr(X Yᵀ)."""
    return float((X * Y).sum())


def _whitened(root: Array, columns: Array) -> Array:
    """Return columns (n, k) in units in which M is 1: over its deviations (n,), or its Cholesky factor (n, n)."""
    if root.ndim == 1:
        return columns / root[:, None]
    whitened: Array = solve_triangular(root, columns, lower=True)
    return whitened


def _both_sides(root: Array, C: Array) -> Array:
    """Return a covariance (n, n) in these units."""
    return _whitened(root, _whitened(root, C).T)
