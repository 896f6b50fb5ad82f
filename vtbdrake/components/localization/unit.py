"""The localization unit: the pose of a carrier on a map of landmarks, from detections and odometry.

Without a pose, it gathers a local map along the odometry and matches it with the map, without an initial guess. Once a
match is sure, it tracks. When the track is lost, it reports this, and searches again with landmarks detected since it
was in doubt.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite, nan

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.arrays import Array, immutable
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.dead_reckoning import DriftModel
from vtbdrake.components.localization.landmarks import Landmarks, SensorView
from vtbdrake.components.localization.planar import compose, inverse
from vtbdrake.components.localization.submap import Submap
from vtbdrake.components.localization.track_state import TrackState
from vtbdrake.components.localization.tracking import Matches, Tracker
from vtbdrake.state import Codec
from vtbdrake.state.codecs import codec_of

# The values of `Localization.status`.
SEARCHING = 0
"""There is no pose yet."""
TRACKING = 1
"""There is a pose."""
LOST = 2
"""The pose was lost, and the unit searches again."""
DOUBTFUL = 3
"""The last scan does not show the place where the carrier should be, and the tracker waits for the next one."""

# A pose by odometry with a number of this size or more, in m or rad, is a fault.
_LARGEST = 1e9

# The fewest matched detections with which a track begins.
_FEWEST = 4

Views = Landmarks | Sequence[SensorView]
"""Detections of one time in H: a scanner's landmarks, or views of several sensors, each with its covariances."""


@immutable
class Localization:
    """The answer of a `LocalizationUnit` to one scan: the pose of the carrier.

    Attributes:
        time: The time of the scan, in s; -inf before the first one.
        X_OH: The pose of the odometry for which the answer holds, shape (3,).
        pose: X_WH, shape (3,) in m and rad; NaN without a pose.
        covariance: Covariance of the pose in the order x, y, heading, shape (3, 3); infinite variances without a pose.
        status: `SEARCHING`, `TRACKING`, `LOST` or `DOUBTFUL`. Only with `TRACKING` is there a pose.
        detected: The number of detections.
        matched: The number of detections that were fused. If 0, the scan has not confirmed the pose by dead reckoning.
        nis: Normalized innovation squared of the scan, of 2 ``matched`` degrees of freedom.
        range_bias: The estimated bias of detections along the ray, in m; 0 without a pose.
    """

    time: float
    X_OH: Array
    pose: Array
    covariance: Array
    status: int
    detected: int = 0
    matched: int = 0
    nis: float = 0.0
    range_bias: float = 0.0

    @classmethod
    def unknown(
        cls, status: int = SEARCHING, *, time: float = -inf, X_OH: ArrayLike = (0.0, 0.0, 0.0), detected: int = 0
    ) -> Localization:
        """Return an answer without a pose.

        Args:
            status: `SEARCHING`, `LOST` or `DOUBTFUL`.
            time: The time of the scan, in s; -inf before the first one.
            X_OH: The pose of the odometry at that time, shape (3,) in m and rad.
            detected: The number of detections.
        """
        return cls(time, np.asarray(X_OH), np.full(3, nan), np.diag(np.full(3, inf)), status, detected)


@immutable
class UnitState:
    """The memory of a `LocalizationUnit`, an immutable value; `UNIT_STATE_CODEC` converts it to arrays.

    Attributes:
        answer: The last answer.
        track: The state of the tracker; without a pose, `TrackState.none` with what is known of the map.
        submap: The landmarks gathered since there was a pose, or since the start; empty while there is one.
        tried_at: Distance travelled in m and time in s at the last attempt of global localization, shape (2,).
        ignored: The number of calls that were ignored, see `LocalizationUnit.step`.
        losses: The number of times that the track was lost.
        doubted: The distance travelled since the track became doubtful, in m; 0 if it is not.
    """

    answer: Localization = field(default_factory=Localization.unknown)
    track: TrackState = field(default_factory=TrackState.none)
    submap: Submap = field(default_factory=Submap.empty)
    tried_at: Array = field(default_factory=lambda: np.array([-inf, -inf]))
    ignored: int = 0
    losses: int = 0
    doubted: float = 0.0


@dataclass(frozen=True, eq=False)
class LocalizationUnit:
    """The localization unit for one map. It is immutable: `step` takes the memory, and returns the new one.

    Attributes:
        locator: The map, prepared for global localization.
        tracker: The filter, with the same map.
        drift: The drift of the odometry.

    Raises:
        ValueError: A setting is outside of its range.
    """

    locator: ConstellationMap
    tracker: Tracker
    drift: DriftModel = field(default_factory=DriftModel)
    submap_length: float = setting(40.0, "The distance over which landmarks are gathered.", unit="m", gt=0.0)
    try_every: tuple[float, float] = setting(
        (2.0, 2.0),
        "Distance and time between attempts of global localization, whichever comes first.",
        unit="m, s",
        ge=0.0,
        finite=False,
    )
    doubt_length: float = setting(
        40.0,
        "The distance over which a track may be doubtful before it is lost, and searched for again.",
        unit="m",
        gt=0.0,
    )
    begins_with_submap: bool = setting(
        False,
        "Whether tracking begins with all gathered landmarks instead of the last scan's, for sensors where "
        "one sample shows too few for a pose. Their errors are then assumed to be independent.",
    )

    def __post_init__(self) -> None:
        check_settings(self)

    def start(self) -> UnitState:
        """Return the memory before the first scan."""
        return UnitState()

    def step(
        self, state: UnitState, landmarks: Views, *, X_OH: ArrayLike, time: float
    ) -> tuple[Localization, UnitState]:
        """Return the answer to a scan, or to what several sensors see at one time, and the memory after it.

        The filter is one for all sensors: their views are fused one after the other.

        A call with a pose or a time that is not finite, a pose of 1e9 m or more, or a time that is not after the last
        one, is ignored and counted. It returns the last answer, with the time of that answer.

        Args:
            state: The memory before.
            landmarks: The detections.
            X_OH: The pose of the carrier by odometry at the time of the scan, shape (3,).
            time: The time of the scan, in s.

        Raises:
            ValueError: X_OH does not have the shape (3,).
        """
        pose = np.asarray(X_OH, dtype=float)
        if pose.shape != (3,):
            raise ValueError(f"X_OH is a planar pose [x, y, heading], shape (3,), not of shape {pose.shape}")
        views = [SensorView(landmarks)] if isinstance(landmarks, Landmarks) else list(landmarks)
        last = state.answer
        if not ((np.abs(pose) < _LARGEST).all() and isfinite(time) and time > last.time):
            return last, replace(state, ignored=state.ignored + 1)
        begins = not isfinite(last.time)
        motion = np.zeros(3) if begins else compose(inverse(last.X_OH), pose)
        duration = 0.0 if begins else time - last.time
        C = self.drift.covariance(motion, duration)
        if begins:
            state = replace(state, submap=Submap.empty(pose))
        if state.track.is_tracking:
            extent = self.drift.extent(motion, duration)
            track = self.tracker.predict(state.track, motion, C, extent=extent)
            fused = []
            for view in views:
                track, matches = self.tracker.update(track, view)
                fused.append(matches)
            is_doubtful = self.tracker.is_doubtful(track)
            doubted = state.doubted + float(np.hypot(*motion[:2])) if is_doubtful else 0.0
            if self.tracker.is_lost(track) or doubted > self.doubt_length:
                # What was seen in doubt is of the same place.
                lost = Localization.unknown(LOST, time=time, X_OH=pose, detected=_count(views))
                submap = self._gathered(state.submap, views, pose, C)
                none = replace(TrackState.none(), gone=track.gone)
                return lost, UnitState(lost, none, submap, ignored=state.ignored, losses=state.losses + 1)
            if is_doubtful:
                answer = Localization.unknown(DOUBTFUL, time=time, X_OH=pose, detected=_count(views))
                submap = self._gathered(state.submap, views, pose, C)
            else:
                answer = self._answer(track, fused, _count(views), pose, time)
                submap = Submap.empty(pose)
            return answer, replace(state, answer=answer, track=track, submap=submap, doubted=doubted)
        return self._searched(state, views, pose, C, time)

    def _searched(
        self, state: UnitState, views: Sequence[SensorView], X_OH: Array, C: Array, time: float
    ) -> tuple[Localization, UnitState]:
        """Return the answer and the memory after a scan that follows an answer without a pose."""
        submap = self._gathered(state.submap, views, X_OH, C)
        none = Localization.unknown(state.answer.status, time=time, X_OH=X_OH, detected=_count(views))
        state = replace(state, answer=none, submap=submap)
        gathered = submap.landmarks()
        is_due = (np.array([submap.distance, time]) - state.tried_at >= self.try_every).any()
        if len(gathered) < self.locator.fewest or not is_due:
            return none, state
        state = replace(state, tried_at=np.array([submap.distance, time]))
        fix = self.locator.locate(gathered)
        if not fix.is_sure:
            return none, state
        # The sensor that sees most begins the track.
        most = max(views, key=lambda view: len(view.landmarks), default=SensorView(Landmarks.empty()))
        landmarks = gathered if self.begins_with_submap else most
        track, matches = self.tracker.start(fix.pose, fix.covariance, landmarks, before=state.track.gone)
        if len(matches.pairs) < _FEWEST or self.tracker.is_lost(track) or self.tracker.is_doubtful(track):
            return none, state
        answer = self._answer(track, [matches], _count(views), X_OH, time)
        return answer, UnitState(answer, track, Submap.empty(X_OH), ignored=state.ignored, losses=state.losses)

    def _gathered(self, submap: Submap, views: Sequence[SensorView], X_OH: Array, C: Array) -> Submap:
        """Return the submap after a motion with covariance C and what is seen then."""
        gathered = submap.moved(X_OH, C, length=self.submap_length)
        for view in views:
            gathered = gathered.with_scan(view, least_deviation=self.locator.least_deviation)
        return gathered

    def _answer(
        self, track: TrackState, fused: Sequence[Matches], detected: int, X_OH: Array, time: float
    ) -> Localization:
        covariance = self.tracker.pose_covariance(track)
        matched = sum(len(matches.pairs) for matches in fused if matches.is_fused)
        nis = sum(matches.nis for matches in fused)
        return Localization(time, X_OH, track.pose, covariance, TRACKING, detected, matched, nis, track.range_bias)


def _count(views: Sequence[SensorView]) -> int:
    """Return the number of detections."""
    return sum(len(view.landmarks) for view in views)


_CODEC = codec_of(UnitState())


# In files, the names of the arrays of the state's own fields end with a dot: ``tried_at.`` beside ``track.mean``.
def _encode(state: UnitState) -> dict[str, np.ndarray]:
    return {name if "." in name else f"{name}.": array for name, array in _CODEC.encode(state).items()}


def _decode(arrays: Mapping[str, np.ndarray]) -> UnitState:
    state: UnitState = _CODEC.decode({name.removesuffix("."): array for name, array in arrays.items()})
    return state


UNIT_STATE_CODEC = Codec(_encode, _decode)
"""The codec of a `UnitState`, for the ``codecs`` of a `SlowPart`."""
