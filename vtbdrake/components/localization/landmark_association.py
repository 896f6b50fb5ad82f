"""Association of the detections of a scan with the landmarks of a map, around a pose that is known roughly.

Pairs of detection and landmark within a gate on the Mahalanobis distance, d² = νᵀ S⁻¹ ν with the innovation ν and its
covariance S, are candidates. The anchor is the one that agrees with most others, after the state has been conditioned
on it, or, if it is alone, best with the state. It decides which pairs are possible; the best one-to-one assignment
among them is taken. Diameters count in the assignment.

A match may be wrong: its probability p is its density, divided by the sum of the densities of this pair, of all pairs
that exclude it, and of what the map does not show, which lies anywhere. The first match of a landmark, which is not in
the state yet, needs at least 0.8, and d² within a narrower gate, because another landmark may be near on the map.

With ``stray_density``, what the map does not show also lies beside a landmark: branches, lower parts of a trunk, a
second tree. Then the pair that agrees with most others may be wrong, and others with it. So there is no anchor, and all
joint associations are weighed. Each takes a detection for one of the landmarks in whose gates it lies, no landmark
twice, or for something else. With the innovations ν_A of its pairs, their joint covariance S_A, the likelihood ratios
q of their diameters and the density c of what the map does not show, the association A has the weight

    w_A = N(ν_A; 0, S_A) Π q c^s,    s detections show something else.

The probability p of a pair is the sum of the weights of all that contain it, over the sum of all (Fortmann, Bar-Shalom
and Scheffe, "Sonar tracking of multiple targets using joint probabilistic data association", IEEE Journal of Oceanic
Engineering 8, 1983). So pairs that share neither detection nor landmark, but contradict each other, lower the
probability of each other, too. The assignment with the largest sum of probabilities is taken.
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

# The largest number of joint associations that are weighed.
_JOINT = 100
# Those with less than this share of the largest weight, by the detections so far, are left out.
_NEGLIGIBLE = 1e-6

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
        is_right: Which of them are right by each of h hypotheses, (h, k).
        weights: The probabilities of these hypotheses, (h,).
    """

    pairs: Indices
    squares: Array
    probability: Array
    is_right: NDArray[np.bool_]
    weights: Array

    @classmethod
    def none(cls) -> MatchedPairs:
        """Return no matches."""
        return cls.all_right(np.zeros((0, 2), dtype=np.intp), np.zeros(0), np.zeros(0))

    @classmethod
    def all_right(cls, pairs: Indices, squares: Array, probability: Array) -> MatchedPairs:
        """Return matches with a single hypothesis, by which all of them are right.

        Args:
            pairs: Indices of the detection and of the landmark on the map, (k, 2).
            squares: Their d², (k,).
            probability: The probabilities that they are right, (k,).
        """
        return cls(pairs, squares, probability, np.ones((1, len(pairs)), dtype=bool), np.ones(1))

    def select(self, mask: NDArray[np.bool_] | Indices) -> MatchedPairs:
        """Return the matches for which a mask (k,) is true, or those with these indices, in their order."""
        pairs, squares, probability = self.pairs[mask], self.squares[mask], self.probability[mask]
        return MatchedPairs(pairs, squares, probability, self.is_right[:, mask], self.weights)

    def first(self, count: int) -> MatchedPairs:
        """Return the first ``count`` matches."""
        return self.select(np.arange(len(self.pairs)) < count)


@dataclass(frozen=True, eq=False)
class ExpectedDetections:
    """The detections that are expected of m landmarks of a map.

    Attributes:
        indices: The indices of the landmarks on the map, (m,).
        is_first: Whether each of them would be matched for the first time, or counts so, as in doubt, (m,).
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
        diameter_cost = self._diameter_cost(detections.select(i), sizes[0][j], sizes[1][j])
        near = _Candidates(i, j, innovations[i, j], covariances[i, j], squares[i, j], diameter_cost)
        area = 0.5 * field_of_view * max(1.0, float((detections.positions**2).sum(axis=1).max()))
        unmapped = _UNMAPPED_ODDS * len(detections) / area + self.stray_density
        if self.stray_density > 0.0:
            matches = _weighed(near, expected.covariance, unmapped)
        else:
            matches = _anchored(near, expected.covariance, unmapped, threshold)
        is_sure = matches.probability >= _LEAST_PROBABILITY
        is_sure &= matches.squares < chi_square_quantile(self.first_gate, 2)
        rows, columns = matches.pairs.T
        named = matches._replace(pairs=np.column_stack([rows, expected.indices[columns]]))
        return named.select(is_sure | ~expected.is_first[columns])

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


class _Candidates(NamedTuple):
    """Pairs within the gate.

    Attributes:
        detections: Their detections, (k,).
        landmarks: Their landmarks, as places among those that are expected, (k,).
        nu: Their innovations in m, (k, 2).
        S: The covariances of those in m², (k, 2, 2).
        squares: Their d², (k,).
        diameter_cost: -2 times the log-likelihood ratios of their diameters, (k,).
    """

    detections: Indices
    landmarks: Indices
    nu: Array
    S: Array
    squares: Array
    diameter_cost: Array


def _anchored(near: _Candidates, joint: Array, unmapped: float, threshold: float) -> MatchedPairs:
    """Return the best assignment of candidates that agree with the anchor; its pairs name landmarks as they do.

    Args:
        near: The candidates.
        joint: The covariances of all expected detections with each other in m², (m, m, 2, 2).
        unmapped: The density of what the map does not show in 1/m².
        threshold: The largest d² of pairs that agree.
    """
    i, j = near.detections, near.landmarks
    agreeing, determinants = _agreeing(near, joint, threshold)
    cost = agreeing + np.log(determinants) + near.diameter_cost
    shape = int(i.max()) + 1, len(joint)
    squares, gain, density = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    squares[i, j] = near.squares
    is_possible = agreeing < threshold
    gain[i, j] = np.where(is_possible, 1.0 + cost[is_possible].max() - cost, 0.0)
    rows, columns = one_to_one(gain)
    density[i, j] = np.exp(-0.5 * cost) / (2.0 * np.pi)
    rivals = density.sum(axis=0) + density.sum(axis=1)[:, None] - 2.0 * density + unmapped
    probability = (density / (density + rivals))[rows, columns]
    return MatchedPairs.all_right(np.column_stack([rows, columns]), squares[rows, columns], probability)


def _agreeing(near: _Candidates, joint: Array, threshold: float) -> tuple[Array, Array]:
    """Return the d² of k candidates after conditioning on the anchor, (k,), 0 of itself, infinite where it excludes.

    Also returned are the determinants, (k,) in m^4, of the conditional covariances; what it excludes, and itself, keep
    their own.

    Args:
        near: The candidates.
        joint: The covariances of all expected detections with each other in m², (m, m, 2, 2).
        threshold: The largest d² of pairs that agree.
    """
    i, j, nu, S = near.detections, near.landmarks, near.nu, near.S
    tried = np.unique(np.linspace(0, len(i) - 1, _HYPOTHESES).astype(int))
    C = joint[j[:, None], j[tried]]
    K = C @ np.linalg.inv(S[tried])
    rest = nu[:, None] - np.einsum("pqij,qj->pqi", K, nu[tried])
    spread = S[:, None] - K @ C.transpose(0, 1, 3, 2)
    is_itself = np.arange(len(i))[:, None] == tried
    excludes = ((i[:, None] == i[tried]) | (j[:, None] == j[tried])) & ~is_itself
    squares = np.where(is_itself, 0.0, np.where(excludes, np.inf, squared_distances(rest, spread)))
    agreement = np.zeros((i.max() + 1, len(tried)))
    np.maximum.at(agreement, i, np.maximum(threshold - squares, 0.0))
    # A detection that is alone has nothing that agrees with it: then what fits the state best is the anchor.
    anchor = np.argmax(agreement.sum(axis=0) - _DECIDES * near.squares[tried])
    is_apart = (is_itself | excludes)[:, anchor]
    covariances = np.where(is_apart[:, None, None], S, spread[:, anchor])
    return squares[:, anchor], np.maximum(np.linalg.det(covariances), 1e-12)


class _JointAssociations(NamedTuple):
    """Joint associations of the first detections of a scan, h of them, and what they leave to the others.

    Attributes:
        is_right: Which of k candidates they contain, (h, k).
        log_weights: The logarithms of their weights, (h,).
        nu: The innovations of the candidates in m, conditioned on the pairs of each association, (h, k, 2).
        S: The covariances of those with each other in m², (h, k, k, 2, 2).
    """

    is_right: NDArray[np.bool_]
    log_weights: Array
    nu: Array
    S: Array

    def select(self, rows: Indices) -> _JointAssociations:
        """Return the associations with these indices, in their order."""
        return _JointAssociations(self.is_right[rows], self.log_weights[rows], self.nu[rows], self.S[rows])

    def with_pair(self, p: int, diameter_cost: float) -> _JointAssociations:
        """Return the associations with one more pair.

        Args:
            p: The place of the pair among the candidates.
            diameter_cost: -2 times the log-likelihood ratio of its diameters.
        """
        nu, S = self.nu[:, p], self.S[:, p, p]
        cost = squared_distances(nu, S) + np.log(np.maximum(np.linalg.det(S), 1e-12)) + diameter_cost
        C = self.S[:, :, p]
        K = C @ np.linalg.inv(S)[:, None]
        is_right = self.is_right.copy()
        is_right[:, p] = True
        return _JointAssociations(
            is_right,
            self.log_weights - 0.5 * cost - np.log(2.0 * np.pi),
            self.nu - np.einsum("hkij,hj->hki", K, nu),
            self.S - np.einsum("hkij,hqlj->hkqil", K, C),
        )


def _weighed(near: _Candidates, joint: Array, unmapped: float) -> MatchedPairs:
    """Return the most probable assignment, with all joint associations; its pairs name landmarks as candidates do.

    Args:
        near: The candidates.
        joint: The covariances of all expected detections with each other in m², (m, m, 2, 2).
        unmapped: The density of what the map does not show in 1/m².
    """
    k, j = np.arange(len(near.landmarks)), near.landmarks
    S = joint[j[:, None], j]
    S[k, k] = near.S
    hypotheses = _JointAssociations(np.zeros((1, len(k)), dtype=bool), np.zeros(1), near.nu[None], S[None])
    for detection in np.unique(near.detections):
        choices = [hypotheses._replace(log_weights=hypotheses.log_weights + np.log(unmapped))]
        for p in np.flatnonzero(near.detections == detection).tolist():
            is_free = np.flatnonzero(~hypotheses.is_right[:, j == j[p]].any(axis=1))
            choices.append(hypotheses.select(is_free).with_pair(p, near.diameter_cost[p]))
        hypotheses = _JointAssociations(*(np.concatenate(values) for values in zip(*choices, strict=True)))
        hypotheses = hypotheses.select(np.argsort(-hypotheses.log_weights, kind="stable")[:_JOINT])
        least = hypotheses.log_weights[0] + np.log(_NEGLIGIBLE)
        hypotheses = hypotheses.select(np.flatnonzero(hypotheses.log_weights > least))
    weights = np.exp(hypotheses.log_weights - hypotheses.log_weights[0])
    weights /= weights.sum()
    pairs, probability = np.column_stack([near.detections, j]), weights @ hypotheses.is_right
    gain, place = np.zeros((2, int(near.detections.max()) + 1, len(joint)))
    gain[tuple(pairs.T)], place[tuple(pairs.T)] = probability, k
    assigned = place[one_to_one(gain)].astype(np.intp)
    return MatchedPairs(pairs, near.squares, probability, hypotheses.is_right, weights).select(assigned)
