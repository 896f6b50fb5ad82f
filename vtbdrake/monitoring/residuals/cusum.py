"""The cumulative sum test: finds a small shift that stays, in noise."""

from __future__ import annotations

from math import expm1

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Siegmund's correction for the excess over the threshold, of normal steps.
_EXCESS = 1.166


def run_length(threshold: float, allowance: float) -> float:
    """Mean number of independent N(0, 1) values until `Cusum` exceeds its threshold, on either side.

    Of one side, (exp(2 k b) - 2 k b - 1) / (2 k^2) with b = h + 1.166 (Siegmund, "Sequential Analysis", 1985, eq.
    2.57); two sides alarm twice as often.
    """
    exponent = 2.0 * allowance * (threshold + _EXCESS)
    return (expm1(exponent) - exponent) / (2.0 * allowance**2) / 2.0


def threshold_for(length: float, allowance: float) -> float:
    """The threshold with which `run_length` is ``length``; 0 if it is longer anyway."""
    if run_length(0.0, allowance) >= length:
        return 0.0
    # Forty megabytes, which who only runs the DPS does without.
    from scipy.optimize import brentq

    largest = 300.0 / allowance  # where run_length is beyond any length
    return float(brentq(lambda h: np.log(run_length(h, allowance) / length), 0.0, largest))


class Cusum:
    r"""Page's test, two-sided, for many values at a time ("Continuous Inspection Schemes", 1954).

    With z the normalized residuals of a window, of N(0, 1) while all is well,

        S+ <- max(0, S+ + z - k),   S- <- max(0, S- - z - k).

    A shift of z by d > k is found, that is S > h, after about h / (d - k) windows. The sums go no further than 2 h, so
    that they come down again when the shift has gone.

    Attributes:
        threshold: h.
        upper, lower: S+ and S-, one entry per value.
    """

    def __init__(self, size: int, *, threshold: float, allowance: float) -> None:
        self.threshold = threshold
        self.upper = np.zeros(size)
        self.lower = np.zeros(size)
        self._allowance = allowance

    def take(self, z: Array) -> Array:
        """The larger of both sums, after further values; where one is NaN, nothing changes."""
        known = np.where(np.isnan(z), 0.0, z)
        k = np.where(np.isnan(z), 0.0, self._allowance)
        self.upper = np.clip(self.upper + known - k, 0.0, 2.0 * self.threshold)
        self.lower = np.clip(self.lower - known - k, 0.0, 2.0 * self.threshold)
        return np.maximum(self.upper, self.lower)
