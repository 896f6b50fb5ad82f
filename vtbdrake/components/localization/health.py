"""The health of a track: whether the estimate of a `Tracker` may be used, or is lost.

*Failures.* A scan fails, and is not fused, if too few of its detections match the map, or too few of the landmarks that
the last fused scan showed. If the map is revised, it may lack most of what is detected: then a scan whose detections
do not match fails only if it shows too few of the map's landmarks in plain view, too. Scans with few detections are
judged together, as soon as they have enough. The track is lost after ``patience`` failures in succession, or when
position or heading are too uncertain. Until then, a scan that matches ends the doubt. As the pose may be far off, a
match then has to be as probable as a first match, also of a landmark in the state.

*Evidence.* The d² of a right first match is chi-square distributed, the d² of a match by chance is uniform within the
gate γ of first matches. So the log-likelihood ratio of a match with d² is (a share ε = 0.2 of matches is by chance
although the pose is right) ln(ε + (1 - ε) γ / 2 exp(-d² / 2)). Its sum is kept up to at most ``credit``; below 0, the
track is lost (the cumulative sum of Page, Biometrika 41, 1954).

*Drift.* Dead reckoning may be worse than the model of its noise says, by wheels that slip or a steering angle that is
measured badly. The change d of the pose by a scan has the covariance D, the pose's before the scan less that after it.
So s = dᵀ D⁻¹ d / 3 is 1 on average; the variance of the next motion is multiplied by a factor that follows s (by a
tenth of its difference from 1 per scan), and that grows fourfold with a scan that fails. It is at least 1.

*Map.* `vtbdrake.components.localization.map_errors` says what the landmarks in the state show of the errors of the map.
Beyond ``distortion_gate``, a distortion T makes the pose doubtful, and far beyond, lost: so large are corrections by
wrong matches. Between its 95 % quantile and that, the covariance of the pose is multiplied by the ratio of T to the
quantile (the ratio of Birge, Physical Review 40, 1932). By the scatter s², T is divided, and the priors of further
landmarks are multiplied. If the landmarks that have left the state show s₀², those in it came with about as much. What
only these show, s² / s₀², multiplies the covariance of the pose, too: they came with less, and errors that neighbours
share displace the pose by more than they scatter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array, Indices
from vtbdrake.components.estimation import chi_square_quantile
from vtbdrake.components.localization import map_errors
from vtbdrake.components.localization.landmarks import SensorView
from vtbdrake.components.localization.track_state import TrackState, in_level_frame

# A scan fails if it matches a smaller share of its detections.
_LEAST_SHARE = 0.15
# A scan fails if it matches a smaller share of the landmarks that should be seen again.
_LEAST_AGAIN = 0.25
# A scan of a unit that revises its map does not fail if it matches this share of the map's landmarks in plain view.
_LEAST_SHOWN = 0.3

# Near the largest distance of detections, landmarks are not seen reliably: this share of it counts.
_RELIABLE = 0.7

# The least number of detections, or of landmarks that should be seen again, for this test, in one scan or several.
_JUDGED_FROM = 6

# With a larger standard deviation of the heading in rad, the track is lost: the linearization holds for small errors.
_LARGEST_TURN = 0.2

# Share by which the factor of the variance of dead reckoning follows the ratio of a scan.
_FOLLOWS = 0.1
# Largest ratio of a scan that counts.
_LARGEST_RATIO = 25.0
# A scan that fails multiplies the factor of the variance of dead reckoning by this number.
_FAILED = 4.0
# Largest factor of the variance of dead reckoning.
_LARGEST_DRIFT = 1e3

# Units in which errors of x, y (m) and heading (rad) are of the same size, as a landmark at 10 m shows them.
_SCALES = np.array([1.0, 1.0, 0.1])

# Degrees of freedom of the distortions: displacement, rotation, scale and shear, which are affine.
_DISTORTIONS = 6

# Beyond this multiple of the gate of distortions, matches are wrong, and the track is lost.
_TANGLED = 10.0

# The share of first matches that are assumed to be by chance although the pose is right.
_CHANCE = 0.2


def judged(
    state: TrackState,
    view: SensorView,
    pairs: Indices,
    *,
    is_mapped: NDArray[np.bool_] | None = None,
    shown: Indices | None = None,
) -> tuple[bool, Array]:
    """Return whether a scan with these pairs of detection and landmark, (k, 2), fails, and what is still to be judged.

    Args:
        state: The state before the scan.
        view: The detections of the scan, in H.
        pairs: Indices of the detection and of the landmark on the map.
        is_mapped: Whether the landmark of each pair is on the map, (k,); None if all are.
        shown: Indices of the landmarks of the map in plain view; None if the map is not revised.

    Returns:
        Whether it fails, and the counts for `TrackState.unjudged`, shape (3, 2).
    """
    again = int(np.isin(pairs[:, 1], state.indices).sum())
    recent = in_level_frame(state, state.landmark_positions[state.is_recent])
    expected = int(view.is_in_view(recent, share=_RELIABLE).sum())
    in_plain_view = np.zeros(0, dtype=np.intp) if shown is None else shown
    scan = np.array(
        [
            [len(view.landmarks), len(pairs) if is_mapped is None else is_mapped.sum()],
            [expected, again],
            [len(in_plain_view), np.isin(in_plain_view, pairs[:, 1]).sum()],
        ],
        dtype=float,
    )
    fails, unjudged = [False, False, False], np.zeros((3, 2))
    for k, least_share in enumerate((_LEAST_SHARE, _LEAST_AGAIN, _LEAST_SHOWN)):
        # A scan with many is judged alone: those before it show another place.
        count, matches = scan[k] if scan[k, 0] >= _JUDGED_FROM else state.unjudged[k] + scan[k]
        if count < _JUDGED_FROM:
            unjudged[k] = count, matches
        else:
            fails[k] = matches < least_share * count
    is_elsewhere = fails[0] and (shown is None or fails[2])
    return is_elsewhere or fails[1], unjudged


def evidence(squares: Array, first_gate: float) -> float:
    """Return the log-likelihood ratio of first matches, right against by chance, from their d² (k,).

    Args:
        squares: The d² of the first matches.
        first_gate: The share of right first matches that their gate lets pass, in (0, 1).
    """
    ratio = 0.5 * chi_square_quantile(first_gate, 2) * np.exp(-0.5 * squares)
    return float(np.log(_CHANCE + (1.0 - _CHANCE) * ratio).sum())


def drift_after_failure(state: TrackState) -> float:
    """Return the factor of the variance of dead reckoning after a scan that failed."""
    return min(_FAILED * state.drift, _LARGEST_DRIFT)


def drift_after(before: TrackState, after: TrackState) -> float:
    """Return the factor of the variance of dead reckoning after a scan that was fused.

    Args:
        before: The state before the scan was fused, at the same time.
        after: The state with the scan.
    """
    change = after.pose - before.pose
    D = before.pose_covariance - after.pose_covariance
    # Directions about which the scan says nothing have no variance, and no change.
    values, directions = np.linalg.eigh(D / np.outer(_SCALES, _SCALES))
    along = directions.T @ (change / _SCALES)
    says = values > 1e-3 * values.max()
    if not says.any() or values.max() <= 0.0:
        return before.drift
    ratio = float((along[says] ** 2 / values[says]).mean())
    return min(max(1.0, before.drift * (1.0 + _FOLLOWS * (min(ratio, _LARGEST_RATIO) - 1.0))), _LARGEST_DRIFT)


def is_lost(state: TrackState, *, patience: int, largest_deviation: float, distortion_gate: float) -> bool:
    """Return whether the track is lost, with the settings of a `Tracker`.

    Args:
        state: The state after the last scan.
        patience: The number of failures in succession after which the track is lost.
        largest_deviation: The largest standard deviation of x and y, in m.
        distortion_gate: The share of right maps that are not doubtful in one test of the distortion, in (0, 1).
    """
    limits = np.array([largest_deviation, largest_deviation, _LARGEST_TURN])
    is_vague = bool((np.sqrt(np.diagonal(state.pose_covariance)) > limits).any())
    is_tangled = state.distortion > _TANGLED * chi_square_quantile(distortion_gate, _DISTORTIONS)
    return state.failures >= patience or state.evidence < 0.0 or is_vague or is_tangled


def is_doubtful(state: TrackState, *, distortion_gate: float) -> bool:
    """Return whether the last scan failed or the map seems distorted.

    Args:
        state: The state after the last scan.
        distortion_gate: The share of right maps that are not doubtful in one test of the distortion, in (0, 1).
    """
    return state.failures > 0 or state.distortion > chi_square_quantile(distortion_gate, _DISTORTIONS)


def widening(state: TrackState) -> float:
    """Return the factor of the covariance of the pose, at least 1, by the scatter and the distortion of the map."""
    worse = max(1.0, state.scatter / map_errors.scatter(state.gone))
    return worse * max(1.0, state.distortion / chi_square_quantile(0.95, _DISTORTIONS))
