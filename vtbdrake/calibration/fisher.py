"""What recordings can tell about parameters, from the Fisher information, before anything is fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf

import numpy as np
from numpy.typing import NDArray

from vtbdrake.calibration.inverse_dynamics import directions_of
from vtbdrake.common.arrays import Array

# A parameter changes nothing if its whole range changes all innovations together by less than this.
_NOTHING = 1e-4
# A parameter is not told if what the undetermined directions leave of it, when they are known to be within the range
# (evenly), exceeds this share of its deviation.
_UNTOLD_SHARE = 0.5
# It is told in any case if they leave less than this share of the range.
_LEAST_UNTOLD = 1e-6
# Largest number of parameters that the text of a direction names.
_TERMS = 6
# The text of a direction names parameters with at least this entry in the unit vector.
_LEAST_TERM = 0.2


@dataclass(frozen=True, eq=False)
class Information:
    """The Fisher information of recordings about parameters: the inverse bounds the covariance of any estimate.

    Attributes:
        names: The parameters.
        scales: How far each is from being known before: half of its range.
        H: The information about the scaled parameters, (nz, nz): J' J of the whitened innovations.
    """

    names: tuple[str, ...]
    scales: Array
    H: Array

    @cached_property
    def _directions(self) -> tuple[Array, Array, NDArray[np.bool]]:
        return directions_of(self.H)

    @property
    def nothing(self) -> tuple[str, ...]:
        """Return the parameters that change nothing in these recordings."""
        return tuple(name for name, h in zip(self.names, np.diag(self.H), strict=True) if h < _NOTHING**2)

    @property
    def alone(self) -> Array:
        """Return the least standard deviation of each parameter if all others were known, (nz,)."""
        h = np.diag(self.H)
        return np.where(h > 0.0, self.scales / np.sqrt(np.maximum(h, 1e-300)), inf)

    @property
    def deviations(self) -> Array:
        """Return the least standard deviations of the scaled parameters in determined directions, (nz,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def together(self) -> Array:
        """Return the least standard deviation of each parameter beside the others, (nz,); infinite if not told."""
        return np.where(self.is_told(np.eye(len(self.names)), self.deviations), self.deviations * self.scales, inf)

    def is_told(self, gradients: Array, deviations: Array) -> NDArray[np.bool]:
        """Return whether functions of the parameters are told, as the undetermined directions leave them alone, (n,).

        Args:
            gradients: Gradients of the functions by the scaled parameters, (n, nz).
            deviations: Deviations of the functions in the directions that are determined, (n,).
        """
        _, directions, determined = self._directions
        left = np.linalg.norm(gradients @ directions[:, ~determined], axis=1) / np.sqrt(3.0)
        size = np.linalg.norm(gradients, axis=1)
        return np.asarray(left <= np.maximum(_UNTOLD_SHARE * deviations, _LEAST_UNTOLD * size))

    @property
    def covariance(self) -> Array:
        """Return the least covariance of the scaled parameters, (nz, nz), in the directions that are determined."""
        values, directions, determined = self._directions
        return np.asarray(directions[:, determined] / values[determined] @ directions[:, determined].T)

    @property
    def combinations(self) -> tuple[str, ...]:
        """Return the combinations of parameters that are not determined, as sentences."""
        values, directions, determined = self._directions
        return tuple(self._combination(directions[:, k], values[k]) for k in np.flatnonzero(~determined))

    def _combination(self, direction: Array, value: float) -> str:
        order = np.argsort(-abs(direction))
        terms = [f"{direction[k]:+.2f} {self.names[k]}" for k in order if abs(direction[k]) > _LEAST_TERM][:_TERMS]
        left = inf if value <= 0.0 else 1.0 / np.sqrt(value)
        return f"not determined: {' '.join(terms)} (in scaled parameters; deviation {left:.2g} of the range)"

    @property
    def identifiable(self) -> tuple[str, ...]:
        """Return the parameters that the recordings tell apart from all others."""
        return tuple(name for name, deviation in zip(self.names, self.together, strict=True) if deviation < inf)

    def __str__(self) -> str:
        width = max(len(name) for name in self.names)
        lines = [f"{'':{width}}  half of range     if alone      together"]
        for row in zip(self.names, self.scales, self.alone, self.together, strict=True):
            lines.append(f"{row[0]:{width}}{row[1]:15.3g}{row[2]:13.3g}{row[3]:14.3g}")
        nothing = [f"changes nothing: {name}" for name in self.nothing]
        return "\n".join([*lines, *nothing, *self.combinations])


def information_of(slopes: Array, names: Sequence[str], scales: Array) -> Information:
    """Return the information in innovations with these derivatives by the parameters, (n, nz).

    Args:
        slopes: Derivatives of the whitened innovations by the parameters, (n, nz).
        names: Names of the parameters, in the order of the columns.
        scales: The size of each parameter, (nz,), by which its column is multiplied: half of its range, or 1 for a
            number of an inertia.
    """
    J = slopes * scales
    return Information(tuple(names), scales, J.T @ J)
