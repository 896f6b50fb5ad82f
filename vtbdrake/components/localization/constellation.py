"""Global localization without a guess: the constellation of the landmarks around the carrier, found again on a map.

Two local landmarks at a distance ℓ can be any pair of the map with that distance, and with trunks as thick; each such
pair gives a pose. The right pose is among the poses of many pairs, a wrong one of few by chance. So pairs vote for
poses (`PairTable`), the poses with most votes are fitted to the landmarks around them (`_approach`, least squares with
weights that fall with the distance), and the best of them are judged by their likelihood (`_Matching`).

**Likelihood.** Of the n local landmarks, the share w is on the map, the rest is not: false trunks, and trees that the
map lacks. Let λ be the density of the map's landmarks in 1/m², N the normal density of the difference of
a local landmark from the one of the map with which it is matched, and D the density of its diameter, if it is
that one, divided by the density of diameters on the map. Compared with a place that the map does not show, the pose has
the logarithm of the likelihood

    Λ = Σ_matched ln((1 - ε_D) D + ε_D) + ln(w N / λ) + Σ_others ln(1 - w).

**Test of uniqueness.** A pose is sure if all of this holds, with s² = s_map² + s_local² (per axis):

* There are at least `fewest` local landmarks.
* Λ > ln(A / (2π s²) · 2π · 10 m / s) + ln 200: the number of poses that can be told apart on a map of area A, and a
  factor of 200 beside it.
* No other pose has a likelihood above Λ - 5. A pose is another one if it has less than half of its matches in common.
* Λ is at least 0.6 of what is expected of a right pose with these landmarks: rows of a plantation match nearly after a
  step from tree to tree, with matches that are many and poor.

**Errors of the map that neighbours share.** With a correlation length L, the errors of a map at distance r have the
correlation exp(-r² / (2 L²)). The field of errors is written as a sum of smooth functions with random factors, the
terms of the series of exp(x·x'/L²) up to the third order (`_shared_functions`). The factors are estimated together with
the pose; what they leave of the variance is independent. So close landmarks may be displaced together, but not apart,
and the covariance of the pose contains the displacement that cannot be known.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, log, pi

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import rotation, transform, wrap

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# What is not in any covariance (bark, lean, roots), and keeps exact landmarks from infinite likelihoods: assumed, in m.
_FLOOR = 0.02

# Pairs are this far apart, in m: closer ones say little about the heading, others are too many.
_NEAREST, _FARTHEST = 3.0, 15.0

# Pairs of the local landmarks vote until there are this many votes; at least so many pairs do.
_VOTES, _FEWEST_PAIRS = 600_000, 25

# Pairs agree within this many standard deviations of distance and diameters.
_GATE = 2.5

# How many places are looked at: those with most votes, those fitted, those judged.
_VOTED, _FITTED, _JUDGED = 160, 48, 12

# The share of diameters that are measured badly, ε_D.
_BAD_DIAMETERS = 0.1

# Landmarks are counted within this radius, in m, for the density around each.
_SURROUNDINGS = 8.0

_FACTOR, _LEAST_MARGIN, _LEAST_FIT = 200.0, 5.0, 0.6


@dataclass(frozen=True, eq=False)
class Fix:
    """Where on the map the carrier is, as far as the landmarks around it tell. Immutable.

    Attributes:
        pose: The most likely pose X_WH, [x, y, heading] in m and rad, shape (3,).
        covariance: Its covariance, if it is the right one, shape (3, 3).
        is_sure: Whether it passes the test of uniqueness. If not, pose and covariance are no measurement.
        log_likelihood: Λ, the logarithm of the likelihood compared with a place that the map does not show.
        margin: By how much Λ exceeds that of the best other pose.
        fit: Λ as a share of what is expected of a right pose.
        pairs: Indices of matched landmarks, local and on the map, shape (m, 2).
    """

    pose: Array
    covariance: Array
    is_sure: bool
    log_likelihood: float
    margin: float
    fit: float
    pairs: Indices

    def __post_init__(self) -> None:
        for array in (self.pose, self.covariance, self.pairs):
            array.flags.writeable = False

    def __deepcopy__(self, memo: object) -> Fix:
        return self


class ConstellationMap:
    """A map of landmarks, prepared to be searched for a constellation.

    What is computed once are the pairs of landmarks, sorted by their distance: about 70 bytes for each of the 30 pairs
    that a tree of a stand with 800 trees/ha has. Immutable.

    Attributes:
        landmarks: The map, in W.
        correlation: Length L in m over which errors of the map are shared by neighbours; 0 if they are independent.
        share: The share w of the local landmarks that are on the map, assumed.
        fewest: The least number of local landmarks with which a pose can be sure.

    Raises:
        ValueError: The map has fewer than 3 landmarks, or a parameter is outside of its range.
    """

    def __init__(self, landmarks: Landmarks, *, correlation: float = 0.0, share: float = 0.5, fewest: int = 16) -> None:
        if len(landmarks) < 3:
            raise ValueError(f"a constellation needs a map of at least 3 landmarks, not {len(landmarks)}")
        if not 0.0 < share < 1.0 or correlation < 0.0 or fewest < 2:
            raise ValueError(
                "share lies between 0 and 1, correlation is at least 0 and fewest at least 2, "
                f"not {share}, {correlation} and {fewest}"
            )
        self.landmarks = landmarks
        self.correlation = correlation
        self.share = share
        self.fewest = fewest
        # The frame M of the map: W with its origin among the landmarks, so that large coordinates cost no digits.
        self._p_WoMo_W = landmarks.positions.mean(axis=0)
        self._places = landmarks.positions - self._p_WoMo_W
        self._tree = cKDTree(self._places)
        self._low, self._high = self._places.min(axis=0), self._places.max(axis=0)
        self._area = float(np.prod(np.maximum(self._high - self._low, 1.0)))
        counts = self._tree.query_ball_point(self._places, _SURROUNDINGS, return_length=True)
        self._densities = np.maximum(counts / (pi * _SURROUNDINGS**2), len(landmarks) / self._area)
        self._roots = np.linalg.cholesky(landmarks.covariances + 1e-12 * np.eye(2))
        self._variance = 0.5 * float(np.mean(np.trace(landmarks.covariances, axis1=1, axis2=2)))
        self._diameter_variances = landmarks.diameter_deviations**2
        # Diameters that stand for all.
        self._typical = np.argsort(landmarks.diameters)[np.linspace(0, len(landmarks) - 1, 200).astype(int)]
        self._pairs = PairTable.of(landmarks, self._places, self._tree)

    def locate(self, local: Landmarks) -> Fix:
        """Return where the carrier is that has these landmarks around it, in its level frame H.

        Their errors are taken as independent.
        """
        if len(local) < 2:
            return self._unknown()
        # The frame C of the constellation: H with its origin among the landmarks, where pose errors are least.
        p_HoCo_H = local.positions.mean(axis=0)
        constellation = _Constellation.of(self, local, local.positions - p_HoCo_H)
        judged = [self._judged(constellation, pose) for pose in self._candidates(constellation)]
        found = sorted((one for one in judged if one is not None), key=lambda one: -one.log_likelihood)
        if not found:
            return self._unknown()
        best = found[0]
        others = [one.log_likelihood for one in found[1:] if _is_other(one.pairs, best.pairs)]
        margin = best.log_likelihood - max([0.0, *others])
        fit = best.log_likelihood / constellation.expected
        poses = self._area / (2.0 * pi * constellation.variance) * 2.0 * pi * 10.0 / constellation.variance**0.5
        is_sure = (
            len(local) >= self.fewest
            and best.log_likelihood > log(max(poses, 1.0)) + log(_FACTOR)
            and margin >= _LEAST_MARGIN
            and fit >= _LEAST_FIT
        )
        R_WH = rotation(best.pose[2])
        arm_W = -R_WH @ p_HoCo_H
        pose = np.array([*(best.pose[:2] + arm_W + self._p_WoMo_W), wrap(best.pose[2])])
        carried = np.array([[1.0, 0.0, -arm_W[1]], [0.0, 1.0, arm_W[0]], [0.0, 0.0, 1.0]])
        covariance = carried @ best.covariance @ carried.T
        return Fix(pose, covariance, is_sure, best.log_likelihood, margin, fit, best.pairs)

    def _unknown(self) -> Fix:
        """Return that the carrier is anywhere on the map."""
        pose = np.array([*(0.5 * (self._low + self._high) + self._p_WoMo_W), 0.0])
        covariance = np.diag([*((self._high - self._low) ** 2 / 12.0), pi**2 / 3.0])
        return Fix(pose, covariance, False, 0.0, 0.0, 0.0, np.zeros((0, 2), dtype=np.intp))

    def _candidates(self, constellation: _Constellation) -> Array:
        """Return the poses X_MC that are to be judged, shape (k, 3)."""
        poses = self._voted(constellation)
        wide = max(3.0 * constellation.variance**0.5, 0.4)
        poses, support = self._approach(constellation, poses, wide)
        poses = poses[np.argsort(-support)[:_FITTED]]
        for width in (0.7 * wide, 0.5 * wide, 0.5 * wide):
            poses, support = self._approach(constellation, poses, width)
        chosen: list[Array] = []
        for row in np.argsort(-support):
            if support[row] > 0.0 and not any(_is_near(poses[row], other) for other in chosen):
                chosen.append(poses[row])
            if len(chosen) == _JUDGED:
                break
        return np.array(chosen).reshape(-1, 3)

    def _voted(self, constellation: _Constellation) -> Array:
        """Return the poses X_MC for which most pairs vote, shape (k, 3)."""
        spread = constellation.variance**0.5
        cell = float(np.clip(7.0 * spread, 0.8, 3.0))
        margin = 20.0
        votes = self._pairs.votes(constellation, self._variance, self.correlation)
        inside = ((votes[:, :2] > self._low - margin) & (votes[:, :2] < self._high + margin)).all(axis=1)
        votes = votes[inside]
        if not len(votes):
            return np.zeros((0, 3))
        columns, rows = (np.ceil((self._high - self._low + 2.0 * margin) / cell) + 1).astype(int)
        sectors = int(2.0 * pi / np.clip(0.6 * spread, 0.05, 0.3))
        scaled = (votes[:, :2] - (self._low - margin)) / np.float32(cell)
        turned = votes[:, 2] * np.float32(sectors / (2.0 * pi))
        found = []
        # Two grids, so that no place lies near the border of a cell in both.
        for shift in (np.float32(0.0), np.float32(0.5)):
            place = (scaled + shift).astype(np.int64)
            sector = (turned + shift).astype(np.int64) % sectors
            keys = (sector * rows + place[:, 1]) * columns + place[:, 0]
            found.append(_crowded(keys, votes))
        return np.vstack(found)

    def _approach(self, constellation: _Constellation, poses: Array, width: float) -> tuple[Array, Array]:
        """Fit poses X_MC (k, 3) to the landmarks of the map nearest to each local one, in one step of least squares.

        Args:
            constellation: The local landmarks.
            poses: Where they may be.
            width: The weights fall to exp(-1/2) at this distance in m.

        Returns:
            The better poses (k, 3), and the sums of weights (k,).
        """
        local = constellation.places
        c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
        x = c * local[:, 0] - s * local[:, 1] + poses[:, :1]
        y = s * local[:, 0] + c * local[:, 1] + poses[:, 1:2]
        distances, nearest = self._tree.query(np.stack([x, y], axis=-1), distance_upper_bound=2.5 * width)
        known = nearest < len(self._places)
        weights = np.where(known, np.exp(-0.5 * np.minimum(distances, 1e3) ** 2 / width**2), 0.0)
        weights *= constellation.weights
        target = self._places[np.where(known, nearest, 0)]
        total = weights.sum(axis=1)
        share = weights / np.maximum(total, 1e-9)[:, np.newaxis]
        mean_C, mean_M = share @ local, np.einsum("kn,kni->ki", share, target)
        u, v = local - mean_C[:, np.newaxis], target - mean_M[:, np.newaxis]
        along = np.einsum("kn,kni,kni->k", share, u, v)
        across = np.einsum("kn,kn->k", share, u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])
        heading = np.arctan2(across, along)
        c, s = np.cos(heading), np.sin(heading)
        turned = np.column_stack([c * mean_C[:, 0] - s * mean_C[:, 1], s * mean_C[:, 0] + c * mean_C[:, 1]])
        fitted = np.column_stack([mean_M - turned, heading])
        return np.where(total[:, np.newaxis] > 0.0, fitted, poses), total

    def _judged(self, constellation: _Constellation, pose: Array) -> _Judged | None:
        """Match the landmarks at a pose X_MC, and estimate it with the shared errors of the map around it."""
        odds = log(self.share / (1.0 - self.share))
        n = len(constellation.places)
        shared = constellation.shared
        functions = shared.shape[1]
        # The displacement of the map around each local landmark, as a factor of the root of the covariance.
        mean, spread = np.zeros((n, 2)), (shared**2).sum(axis=1)[:, np.newaxis, np.newaxis] * np.eye(2)
        pairs: Indices = np.zeros((0, 2), dtype=np.intp)
        for _ in range(6):
            R = rotation(pose[2])
            seen_M = transform(pose, constellation.places)
            C_M = R @ constellation.covariances @ R.T + _FLOOR**2 * np.eye(2)
            _, near = self._tree.query(seen_M + self._variance**0.5 * mean, k=min(3, len(self._places)))
            L = self._roots[near]
            P = L @ L.swapaxes(-1, -2)
            left = constellation.independent[:, np.newaxis, np.newaxis, np.newaxis]
            S = left * P + L @ spread[:, np.newaxis] @ L.swapaxes(-1, -2) + C_M[:, np.newaxis]
            delta = self._places[near] - seen_M[:, np.newaxis] - np.einsum("nkij,nj->nki", L, mean)
            diameter = constellation.diameter_gain(self, near)
            gain = odds - np.log(self._densities[near]) + diameter + _log_normal(delta, S)
            before, pairs = pairs, _one_to_one(near, gain)
            if len(pairs) < 3:
                return None
            if np.array_equal(before, pairs):
                break
            i, j = pairs.T
            L = self._roots[j]
            S = constellation.independent[i, np.newaxis, np.newaxis] * (L @ L.swapaxes(-1, -2)) + C_M[i]
            arm = seen_M[i] - pose[:2]
            A = np.zeros((len(i), 2, 3 + 2 * functions))
            A[:, 0, 0] = A[:, 1, 1] = 1.0
            A[:, 0, 2], A[:, 1, 2] = -arm[:, 1], arm[:, 0]
            A[:, :, 3:] = np.einsum("mf,mij->mifj", shared[i], L).reshape(len(i), 2, -1)
            # Divided by the root of the covariance, so that all errors are of unit variance.
            root = np.linalg.cholesky(S)
            residual = np.linalg.solve(root, (self._places[j] - seen_M[i])[..., np.newaxis]).ravel()
            A = np.linalg.solve(root, A).reshape(2 * len(i), -1)
            information = A.T @ A + np.diag([0.0] * 3 + [1.0] * (2 * functions))
            covariance = np.linalg.inv(information)
            change = covariance @ (A.T @ residual)
            pose = np.asarray(pose + change[:3], dtype=np.float64)
            factors = change[3:].reshape(functions, 2)
            mean = shared @ factors
            block = covariance[3:, 3:].reshape(functions, 2, functions, 2)
            spread = np.einsum("nf,figj,ng->nij", shared, block, shared, optimize=True)
            residual = residual - A @ change
            # The density of all residuals, the factors integrated out.
            square = residual @ residual + change[3:] @ change[3:]
            logdet = 2.0 * np.log(np.abs(np.diagonal(root, axis1=1, axis2=2))).sum()
            logdet += np.linalg.slogdet(information[3:, 3:])[1]
        column = (near[i] == j[:, np.newaxis]).argmax(axis=1)
        evidence = (odds - np.log(self._densities[j]) + diameter[i, column]).sum()
        evidence += -0.5 * (square + logdet) - len(i) * log(2.0 * pi) + n * log(1.0 - self.share)
        return _Judged(pose, np.asarray(covariance[:3, :3], dtype=np.float64), float(evidence), pairs)


@dataclass(frozen=True, eq=False)
class _Judged:
    """A pose X_MC with its covariance, its likelihood and its matches (m, 2)."""

    pose: Array
    covariance: Array
    log_likelihood: float
    pairs: Indices


@dataclass(frozen=True, eq=False)
class _Constellation:
    """The local landmarks, in C, and what is known of their errors on a map.

    Attributes:
        places: Positions in m, (n, 2).
        covariances: Of their detection, (n, 2, 2) in m^2.
        variances: The same as one variance, (n,).
        weights: Weights for a fit, 1 for the average landmark, (n,).
        diameters: In m, (n,).
        diameter_variances: In m^2, (n,).
        common: How frequent the diameters are on the map, (n,) in 1/m.
        shared: The smooth functions of the map's shared errors at the landmarks, (n, f).
        independent: The share of the map's variance that they leave, (n,).
        variance: Of a difference between here and the map, per axis in m^2.
        expected: The likelihood Λ that is expected of a right pose.
    """

    places: Array
    covariances: Array
    variances: Array
    weights: Array
    diameters: Array
    diameter_variances: Array
    common: Array
    shared: Array
    independent: Array
    variance: float
    expected: float

    @classmethod
    def of(cls, whole: ConstellationMap, local: Landmarks, places: Array) -> _Constellation:
        """Return these landmarks, seen against a map."""
        shared = _shared_functions(places, whole.correlation)
        independent = 1.0 - (shared**2).sum(axis=1)
        # The variance about its mean is that part of the map's errors that displaces landmarks against each other.
        relative = whole._variance * float(np.mean(1.0 - _correlation(places, whole.correlation)))
        variances = 0.5 * np.trace(local.covariances, axis1=1, axis2=2) + _FLOOR**2
        variance = relative + float(np.mean(variances))
        typical = whole.landmarks.diameters[whole._typical]
        typical_variances = whole._diameter_variances[whole._typical]
        diameter_variances = local.diameter_deviations**2
        common = _normal(
            local.diameters[:, np.newaxis] - typical, diameter_variances[:, np.newaxis] + typical_variances
        )
        common = common.mean(axis=1)
        # The same for a landmark that has one of the typical diameters, measured as well as most are.
        usual = float(np.median(diameter_variances))
        of_typical = _normal(typical[:, np.newaxis] - typical, usual + typical_variances).mean(axis=1)
        at_one_deviation = _normal(np.zeros(len(typical)), usual + typical_variances) * exp(-0.5)
        diameter = float(np.mean(_robust_gain(at_one_deviation, of_typical)))
        density = len(whole.landmarks) / whole._area
        matched = np.log(whole.share / (density * 2.0 * pi * (relative + variances))) - 1.0 + diameter
        others = log(1.0 - whole.share)
        expected = float(np.sum(whole.share * np.maximum(matched, others) + (1.0 - whole.share) * others))
        return cls(
            places,
            local.covariances,
            variances,
            variance / (relative + variances),
            local.diameters,
            diameter_variances,
            common,
            shared,
            independent,
            variance,
            max(expected, 1.0),
        )

    def diameter_gain(self, whole: ConstellationMap, near: Indices) -> Array:
        """Return the logarithm of the factor for diameters of landmarks and those of the map near them, (n, k)."""
        variances = self.diameter_variances[:, np.newaxis] + whole._diameter_variances[near]
        density = _normal(self.diameters[:, np.newaxis] - whole.landmarks.diameters[near], variances)
        return _robust_gain(density, self.common[:, np.newaxis])


@dataclass(frozen=True, eq=False)
class PairTable:
    """All pairs of landmarks that are neither close nor far, sorted by their distance.

    Attributes:
        distances: In m, (n,).
        angles: The directions from the first to the second landmark in rad, (n,).
        middles: The places half way in m, (2, n).
        diameters: Of the first and the second landmark in m, (2, n).
        reaches: By how much diameters may differ in m, (2, n).
    """

    distances: NDArray[np.float32]
    angles: NDArray[np.float32]
    middles: NDArray[np.float32]
    diameters: NDArray[np.float32]
    reaches: NDArray[np.float32]

    @classmethod
    def of(cls, landmarks: Landmarks, places: Array, tree: cKDTree) -> PairTable:
        """Return the table of the landmarks of a map that are at these places, (n, 2), which the tree has, too."""
        pairs = _pairs(places, tree)
        first, second = places[pairs[:, 0]], places[pairs[:, 1]]
        delta = (second - first).astype(np.float32)
        distances = np.hypot(*delta.T)
        order = np.argsort(distances)
        pairs, delta = pairs[order], delta[order]
        return cls(
            distances[order],
            np.arctan2(delta[:, 1], delta[:, 0]),
            np.ascontiguousarray((0.5 * (first + second))[order].T, dtype=np.float32),
            landmarks.diameters[pairs.T].astype(np.float32),
            (_GATE * landmarks.diameter_deviations[pairs.T]).astype(np.float32) ** 2,
        )

    def votes(self, constellation: _Constellation, variance: float, correlation: float) -> NDArray[np.float32]:
        """Return the poses X_MC for which pairs of the local landmarks vote, (n, 3), with headings in [0, 2π)."""
        places = constellation.places
        pairs = _pairs(places, cKDTree(places))
        pairs = pairs[np.random.default_rng(0).permutation(len(pairs))]
        delta = places[pairs[:, 1]] - places[pairs[:, 0]]
        distances, angles = np.hypot(*delta.T), np.arctan2(delta[:, 1], delta[:, 0])
        middles = 0.5 * (places[pairs[:, 0]] + places[pairs[:, 1]])
        together = np.exp(-0.5 * (distances / correlation) ** 2) if correlation else 0.0
        reach = _GATE * np.sqrt(constellation.variances[pairs].sum(axis=1) + 2.0 * variance * (1.0 - together))
        begin, end = np.searchsorted(self.distances, np.array([distances - reach, distances + reach], dtype=np.float32))
        enough = np.searchsorted(np.cumsum(2 * (end - begin)), _VOTES) + 1
        found = [np.zeros((0, 3), np.float32)]
        turn = np.float32(2.0 * pi)
        for row in range(min(len(pairs), max(int(enough), _FEWEST_PAIRS))):
            part = slice(begin[row], end[row])
            diameters = constellation.diameters[pairs[row]].astype(np.float32)
            reaches = (_GATE**2 * constellation.diameter_variances[pairs[row]]).astype(np.float32)
            for flip in (False, True):
                one, other = (1, 0) if flip else (0, 1)
                alike = (self.diameters[one, part] - diameters[0]) ** 2 <= self.reaches[one, part] + reaches[0]
                alike &= (self.diameters[other, part] - diameters[1]) ** 2 <= self.reaches[other, part] + reaches[1]
                heading = self.angles[part][alike] - np.float32(angles[row] - pi * flip)
                heading -= turn * np.floor(heading / turn)
                c, s = np.cos(heading), np.sin(heading)
                x, y = middles[row].astype(np.float32)
                middle = self.middles[:, part][:, alike]
                found.append(np.column_stack([middle[0] - (c * x - s * y), middle[1] - (s * x + c * y), heading]))
        return np.concatenate(found)


def _pairs(places: Array, tree: cKDTree) -> Indices:
    pairs: Indices = tree.query_pairs(_FARTHEST, output_type="ndarray")
    delta = places[pairs[:, 1]] - places[pairs[:, 0]]
    return pairs[(delta**2).sum(axis=1) >= _NEAREST**2]


def _crowded(keys: NDArray[np.int64], votes: NDArray[np.float32]) -> Array:
    """Return the mean poses of the cells with most votes, (k, 3), given the cell of each vote (n,)."""
    bits = len(keys).bit_length()
    packed = np.sort((keys << bits) | np.arange(len(keys)))
    cells = packed >> bits
    starts = np.flatnonzero(np.diff(cells, prepend=-1))
    counts = np.diff(starts, append=len(cells))
    most = np.argsort(-counts, kind="stable")[: _VOTED // 2]
    rows = np.concatenate(
        [packed[start : start + count] for start, count in zip(starts[most], counts[most], strict=True)]
    )
    members = votes[rows & ((1 << bits) - 1)].astype(float)
    first = np.cumsum(counts[most]) - counts[most]
    columns = np.column_stack([members[:, :2], np.cos(members[:, 2]), np.sin(members[:, 2])])
    means = np.add.reduceat(columns, first) / counts[most][:, np.newaxis]
    return np.column_stack([means[:, :2], np.arctan2(means[:, 3], means[:, 2])])


def _one_to_one(near: Indices, gain: Array) -> Indices:
    """Return the pairs (m, 2) of each landmark with the best one near it, if that gains, one to one."""
    best = gain.argmax(axis=1)
    rows = np.arange(len(gain))
    gains, chosen = gain[rows, best], near[rows, best]
    rows = rows[gains > 0.0]
    rows = rows[np.argsort(-gains[rows], kind="stable")]
    _, first = np.unique(chosen[rows], return_index=True)
    rows = np.sort(rows[first])
    return np.column_stack([rows, chosen[rows]])


def _is_other(pairs: Indices, best: Indices) -> bool:
    """Return whether less than half of the matches are the same."""
    common = len({*map(tuple, pairs.tolist())} & {*map(tuple, best.tolist())})
    return common < 0.5 * min(len(pairs), len(best))


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


def _normal(delta: Array, variances: ArrayLike) -> Array:
    """Return densities of the normal distribution; 0 for an infinite variance."""
    variances = np.maximum(variances, 1e-4)
    density: Array = np.exp(-0.5 * delta**2 / variances) / np.sqrt(2.0 * pi * variances)
    return density


def _robust_gain(density: Array, common: Array) -> Array:
    """Return the logarithm of the factor for a diameter; nothing is gained where nothing is known."""
    factor = np.divide(density, common, out=np.ones_like(density), where=common > 0.0)
    return np.log((1.0 - _BAD_DIAMETERS) * factor + _BAD_DIAMETERS)


def _log_normal(delta: Array, S: Array) -> Array:
    """Return ln N(delta; 0, S) for deltas (..., 2)."""
    a, b, c = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
    x, y = delta[..., 0], delta[..., 1]
    determinant = a * c - b**2
    square = (c * x**2 - 2.0 * b * x * y + a * y**2) / determinant
    density: Array = -0.5 * (square + np.log(determinant)) - log(2.0 * pi)
    return density
