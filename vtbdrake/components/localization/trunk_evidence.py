"""The probability that a cylinder, fitted to points of a scan, is a trunk, from measures of how much it looks like one.

Trunks differ from walls, hedges, bushes and cars, but in no single measure: street trees lean, bark is rough, and
branches are in the way. So no measure decides alone; a logistic regression weighs them, p = 1 / (1 + exp(-(b + w·x))).
Its weights are fitted by `vtbdrake_diagrams.forest.studies.trunk_probabilities`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array

# Mean squares of weighted errors below this one, in units of their variance, say no more for a trunk.
_LEAST_MISFIT = 0.02
# Objects beside a cylinder with more than this density of points, over its own, say no more against a trunk.
_MOST_CLUTTER = 1.5
# The limits of what the roundness counts for.
_ROUND = (-1.0, 2.0)
# The least standard deviation of a position that counts, in m.
_LEAST_SPREAD = 1e-4

# The constant b, then the weights of `TrunkEvidence.terms` [calibrated].
_WEIGHTS = np.array([-10.24, 6.11, 3.10, -0.90, -2.08, 1.02, -1.43, -0.97])


@dataclass(frozen=True, eq=False)
class TrunkEvidence:
    """The measures of k cylinders, each (k,).

    Attributes:
        opacity: The share of the rays towards the cylinder that end on it, from 0 to 1: foliage lets some pass.
        uprightness: The share of the layers of the slice, among layers that rays pass there, in which it is hit.
        misfit: The mean square of the weighted errors of its ranges, in units of their variance.
        clutter: The density of points beside the cylinder, at its distance, over the density of points on it: about
            1 on a wall, 0 for a trunk that stands alone.
        roundness: The logarithm of the mean square error of a flat face over the cylinder's.
        is_hidden: Whether something nearer hides an edge: 1 or 0.
        spread: The standard deviation of the position that follows from the fit, in m.
    """

    opacity: Array
    uprightness: Array
    misfit: Array
    clutter: Array
    roundness: Array
    is_hidden: Array
    spread: Array

    def terms(self) -> Array:
        """Return the terms x of the regression and a leading 1, (k, 8)."""
        return np.column_stack(
            [
                np.ones_like(self.opacity),
                self.opacity,
                np.minimum(self.uprightness, 1.0),
                np.log(np.maximum(self.misfit, _LEAST_MISFIT)),
                np.sqrt(np.minimum(self.clutter, _MOST_CLUTTER)),
                np.clip(self.roundness, *_ROUND),
                self.is_hidden,
                np.log(np.maximum(self.spread, _LEAST_SPREAD)),
            ]
        )

    def probabilities(self) -> Array:
        """Return the probability of each cylinder to be a trunk, (k,)."""
        odds: Array = self.terms() @ _WEIGHTS
        return 1.0 / (1.0 + np.exp(-odds))

    def select(self, rows: NDArray[np.bool_]) -> TrunkEvidence:
        """Return the measures of the cylinders for which a mask (k,) is true."""
        return TrunkEvidence(*(getattr(self, field.name)[rows] for field in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[TrunkEvidence]) -> TrunkEvidence:
        """Return the measures of all parts, one after the other."""
        empty = [np.zeros(0)]
        return cls(*(np.concatenate(empty + [getattr(part, field.name) for part in parts]) for field in fields(cls)))
