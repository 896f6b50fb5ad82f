"""Global localization without an initial guess, by the constellation of the landmarks around the carrier on a map.

Pairs of landmarks vote for poses (`pair_votes`). Those with most votes are fitted to the nearest landmarks of the map
(least squares with weights that fall with the distance), and the best of them are compared by their likelihood.

**Likelihood.** Of the n local landmarks, the share w is on the map; the rest is not: false trunks, and trees that the
map lacks. Let λ_k be the density of the map's landmarks in 1/m² around its landmark k (within 8 m, at least the mean of
the map), N_ik the normal density of the difference of the local landmark i from it, and D_ik the density of the local
diameter, if both are the same, divided by its density among all diameters of the map. The logarithm of the likelihood
ratio of a pose, against the hypothesis that the map does not show the place, is

    Λ = Σ_i ln(1 - w + w Σ_k N_ik ((1 - ε) D_ik + ε) / λ_k),

where ε is the share of diameters that are measured badly. The pose is found by expectation maximization, its covariance
is the inverse of the observed information: matches that are in doubt count less (Louis, J. R. Stat. Soc. B 44, 1982).

**Test of uniqueness.** A pose is sure if all of these conditions hold, where s² is the variance per axis of the
difference between the local position of a landmark and that on the map:

* There are at least `fewest` local landmarks.
* Λ > ln(A / (2π s²) · 2π · 10 m / s) + ln 10⁶. The first logarithm counts the distinguishable poses on a
  map of area A, at least 1 ha: a small map asks for no less. At a place that the map does not show, an attempt exceeds
  the bound with a probability of at most 10⁻⁶ if the trees stand at random, because the expectation of exp Λ is then 1
  for each pose; real stands are not quite random.
* Every other pose has at most Λ - 5 and at most Λ / 2. Poses are different if they have less than half of their matches
  in common. (In the rows of a plantation many poses nearly match; the best of them may lead by more than 5 by chance.)
* Λ is at least 0.6 of its expectation for the right pose with these landmarks.

**Errors of the map that neighbours share.** With a correlation length L, the errors of a map at a distance r have the
correlation exp(-r² / (2 L²)). The field of errors is a sum of smooth functions with random factors that are estimated
together with the pose (`_shared_functions`); the rest of the variance is independent. So neighbours may be displaced
together, but not apart, and the covariance of the pose contains the displacement that cannot be observed. If the errors
of a map do not follow this model, the displacement is estimated less accurately than assumed: the covariance is too
small.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, log, pi

import numpy as np
from scipy.spatial import cKDTree

from vtbdrake.common.arrays import Array, Indices, immutable
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.pair_votes import LocalPairs, PairTable
from vtbdrake.components.localization.planar import compose, rotation, rotations, transform, wrap

# Standard deviation in m that is added to the diameters' deviations: assumed, for bark.
_DIAMETER_FLOOR = 0.01

# The share of diameters that are measured badly, ε: assumed.
_BAD_DIAMETERS = 0.1

# Landmarks are counted within this radius, in m, for the density around each.
_SURROUNDINGS = 8.0

# Number of poses with the most votes that are looked at.
_VOTED = 300
# Number of poses that are fitted.
_FITTED = 60
# Number of poses that are judged.
_JUDGED = 10

# The number of steps of expectation maximization.
_STEPS = 8

# The number of landmarks of the map, the nearest ones, that may match a local one.
_NEIGHBOURS = 3

# The number of samples from which the likelihood of a right pose is computed.
_SAMPLES = 300

# The test of uniqueness, see the module.
# Number of attempts off the map, among random trees, for one that is wrongly sure; a carrier tries every 2 m.
_FACTOR = 1e6
# A map of a smaller area asks for as much evidence as one of this area, in m².
_LEAST_AREA = 1e4
# Least difference of Λ to the best other pose.
_LEAST_MARGIN = 5.0
# Largest Λ of another pose, as a share of the Λ of the best one.
_LARGEST_SHARE = 0.5
# Least fit, relative to the expected one.
_LEAST_FIT = 0.6


@immutable
class Fix:
    """The result of matching local landmarks with a map: a pose of the carrier on it. Immutable.

    Attributes:
        pose: The most likely pose X_WH, [x, y, heading] in m and rad, shape (3,).
        covariance: The covariance of the pose, if it is the right one, shape (3, 3).
        is_sure: Whether the pose passes the test of uniqueness. If not, pose and covariance must not be used.
        log_likelihood: Logarithm Λ of the likelihood ratio against a place that the map does not show.
        margin: Difference between Λ and the Λ of the best other pose, or of a place off the map (0) if that is larger.
        fit: Ratio of Λ to its expectation for the right pose.
        pairs: Matches: indices of the local landmark and of the one on the map, shape (m, 2).
    """

    pose: Array
    covariance: Array
    is_sure: bool
    log_likelihood: float
    margin: float
    fit: float
    pairs: Indices


@dataclass(frozen=True, eq=False)
class _Local:
    """Local landmarks, prepared for the comparison with a map, in a frame C that has its origin among them.

    Attributes:
        places: Positions in C in m, (n, 2).
        covariances: Covariances of the positions in m², (n, 2, 2).
        diameters: Diameters in m, (n,).
        diameter_variances: Variances of the diameters in m², (n,).
        common: Densities of these diameters among the map's diameters in 1/m, (n,).
        shared: The functions that make up the displacement of the map at the landmarks, (n, f).
        independent: The share of the map's variance that these functions do not contain, (n,).
    """

    places: Array
    covariances: Array
    diameters: Array
    diameter_variances: Array
    common: Array
    shared: Array
    independent: Array

    @property
    def variances(self) -> Array:
        """Variances of the positions per axis in m², (n,)."""
        return 0.5 * np.trace(self.covariances, axis1=1, axis2=2)


@dataclass(frozen=True, eq=False)
class _Matches:
    """The possible matches of each local landmark at one pose: the k nearest landmarks of the map.

    Attributes:
        near: Indices on the map, (n, k).
        deltas: Their positions less the local landmark's position in m, (n, k, 2).
        weights: Inverse covariances of these, (n, k, 2, 2).
        ratios: Logarithms of w N D / λ, (n, k).
    """

    near: Indices
    deltas: Array
    weights: Array
    ratios: Array

    def likelihoods(self, share: float) -> Array:
        """Return the terms of Λ, (n,), if the share w is on the map."""
        terms: Array = np.logaddexp(log(1.0 - share), np.logaddexp.reduce(self.ratios, axis=1))
        return terms

    def probabilities(self, share: float) -> Array:
        """Return the probabilities of the matches, (n, k)."""
        return np.exp(self.ratios - self.likelihoods(share)[:, np.newaxis])


@dataclass(frozen=True, eq=False)
class _Judged:
    """A pose X_MC with its covariance, its likelihood and its matches (m, 2)."""

    pose: Array
    covariance: Array
    log_likelihood: float
    pairs: Indices


class ConstellationMap:
    """A map of landmarks, prepared for the search for a constellation. Immutable.

    Attributes:
        landmarks: The map, in W.
        correlation: Length L in m over which errors of the map are shared by neighbours; 0 if they are independent.
        share: The share w of the local landmarks that are on the map, assumed.
        fewest: The least number of local landmarks with which a pose can be sure.
        least_deviation: Standard deviation in m that is added to the local landmarks' deviations, per axis: assumed,
            for bark, lean and roots. It also keeps the likelihoods of exact landmarks finite.

    Raises:
        ValueError: The map has fewer than 3 landmarks, or a parameter is outside of its range.
    """

    def __init__(
        self,
        landmarks: Landmarks,
        *,
        correlation: float = 0.0,
        share: float = 0.4,
        fewest: int = 16,
        least_deviation: float = 0.02,
    ) -> None:
        if len(landmarks) < 3:
            raise ValueError(f"a constellation needs a map of at least 3 landmarks, not {len(landmarks)}")
        if not (0.0 < share < 1.0 and 0.0 <= correlation < inf and fewest >= 2 and 0.0 < least_deviation < inf):
            raise ValueError(
                "share lies between 0 and 1, correlation is finite and at least 0, fewest at least 2, and "
                f"least_deviation positive and finite, not {share}, {correlation}, {fewest} and {least_deviation}"
            )
        self.landmarks = landmarks
        self.correlation = correlation
        self.share = share
        self.fewest = fewest
        self.least_deviation = least_deviation
        # The frame M of the map: W with its origin among the landmarks, so that large coordinates cost no digits.
        self._p_WoMo_W = landmarks.positions.mean(axis=0)
        self._places = landmarks.positions - self._p_WoMo_W
        self._tree = cKDTree(self._places)
        self._low, self._high = self._places.min(axis=0), self._places.max(axis=0)
        self._area = float(np.prod(np.maximum(self._high - self._low, 1.0)))
        counts = self._tree.query_ball_point(self._places, _SURROUNDINGS, return_length=True)
        # Near the edge of the map, part of the disc is empty: the mean density is the lower limit.
        self._densities = np.maximum(counts / (pi * _SURROUNDINGS**2), len(landmarks) / self._area)
        self._roots = np.linalg.cholesky(landmarks.covariances + 1e-12 * np.eye(2))
        self._variance = 0.5 * float(np.median(np.trace(landmarks.covariances, axis1=1, axis2=2)))
        self._diameter_variances = landmarks.diameter_deviations**2 + _DIAMETER_FLOOR**2
        # A sample of landmarks that represents the distribution of the diameters.
        self._typical = np.argsort(landmarks.diameters)[np.linspace(0, len(landmarks) - 1, 200).astype(int)]
        self._pairs = PairTable.of(
            self._places, self._tree, diameters=landmarks.diameters, diameter_variances=self._diameter_variances
        )

    def locate(self, local: Landmarks) -> Fix:
        """Return the pose of a carrier that detects these landmarks, which are given in its level frame H.

        The errors of the local landmarks are assumed to be independent.
        """
        if len(local) < 2:
            return self._unknown()
        p_HoCo_H = local.positions.mean(axis=0)
        here = self._described(local, local.positions - p_HoCo_H)
        relative = self._relative(here.places)
        variance = relative + float(np.mean(here.variances)) + self.least_deviation**2
        judged = [self._judged(here, pose) for pose in self._candidates(here, variance**0.5)]
        ranking = sorted(
            (candidate for candidate in judged if candidate is not None),
            key=lambda candidate: -candidate.log_likelihood,
        )
        if not ranking:
            return self._unknown()
        best = ranking[0]
        rivals = [candidate.log_likelihood for candidate in ranking[1:] if _is_other(candidate.pairs, best.pairs)]
        margin = best.log_likelihood - max([0.0, *rivals])
        fit = best.log_likelihood / max(1.0, self._expected(here, relative / max(self._variance, 1e-12)))
        is_sure = (
            len(local) >= self.fewest
            and best.log_likelihood > self._required(variance)
            and margin >= max(_LEAST_MARGIN, (1.0 - _LARGEST_SHARE) * best.log_likelihood)
            and fit >= _LEAST_FIT
        )
        p_CoHo_M = rotation(best.pose[2]) @ -p_HoCo_H
        pose = compose([*(best.pose[:2] + self._p_WoMo_W), best.pose[2]], [*-p_HoCo_H, 0.0])
        carried = np.array([[1.0, 0.0, -p_CoHo_M[1]], [0.0, 1.0, p_CoHo_M[0]], [0.0, 0.0, 1.0]])
        covariance = carried @ best.covariance @ carried.T
        return Fix(pose, covariance, is_sure, best.log_likelihood, margin, fit, best.pairs)

    def required(self, local: Landmarks) -> float:
        """Return the log-likelihood ratio Λ that a sure pose needs at least with these landmarks."""
        local_variance = 0.5 * float(np.mean(np.trace(local.covariances, axis1=1, axis2=2)))
        return self._required(
            self._relative(local.positions - local.positions.mean(axis=0)) + local_variance + self.least_deviation**2
        )

    def _required(self, variance: float) -> float:
        """Return the least Λ of a sure pose, if local and mapped positions differ by a variance in m² per axis."""
        poses = max(self._area, _LEAST_AREA) / (2.0 * pi * variance) * 2.0 * pi * 10.0 / variance**0.5
        return log(max(poses, 1.0)) + log(_FACTOR)

    def _relative(self, places: Array) -> float:
        """Return the part of the map's variance that displaces landmarks relative to each other, in m².

        It is the variance about their mean.
        """
        return self._variance * (1.0 - float(np.mean(_correlation(places, self.correlation))))

    def _unknown(self) -> Fix:
        """Return the result of a failed search: the carrier may be anywhere on the map."""
        pose = np.array([*(0.5 * (self._low + self._high) + self._p_WoMo_W), 0.0])
        covariance = np.diag([*((self._high - self._low) ** 2 / 12.0 + 1.0), pi**2 / 3.0])
        return Fix(pose, covariance, False, 0.0, 0.0, 0.0, np.zeros((0, 2), dtype=np.intp))

    def _described(self, local: Landmarks, places: Array) -> _Local:
        shared = _shared_functions(places, self.correlation)
        diameter_variances = local.diameter_deviations**2 + _DIAMETER_FLOOR**2
        common = self._common(local.diameters, diameter_variances)
        independent = 1.0 - (shared**2).sum(axis=1)
        return _Local(places, local.covariances, local.diameters, diameter_variances, common, shared, independent)

    def _common(self, diameters: Array, variances: Array) -> Array:
        """Return the density of diameters among the map's, (n,), if they are measured with these variances."""
        delta = diameters[:, np.newaxis] - self.landmarks.diameters[self._typical]
        return _normal(delta, variances[:, np.newaxis] + self._diameter_variances[self._typical]).mean(axis=1)

    def _expected(self, here: _Local, relative: float) -> float:
        """Return the expectation of Λ for the right pose, from random samples of landmarks on the map and off it.

        Args:
            here: The local landmarks.
            relative: The share of the map's variance that displaces landmarks relative to each other.
        """
        rng = np.random.default_rng(0)
        local_rows = rng.integers(len(here.places), size=_SAMPLES)
        landmark_indices = rng.integers(len(self._places), size=_SAMPLES)
        S = (
            relative * self.landmarks.covariances[landmark_indices]
            + here.covariances[local_rows]
            + self.least_deviation**2 * np.eye(2)
        )
        errors = np.einsum("nij,nj->ni", np.linalg.cholesky(S), rng.normal(size=(_SAMPLES, 2)))
        true = self.landmarks.diameters[landmark_indices]
        variances = here.diameter_variances[local_rows]
        diameter_variances = np.where(np.isfinite(variances), variances, 0.0) + np.where(
            np.isfinite(self._diameter_variances[landmark_indices]), self._diameter_variances[landmark_indices], 0.0
        )
        diameters = true + np.sqrt(diameter_variances) * rng.normal(size=_SAMPLES)
        common = self._common(diameters, variances)
        expected = 0.0
        for share, places in (
            (self.share, self._places[landmark_indices] + errors),
            (1.0 - self.share, rng.uniform(self._low, self._high, (_SAMPLES, 2))),
        ):
            nothing = np.zeros((_SAMPLES, 0))
            sampled = _Local(
                places, here.covariances[local_rows], diameters, variances, common, nothing, np.full(_SAMPLES, relative)
            )
            matches = self._matches(sampled, np.zeros(3), np.zeros((_SAMPLES, 2)), np.zeros((_SAMPLES, 2, 2)))
            expected += share * float(matches.likelihoods(self.share).mean())
        return len(here.places) * expected

    def _candidates(self, here: _Local, deviation: float) -> Array:
        """Return the poses X_MC to be judged, (k, 3); ``deviation`` (m) is local from mapped positions' deviation."""
        local = LocalPairs.of(
            here.places,
            here.variances + self.least_deviation**2,
            diameters=here.diameters,
            diameter_variances=here.diameter_variances,
            map_variance=self._variance,
            correlation=self.correlation,
        )
        poses = self._pairs.favourites(local, count=_VOTED)
        weights = 1.0 / (deviation**2 + here.variances)
        weights /= weights.mean()
        wide = max(2.0 * deviation, 0.4)
        poses, support = self._approach(here.places, weights, poses, wide)
        poses = poses[np.argsort(-support)[:_FITTED]]
        for width in (0.8 * wide, 0.6 * wide, 0.6 * wide):
            poses, support = self._approach(here.places, weights, poses, width)
        distinct: list[Array] = []
        for row in np.argsort(-support):
            if support[row] > 0.0 and not any(_is_near(poses[row], other) for other in distinct):
                distinct.append(poses[row])
            if len(distinct) == _JUDGED:
                break
        return np.array(distinct).reshape(-1, 3)

    def _approach(self, places: Array, weights: Array, poses: Array, width: float) -> tuple[Array, Array]:
        """Fit poses to the landmarks of the map nearest to each local one, in one step of least squares.

        Args:
            places: The local landmarks in C, (n, 2).
            weights: Their weights, (n,).
            poses: Poses X_MC, (k, 3).
            width: The distance in m at which the weights have fallen to exp(-1/2).

        Returns:
            The improved poses (k, 3), and their sums of weights (k,).
        """
        places_M = places @ rotations(poses[:, 2]).swapaxes(1, 2) + poses[:, np.newaxis, :2]
        distances, nearest = self._tree.query(places_M, distance_upper_bound=2.5 * width)
        is_near = nearest < len(self._places)
        weight = weights * np.where(is_near, np.exp(-0.5 * np.minimum(distances / width, 9.0) ** 2), 0.0)
        target = self._places[np.where(is_near, nearest, 0)]
        total = weight.sum(axis=1)
        weight /= np.maximum(total, 1e-9)[:, np.newaxis]
        mean_C, mean_M = weight @ places, np.einsum("kn,kni->ki", weight, target)
        u, v = places - mean_C[:, np.newaxis], target - mean_M[:, np.newaxis]
        along = np.einsum("kn,kni,kni->k", weight, u, v)
        across = np.einsum("kn,kn->k", weight, u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])
        heading = np.arctan2(across, along)
        turned = np.einsum("kij,kj->ki", rotations(heading), mean_C)
        return np.column_stack([mean_M - turned, heading]), total

    def _matches(self, here: _Local, pose: Array, mean: Array, spread: Array) -> _Matches:
        """Compare local landmarks at a pose X_MC with the nearest ones of the map.

        Args:
            here: The local landmarks.
            pose: The pose, (3,).
            mean: The expected displacement of the map at them, in units of the root of its covariance, (n, 2).
            spread: The covariance of this displacement, in the same units, (n, 2, 2).
        """
        R_MC = rotation(pose[2])
        places_M = transform(pose, here.places)
        C = R_MC @ here.covariances @ R_MC.T + self.least_deviation**2 * np.eye(2)
        _, near = self._tree.query(places_M + self._variance**0.5 * mean, k=min(_NEIGHBOURS, len(self._places)))
        L = self._roots[near]
        S = L @ (spread + here.independent[:, np.newaxis, np.newaxis] * np.eye(2))[:, np.newaxis] @ L.swapaxes(-1, -2)
        S += C[:, np.newaxis]
        deltas = self._places[near] - places_M[:, np.newaxis] - np.einsum("nkij,nj->nki", L, mean)
        a, b, c = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
        determinant = a * c - b**2
        weights = np.moveaxis(np.array([[c, -b], [-b, a]]) / determinant, (0, 1), (2, 3))
        normal = -0.5 * np.einsum("nki,nkij,nkj->nk", deltas, weights, deltas) - 0.5 * np.log(determinant)
        variances = here.diameter_variances[:, np.newaxis] + self._diameter_variances[near]
        same = _normal(here.diameters[:, np.newaxis] - self.landmarks.diameters[near], variances)
        # An unknown diameter carries no information: both densities are 0, and the factor is 1.
        common = np.broadcast_to(here.common[:, np.newaxis], same.shape)
        factor = np.divide(same, common, out=np.ones_like(same), where=common > 0.0)
        diameter = np.log((1.0 - _BAD_DIAMETERS) * factor + _BAD_DIAMETERS)
        ratios = log(self.share / (2.0 * pi)) - np.log(self._densities[near]) + normal + diameter
        return _Matches(near, deltas, weights, ratios)

    def _judged(self, here: _Local, pose: Array) -> _Judged | None:
        """Find the most likely pose near a pose X_MC, with the displacement of the map around it.

        The displacement at landmark i is L_k Σ_f φ_f(i) β_f, with the root L_k of the map's covariance and normal
        factors β of unit variance; Λ is integrated over them (Laplace's approximation).
        """
        functions = here.shared.shape[1]
        prior = np.diag([0.0] * 3 + [1.0] * (2 * functions))
        mean = np.zeros((len(here.places), 2))
        spread = (here.shared**2).sum(axis=1)[:, np.newaxis, np.newaxis] * np.eye(2)
        for step in range(_STEPS):
            matches = self._matches(here, pose, mean, spread)
            probable = matches.probabilities(self.share)
            i, k = np.nonzero(probable > 1e-3)
            L = self._roots[matches.near[i, k]]
            arm = transform([0.0, 0.0, pose[2]], here.places[i])
            A = np.zeros((len(i), 2, 3 + 2 * functions))
            A[:, 0, 0] = A[:, 1, 1] = 1.0
            A[:, 0, 2], A[:, 1, 2] = -arm[:, 1], arm[:, 0]
            A[:, :, 3:] = np.einsum("mf,mij->mifj", here.shared[i], L).reshape(len(i), 2, 2 * functions)
            weights = matches.weights[i, k] * probable[i, k, np.newaxis, np.newaxis]
            weighted = (weights @ A).reshape(2 * len(i), 3 + 2 * functions)
            information = weighted.T @ A.reshape(weighted.shape) + prior
            if np.linalg.cond(information[:3, :3]) > 1e12:
                return None
            covariance = np.linalg.inv(information)
            # The displacement is estimated anew in each step: the differences are taken without the present one.
            deltas = matches.deltas[i, k] + np.einsum("mij,mj->mi", L, mean[i])
            change = covariance @ (weighted.T @ deltas.ravel())
            pose = pose + change[:3]
            mean = here.shared @ change[3:].reshape(functions, 2)
            if functions and step < 2:
                # In the first steps the displacement is too uncertain to distinguish neighbours: its covariance counts.
                block = covariance[3:, 3:].reshape(functions, 2, functions, 2)
                spread = np.einsum("nf,figj,ng->nij", here.shared, block, here.shared, optimize=True)
                continue
            if not spread.any() and np.abs(change[:3]).max() < 1e-3:
                break
            spread = np.zeros_like(spread)
        matches = self._matches(here, pose, mean, spread)
        evidence = float(matches.likelihoods(self.share).sum() - 0.5 * change[3:] @ change[3:])
        evidence -= 0.5 * float(np.linalg.slogdet(information[3:, 3:])[1])
        # The information that is missing because matches are uncertain: the covariance of the score of each landmark.
        scores = np.einsum("mji,mjl,ml->mi", A, matches.weights[i, k], deltas - A @ change)
        p = probable[i, k, np.newaxis]
        means = np.zeros((len(here.places), A.shape[2]))
        np.add.at(means, i, p * scores)
        missing = scores.T @ (p * scores) - means.T @ means
        covariance = _inverse_of_observed(information, missing)[:3, :3]
        return _Judged(pose, covariance, evidence, _one_to_one(matches.near, probable))


def _inverse_of_observed(complete: Array, missing: Array) -> Array:
    """Return the inverse of the complete information less the missing one, at most nine tenths of it."""
    root = np.linalg.inv(np.linalg.cholesky(complete))
    shares, directions = np.linalg.eigh(root @ missing @ root.T)
    back = directions.T @ root
    covariance: Array = back.T @ (back / (1.0 - np.minimum(shares, 0.9))[:, np.newaxis])
    return covariance


def _one_to_one(near: Indices, probable: Array) -> Indices:
    """Return the one-to-one matches (m, 2) whose probabilities (n, k) are above one half."""
    best = probable.argmax(axis=1)
    rows = np.flatnonzero(probable.max(axis=1) > 0.5)
    rows = rows[np.argsort(-probable[rows, best[rows]], kind="stable")]
    landmark_indices, first = np.unique(near[rows, best[rows]], return_index=True)
    pairs = np.column_stack([rows[first], landmark_indices])
    return pairs[np.argsort(pairs[:, 0])]


def _is_other(pairs: Indices, best: Indices) -> bool:
    """Return whether two poses with these matches, (m, 2) and (l, 2), have less than half of them in common."""
    common = len({*map(tuple, pairs.tolist())} & {*map(tuple, best.tolist())})
    return common < 0.5 * min(len(pairs), len(best)) or not len(pairs)


def _is_near(pose: Array, other: Array) -> bool:
    return float(np.hypot(*(pose[:2] - other[:2]))) < 0.3 and abs(wrap(float(pose[2] - other[2]))) < 0.05


def _correlation(places: Array, length: float) -> Array:
    """Return the correlations of the map's errors at all pairs of places, (n, n)."""
    if length == 0.0:
        return np.eye(len(places))
    squares = ((places[:, np.newaxis] - places) ** 2).sum(axis=2)
    return np.exp(-0.5 * squares / length**2)


def _shared_functions(places: Array, length: float) -> Array:
    """Return functions f, (n, f), so that f(x)·f(x') is nearly exp(-|x - x'|² / (2 L²)) near the origin.

    exp(-|x - x'|² / (2 L²)) = exp(-|x|² / (2 L²)) exp(-|x'|² / (2 L²)) Σ_k (x·x' / L²)^k / k!, here up to k = 3.
    """
    if length == 0.0:
        return np.zeros((len(places), 0))
    x, y = (places / length).T
    cut = np.exp(-0.5 * (x**2 + y**2))
    r2, r6 = 2.0**0.5, 6.0**0.5
    second = [x**2 / r2, x * y, y**2 / r2]
    third = [x**3 / r6, x**2 * y / r2, x * y**2 / r2, y**3 / r6]
    return np.column_stack([np.ones_like(x), x, y, *second, *third]) * cut[:, np.newaxis]


def _normal(delta: Array, variances: Array) -> Array:
    """Return densities of the normal distribution; 0 for an infinite variance."""
    density: Array = np.exp(-0.5 * delta**2 / variances) / np.sqrt(2.0 * pi * variances)
    return density
