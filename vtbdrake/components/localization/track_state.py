"""The memory of a `Tracker`: the state x of its filter with its covariance, and the health of the track.

x = [X_WH; b; e; g; f; l_1; ...; l_n], see `vtbdrake.components.localization.tracking`; without f if the scale of turns
is taken as exact.
"""

from __future__ import annotations

from dataclasses import field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array, Indices, immutable
from vtbdrake.components.localization.map_errors import ShownErrors
from vtbdrake.components.localization.planar import rotation
from vtbdrake.components.localization.revision import Revision

BIAS = 3
"""The place of b in x."""
ODOMETRY = 4
"""The place of e in x."""
RATE = 5
"""The place of g in x."""
TURN = 6
"""The place of f in x, if x has it."""


@immutable
class TrackState:
    """The memory of a `Tracker`: an immutable value with read-only arrays.

    Attributes:
        mean: The estimate of x (m, rad, s), shape (6 + 2 n,) or, with f, (7 + 2 n,); empty if nothing is tracked.
        covariance: The covariance of x.
        indices: Indices on the map of the landmarks in x, shape (n,); those that the map lacks are numbered from its
            size on.
        is_recent: Whether each of them was seen in the last scan that was fused and had it in view, shape (n,).
        evidence: Cumulative log-likelihood ratio of first matches.
        failures: The number of scans in succession that failed.
        distortion: The test statistic of a distorted map after the last scan that was fused.
        scatter: The factor by which the variance of the map's errors seems larger than the map says, at least 1.
        gone: The errors of the map that landmarks showed which have left x; a new track goes on from there.
        drift: The factor by which the variance of dead reckoning is larger than assumed, at least 1.
        unjudged: Numbers of detections and of matched ones, of landmarks that should be seen again and of seen ones,
            of the map's landmarks in plain view and of matched ones, in the last scans, which together had too few to
            be judged, shape (3, 2).
        travelled: The distance travelled by dead reckoning since the start of the track, in m.
        seen_at: That distance at the last fused detection of each landmark in x, shape (n,) in m; -inf before.
        factors: The variance of each landmark when it entered x, in units of the map's, by the scatter and the doubt of
            its match, shape (n,); 1 if the map lacks it.
        revision: What the drive has shown of the landmarks, if the map is revised.

    From ``evidence`` to ``unjudged``, they are the health of the track, see `vtbdrake.components.localization.health`.
    """

    mean: Array
    covariance: Array
    indices: Indices
    is_recent: NDArray[np.bool_]
    evidence: float = 0.0
    failures: int = 0
    distortion: float = 0.0
    scatter: float = 1.0
    gone: ShownErrors = field(default_factory=ShownErrors)
    drift: float = 1.0
    unjudged: Array = field(default_factory=lambda: np.zeros((3, 2)))
    travelled: float = 0.0
    seen_at: Array = field(default_factory=lambda: np.zeros(0))
    factors: Array = field(default_factory=lambda: np.zeros(0))
    revision: Revision = field(default_factory=Revision.none)

    @classmethod
    def none(cls) -> TrackState:
        """Return the state in which nothing is tracked."""
        return cls(np.zeros(0), np.zeros((0, 0)), np.zeros(0, dtype=np.intp), np.zeros(0, dtype=bool))

    def with_arrays(self, **arrays: Any) -> TrackState:
        """Return the state with other arrays, which are not copied and are read-only from now on."""
        for array in arrays.values():
            array.flags.writeable = False
        return replace(self, **arrays)

    @property
    def is_tracking(self) -> bool:
        """Return whether there is a pose."""
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
        return float(self.mean[BIAS])

    @property
    def first_landmark(self) -> int:
        """The place of the first landmark in x."""
        return len(self.mean) - 2 * len(self.indices)

    @property
    def landmark_positions(self) -> Array:
        """The estimated positions l_i of the landmarks in x, in W in m, shape (n, 2)."""
        return self.mean[self.first_landmark :].reshape(-1, 2)

    def landmark_columns(self, rows: Indices) -> Indices:
        """Return the places in x of landmarks, shape (m, 2).

        Args:
            rows: Their places among the landmarks in x, (m,).
        """
        return self.first_landmark + 2 * rows[:, None] + np.arange(2)

    def without(self, mask: NDArray[np.bool_]) -> TrackState:
        """Return the state without the landmarks for which the mask (n,) is true."""
        if not mask.any():
            return self
        remains = np.concatenate([np.ones(self.first_landmark, dtype=bool), np.repeat(~mask, 2)])
        return self.with_arrays(
            mean=self.mean[remains],
            covariance=self.covariance[np.ix_(remains, remains)],
            indices=self.indices[~mask],
            is_recent=self.is_recent[~mask],
            seen_at=self.seen_at[~mask],
            factors=self.factors[~mask],
        )


def in_level_frame(state: TrackState, places: Array) -> Array:
    """Return places in the level frame H of the carrier at the estimated pose, (n, 2).

    Args:
        state: The state.
        places: The places in W, (n, 2).
    """
    return (places - state.mean[:2]) @ rotation(-state.mean[2]).T
