"""Association of the detections of a scan with the landmarks of a map, around a pose that is known roughly.

Pairs of detection and landmark within a gate on the Mahalanobis distance, d² = νᵀ S⁻¹ ν with the innovation ν and its
covariance S, are hypotheses. The anchor is the one that agrees with most others, after the state has been conditioned
on it, or, if it is alone, best with the state. It decides which pairs are possible; the best one-to-one assignment
among them is taken. Diameters count in the assignment.

A match may be wrong: its probability p is its density, divided by the sum of the densities of this pair, of all pairs
that exclude it, and of what the map does not show. The first match of a landmark, which is not in the state yet, needs
at least 0.8, and d² within a narrower gate, because another landmark may be near on the map. What the map does not show
lies anywhere, or, with ``stray_density``, beside a landmark: branches, lower parts of a trunk, a second tree. Then the
anchor may be wrong, too: it and the pairs that exclude it have their densities given the pair that agrees best with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vtbdrake.common.arrays import Array, Indices
from vtbdrake.components.estimation import chi_square_quantile, one_to_one, squared_distances
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import transform

# Hypotheses that are tried in the association of a scan.
_HYPOTHESES = 40

# The weight of the d² of a hypothesis itself, beside the d² of each pair that agrees with it.
_DECIDES = 1e-6

# The density that competes with a first match is the density of all detections times these odds that a detection shows
# something that is not on the map: assumed, on the safe side for a map that lacks a third of the trees.
_UNMAPPED_ODDS = 2.0
# Least probability of a first match.
_LEAST_PROBABILITY = 0.8

# The upper limit of -2 times the log-likelihood ratio of a diameter, as for three deviations: trunks are not cylinders.
_DIAMETER_CAP = 9.0

# Larger standard deviations of a diameter, in m, are cut to this one: the diameter is unknown.
_NO_DIAMETER = 10.0


class MatchedPairs(NamedTuple):
    """Matches of detections with landmarks.

    Attributes:
        pairs: Indices of the detection and of the landmark on the map, (k, 2).
        squares: Their d², (k,).
        probability: The probabilities that they are right, (k,).
        rivals: The densities of what else the detections may show, other landmarks or something beside them, over the
            likelihood ratios of their diameters, in 1/m², (k,).
    """

    pairs: Indices
    squares: Array
    probability: Array
    rivals: Array

    @classmethod
    def none(cls) -> MatchedPairs:
        """Return no matches."""
        return cls(np.zeros((0, 2), dtype=np.intp), np.zeros(0), np.zeros(0), np.zeros(0))

    def select(self, mask: NDArray[np.bool_] | Indices) -> MatchedPairs:
        """Return the matches for which a mask (k,) is true, or those with these indices, in their order."""
        return MatchedPairs(self.pairs[mask], self.squares[mask], self.probability[mask], self.rivals[mask])

    def first(self, count: int) -> MatchedPairs:
        """Return the first ``count`` matches."""
        return self.select(np.arange(len(self.pairs)) < count)


@dataclass(frozen=True, eq=False)
class ExpectedDetections:
    """The detections that are expected of m landmarks of a map.

    Attributes:
        indices: The indices of the landmarks on the map, (m,).
        is_first: Whether each of them would be matched for the first time, (m,).
        positions: The expected detections in the level frame H in m, (m, 2).
        covariance: The covariances of all of them with each other in m², (m, m, 2, 2), without the noise of detections.
    """

    indices: Indices
    is_first: NDArray[np.bool_]
    positions: Array
    covariance: Array

    @property
    def covariances(self) -> Array:
        """The covariance of each expected detection in m², (m, 2, 2)."""
        m = np.arange(len(self.indices))
        return self.covariance[m, m]


@dataclass(frozen=True, eq=False)
class Association:
    """The association described in the module, for one map.

    Attributes:
        landmarks: The map, in W.
        usable: Indices of the landmarks that may be matched, (n,).
        variances: Variances of the expected detections of these in m², (n,), without the pose's variance.
        gate: The share of right pairs that the gate lets pass.
        first_gate: The same of first matches.
        stray_density: The density of detections of something else around a landmark of the map, in 1/m².
    """

    landmarks: Landmarks
    usable: Indices
    variances: Array
    gate: float
    first_gate: float
    stray_density: float = 0.0
    _tree: cKDTree = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", cKDTree(self.landmarks.positions[self.usable]))

    def nearby(self, X_WH: Array, covariance: Array, detections: Landmarks, *, scatter: float) -> Indices:
        """Return the landmarks of the map that can be within the gate of a detection.

        Args:
            X_WH: The pose of the carrier, (3,).
            covariance: The covariance P of the pose, (3, 3).
            detections: The detections, in H, with their noise.
            scatter: The factor of the variances of the landmarks.
        """
        places = transform(X_WH, detections.positions)
        levers = (detections.positions**2).sum(axis=1)
        noise = np.trace(detections.covariances, axis1=1, axis2=2)
        spread = noise + covariance[0, 0] + covariance[1, 1] + levers * covariance[2, 2]
        gate, variances = chi_square_quantile(self.gate, 2), scatter * self.variances
        around = self._tree.query_ball_point(places, np.sqrt(gate * (spread + variances.max())))
        rows = np.repeat(np.arange(len(places)), [len(neighbours) for neighbours in around])
        near = np.concatenate([*around, []]).astype(np.intp)
        squares = ((self._tree.data[near] - places[rows]) ** 2).sum(axis=1)
        return self.usable[np.unique(near[squares <= gate * (spread[rows] + variances[near])])]

    def within(self, place: Array, radius: float) -> Indices:
        """Return the usable landmarks of the map within a radius of a place, (m,).

        Args:
            place: The place in W in m, (2,).
            radius: The radius in m.
        """
        return self.usable[np.sort(np.asarray(self._tree.query_ball_point(place, radius), dtype=np.intp))]

    def matched(
        self,
        detections: Landmarks,
        expected: ExpectedDetections,
        *,
        field_of_view: float,
        sizes: tuple[Array, Array] | None = None,
    ) -> MatchedPairs:
        """Return the matches of detections, in H with their noise, with those that are expected.

        Args:
            detections: The detections of the scan, in H.
            expected: The detections that are expected of landmarks nearby.
            field_of_view: The horizontal field of view of the sensor in rad, for the density of detections.
            sizes: The diameters of these landmarks and their standard deviations in m, (m,) each; None if all of them
                are on the map.
        """
        if sizes is None:
            mapped = self.landmarks.select(expected.indices)
            sizes = mapped.diameters, mapped.diameter_deviations
        innovations = detections.positions[:, None] - expected.positions
        covariances = expected.covariances + detections.covariances[:, None]
        squares = squared_distances(innovations, covariances)
        threshold = chi_square_quantile(self.gate, 2)
        i, j = np.nonzero(squares < threshold)
        if not len(i):
            return MatchedPairs.none()
        nu, S, doubts = innovations[i, j], covariances[i, j], self.stray_density > 0.0
        compared = _compared(i, j, nu, S, expected.covariance, threshold, doubts=doubts)
        diameter_cost = self._diameter_cost(detections.select(i), sizes[0][j], sizes[1][j])
        cost = compared.squares + np.log(compared.determinants) + diameter_cost
        gain = np.zeros(squares.shape)
        is_possible = (compared.squares < threshold) & ~compared.is_excluded
        gain[i, j] = np.where(is_possible, 1.0 + cost[is_possible].max() - cost, 0.0)
        rows, columns = one_to_one(gain)
        density, diameter_ratio = np.zeros(squares.shape), np.ones(squares.shape)
        density[i, j] = np.exp(-0.5 * cost) / (2.0 * np.pi)
        diameter_ratio[i, j] = np.exp(-0.5 * diameter_cost)
        area = 0.5 * field_of_view * max(1.0, float((detections.positions**2).sum(axis=1).max()))
        unmapped = _UNMAPPED_ODDS * len(detections) / area + self.stray_density
        rivals = density.sum(axis=0) + density.sum(axis=1)[:, None] - 2.0 * density + unmapped
        probability = (density / (density + rivals))[rows, columns]
        pairs = np.column_stack([rows, expected.indices[columns]])
        odds = (rivals / diameter_ratio)[rows, columns]
        matches = MatchedPairs(pairs, squares[rows, columns], probability, odds)
        is_sure = (probability >= _LEAST_PROBABILITY) & (matches.squares < chi_square_quantile(self.first_gate, 2))
        return matches.select(is_sure | ~expected.is_first[columns])

    def _diameter_cost(self, detections: Landmarks, diameters: Array, deviations: Array) -> Array:
        """Return -2 times the log-likelihood ratio of diameters, of a right pair against any landmark of the map.

        Args:
            detections: The detection of each pair, k of them.
            diameters: The diameters of the landmarks of the pairs in m, (k,).
            deviations: The standard deviations of these in m, (k,).
        """
        mapped, measured = self.landmarks.diameters, detections.diameters
        noise = np.minimum(detections.diameter_deviations, _NO_DIAMETER) ** 2
        right = np.minimum(deviations, _NO_DIAMETER) ** 2 + noise
        any_other = mapped.var() + noise
        ratio = (measured - diameters) ** 2 / right + np.log(right / any_other)
        # A diameter that is known no better than all diameters together carries no information.
        cost = np.where(right < any_other, ratio - (measured - mapped.mean()) ** 2 / any_other, 0.0)
        return np.minimum(cost, _DIAMETER_CAP)


class _Comparison(NamedTuple):
    """Pairs within the gate, compared after conditioning on the anchor.

    If the anchor may be wrong, it and the pairs that exclude it are conditioned on the pair that agrees best with it;
    without one, they keep their own d² and covariances. Otherwise the anchor has a d² of 0, and these pairs an infinite
    one.

    Attributes:
        squares: The d² of the pairs, (k,).
        determinants: The determinants of their covariances in m^4, (k,).
        is_excluded: Whether the pair shares its detection or its landmark with the anchor, (k,).
    """

    squares: Array
    determinants: Array
    is_excluded: NDArray[np.bool_]


def _compared(
    i: Indices, j: Indices, nu: Array, S: Array, joint: Array, threshold: float, *, doubts: bool
) -> _Comparison:
    """Return k pairs, compared.

    Args:
        i: The detections of the pairs, (k,).
        j: The landmarks of the pairs, (k,), as rows of ``joint``.
        nu: Their innovations, (k, 2).
        S: The covariances of those, (k, 2, 2).
        joint: The covariances of all expected detections with each other, (m, m, 2, 2).
        threshold: The largest d² of pairs that agree.
        doubts: Whether the anchor may be wrong.
    """
    tried = np.unique(np.linspace(0, len(i) - 1, _HYPOTHESES).astype(int))
    C = joint[j[:, None], j[tried]]
    K = C @ np.linalg.inv(S[tried])
    rest = nu[:, None] - np.einsum("pqij,qj->pqi", K, nu[tried])
    spread = S[:, None] - K @ C.transpose(0, 1, 3, 2)
    is_itself = np.arange(len(i))[:, None] == tried
    excludes = ((i[:, None] == i[tried]) | (j[:, None] == j[tried])) & ~is_itself
    squares = np.where(is_itself, 0.0, np.where(excludes, np.inf, squared_distances(rest, spread)))
    unconditional = squared_distances(nu, S)
    agreement = np.zeros((i.max() + 1, len(tried)))
    np.maximum.at(agreement, i, np.maximum(threshold - squares, 0.0))
    # A detection that is alone has nothing that agrees with it: then what fits the state best is the anchor.
    anchor = np.argmax(agreement.sum(axis=0) - _DECIDES * unconditional[tried])
    is_excluded = excludes[:, anchor]
    is_apart = is_itself[:, anchor] | is_excluded
    conditional, covariances = squares[:, anchor].copy(), spread[:, anchor].copy()
    if not doubts:
        covariances[is_apart] = S[is_apart]
        return _Comparison(conditional, np.maximum(np.linalg.det(covariances), 1e-12), is_excluded)
    agreeing = np.where(is_apart, np.inf, conditional)[tried]
    partner = np.argmin(agreeing)
    has_partner = agreeing[partner] < threshold
    conditional[is_apart] = squares[is_apart, partner] if has_partner else unconditional[is_apart]
    covariances[is_apart] = spread[is_apart, partner] if has_partner else S[is_apart]
    return _Comparison(conditional, np.maximum(np.linalg.det(covariances), 1e-12), is_excluded)
