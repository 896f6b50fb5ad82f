"""Tracking of a carrier among landmarks of a map, from a first pose on: simultaneous localization and map refinement.

The state x = [X_WH; b; e; g; f; l_1; ...; l_n] holds the planar pose of the carrier, the range bias b of the detector,
three lasting errors e, g and f of dead reckoning, and the true positions l_i (in W) of those landmarks of the map that
have been seen. Each landmark enters the state once, with its position on the map and the error of the map as the prior;
from then on it is refined by detections, and correlated with the pose. A filter that takes the map's error as
independent in each scan would become overconfident, because it is the same error. A detection z of landmark l in the
level frame H is

    z = d + b (d - s) / |d - s| + noise,    d = R_WHᵀ (l - p_WoHo_W),    s = p_HoLo_H,

where s is the position of the scanner; for a sensor of another kind beside it (`SensorView.is_scan`), b is 0. This is
EKF-SLAM with a map (Durrant-Whyte and Bailey, "Simultaneous localization and mapping: part I", IEEE Robotics &
Automation Magazine 13, 2006). Landmarks far behind are marginalized.

The heading of a plain extended Kalman filter becomes overconfident. Scans show the positions of landmarks relative to
the carrier, so that a common rotation of both is not observable; but with derivatives at estimates that change from
scan to scan, it seems to be (Huang, Mourikis and Roumeliotis, "Observability-based rules for designing consistent EKF
SLAM estimators", International Journal of Robotics Research 29, 2010). Therefore the errors here are defined as in the
right-invariant filter (Barrau and Bonnabel, "An EKF-SLAM algorithm with consistency properties", arXiv:1510.06263,
2015): an error θ of the heading displaces the carrier and each landmark, at a point p, by θ J p, where J is the
rotation by a right angle. A correction is applied by the exponential map of these errors: with the turn θ, a point
moves by V(θ) times its step to first order, V(θ) = [sin θ I + (1 - cos θ) J] / θ. So what turns with the carrier moves
on an arc, and what the map holds stays in its place.

Dead reckoning measures a motion [t; turn] in the time T. It is too long by its share e, its gyros have the bias g, and
its turns are too large by their share f:

    true motion = [(1 - e) R(-δ / 2) t; turn - δ] + noise,    δ = g T + f turn.

e and f are first-order Gauss-Markov processes over the distance travelled, because the slip of wheels depends on the
slope; g is a random walk in time. With a steering angle in place of gyros, T is the distance, g an error of the
curvature, and f one of the angle's scale, which is another one in a sharper curve. Noise alone, independent from step
to step, would be too small after a minute, or a curve, without landmarks. e, g and f are estimated while landmarks are
seen.

Errors of a map may be correlated: neighbours are displaced alike. With M_ij = c σ_i σ_j exp(-r_ij² / (2 L²)) +
(1 - c) σ_i² δ_ij for the errors of the landmarks, per axis, the prior of a landmark that is seen for the first time is
its distribution given the errors of those in the state (simple kriging). So a new landmark is expected to be displaced
like its neighbours.

Errors of detections may last: a trunk that leans or is no circle is detected beside its axis in scan after scan. Of
the variance, the share w (``lasting_share``) has the correlation ρ = exp(-d / λ) from one sight of a landmark to the
next, after the way d; in the sum of many sights, such errors count as independent ones with (1 + ρ) / (1 - ρ) times
their variance. So the variance R of a detection is R [1 + 2 w ρ / (1 - ρ)] in the correction, but R in the association
and in the test of the innovation. Who stands still learns nothing from further scans.

A detection may show something beside the landmark that it is matched with. Where few landmarks are seen, nothing
contradicts it, and most of all where the pose was uncertain, it moves the pose by much. With ``stray_density``, the
association weighs all joint associations of the scan, also those that contradict the pairs that are fused. By each of
them, some of these pairs are right, and the others are wrong and say nothing. The estimate is the mean of these
hypotheses' estimates, and its covariance contains how far they lie apart, as in the filter with joint probabilistic
data association (Fortmann, Bar-Shalom and Scheffe, "Sonar tracking of multiple targets using joint probabilistic data
association", IEEE Journal of Oceanic Engineering 8, 1983).

A scan with a single match is fused if the landmark is in the state; a first match needs another one that agrees. After
a scan that failed, all matches have to be as probable as first matches.

If the map is revised (``revises``), a detection that can show no landmark of the map and none of the state begins a
landmark that the map lacks. With the pose, the bias and the noise of the detection it has the position

    l = p_WoHo_W + R_WH (z - b (z - s) / |z - s|),

and is correlated with the pose and with all other landmarks accordingly. From then on it is tracked as the others are.
So the uncertainty of the pose grows where there are no landmarks of the map, and landmarks that were begun there are
corrected when the pose is, by landmarks that are seen again. (The farther landmarks are not left to a graph of poses:
the filter has their covariances at hand, which the association needs in each scan.) Landmarks that are gone are
dropped; see `vtbdrake.components.localization.revision`.

`vtbdrake.components.localization.landmark_association` decides which landmark each detection shows,
`vtbdrake.components.localization.health` whether the estimate may be used.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf, pi, sin

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve

from vtbdrake.common.arrays import Array, Indices
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.estimation import chi_square_quantile, one_to_one, squared_distances
from vtbdrake.components.localization import health, map_errors
from vtbdrake.components.localization.landmark_association import Association, ExpectedDetections, MatchedPairs
from vtbdrake.components.localization.landmarks import Landmarks, SensorView
from vtbdrake.components.localization.map_errors import ShownErrors
from vtbdrake.components.localization.planar import compose, rotation
from vtbdrake.components.localization.revision import MapChanges, is_in_plain_view, places_of
from vtbdrake.components.localization.track_state import (
    BIAS,
    ODOMETRY,
    RATE,
    TURN,
    TrackState,
    in_level_frame,
)

# The number of leading elements of x on which a detection depends, beside the landmark.
_OBSERVED = 4

# Standard deviations in m and rad of a pose without information.
_LOOSE = np.array([5.0, 5.0, 0.2])

# What lies within this share of right pairs around a landmark may be the landmark: it does not show that the landmark
# is gone, and is no other one.
_WIDE_GATE = 0.9999
# The gap between the barks of two trunks in m below which a detector does not separate them.
_LEAST_GAP = 0.3


@dataclass(frozen=True, eq=False)
class Matches:
    """The matches of a scan with the map.

    Attributes:
        pairs: Indices of the detection and of the landmark on the map, shape (k, 2); landmarks that the map lacks are
            numbered from its size on.
        nis: The normalized innovation squared of the pairs: chi-square distributed with 2 k degrees of freedom.
        is_fused: Whether the scan changed the estimate.
    """

    pairs: Indices
    nis: float = 0.0
    is_fused: bool = False


_NO_MATCHES = Matches(np.zeros((0, 2), dtype=np.intp))


@dataclass(frozen=True, eq=False)
class Tracker:
    """The filter described in the module, for one map.

    A scan is associated with the map; of its matches, the worst are dropped until the joint innovation is probable. The
    prior covariance of a landmark that is matched for the first time (given its neighbours) is divided by p², where p
    is the probability of the match. It is also multiplied by the share of the variance that passes ``first_gate``,
    0.84: landmarks with the largest errors on the map are never matched.

    The estimate must not be used while the track `is_doubtful`, and no more once it `is_lost`.

    Landmarks that were marginalized enter anew if the carrier comes back, and their map error is then used twice:
    ``horizon`` and ``most`` must be so large that the state holds the landmarks of a whole closed route. Landmarks of
    which the map is less certain than ``largest_deviation`` are not used.

    Attributes:
        landmarks: The map, in W.

    Raises:
        ValueError: The map is empty, or a setting is outside of its range.
    """

    landmarks: Landmarks
    sensor: tuple[float, float] = setting(
        (0.0, 0.0), "The position s = p_HoLo_H of the scanner in the plane.", unit="m"
    )
    field_of_view: float = setting(
        2.0 * pi,
        "The horizontal field of view, for the density of detections; a `SensorView` may have a narrower one.",
        unit="rad",
        gt=0.0,
        le=2.0 * pi,
    )
    bias_deviation: float = setting(0.03, "Standard deviation of the range bias; assumed.", unit="m", ge=0.0)
    odometry_deviation: float = setting(0.02, "Standard deviation of e; assumed.", ge=0.0)
    odometry_length: float = setting(
        20.0, "The distance over which e loses two thirds of its correlation; assumed.", unit="m", gt=0.0, finite=False
    )
    rate_deviation: float = setting(
        5e-4,
        "Standard deviation of g, the residual bias of the gyros in dead reckoning; assumed.",
        unit="rad/s",
        ge=0.0,
    )
    rate_walk: float = setting(2e-5, "Random walk of g; assumed.", unit="rad/s^1.5", ge=0.0)
    least_deviation: float = setting(
        0.005,
        "Standard deviation that is added to the deviations of detections, per axis; calibrated with simulated scans "
        "of `vtbdrake_diagrams.forest` and an exact map.",
        unit="m",
        ge=0.0,
    )
    scan_deviation: float = setting(
        0.0,
        "Standard deviation, per axis, of the common displacement of all detections of a scan; assumed.",
        unit="m",
        ge=0.0,
    )
    correlation: float = setting(
        0.0, "Correlation length L of the map's errors; 0 if they are independent.", unit="m", ge=0.0
    )
    correlated_share: float = setting(
        0.98, "The share c of the variance of the map that is correlated; assumed.", ge=0.0, lt=1.0
    )
    gate: float = setting(0.997, "The share of right pairs that the gate lets pass.", gt=0.0, lt=1.0)
    first_gate: float = setting(
        0.95,
        "The same of first matches, whose gate is narrower: on the map, another landmark may be near.",
        gt=0.0,
        lt=1.0,
    )
    horizon: float = setting(
        100.0, "Distance from the carrier beyond which landmarks are marginalized.", unit="m", gt=0.0, finite=False
    )
    most: int = setting(400, "The largest number of landmarks in the state; the farthest are marginalized.", ge=1)
    patience: int = setting(3, "The number of failures in succession after which the track is lost.", ge=1)
    credit: float = setting(12.0, "The upper limit of the evidence.", gt=0.0, finite=False)
    first_credit: float = setting(
        6.0,
        "The evidence at the start; it is less than ``credit``, so that a wrong start ends sooner.",
        gt=0.0,
        finite=False,
    )
    largest_deviation: float = setting(
        2.0,
        "The largest standard deviation of the position, per axis, with which a track goes on.",
        unit="m",
        gt=0.0,
        finite=False,
    )
    distortion_gate: float = setting(
        0.99999, "The share of right maps that are not doubtful in one test of the distortion.", gt=0.0, lt=1.0
    )
    lasting_share: float = setting(
        0.0,
        "The share w of the variance of one sensor's detections that lasts while a landmark is seen.",
        ge=0.0,
        lt=1.0,
    )
    lasting_length: float = setting(
        8.0, "The distance λ over which that share loses two thirds of its correlation; assumed.", unit="m", gt=0.0
    )
    revises: bool = setting(
        False, "Whether landmarks that the map lacks are added, and landmarks that are gone are dropped."
    )
    lasting_deviation: float = setting(
        0.018,
        "Standard deviation, per axis, of the error that all detections of a landmark have in common, as by bark and "
        "lean. It is in the covariances of added landmarks; their detections are fused as independent. Calibrated with "
        "simulated scans of `vtbdrake_diagrams.forest`, whose trunks lean by 0.01 rad.",
        unit="m",
        ge=0.0,
    )
    stray_density: float = setting(
        0.0,
        "The density of detections of something else around a landmark of the map; 0: pairs in the gates count as "
        "right.",
        unit="1/m^2",
        ge=0.0,
    )
    turn_deviation: float = setting(
        0.0,
        "Standard deviation of f, the error of the scale of turns, which lasts as long as e; 0, as for gyros: none is "
        "estimated.",
        ge=0.0,
    )
    _association: Association = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not len(self.landmarks):
            raise ValueError("the map of a tracker is empty: localization needs landmarks")
        check_settings(self)
        variances = np.linalg.eigvalsh(self.landmarks.covariances)[:, -1]
        usable = np.flatnonzero(variances <= self.largest_deviation**2)
        if not len(usable):
            raise ValueError(
                f"no landmark of the map is certain within largest_deviation={self.largest_deviation:g} m: the best "
                f"one has a standard deviation of {np.sqrt(variances.min()):g} m"
            )
        # Variances of an expected detection without the pose's: of the landmark, of the bias and of the scan.
        spread = variances[usable].astype(float) + self.bias_deviation**2 + self.scan_deviation**2
        association = Association(self.landmarks, usable, spread, self.gate, self.first_gate, self.stray_density)
        object.__setattr__(self, "_association", association)

    def start(
        self,
        X_WH: ArrayLike,
        covariance: ArrayLike,
        landmarks: Landmarks | SensorView | None = None,
        *,
        before: ShownErrors | None = None,
    ) -> tuple[TrackState, Matches]:
        """Return the state at a first pose, and the matches of what is seen there.

        With detections, the pose is assumed to come from the same map, whose errors must not be used twice: the
        covariance serves for the association only, and the estimate is computed from the matched pairs alone.

        Args:
            X_WH: The pose, shape (3,).
            covariance: The covariance of the pose, shape (3, 3).
            landmarks: Detections in H at that pose; None starts with the given covariance.
            before: The errors of the map that an earlier track has shown, its `TrackState.gone`; none by default.
        """
        gone = ShownErrors() if before is None else before
        pose = np.array(X_WH, dtype=float)
        state = self._at(pose, np.array(covariance, dtype=float), gone)
        if landmarks is None:
            return state, _NO_MATCHES
        view = self._widened(landmarks)
        matches = self._associate(state, view).first(self.most)
        loose = self._at(pose, np.diag(_LOOSE**2), gone)
        return self._fused(self._extended(loose, matches.pairs[:, 1], matches.probability), view, matches)

    def predict(self, state: TrackState, motion: ArrayLike, covariance: ArrayLike, *, extent: float) -> TrackState:
        """Return the state after a motion.

        Args:
            state: The state before.
            motion: The pose of the carrier afterwards in its frame before, by dead reckoning, shape (3,).
            covariance: The covariance of its noise, shape (3, 3).
            extent: Extent of the error g of the heading, see `DriftModel.extent`: the duration of the motion in s.
        """
        measured = np.asarray(motion, dtype=float)
        mean, P, heading = state.mean.copy(), state.covariance.copy(), state.mean[2]
        # How much the errors g and f turn the carrier, each of size 1.
        first = state.first_landmark
        levers = np.array([extent, measured[2]])[: first - RATE]
        turned = float(levers @ mean[RATE:first])
        way = rotation(-turned / 2.0) @ measured[:2]
        move = np.array([*((1.0 - mean[ODOMETRY]) * way), measured[2] - turned])
        F, G = np.eye(3), block_diag(rotation(heading), 1.0)
        F[:2, 2] = rotation(heading + np.pi / 2.0) @ move[:2]
        # The derivatives of the pose with respect to e, g and f.
        along, by_turn = np.array([*way, 0.0]), np.array([-0.5 * move[1], 0.5 * move[0], 1.0])
        B = -G @ np.column_stack([along, np.outer(by_turn, levers)])
        mean[:3] = compose(mean[:3], move)
        P[:3] = F @ P[:3] + B @ P[ODOMETRY:first]
        P[:, :3] = P[:, :3] @ F.T + P[:, ODOMETRY:first] @ B.T
        P[:3, :3] += state.drift * G @ np.asarray(covariance, dtype=float) @ G.T
        P[RATE, RATE] += self.rate_walk**2 * abs(extent)
        decay = float(np.exp(-np.hypot(*measured[:2]) / self.odometry_length))
        for row, deviation in ((ODOMETRY, self.odometry_deviation), (TURN, self.turn_deviation)):
            if row < first:
                mean[row] *= decay
                P[row] *= decay
                P[:, row] *= decay
                P[row, row] += (1.0 - decay**2) * deviation**2
        travelled = state.travelled + float(np.hypot(*measured[:2]))
        return replace(state.with_arrays(mean=mean, covariance=P), travelled=travelled)

    def update(self, state: TrackState, landmarks: Landmarks | SensorView) -> tuple[TrackState, Matches]:
        """Return the state after a scan, and its matches.

        Args:
            state: The state at the time of the scan.
            landmarks: The detections, in H.
        """
        view = self._widened(landmarks)
        if not len(view.landmarks):
            return state, _NO_MATCHES
        matches = self._associate(state, view)
        failed = replace(
            state.with_arrays(unjudged=np.zeros((3, 2))),
            failures=state.failures + 1,
            drift=health.drift_after_failure(state),
        )
        fails, unjudged = self._judged(state, view, matches.pairs)
        if fails:
            return failed, Matches(matches.pairs)
        is_first = ~np.isin(matches.pairs[:, 1], state.indices)
        # A first match alone has nothing that agrees with it; one of a landmark in the state does not need it.
        if len(matches.pairs) < 2 and is_first.all():
            return self._revised(state.with_arrays(unjudged=unjudged), view, matches.pairs), Matches(matches.pairs)
        first = matches.select(is_first)
        extended = self._extended(state, first.pairs[:, 1], first.probability)
        ordered = matches.select(np.argsort(is_first, kind="stable"))
        fused, remaining = self._fused(extended, view, ordered)
        # Too few of the pairs may be left.
        fails, unjudged = self._judged(state, view, remaining.pairs)
        if fails:
            return failed, Matches(remaining.pairs)
        evidence = min(self.credit, state.evidence + health.evidence(first.squares, self.first_gate))
        drift = health.drift_after(state, fused) if remaining.is_fused else state.drift
        fused = fused.with_arrays(unjudged=unjudged)
        failures = 0 if remaining.is_fused else state.failures
        fused = replace(fused, evidence=evidence, failures=failures, drift=drift)
        return self._revised(fused, view, remaining.pairs) if remaining.is_fused else fused, remaining

    def is_lost(self, state: TrackState) -> bool:
        """Return whether the track is lost, so that its pose must not be used any more."""
        return health.is_lost(
            state,
            patience=self.patience,
            largest_deviation=self.largest_deviation,
            distortion_gate=self.distortion_gate,
        )

    def is_doubtful(self, state: TrackState) -> bool:
        """Return whether the last scan failed or the map seems distorted, so that the pose must not be used now."""
        return health.is_doubtful(state, distortion_gate=self.distortion_gate)

    def pose_covariance(self, state: TrackState) -> Array:
        """Return the covariance of X_WH, (3, 3), larger than the filter's if the map seems distorted."""
        return state.pose_covariance * health.widening(state)

    def changes(self, state: TrackState) -> MapChanges:
        """Return the differences of the map from what the drive has shown so far; none if it is not revised.

        A landmark that the map lacks may be one whose error on the map is too large for a match. If one of the same
        diameter that is not matched is that near, the two are taken for the same: it is moved, not added.
        """
        is_added = ~self._is_mapped(state.indices) & np.isin(state.indices, state.revision.sure)
        rows = np.flatnonzero(is_added)
        places = state.landmark_positions[rows]
        covariances = np.array([state.covariance[np.ix_(columns, columns)] for columns in state.landmark_columns(rows)])
        diameters, deviations = self._sizes(state, state.indices[rows])
        covariances = covariances.reshape(-1, 2, 2) + self.lasting_deviation**2 * np.eye(2)
        landmarks = Landmarks(places, covariances, diameters, deviations)
        unmatched = np.setdiff1d(self._association.usable, state.indices)
        on_map = self.landmarks.select(unmatched)
        squares = squared_distances(
            places[:, None] - on_map.positions, landmarks.covariances[:, None] + on_map.covariances
        )
        variances = landmarks.diameter_deviations[:, None] ** 2 + on_map.diameter_deviations**2
        squares += (landmarks.diameters[:, None] - on_map.diameters) ** 2 / np.maximum(variances, 1e-6)
        moved, origins = one_to_one(chi_square_quantile(_WIDE_GATE, 3) - squares)
        added = landmarks.select(np.setdiff1d(np.arange(len(landmarks)), moved))
        gone = state.revision.gone
        gone = np.setdiff1d(gone[self._is_mapped(gone)], unmatched[origins])
        return MapChanges(added, gone, landmarks.select(moved), unmatched[origins])

    def _widened(self, landmarks: Landmarks | SensorView) -> SensorView:
        view = SensorView.of(landmarks)
        return replace(view, landmarks=view.landmarks.widened(self.least_deviation))

    def _at(self, X_WH: Array, covariance: Array, gone: ShownErrors) -> TrackState:
        lasting = [self.bias_deviation, self.odometry_deviation, self.rate_deviation]
        # An error that is none needs no place in x.
        lasting += [self.turn_deviation] * (self.turn_deviation > 0.0)
        P = block_diag(covariance, np.diag(lasting) ** 2)
        mean = np.concatenate([X_WH, np.zeros(len(lasting))])
        scatter = map_errors.scatter(gone)
        return replace(
            TrackState.none(), mean=mean, covariance=P, evidence=self.first_credit, scatter=scatter, gone=gone
        )

    def _extended(self, state: TrackState, indices: Indices, probability: Array | None = None) -> TrackState:
        """Return the state with further landmarks of the map, (m,), which it does not have yet.

        Args:
            state: The state.
            indices: The indices of these landmarks on the map.
            probability: The probabilities of their first matches, (m,); by default nothing was matched.
        """
        places, variances = self.landmarks.positions, self.landmarks.covariances
        mean, P, n, m = state.mean, state.covariance, len(state.indices), len(indices)
        doubt = np.ones(m) if probability is None else probability**-2.0
        factor = doubt if probability is None else _variance_within(self.first_gate) * doubt
        if self.correlation == 0.0:
            prior = block_diag(np.zeros((0, 0)), *((state.scatter * factor)[:, None, None] * variances[indices]))
            J, added = np.zeros((2 * m, 2 * n)), places[indices]
        else:
            is_mapped = self._is_mapped(state.indices)
            mapped = state.indices[is_mapped]
            k = len(mapped)
            M = self._map_covariance(np.concatenate([mapped, indices]))
            weights = np.linalg.solve(M[:k, :k], M[:k, k:])
            rest = M[k:, k:] - M[k:, :k] @ weights
            if probability is not None:
                # The variance of the error of each landmark, given the errors of all others, times the factor.
                rest = rest + np.diag((factor - 1.0) / np.diagonal(np.linalg.inv(M))[k:])
            prior, J = np.kron(state.scatter * rest, np.eye(2)), np.zeros((2 * m, 2 * n))
            J[:, np.repeat(is_mapped, 2)] = np.kron(weights.T, np.eye(2))
            added = places[indices] + weights.T @ (state.landmark_positions[is_mapped] - places[mapped])
        first = state.first_landmark
        cross = J @ P[first:]
        return state.with_arrays(
            mean=np.concatenate([mean, added.ravel()]),
            covariance=np.block([[P, cross.T], [cross, cross[:, first:] @ J.T + prior]]),
            indices=np.concatenate([state.indices, indices]),
            is_recent=np.concatenate([state.is_recent, np.zeros(m, dtype=bool)]),
            seen_at=np.concatenate([state.seen_at, np.full(m, -inf)]),
            factors=np.concatenate([state.factors, state.scatter * doubt]),
        )

    def _map_covariance(self, indices: Indices) -> Array:
        """Return M of the errors of landmarks on the map, (m, m) in m²; (m,) if they are independent."""
        variances = np.maximum(np.trace(self.landmarks.covariances[indices], axis1=1, axis2=2) / 2.0, 1e-6)
        if self.correlation == 0.0:
            return variances
        places, deviations = self.landmarks.positions[indices], np.sqrt(variances)
        squares = ((places[:, None] - places[None]) ** 2).sum(axis=2)
        M: Array = (
            self.correlated_share * np.exp(-0.5 * squares / self.correlation**2) * np.outer(deviations, deviations)
        )
        M[np.diag_indices_from(M)] = variances
        return M

    def _associate(self, state: TrackState, view: SensorView) -> MatchedPairs:
        """Return the matches of detections with the map around the pose of a state."""
        detections = view.landmarks
        near = self._association.nearby(state.pose, state.pose_covariance, detections, scatter=state.scatter)
        if self.revises:
            is_near = np.isin(state.indices, self._around(state, view)) & ~self._is_mapped(state.indices)
            near = np.union1d(np.setdiff1d(near, state.revision.gone), state.indices[is_near])
        if not len(near):
            return MatchedPairs.none()
        expected = self._expected_of(state, near, view)
        # In doubt, landmarks of the state are believed no more than those that are seen for the first time.
        expected = replace(expected, is_first=expected.is_first | (state.failures > 0))
        return self._association.matched(
            detections,
            expected,
            field_of_view=min(self.field_of_view, view.field_of_view),
            sizes=self._sizes(state, expected.indices),
        )

    def _expected_of(self, state: TrackState, identities: Indices, view: SensorView) -> ExpectedDetections:
        """Return the detections that are expected of landmarks, (m,), also of some that the state does not have yet."""
        extended = self._extended(state, identities[~np.isin(identities, state.indices)])
        rows = np.flatnonzero(np.isin(extended.indices, identities))
        positions, H = self._expected(extended, rows, is_scan=view.is_scan)
        columns = extended.landmark_columns(rows)
        HPHt = _times(H, columns, _times_transpose(extended.covariance, H, columns))
        covariance = HPHt.reshape(len(rows), 2, len(rows), 2).transpose(0, 2, 1, 3) + self.scan_deviation**2 * np.eye(2)
        return ExpectedDetections(extended.indices[rows], rows >= len(state.indices), positions, covariance)

    def _fused(self, state: TrackState, view: SensorView, matches: MatchedPairs) -> tuple[TrackState, Matches]:
        """Return the state after the fusion of matched detections, of landmarks in the state."""
        detections, is_weighed = view.landmarks, len(matches.weights) > 1
        # The worst pairs are dropped until the joint innovation is probable; their landmarks stay in the state.
        while len(pairs := matches.pairs):
            rows = places_of(state.indices, pairs[:, 1])
            expected, H = self._expected(state, rows, is_scan=view.is_scan)
            nu = (detections.positions[pairs[:, 0]] - expected).ravel()
            columns = state.landmark_columns(rows)
            PHt = _times_transpose(state.covariance, H, columns)
            S = _times(H, columns, PHt) + block_diag(*detections.covariances[pairs[:, 0]])
            S += self.scan_deviation**2 * np.tile(np.eye(2), (len(pairs), len(pairs)))
            factor = cho_factor(S, lower=True)
            weighted = cho_solve(factor, nu)
            parts = (nu * weighted).reshape(-1, 2).sum(axis=1)
            if parts.sum() <= chi_square_quantile(self.gate, 2 * len(pairs)):
                break
            worst = np.argmin(matches.probability) if is_weighed else np.argmax(parts)
            matches = matches.select(np.arange(len(pairs)) != worst)
        else:
            return state, _NO_MATCHES
        nis, repeated = float(parts.sum()), self._repeated(state, rows)
        if repeated.any():
            S += block_diag(*(repeated[:, None, None] * detections.covariances[pairs[:, 0]]))
            factor = cho_factor(S, lower=True)
            weighted = cho_solve(factor, nu)
        if is_weighed:
            weighted, information = _mixed(S, nu, matches.is_right, matches.weights)
            P = state.covariance - PHt @ information @ PHt.T
        else:
            P = state.covariance - PHt @ cho_solve(factor, PHt.T)
        mean, P = _corrected(state.mean, 0.5 * (P + P.T), PHt @ weighted, first=state.first_landmark)
        seen_at = state.seen_at.copy()
        seen_at[rows] = state.travelled
        is_in_view = view.is_in_view(in_level_frame(state, state.landmark_positions), share=inf)
        is_recent = np.where(is_in_view, np.isin(state.indices, pairs[:, 1]), state.is_recent)
        fused = state.with_arrays(mean=mean, covariance=P, is_recent=is_recent, seen_at=seen_at)
        distance = np.hypot(*(fused.landmark_positions - mean[:2]).T)
        far = distance > self.horizon
        far[np.argsort(distance)[self.most :]] = True
        return self._with_shown_errors(fused, fused.without(far)), Matches(pairs, nis, is_fused=True)

    def _with_shown_errors(self, fused: TrackState, near: TrackState) -> TrackState:
        """Return the state ``near`` with what it shows of the map's errors; ``fused`` also has the landmarks behind."""
        shown = self._shown_errors(near)
        gone = near.gone
        if len(near.indices) < len(fused.indices):
            whole = self._shown_errors(fused)
            freedom = max(0.0, gone.freedom + whole.freedom - shown.freedom)
            gone = ShownErrors(excess=gone.excess + whole.excess - shown.excess, freedom=freedom)
        scatter = map_errors.scatter(shown, map_errors.scatter(gone))
        return replace(near, distortion=shown.distortion / scatter, scatter=scatter, gone=gone)

    def _shown_errors(self, state: TrackState) -> ShownErrors:
        """Return the errors of the map that the landmarks in a state show."""
        rows = np.flatnonzero(self._is_mapped(state.indices))
        if not len(rows):
            return ShownErrors()
        mapped = state.indices[rows]
        places, columns = self.landmarks.positions[mapped], state.landmark_columns(rows).ravel()
        return map_errors.shown_errors(
            places,
            state.landmark_positions[rows] - places,
            self._map_covariance(mapped),
            state.covariance[np.ix_(columns, columns)],
            _variance_within(self.first_gate) * state.factors[rows],
        )

    def _repeated(self, state: TrackState, rows: Indices) -> Array:
        """Return 2 w ρ / (1 - ρ), by which multiple of themselves the variances of detections grow, (m,).

        Args:
            state: The state.
            rows: The detected landmarks, as places in the state.
        """
        if self.lasting_share == 0.0:
            return np.zeros(len(rows))
        way = (state.travelled - state.seen_at[rows]) / self.lasting_length
        rho = np.exp(-np.maximum(way, 1e-6))
        return 2.0 * self.lasting_share * rho / (1.0 - rho)

    def _is_mapped(self, identities: Indices) -> NDArray[np.bool_]:
        """Return whether landmarks are on the map, not only in the state, (m,)."""
        is_mapped: NDArray[np.bool_] = identities < len(self.landmarks)
        return is_mapped

    def _sizes(self, state: TrackState, identities: Indices) -> tuple[Array, Array]:
        """Return the diameters of landmarks and their standard deviations in m, (m,) each."""
        is_mapped = self._is_mapped(identities)
        mapped, rows = identities[is_mapped], state.revision.rows(identities[~is_mapped])
        sizes = np.empty((2, len(identities)))
        sizes[:, is_mapped] = self.landmarks.diameters[mapped], self.landmarks.diameter_deviations[mapped]
        sizes[:, ~is_mapped] = state.revision.diameters[rows], state.revision.diameter_deviations[rows]
        return sizes[0], sizes[1]

    def _around(self, state: TrackState, view: SensorView) -> Indices:
        """Return the landmarks that are not gone, and as near as the detections of a view, (m,)."""
        radius = float(np.hypot(*view.landmarks.positions.T).max()) + self.largest_deviation
        mapped = self._association.within(state.pose[:2], radius)
        is_near = np.hypot(*(state.landmark_positions - state.pose[:2]).T) < radius
        return np.union1d(np.setdiff1d(mapped, state.revision.gone), state.indices[is_near])

    def _judged(self, state: TrackState, view: SensorView, pairs: Indices) -> tuple[bool, Array]:
        """Return whether a scan with these pairs fails, and what is still to be judged, see `health.judged`."""
        shown = None
        if self.revises:
            around = self._around(state, view)
            mapped = around[self._is_mapped(around)]
            places = in_level_frame(state, self.landmarks.positions[mapped])
            shown = mapped[is_in_plain_view(view, places, self.landmarks.diameters[mapped])]
        return health.judged(state, view, pairs, is_mapped=self._is_mapped(pairs[:, 1]), shown=shown)

    def _revised(self, state: TrackState, view: SensorView, pairs: Indices) -> TrackState:
        """Return the state with what a scan shows of the landmarks around, after the fusion of its matches (k, 2)."""
        if not self.revises:
            return state
        expected = self._expected_of(state, self._around(state, view), view)
        left = np.setdiff1d(np.arange(len(view.landmarks)), pairs[:, 0])
        rest = view.landmarks.select(left)
        offsets = rest.positions[:, None] - expected.positions
        squares = squared_distances(offsets, expected.covariances + rest.covariances[:, None])
        wide = chi_square_quantile(_WIDE_GATE, 2)
        is_hit = np.isin(expected.indices, pairs[:, 1])
        diameters, _ = self._sizes(state, expected.indices)
        is_shown = is_in_plain_view(view, expected.positions, diameters)
        is_judged = is_hit | (is_shown & (squares > wide).all(axis=0))
        judged = expected.indices[is_judged]
        unknown = np.setdiff1d(judged, state.revision.identities)
        matched = view.landmarks.select(pairs[places_of(pairs[:, 1], expected.indices[is_hit]), 0])
        revision = state.revision.with_landmarks(unknown, self.landmarks.select(unknown))
        revision = revision.judged(judged, is_hit[is_judged], state.pose[:2], matched)
        # What lies in the gate of a landmark that was not matched yet may be matched to it later.
        gates = np.where(expected.is_first, chi_square_quantile(self.first_gate, 2), wide)
        gaps = np.hypot(*offsets.transpose(2, 0, 1)) - 0.5 * (rest.diameters[:, None] + diameters)
        is_new = ((squares > gates) & (expected.is_first | (gaps > _LEAST_GAP))).all(axis=1)
        remaining = state.without(np.isin(state.indices, revision.gone))
        begun = self._begun(replace(remaining, revision=revision), view, left[is_new])
        is_kept = self._is_mapped(begun.revision.identities) | np.isin(begun.revision.identities, begun.indices)
        return replace(begun, revision=begun.revision.select(is_kept))

    def _begun(self, state: TrackState, view: SensorView, rows: Indices) -> TrackState:
        """Return the state with landmarks that the map lacks, by their first detections, the given ones of a view."""
        detections, m, P, R_WH = view.landmarks.select(rows), len(rows), state.covariance, rotation(state.mean[2])
        ray = detections.positions - np.asarray(self.sensor)
        along = float(view.is_scan) * ray / np.maximum(np.hypot(*ray.T), 1e-3)[:, None]
        from_carrier = (detections.positions - state.mean[BIAS] * along) @ R_WH.T
        # The derivatives of the positions with respect to the pose and the bias.
        derivatives = np.empty((m, 2, _OBSERVED))
        derivatives[:, :, :2] = np.eye(2)
        derivatives[:, :, 2] = from_carrier[:, ::-1] * [-1.0, 1.0]
        derivatives[:, :, BIAS] = -along @ R_WH.T
        A = derivatives.reshape(2 * m, _OBSERVED)
        noise = block_diag(np.zeros((0, 0)), *(R_WH @ detections.covariances @ R_WH.T))
        noise += self.scan_deviation**2 * np.tile(np.eye(2), (m, m))
        cross = A @ P[:_OBSERVED]
        identities = len(self.landmarks) + state.revision.begun + np.arange(m)
        revision = state.revision.with_landmarks(identities, detections, begun_at=state.pose[:2])
        begun = state.with_arrays(
            mean=np.concatenate([state.mean, (state.mean[:2] + from_carrier).ravel()]),
            covariance=np.block([[P, cross.T], [cross, cross[:, :_OBSERVED] @ A.T + noise]]),
            indices=np.concatenate([state.indices, identities]),
            is_recent=np.concatenate([state.is_recent, np.zeros(m, dtype=bool)]),
            seen_at=np.concatenate([state.seen_at, np.full(m, state.travelled)]),
            factors=np.concatenate([state.factors, np.ones(m)]),
        )
        return replace(begun, revision=revision)

    def _expected(self, state: TrackState, rows: Indices, *, is_scan: bool) -> tuple[Array, Array]:
        """Return the expected detections of landmarks of the state in H, (m, 2), and the derivatives (m, 2, 6).

        The derivatives are those with respect to the pose, the bias, and the landmark itself.
        """
        R_HW = rotation(-state.mean[2])
        d = in_level_frame(state, state.landmark_positions[rows])
        ray = d - np.asarray(self.sensor)
        length = np.maximum(np.hypot(*ray.T), 1e-3)[:, None]
        along = ray / length
        bias = state.mean[BIAS] if is_scan else 0.0
        # The derivative of d + b along, with respect to d.
        across = np.eye(2) - along[:, :, None] * along[:, None, :]
        D = np.eye(2) + (bias / length)[:, :, None] * across
        H = np.empty((len(rows), 2, 6))
        H[:, :, 4:] = D @ R_HW
        H[:, :, :2] = -H[:, :, 4:]
        H[:, :, 2] = np.einsum("nij,nj->ni", D, d[:, ::-1] * [1.0, -1.0])
        H[:, :, 3] = along if is_scan else 0.0
        return d + bias * along, H


def _variance_within(gate: float) -> float:
    """Return the variance, per axis, of the share of a standard normal distribution in the plane that passes a gate."""
    return 1.0 + 0.5 * (1.0 - 1.0 / gate) * chi_square_quantile(gate, 2)


def _mixed(S: Array, nu: Array, is_right: NDArray[np.bool_], weights: Array) -> tuple[Array, Array]:
    """Return a and B, with which the state moves by P Hᵀ a and its covariance falls by P Hᵀ B H P.

    They are the mean and the covariance of a mixture: by each hypothesis, some of k pairs are right.

    Args:
        S: The covariance of the innovations in m², (2 k, 2 k).
        nu: The innovations in m, (2 k,).
        is_right: Which pairs are right by each hypothesis, (h, k).
        weights: The probabilities of the hypotheses, (h,).
    """
    subsets, places = np.unique(is_right, axis=0, return_inverse=True)
    probability = np.bincount(places.ravel(), weights=weights)
    # The inverse of the part of S of the pairs that are right; the others say nothing.
    is_used = np.repeat(subsets, 2, axis=1)
    both = is_used[:, :, None] & is_used[:, None, :]
    information = np.where(both, np.linalg.inv(np.where(both, S, np.eye(len(S)))), 0.0)
    steps = information @ nu
    a = probability @ steps
    B = np.einsum("h,hij->ij", probability, information) - (probability[:, None] * steps).T @ steps + np.outer(a, a)
    return a, B


def _corrected(mean: Array, P: Array, step: Array, *, first: int) -> tuple[Array, Array]:
    """Return the estimate after a correction, and its covariance.

    Args:
        mean: The estimate before, (N,).
        P: The covariance after the correction, as errors displace points about that estimate, (N, N).
        step: The correction to first order, (N,).
        first: The place of the first landmark.
    """
    J, turn, corrected, lever = rotation(pi / 2.0), step[2], mean + step, np.zeros(len(mean))
    V = np.sinc(turn / pi) * np.eye(2) + np.sinc(0.5 * turn / pi) * sin(0.5 * turn) * J
    for points in (slice(0, 2), slice(first, None)):
        moved = step[points].reshape(-1, 2) @ V.T
        corrected[points] = mean[points] + moved.ravel()
        # An error of the heading displaces the corrected points by this much more.
        lever[points] = (moved @ J.T).ravel()
    P = P + np.outer(lever, P[2])
    return corrected, P + np.outer(P[:, 2], lever)


def _times_transpose(P: Array, H: Array, columns: Indices) -> Array:
    """Return P Hᵀ, shape (N, 2 m), for derivatives (m, 2, 6) with respect to landmarks in these columns (m, 2)."""
    by_landmark = np.einsum("Nmj,mij->Nmi", P[:, columns], H[:, :, _OBSERVED:])
    return P[:, :_OBSERVED] @ H[:, :, :_OBSERVED].reshape(-1, _OBSERVED).T + by_landmark.reshape(len(P), -1)


def _times(H: Array, columns: Indices, matrix: Array) -> Array:
    """Return H times a matrix (N, k), shape (2 m, k), for derivatives (m, 2, 6)."""
    return _times_transpose(matrix.T, H, columns).T
