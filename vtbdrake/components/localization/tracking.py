"""Tracking of a carrier among landmarks of a map, from a first pose on: simultaneous localization and map refinement.

The state x = [X_WH; b; e; g; l_1; ...; l_n] holds the planar pose of the carrier, the range bias b of the detector,
two lasting errors e and g of dead reckoning, and the true positions l_i (in W) of those landmarks of the map that have
been seen. Each landmark enters the state once, with its position on the map and the error of the map as the prior; from
then on it is refined by detections, and correlated with the pose. A filter that takes the map's error as independent in
each scan would become overconfident, because it is the same error. A detection z of landmark l in the level frame H is

    z = d + b (d - s) / |d - s| + noise,    d = R_WHᵀ (l - p_WoHo_W),    s = p_HoLo_H,

where s is the position of the scanner. This is EKF-SLAM with a map (Durrant-Whyte and Bailey, "Simultaneous
localization and mapping: part I", IEEE Robotics & Automation Magazine 13, 2006). Landmarks far behind are marginalized.

The heading of a plain extended Kalman filter becomes overconfident. Scans show the positions of landmarks relative to
the carrier, so that a common rotation of both is not observable; but with derivatives at estimates that change from
scan to scan, it seems to be (Huang, Mourikis and Roumeliotis, "Observability-based rules for designing consistent EKF
SLAM estimators", International Journal of Robotics Research 29, 2010). Therefore the errors here are those of the
right-invariant filter (Barrau and Bonnabel, "An EKF-SLAM algorithm with consistency properties", arXiv:1510.06263,
2015): an error θ of the heading displaces the carrier and each landmark, at a point p, by θ J p, where J is the
rotation by a right angle.

Dead reckoning measures a motion [t; turn] in the time T. It is too long by its share e, and its gyros have the bias g:

    true motion = [(1 - e) R(-g T / 2) t; turn - g T] + noise.

e is a first-order Gauss-Markov process over the distance travelled, because the slip of wheels depends on the slope; g
is a random walk in time. Noise alone, independent from step to step, would be too small after a minute without
landmarks. e and g are estimated while landmarks are seen.

Errors of a map may be correlated: neighbours are displaced alike. With K_ij = c σ_i σ_j exp(-r_ij² / (2 L²)) +
(1 - c) σ_i² δ_ij for the errors of the landmarks, per axis, the prior of a landmark that is seen for the first time is
its distribution given the errors of those in the state (simple kriging). So a new landmark is expected to be displaced
like its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf, pi
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve, solve_triangular
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import compose, rotation, transform
from vtbdrake.components.settings import check_settings
from vtbdrake.components.world_model.association import chi_square_quantile

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Indices of b, e and g in x; the number of leading elements on which a detection depends; the index of the first
# landmark.
_BIAS, _ODOMETRY, _RATE = 3, 4, 5
_SEEN, _FIXED = 4, 6

# Standard deviations in m and rad of a pose without information.
_LOOSE = np.array([5.0, 5.0, 0.2])

# Hypotheses that are tried in the association of a scan.
_HYPOTHESES = 40

# The density that competes with a first match is that of all detections times the odds that a detection shows something
# that is not on the map: assumed, on the safe side for a map that lacks a third of the trees. The second number is the
# least probability of a first match.
_OTHERS, _LEAST_PROBABILITY = 2.0, 0.8

# The upper limit of -2 times the log-likelihood ratio of a diameter, as for three deviations: trunks are not cylinders.
_DIAMETER_CAP = 9.0

# Larger standard deviations of a diameter, in m, are cut to this one: the diameter is unknown.
_NO_DIAMETER = 10.0

# A scan fails if it matches a smaller share of its detections, or of the landmarks that should be seen again.
_LEAST_SHARE, _LEAST_AGAIN = 0.15, 0.25

# The least number of detections, or of landmarks that should be seen again, for this test.
_JUDGED_FROM = 6

# With a larger standard deviation of the heading in rad, the track is lost: the linearization holds for small errors.
_LARGEST_TURN = 0.2

# The factor of the variance of dead reckoning: by which share it follows the ratio of a scan, the largest ratio that
# counts, the factor of a scan that fails, and the largest value.
_FOLLOWS, _LARGEST_RATIO, _FAILED, _LARGEST_DRIFT = 0.1, 25.0, 4.0, 1e3

# Units in which errors of x, y (m) and heading (rad) are of the same size, as a landmark at 10 m shows them.
_SCALES = np.array([1.0, 1.0, 0.1])

# Degrees of freedom of the distortions: displacement, rotation, scale and shear, which are affine.
_DISTORTIONS = 6

# Beyond this multiple of the gate of distortions, matches are wrong, and the track is lost.
_TANGLED = 10.0

# The share of first matches that are assumed to be by chance although the pose is right.
_CHANCE = 0.2


@dataclass(frozen=True, eq=False)
class TrackState:
    """The memory of a `Tracker`: an immutable value with read-only arrays.

    Attributes:
        mean: The estimate of x (m, rad, s), shape (6 + 2 n,); empty if nothing is tracked.
        covariance: The covariance of x, shape (6 + 2 n, 6 + 2 n).
        indices: Indices on the map of the landmarks in x, shape (n,).
        is_recent: Whether each of them was seen in the last scan that was fused, shape (n,).
        evidence: Cumulative log-likelihood ratio of first matches, see `Tracker`.
        failures: The number of scans in succession that failed, see `Tracker`.
        distortion: The test statistic of a distorted map after the last scan that was fused, see `Tracker`.
        drift: The factor by which the variance of dead reckoning is larger than assumed, at least 1, see `Tracker`.
    """

    mean: Array
    covariance: Array
    indices: Indices
    is_recent: NDArray[np.bool_]
    evidence: float = 0.0
    failures: int = 0
    distortion: float = 0.0
    drift: float = 1.0

    def __post_init__(self) -> None:
        for name in ("mean", "covariance", "indices", "is_recent"):
            array = getattr(self, name)
            if not isinstance(array, np.ndarray) or array.flags.writeable:
                array = np.array(array)
                array.flags.writeable = False
            object.__setattr__(self, name, array)

    @classmethod
    def none(cls) -> TrackState:
        """Return the state in which nothing is tracked."""
        return cls(np.zeros(0), np.zeros((0, 0)), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=bool))

    def __deepcopy__(self, memo: object) -> TrackState:
        return self

    def with_arrays(self, **arrays: Any) -> TrackState:
        """Return the state with other arrays, which are not copied and are read-only from now on."""
        for array in arrays.values():
            array.flags.writeable = False
        return replace(self, **arrays)

    @property
    def is_tracking(self) -> bool:
        """Whether there is a pose."""
        return bool(self.mean.size)

    @property
    def pose(self) -> Array:
        """X_WH, shape (3,)."""
        return self.mean[:3]

    @property
    def pose_covariance(self) -> Array:
        """The covariance of X_WH, shape (3, 3)."""
        return self.covariance[:3, :3]

    @property
    def range_bias(self) -> float:
        """The estimated range bias b of the detector in m."""
        return float(self.mean[_BIAS])


@dataclass(frozen=True, eq=False)
class Matches:
    """The matches of a scan with the map.

    Attributes:
        pairs: Indices of the detection and of the landmark on the map, shape (k, 2).
        nis: The normalized innovation squared of the pairs: chi-square distributed with 2 k degrees of freedom.
        is_fused: Whether the scan changed the estimate.
    """

    pairs: Indices
    nis: float = 0.0
    is_fused: bool = False


class _Found(NamedTuple):
    """Pairs of detection and landmark (k, 2), their d² and their probability (k,)."""

    pairs: Indices
    squares: Array
    probability: Array

    def select(self, mask: NDArray[np.bool_]) -> _Found:
        return _Found(self.pairs[mask], self.squares[mask], self.probability[mask])

    def first(self, count: int) -> _Found:
        return self.select(np.arange(len(self.pairs)) < count)


_NOTHING = _Found(np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros(0))
_NO_MATCHES = Matches(np.zeros((0, 2), dtype=np.int64))


@dataclass(frozen=True, eq=False)
class Tracker:
    """The filter described in the module, for one map.

    Association: pairs of detection and landmark within a gate on the Mahalanobis distance are hypotheses. The one that
    agrees with most others, after the state has been conditioned on it, decides which pairs are possible; the best
    one-to-one assignment among them is taken, and its worst pairs are dropped until the joint innovation is
    probable. Diameters count in the assignment. The first match of a landmark, which is not in the state yet, may be
    wrong: its probability p is its density, divided by the sum of the densities of this pair, of all pairs that exclude
    it, and of what the map does not show. It must be at least 0.8, and the prior covariance of the landmark (given its
    neighbours) is divided by p². It is also multiplied by the share of the variance that passes ``first_gate``, 0.84:
    landmarks with the largest errors on the map are never matched.

    Health: a scan fails, and is not fused, if too few of its detections match, or too few of the landmarks that the
    last fused scan showed. The track is lost after ``patience`` failures in succession, when the position is uncertain
    by more than ``largest_deviation`` or the heading by more than 0.2 rad, or when first matches contradict the pose:
    the d² of a right match is chi-square distributed, that of a match by chance is uniform within ``first_gate``. The
    log-likelihood ratio of right matches is summed up to at most ``credit``; below 0, the track is lost (the cumulative
    sum of Page, Biometrika 41, 1954).

    Drift: dead reckoning may be worse than the model of its noise says, by wheels that slip or a steering angle that is
    measured badly. The change d of the pose by a scan has the covariance D, the pose's before the scan less that after
    it. So s = dᵀ D⁻¹ d / 3 is 1 on average; the variance of the next motion is multiplied by a factor that follows s
    (by a tenth of its difference from 1 per scan), and that grows fourfold with a scan that fails. It is at least 1.

    Doubt: a map that is bent, sheared or scaled fits everywhere nearly, and leads astray all the same. It shows in the
    corrections c of the landmarks in the state, their estimates less their positions on the map: on a right map they
    have the covariance K (less what is not known yet), on a distorted one they change with the position. With the
    functions B = [1, x, y], the statistic T = Σ |(Bᵀ K⁻¹ B)^(-1/2) Bᵀ K⁻¹ c|² over both axes is at most chi-square
    distributed with 6 degrees of freedom on a right map. Beyond ``distortion_gate``, the pose is doubtful, and far
    beyond, lost: so large are corrections by wrong matches. Between its
    95 % quantile and that, the covariance of the pose is multiplied by the ratio of T to the quantile (the ratio of
    Birge, Physical Review 40, 1932).

    Landmarks that were marginalized enter anew if the carrier comes back, and their map error is then used twice:
    ``horizon`` and ``most`` must be so large that the state holds the landmarks of a whole closed route. Landmarks of
    which the map is less certain than ``largest_deviation`` are not used.

    Attributes:
        landmarks: The map, in W.
        sensor: The position s = p_HoLo_H of the scanner in the plane, in m.
        field_of_view: The horizontal field of view in rad, for the density of detections.
        bias_deviation: Standard deviation of the range bias, in m; assumed.
        odometry_deviation: Standard deviation of e; assumed.
        odometry_length: The distance in m over which e loses two thirds of its correlation; assumed.
        rate_deviation: Standard deviation of g, the residual bias of the gyros in dead reckoning, in rad/s; assumed.
        rate_walk: Random walk of g in rad/s per root second; assumed.
        least_deviation: Standard deviation in m that is added to those of detections, per axis; calibrated with
            simulated scans of `vtbdrake_diagrams.forest` and an exact map.
        scan_deviation: Standard deviation in m, per axis, of the common displacement of all detections of a scan;
            assumed.
        correlation: Correlation length L of the map's errors in m; 0 if they are independent.
        correlated_share: The share c of the variance of the map that is correlated; assumed.
        gate: The share of right pairs that the gate lets pass.
        first_gate: The same of first matches, whose gate is narrower: on the map, another landmark may be near.
        horizon: Distance from the carrier in m beyond which landmarks are marginalized.
        most: The largest number of landmarks in the state; the farthest are marginalized.
        patience: The number of failures in succession after which the track is lost.
        credit: The upper limit of the evidence.
        first_credit: The evidence at the start; it is less than ``credit``, so that a wrong start ends sooner.
        largest_deviation: The largest standard deviation of the position in m, per axis, with which a track goes on.
        distortion_gate: The share of right maps that are not doubtful in one test of the distortion.

    Raises:
        ValueError: The map is empty, or a setting is outside of its range.
    """

    landmarks: Landmarks
    sensor: tuple[float, float] = (0.0, 0.0)
    field_of_view: float = 2.0 * pi
    bias_deviation: float = 0.03
    odometry_deviation: float = 0.02
    odometry_length: float = 20.0
    rate_deviation: float = 5e-4
    rate_walk: float = 2e-5
    least_deviation: float = 0.005
    scan_deviation: float = 0.0
    correlation: float = 0.0
    correlated_share: float = 0.98
    gate: float = 0.997
    first_gate: float = 0.95
    horizon: float = 100.0
    most: int = 400
    patience: int = 3
    credit: float = 12.0
    first_credit: float = 6.0
    largest_deviation: float = 2.0
    distortion_gate: float = 0.99999
    _usable: Indices = field(init=False, repr=False)
    _tree: cKDTree = field(init=False, repr=False)
    _variances: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not len(self.landmarks):
            raise ValueError("the map of a tracker is empty: localization needs landmarks")
        checks = {
            "field_of_view": (0.0 < self.field_of_view <= 2.0 * pi, "in rad, within (0, 2 pi]"),
            "bias_deviation": (0.0 <= self.bias_deviation < inf, "in m, at least 0"),
            "odometry_deviation": (0.0 <= self.odometry_deviation < inf, "a share, at least 0"),
            "odometry_length": (self.odometry_length > 0.0, "in m, positive"),
            "rate_deviation": (0.0 <= self.rate_deviation < inf, "in rad/s, at least 0"),
            "rate_walk": (0.0 <= self.rate_walk < inf, "in rad/s per root second, at least 0"),
            "least_deviation": (0.0 <= self.least_deviation < inf, "in m, at least 0"),
            "scan_deviation": (0.0 <= self.scan_deviation < inf, "in m, at least 0"),
            "correlation": (0.0 <= self.correlation < inf, "in m, at least 0"),
            "correlated_share": (0.0 <= self.correlated_share < 1.0, "a share from 0 to below 1"),
            "gate": (0.0 < self.gate < 1.0, "a share between 0 and 1"),
            "first_gate": (0.0 < self.first_gate < 1.0, "a share between 0 and 1"),
            "horizon": (self.horizon > 0.0, "in m, positive"),
            "most": (self.most >= 1, "at least 1"),
            "patience": (self.patience >= 1, "at least 1"),
            "credit": (self.credit > 0.0, "positive"),
            "first_credit": (self.first_credit > 0.0, "positive"),
            "largest_deviation": (self.largest_deviation > 0.0, "in m, positive"),
            "distortion_gate": (0.0 < self.distortion_gate < 1.0, "a share between 0 and 1"),
        }
        check_settings("Tracker", self, checks)
        variances = np.linalg.eigvalsh(self.landmarks.covariances)[:, -1]
        usable = np.flatnonzero(variances <= self.largest_deviation**2)
        if not len(usable):
            raise ValueError(
                f"no landmark of the map is certain within largest_deviation={self.largest_deviation:g} m: the best "
                f"one has a standard deviation of {np.sqrt(variances.min()):g} m"
            )
        object.__setattr__(self, "_usable", usable)
        object.__setattr__(self, "_tree", cKDTree(self.landmarks.positions[usable]))
        # Variances of a predicted detection, apart from that of the pose: of the landmark, of the bias and of the scan.
        deviations = (self.bias_deviation, self.least_deviation, self.scan_deviation)
        object.__setattr__(self, "_variances", variances[usable] + float(np.sum(np.square(deviations))))

    def start(
        self, X_WH: ArrayLike, covariance: ArrayLike, landmarks: Landmarks | None = None
    ) -> tuple[TrackState, Matches]:
        """Return the state at a first pose, and the matches of what is seen there.

        With landmarks, the pose is assumed to come from the same map, whose errors must not be used twice: the
        covariance serves for the association only, and the estimate is computed from the matched pairs alone.

        Args:
            X_WH: The pose, shape (3,).
            covariance: The covariance of the pose, shape (3, 3).
            landmarks: Detections in H at that pose; None starts with the given covariance.
        """
        pose = np.array(X_WH, dtype=float)
        state = self._at(pose, np.array(covariance, dtype=float))
        if landmarks is None:
            return state, _NO_MATCHES
        found = self._associate(state, landmarks).first(self.most)
        loose = self._at(pose, np.diag(_LOOSE**2))
        return self._fused(self._extended(loose, found.pairs[:, 1], found.probability), landmarks, found.pairs)

    def predict(self, state: TrackState, motion: ArrayLike, covariance: ArrayLike, *, duration: float) -> TrackState:
        """Return the state after a motion.

        Args:
            state: The state before.
            motion: The pose of the carrier afterwards in its frame before, by dead reckoning, shape (3,).
            covariance: The covariance of its noise, shape (3, 3).
            duration: The duration of the motion in s.
        """
        measured = np.asarray(motion, dtype=float)
        mean, P, heading = state.mean.copy(), state.covariance.copy(), state.mean[2]
        turned = mean[_RATE] * duration
        way = rotation(-turned / 2.0) @ measured[:2]
        move = np.array([*((1.0 - mean[_ODOMETRY]) * way), measured[2] - turned])
        F, G = np.eye(3), block_diag(rotation(heading), 1.0)
        F[:2, 2] = rotation(heading + np.pi / 2.0) @ move[:2]
        aside = 0.5 * duration * move[:2]
        # The derivatives of the pose with respect to e and g.
        B = -G @ np.array([[way[0], -aside[1]], [way[1], aside[0]], [0.0, duration]])
        mean[:3] = compose(mean[:3], move)
        P[:3] = F @ P[:3] + B @ P[_ODOMETRY:_FIXED]
        P[:, :3] = P[:, :3] @ F.T + P[:, _ODOMETRY:_FIXED] @ B.T
        P[:3, :3] += state.drift * G @ np.asarray(covariance, dtype=float) @ G.T
        P[_RATE, _RATE] += self.rate_walk**2 * duration
        kept = float(np.exp(-np.hypot(*measured[:2]) / self.odometry_length))
        mean[_ODOMETRY] *= kept
        P[_ODOMETRY] *= kept
        P[:, _ODOMETRY] *= kept
        P[_ODOMETRY, _ODOMETRY] += (1.0 - kept**2) * self.odometry_deviation**2
        return state.with_arrays(mean=mean, covariance=P)

    def update(self, state: TrackState, landmarks: Landmarks) -> tuple[TrackState, Matches]:
        """Return the state after a scan, and its matches.

        Args:
            state: The state at the time of the scan.
            landmarks: The detections, in H.
        """
        if not len(landmarks):
            return state, _NO_MATCHES
        found = self._associate(state, landmarks)
        failed = replace(state, failures=state.failures + 1, drift=min(_FAILED * state.drift, _LARGEST_DRIFT))
        if self._is_elsewhere(state, landmarks, found.pairs):
            return failed, Matches(found.pairs)
        if len(found.pairs) < 2:
            return state, Matches(found.pairs)
        is_known = np.isin(found.pairs[:, 1], state.indices)
        new = found.select(~is_known)
        extended = self._extended(state, new.pairs[:, 1], new.probability)
        fused, matches = self._fused(extended, landmarks, np.vstack([found.pairs[is_known], new.pairs]))
        # Too few of the pairs may be left.
        if self._is_elsewhere(state, landmarks, matches.pairs):
            return failed, Matches(matches.pairs)
        evidence = min(self.credit, state.evidence + self._evidence(new.squares))
        drift = _drift(state, fused) if matches.is_fused else state.drift
        return replace(fused, evidence=evidence, failures=0, drift=drift), matches

    def is_lost(self, state: TrackState) -> bool:
        """Return whether the track is lost, so that its pose must not be used any more."""
        limits = np.array([self.largest_deviation, self.largest_deviation, _LARGEST_TURN])
        is_vague = bool((np.sqrt(np.diagonal(state.pose_covariance)) > limits).any())
        is_tangled = state.distortion > _TANGLED * chi_square_quantile(self.distortion_gate, _DISTORTIONS)
        return state.failures >= self.patience or state.evidence < 0.0 or is_vague or is_tangled

    def is_doubtful(self, state: TrackState) -> bool:
        """Return whether the last scan failed or the map seems distorted, so that the pose must not be used now."""
        return state.failures > 0 or state.distortion > chi_square_quantile(self.distortion_gate, _DISTORTIONS)

    def pose_covariance(self, state: TrackState) -> Array:
        """Return the covariance of X_WH, (3, 3), larger than the filter's if the map seems distorted, see `Tracker`."""
        ratio = state.distortion / chi_square_quantile(0.95, _DISTORTIONS)
        return state.pose_covariance * max(1.0, ratio)

    # -- the state

    def _at(self, X_WH: Array, covariance: Array) -> TrackState:
        P = block_diag(covariance, self.bias_deviation**2, self.odometry_deviation**2, self.rate_deviation**2)
        mean = np.concatenate([X_WH, np.zeros(_FIXED - 3)])
        return replace(TrackState.none(), mean=mean, covariance=P, evidence=self.first_credit)

    def _extended(self, state: TrackState, indices: Indices, probability: Array | None = None) -> TrackState:
        """Return the state with further landmarks of the map, (m,), which it does not have yet.

        Args:
            state: The state.
            indices: The indices of these landmarks on the map.
            probability: The probabilities of their first matches, (m,); by default nothing was matched.
        """
        places, variances = self.landmarks.positions, self.landmarks.covariances
        mean, P, n, m = state.mean, state.covariance, len(state.indices), len(indices)
        factor = np.ones(m) if probability is None else _variance_within(self.first_gate) * probability**-2.0
        if self.correlation == 0.0:
            prior = block_diag(np.zeros((0, 0)), *(factor[:, None, None] * variances[indices]))
            J, added = np.zeros((2 * m, 2 * n)), places[indices]
        else:
            K = self._covariance(np.concatenate([state.indices, indices]))
            weights = np.linalg.solve(K[:n, :n], K[:n, n:])
            rest = K[n:, n:] - K[n:, :n] @ weights
            if probability is not None:
                # The variance of the error of each landmark, given those of all others, times the factor.
                rest = rest + np.diag((factor - 1.0) / np.diagonal(np.linalg.inv(K))[n:])
            prior, J = np.kron(rest, np.eye(2)), np.kron(weights.T, np.eye(2))
            added = places[indices] + weights.T @ (mean[_FIXED:].reshape(-1, 2) - places[state.indices])
        cross = J @ P[_FIXED:]
        return state.with_arrays(
            mean=np.concatenate([mean, added.ravel()]),
            covariance=np.block([[P, cross.T], [cross, cross[:, _FIXED:] @ J.T + prior]]),
            indices=np.concatenate([state.indices, indices]),
            is_recent=np.concatenate([state.is_recent, np.zeros(m, dtype=bool)]),
        )

    def _covariance(self, indices: Indices) -> Array:
        """Return K of the map's errors, shape (m, m) in m^2."""
        places = self.landmarks.positions[indices]
        deviations = np.sqrt(np.maximum(self._map_variances(indices), 1e-6))
        squares = ((places[:, None] - places[None]) ** 2).sum(axis=2)
        K: Array = (
            self.correlated_share * np.exp(-0.5 * squares / self.correlation**2) * np.outer(deviations, deviations)
        )
        K[np.diag_indices_from(K)] = deviations**2
        return K

    def _map_variances(self, indices: Indices) -> Array:
        """Return the mean variances per axis of landmarks on the map, (m,) in m^2."""
        variances: Array = np.trace(self.landmarks.covariances[indices], axis1=1, axis2=2) / 2.0
        return variances

    def _fused(self, state: TrackState, landmarks: Landmarks, pairs: Indices) -> tuple[TrackState, Matches]:
        """Return the state after the fusion of matched detections, of landmarks in the state."""
        # The worst pairs are dropped until the joint innovation is probable; their landmarks stay in the state.
        while len(pairs):
            rows = _rows_of(state.indices, pairs[:, 1])
            expected, H = self._expected(state, rows)
            innovation = (landmarks.positions[pairs[:, 0]] - expected).ravel()
            PHt = _times_transpose(state.covariance, H, rows)
            S = _times(H, rows, PHt) + block_diag(*self._noise(landmarks)[pairs[:, 0]])
            S += self.scan_deviation**2 * np.tile(np.eye(2), (len(pairs), len(pairs)))
            factor = cho_factor(S, lower=True)
            weighted = cho_solve(factor, innovation)
            parts = (innovation * weighted).reshape(-1, 2).sum(axis=1)
            if parts.sum() <= chi_square_quantile(self.gate, 2 * len(pairs)):
                break
            pairs = np.delete(pairs, np.argmax(parts), axis=0)
        else:
            return state, _NO_MATCHES
        P = state.covariance - PHt @ cho_solve(factor, PHt.T)
        mean, P = _corrected(state.mean, 0.5 * (P + P.T), PHt @ weighted)
        fused = state.with_arrays(mean=mean, covariance=P, is_recent=np.isin(state.indices, pairs[:, 1]))
        distance = np.hypot(*(mean[_FIXED:].reshape(-1, 2) - mean[:2]).T)
        far = distance > self.horizon
        far[np.argsort(distance)[self.most :]] = True
        near = _without(fused, far)
        return replace(near, distortion=self._distortion(near)), Matches(pairs, float(parts.sum()), is_fused=True)

    def _distortion(self, state: TrackState) -> float:
        """Return the statistic T of a distorted map, see `Tracker`."""
        places = self.landmarks.positions[state.indices]
        corrections = state.mean[_FIXED:].reshape(-1, 2) - places
        around = places - places.mean(axis=0)
        B = np.column_stack([np.ones(len(places)), around / max(1.0, float(np.abs(around).max()))])
        if self.correlation == 0.0:
            deviations = np.sqrt(np.maximum(self._map_variances(state.indices), 1e-6))[:, None]
            B, corrections = B / deviations, corrections / deviations
        else:
            root = np.linalg.cholesky(self._covariance(state.indices))
            B, corrections = (solve_triangular(root, one, lower=True) for one in (B, corrections))
        Q, R = np.linalg.qr(B)
        # Landmarks on one line, or fewer than three, show fewer distortions.
        is_shown = np.abs(np.diagonal(R)) > 1e-6 * np.abs(R).max()
        return float(((Q.T @ corrections)[is_shown] ** 2).sum())

    def _noise(self, landmarks: Landmarks) -> Array:
        return landmarks.covariances + self.least_deviation**2 * np.eye(2)

    def _expected(self, state: TrackState, rows: Indices) -> tuple[Array, Array]:
        """Return the expected detections of landmarks of the state in H, (m, 2), and the derivatives (m, 2, 6).

        The derivatives are those with respect to the pose, the bias, and the landmark itself.
        """
        R_HW = rotation(-state.mean[2])
        d = (state.mean[_FIXED:].reshape(-1, 2)[rows] - state.mean[:2]) @ R_HW.T
        ray = d - np.asarray(self.sensor)
        length = np.maximum(np.hypot(*ray.T), 1e-3)[:, None]
        along = ray / length
        bias = state.mean[_BIAS]
        # The derivative of d + b along, with respect to d.
        across = np.eye(2) - along[:, :, None] * along[:, None, :]
        D = np.eye(2) + (bias / length)[:, :, None] * across
        H = np.empty((len(rows), 2, 6))
        H[:, :, 4:] = D @ R_HW
        H[:, :, :2] = -H[:, :, 4:]
        H[:, :, 2] = np.einsum("nij,nj->ni", D, d[:, ::-1] * [1.0, -1.0])
        H[:, :, 3] = along
        return d + bias * along, H

    # -- association

    def _associate(self, state: TrackState, landmarks: Landmarks) -> _Found:
        near = self._nearby(state, landmarks)
        if not len(near):
            return _NOTHING
        extended = self._extended(state, near[~np.isin(near, state.indices)])
        rows = np.flatnonzero(np.isin(extended.indices, near))
        expected, H = self._expected(extended, rows)
        # Covariances of all expected detections with each other, (m, m, 2, 2).
        joint = _times(H, rows, _times_transpose(extended.covariance, H, rows))
        joint = joint.reshape(len(rows), 2, len(rows), 2).transpose(0, 2, 1, 3) + self.scan_deviation**2 * np.eye(2)
        innovations = landmarks.positions[:, None] - expected
        spread = joint[np.arange(len(rows)), np.arange(len(rows))] + self._noise(landmarks)[:, None]
        squares = _squared_distance(innovations, spread)
        threshold = chi_square_quantile(self.gate, 2)
        i, j = np.nonzero(squares < threshold)
        if not len(i):
            return _NOTHING
        nu, S = innovations[i, j], spread[i, j]
        best, determinant = _agreeing(i, j, nu, S, joint, threshold)
        diameter = self._diameter_cost(landmarks, i, extended.indices[rows][j])
        cost = best + np.log(determinant) + diameter
        value = np.zeros(squares.shape)
        is_possible = best < threshold
        value[i, j] = np.where(is_possible, 1.0 + cost[is_possible].max() - cost, 0.0)
        one, two = linear_sum_assignment(value, maximize=True)
        is_pair = value[one, two] > 0.0
        one, two = one[is_pair], two[is_pair]
        density = np.zeros(squares.shape)
        density[i, j] = np.exp(-0.5 * cost) / (2.0 * np.pi)
        area = 0.5 * self.field_of_view * max(1.0, float((landmarks.positions**2).sum(axis=1).max()))
        others = _OTHERS * len(landmarks) / area
        rivals = density.sum(axis=0) + density.sum(axis=1)[:, None] - density
        probability = (density / (others + rivals))[one, two]
        indices = extended.indices[rows[two]]
        found = _Found(np.column_stack([one, indices]), squares[one, two], probability)
        is_first = (probability >= _LEAST_PROBABILITY) & (found.squares < chi_square_quantile(self.first_gate, 2))
        return found.select(np.isin(indices, state.indices) | is_first)

    def _nearby(self, state: TrackState, landmarks: Landmarks) -> Indices:
        """Return the landmarks of the map that can be within the gate of a detection."""
        places = transform(state.pose, landmarks.positions)
        P, levers = state.pose_covariance, (landmarks.positions**2).sum(axis=1)
        own = np.trace(landmarks.covariances, axis1=1, axis2=2)
        variances = own + P[0, 0] + P[1, 1] + levers * P[2, 2]
        gate = chi_square_quantile(self.gate, 2)
        found = self._tree.query_ball_point(places, np.sqrt(gate * (variances + self._variances.max())))
        rows = np.repeat(np.arange(len(places)), [len(one) for one in found])
        near = np.concatenate([*found, []]).astype(np.int64)
        squares = ((self._tree.data[near] - places[rows]) ** 2).sum(axis=1)
        return self._usable[np.unique(near[squares <= gate * (variances[rows] + self._variances[near])])]

    def _diameter_cost(self, landmarks: Landmarks, seen: Indices, indices: Indices) -> Array:
        """Return -2 times the log-likelihood ratio of diameters, of a right pair against any landmark of the map."""
        all_diameters, measured = self.landmarks.diameters, landmarks.diameters[seen]
        noise = np.minimum(landmarks.diameter_deviations[seen], _NO_DIAMETER) ** 2 + self.least_deviation**2
        own = np.minimum(self.landmarks.diameter_deviations[indices], _NO_DIAMETER) ** 2 + noise
        other = all_diameters.var() + noise
        ratio = (measured - all_diameters[indices]) ** 2 / own + np.log(own / other)
        # A diameter that is known no better than those of all carries no information.
        cost = np.where(own < other, ratio - (measured - all_diameters.mean()) ** 2 / other, 0.0)
        return np.minimum(cost, _DIAMETER_CAP)

    # -- health

    def _is_elsewhere(self, state: TrackState, landmarks: Landmarks, pairs: Indices) -> bool:
        """Return whether a scan with these pairs of detection and landmark fails, see `Tracker`."""
        matched, again = len(pairs), int(np.isin(pairs[:, 1], state.indices).sum())
        recent = state.mean[_FIXED:].reshape(-1, 2)[state.is_recent]
        # Near the largest distance of detections, landmarks are not seen reliably.
        reach = 0.7 * np.hypot(*landmarks.positions.T).max()
        expected = int((np.hypot(*(recent - state.mean[:2]).T) < reach).sum())
        few = len(landmarks) >= _JUDGED_FROM and matched < _LEAST_SHARE * len(landmarks)
        return few or (expected >= _JUDGED_FROM and again < _LEAST_AGAIN * expected)

    def _evidence(self, squares: Array) -> float:
        """Return the log-likelihood ratio of first matches, right against by chance, from their d² (k,)."""
        ratio = 0.5 * chi_square_quantile(self.first_gate, 2) * np.exp(-0.5 * squares)
        return float(np.log(_CHANCE + (1.0 - _CHANCE) * ratio).sum())


def _agreeing(i: Indices, j: Indices, nu: Array, S: Array, joint: Array, threshold: float) -> tuple[Array, Array]:
    """Return the d² (k,) of pairs after conditioning on the one with which most others agree.

    Also returned are the determinants, (k,) in m^4, of the conditional covariances; that pair keeps its own.

    Args:
        i: The detections of the pairs, (k,).
        j: The landmarks of the pairs, (k,), as rows of ``joint``.
        nu: Their innovations, (k, 2).
        S: The covariances of those, (k, 2, 2).
        joint: The covariances of all expected detections with each other, (m, m, 2, 2).
        threshold: The largest d² of pairs that agree.
    """
    chosen = np.unique(np.linspace(0, len(i) - 1, _HYPOTHESES).astype(int))
    C = joint[j[:, None], j[chosen]]
    gain = C @ np.linalg.inv(S[chosen])
    rest = nu[:, None] - np.einsum("pqij,qj->pqi", gain, nu[chosen])
    spread = S[:, None] - gain @ C.transpose(0, 1, 3, 2)
    spread[chosen, np.arange(len(chosen))] = S[chosen]
    squares = _squared_distance(rest, spread)
    is_itself = np.arange(len(i))[:, None] == chosen
    is_rival = (i[:, None] == i[chosen]) | (j[:, None] == j[chosen])
    squares = np.where(is_itself, 0.0, np.where(is_rival, np.inf, squares))
    agreement = np.zeros((i.max() + 1, len(chosen)))
    np.maximum.at(agreement, i, np.maximum(threshold - squares, 0.0))
    best = np.argmax(agreement.sum(axis=0))
    return squares[:, best], np.maximum(np.linalg.det(spread[:, best]), 1e-12)


def _drift(before: TrackState, after: TrackState) -> float:
    """Return the factor of the variance of dead reckoning after a scan that was fused, see `Tracker`."""
    change = after.pose - before.pose
    D = before.pose_covariance - after.pose_covariance
    # Directions of which the scan says nothing have no variance, and no change.
    values, directions = np.linalg.eigh(D / np.outer(_SCALES, _SCALES))
    along = directions.T @ (change / _SCALES)
    says = values > 1e-3 * values.max()
    if not says.any() or values.max() <= 0.0:
        return before.drift
    ratio = float((along[says] ** 2 / values[says]).mean())
    return min(max(1.0, before.drift * (1.0 + _FOLLOWS * (min(ratio, _LARGEST_RATIO) - 1.0))), _LARGEST_DRIFT)


def _variance_within(gate: float) -> float:
    """Return the variance, per axis, of the share of a standard normal distribution in the plane that passes a gate."""
    return 1.0 + 0.5 * (1.0 - 1.0 / gate) * chi_square_quantile(gate, 2)


def _corrected(mean: Array, P: Array, step: Array) -> tuple[Array, Array]:
    """Return the estimate after a correction, and its covariance.

    Args:
        mean: The estimate before, (N,).
        P: The covariance after the correction, as errors displace points about that estimate, (N, N).
        step: The correction to first order, (N,).
    """
    J, turn, around = rotation(pi / 2.0), step[2], mean[_FIXED:].reshape(-1, 2) - mean[:2]
    corrected = mean + step
    # Landmarks turn about the carrier on arcs, not on tangents.
    corrected[_FIXED:] += (around @ (rotation(turn) - np.eye(2) - turn * J).T).ravel()
    # An error of the heading displaces the corrected points by this much more.
    lever = np.zeros(len(mean))
    lever[:2] = J @ step[:2]
    lever[_FIXED:] = ((corrected - mean)[_FIXED:].reshape(-1, 2) @ J.T).ravel()
    P = P + np.outer(lever, P[2])
    return corrected, P + np.outer(P[:, 2], lever)


def _without(state: TrackState, dropped: NDArray[np.bool_]) -> TrackState:
    """Return the state without the landmarks for which the mask (n,) is true."""
    if not dropped.any():
        return state
    kept = np.concatenate([np.ones(_FIXED, dtype=bool), np.repeat(~dropped, 2)])
    return state.with_arrays(
        mean=state.mean[kept],
        covariance=state.covariance[np.ix_(kept, kept)],
        indices=state.indices[~dropped],
        is_recent=state.is_recent[~dropped],
    )


def _rows_of(indices: Indices, wanted: Indices) -> Indices:
    """Return where each of the wanted values stands in indices, which have it once."""
    order = np.argsort(indices)
    return order[np.searchsorted(indices, wanted, sorter=order)]


def _columns(rows: Indices) -> Indices:
    """Return the places in x of landmarks, shape (m, 2)."""
    return _FIXED + 2 * rows[:, None] + np.arange(2)


def _times_transpose(P: Array, H: Array, rows: Indices) -> Array:
    """Return P Hᵀ, shape (N, 2 m), for derivatives (m, 2, 6)."""
    own = np.einsum("Nmj,mij->Nmi", P[:, _columns(rows)], H[:, :, _SEEN:])
    return P[:, :_SEEN] @ H[:, :, :_SEEN].reshape(-1, _SEEN).T + own.reshape(len(P), -1)


def _times(H: Array, rows: Indices, columns: Array) -> Array:
    """Return H times columns (N, k), shape (2 m, k), for derivatives (m, 2, 6)."""
    return _times_transpose(columns.T, H, rows).T


def _squared_distance(nu: Array, S: Array) -> Array:
    """Return νᵀ S⁻¹ ν for innovations (..., 2) and covariances (..., 2, 2)."""
    x, y = nu[..., 0], nu[..., 1]
    determinant = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]
    squares: Array = S[..., 1, 1] * x**2 - (S[..., 0, 1] + S[..., 1, 0]) * x * y + S[..., 0, 0] * y**2
    return squares / np.maximum(determinant, 1e-12)
