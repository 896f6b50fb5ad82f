"""The perception in the DPS: images and scans become poses of the target, for its tracker.

Every estimate is the pose X_IT of the target T in the servicer's own inertial frame I, at the time at which the image
was taken or the scan was complete, by the clock of the DPS: an `Arrival` dates each of them. It is made from the poses
of the base B at that time, as the `BaseEstimator` remembers them. So a part takes a sample one period of the DPS after
its arrival: a history that then ends one period before the arrival reaches the sample's time. The tracker's state is
one period newer than the history.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.common.arrays import Array
from vtbdrake.common.scan import Scan
from vtbdrake.components.arrival import Arrival
from vtbdrake.components.perception.estimate import PoseEstimate, rotation_matrix
from vtbdrake.components.perception.markers import MarkerBoard, MarkerDetectorConfig, detect_markers, pose_from_markers
from vtbdrake.components.perception.registration import Faces, RegistrationConfig, deskew, misfit, register_points
from vtbdrake.components.perception.target_tracker import (
    STATE_SIZE,
    STATUS_SIZE,
    MotionModel,
    TargetTracker,
    pose_of_state,
)
from vtbdrake.testbed.slow_part import SlowPart
from vtbdrake_diagrams.satellite.bodies import Servicer, Target
from vtbdrake_diagrams.satellite.estimation import HISTORY, POSE, BaseEstimator, pose_at

if TYPE_CHECKING:
    from pydrake.systems.sensors import CameraInfo, ImageRgba8U


def target_board(target: Target | None = None) -> MarkerBoard:
    """Return the markers of the target, a millimetre above its faces."""
    target = target or Target()
    poses = {}
    for tag in target.tags:
        z, y = np.array(tag.normal, dtype=float), np.array(tag.up, dtype=float)
        R_TM = RotationMatrix(np.column_stack([np.cross(y, z), y, z]))
        poses[tag.id] = RigidTransform(R_TM, tag.center + 0.001 * z)
    return MarkerBoard.of(poses, size=target.tag_size)


def target_faces(target: Target | None = None) -> Faces:
    """Return the faces of the target's body and panels; the grapple fixture is not modelled."""
    return Faces.of_boxes((RigidTransform(center), edges) for edges, center in (target or Target()).boxes)


def target_motion() -> MotionModel:
    """Return the free flight of the target, whose inertia is known."""
    inertia = Target().inertia().CalcRotationalInertia()
    return MotionModel(inertia=[*inertia.get_moments().tolist(), *inertia.get_products().tolist()])


@dataclass
class PerceptionConfig:
    """The configuration of the perception of the target."""

    detector: MarkerDetectorConfig = field(default_factory=MarkerDetectorConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    motion: MotionModel = field(default_factory=target_motion)
    # Whether the points of a scan are corrected by the estimated motion of the target during the scan.
    deskew: bool = True
    # From the sample of an image to its markers (s).
    marker_latency: float = 0.06
    # From the sample of a scan to its pose (s).
    scan_latency: float = 0.04


@dataclass(frozen=True, eq=False)
class TrackedTarget:
    """The target as the tracker showed it when a slow part took its sample.

    Attributes:
        state: The tracker's ``state``, (13,).
        status: The tracker's ``status``, (4,).
        time: The time that the state is for, in s.
    """

    state: Array
    status: Array
    time: float

    @property
    def valid(self) -> bool:
        """Return whether the tracker follows the target."""
        return bool(self.status[0])

    def deviation(self) -> tuple[float, float]:
        """Return three standard deviations of the attitude (rad) and of the position (m), and a little more."""
        return 3.0 * float(self.status[2]) + 0.005, 3.0 * float(self.status[3]) + 0.01

    def at(self, time: float) -> RigidTransform:
        """Return X_IT at another time, with constant velocities."""
        X_IT, dt = pose_of_state(self.state), time - self.time
        turn = RotationMatrix(rotation_matrix(self.state[7:10] * dt))
        return RigidTransform(turn @ X_IT.rotation(), X_IT.translation() + dt * self.state[10:13])


@dataclass(frozen=True, eq=False)
class MarkerPose:
    """The target's pose from one image: the function of the slow part ``markers``.

    Attributes:
        board: The markers on the target.
        X_BC: Pose of the camera, as the DPS knows it.
        intrinsics: [fx, fy, cx, cy] of the camera in pixels.
        detector: How markers are found.
        period: The period of the DPS, in s.
    """

    board: MarkerBoard
    X_BC: RigidTransform
    intrinsics: Array
    detector: MarkerDetectorConfig
    period: float

    def prepare(self) -> None:
        """Load OpenCV."""
        detect_markers(np.zeros((8, 8), dtype=np.uint8), self.detector)

    def __call__(
        self, *, image: ImageRgba8U, time: Array, request: Array, history: Array, target: Array, status: Array
    ) -> dict[str, Any]:
        """Return the estimate of X_IT, and the count of the target's markers in the image."""
        taken = float(time[0])
        detections = detect_markers(image, self.detector).on(self.board)
        X_IC = pose_at(history, taken) @ self.X_BC
        tracked = TrackedTarget(target, status, float(history[0]) + self.period)
        prediction = X_IC.inverse() @ tracked.at(taken) if tracked.valid else None
        X_CT = pose_from_markers(detections, self.board, self.intrinsics, time=taken, prediction=prediction)
        return {"estimate": X_CT.seen_from(X_IC), "count": np.array([len(detections.ids)], dtype=float)}


@dataclass(frozen=True, eq=False)
class ScanPose:
    """The target's pose from one scan: the function of the slow part ``registration``.

    Attributes:
        faces: The model of the target.
        X_BL: Pose of the scanner, as the DPS knows it.
        registration: How points are registered.
        deskew: Whether they are corrected by the motions of base and target during the scan.
        attitude: R_IT to begin with while nothing is tracked; None waits for the markers.
        period: The period of the DPS, in s.
    """

    faces: Faces
    X_BL: RigidTransform
    registration: RegistrationConfig
    deskew: bool
    attitude: RotationMatrix | None
    period: float

    def __call__(
        self,
        *,
        scan: Scan,
        time: Array,
        request: Array,
        history: Array,
        target: Array,
        status: Array,
        memory: PoseEstimate,
    ) -> tuple[PoseEstimate, PoseEstimate]:
        """Return the estimate of X_IT, and what is remembered: the last one that was shown.

        While nothing is tracked, what is remembered is the estimate before de-skewing. Then a scan is de-skewed by the
        motion since the last one: both are skewed alike, so that the difference of their poses is not. The first scan
        alone says nothing of the motion, and is not shown.
        """
        taken = float(time[0])
        tracked = TrackedTarget(target, status, float(history[0]) + self.period)
        if not len(scan.ranges) or not (tracked.valid or self.attitude):
            nothing = PoseEstimate.missing(time=taken)
            return nothing, nothing
        eye = (pose_at(history, taken) @ self.X_BL).translation()
        p_BQ = scan.points() @ self.X_BL.rotation().matrix().T + self.X_BL.translation()
        fired = taken + (scan.times if self.deskew else np.zeros_like(scan.times))
        points = in_inertial_frame(p_BQ, fired, history)
        if tracked.valid:
            estimate = self._follow(points, scan.times, eye, tracked, time=taken)
            return estimate, estimate
        is_recent = memory.valid and taken - memory.time < _RECENT
        skewed = self._best(points, eye, taken, [memory.X] if is_recent else self._guesses(points, eye))
        if not (self.deskew and skewed.valid):
            return skewed, skewed
        if not is_recent:
            return PoseEstimate.missing(time=taken), skewed
        motion = skewed.error_to(memory.X) / (memory.time - taken)
        points = deskew(points, scan.times, origin=skewed.matrix[:, 3], velocity=motion[3:], rate=motion[:3])
        return self._best(points, eye, taken, [skewed.X]), skewed

    def _follow(self, points: Array, fired: Array, eye: Array, tracked: TrackedTarget, *, time: float) -> PoseEstimate:
        """Return the estimate that begins at the predicted pose; ``fired`` is relative to ``time``."""
        start = tracked.at(time)
        if self.deskew:
            rate, velocity = tracked.state[7:10], tracked.state[10:13]
            points = deskew(points, fired, origin=start.translation(), velocity=velocity, rate=rate)
        attitude, position = tracked.deviation()
        settings = self.registration
        # What is too far from the predicted pose is not the target.
        basin = min(settings.basin, position + attitude * _EXTENT + 6.0 * settings.range_noise)
        return register_points(
            points,
            self.faces,
            start,
            eye=eye,
            time=time,
            registration=replace(settings, basin=basin),
            deviation=(attitude, position),
        )

    def _best(self, points: Array, eye: Array, time: float, starts: Sequence[RigidTransform]) -> PoseEstimate:
        """Return the best of the estimates that begin at ``starts``."""
        settings = self.registration
        estimates = [
            register_points(points, self.faces, start, eye=eye, time=time, registration=settings) for start in starts
        ]
        limit = 4.0 * settings.range_noise
        scores = [misfit(points, self.faces, e.X, eye=eye, limit=limit) if e.valid else np.inf for e in estimates]
        return estimates[int(np.argmin(scores))]

    def _guesses(self, points: Array, eye: Array) -> list[RigidTransform]:
        """Return poses behind the nearest points, in attitudes about the one to begin with."""
        assert self.attitude is not None
        arms = points - eye
        distances = np.linalg.norm(arms, axis=1)
        middle = arms[distances < distances.min() + 0.5].mean(axis=0)
        p_IT = eye + middle * (1.0 + 0.4 / float(np.linalg.norm(middle)))
        turns = [_BASIN * np.array(turn) for turn in product((-1.0, 0.0, 1.0), repeat=3)]
        return [RigidTransform(RotationMatrix(rotation_matrix(turn)) @ self.attitude, p_IT) for turn in turns]


_RECENT = 3.0  # Until when a scan begins where the last one was registered, in s.
_EXTENT = 1.5  # How far the target's panels reach, in m.
_BASIN = np.radians(25.0)  # How far apart the attitudes are in which a scan is registered at first.


def in_inertial_frame(p_BQ: Array, times: Array, history: Array) -> Array:
    """Return points that were measured in B at their own times, in I.

    Args:
        p_BQ: The points, (n, 3) in m.
        times: When they were measured, (n,) in s.
        history: The port ``history`` of the `BaseEstimator`.
    """
    past = np.reshape(history, (HISTORY, POSE))[::-1]
    w, x, y, z, *position = (np.interp(times, past[:, 0], past[:, k]) for k in range(1, POSE))
    v = np.column_stack([x, y, z])
    square = (w**2 + x**2 + y**2 + z**2)[:, None]  # Between two quaternions, a little less than 1.
    twice = 2.0 * np.cross(v, p_BQ)
    turned: Array = p_BQ + (w[:, None] * twice + np.cross(v, twice)) / square
    return turned + np.column_stack(position)


def add_marker_part(
    builder: DiagramBuilder,
    base: BaseEstimator,
    target: TargetTracker,
    *,
    config: PerceptionConfig,
    period: float,
    info: CameraInfo,
    X_BC: RigidTransform,
    image_latency: float = 0.0,
) -> SlowPart:
    """Add the slow part ``markers`` with its ``image_arrival``, and the input port ``image`` of their Diagram.

    Args:
        builder: The builder of the Diagram ``env`` of the DPS.
        base: The estimator that remembers the base's poses.
        target: The tracker that predicts the target's pose.
        config: The configuration of the evaluation of images.
        period: The period of the DPS, in s.
        info: The size of its images, and its intrinsics.
        X_BC: Pose of the camera on the base.
        image_latency: How old its images are when it shows them, in s.

    Returns:
        The part, with the outputs ``estimate`` (of X_IT) and ``count``.
    """
    from pydrake.systems.sensors import ImageRgba8U

    function = MarkerPose(
        board=target_board(),
        X_BC=X_BC,
        intrinsics=np.array([info.focal_x(), info.focal_y(), info.center_x(), info.center_y()]),
        detector=config.detector,
        period=period,
    )
    image = ImageRgba8U(info.width(), info.height())
    part = SlowPart(
        function,
        inputs={"image": image, **_ESTIMATES},
        outputs={"estimate": PoseEstimate.missing(), "count": 1},
        period=period,
        latency=config.marker_latency,
        offset=period,
        on_request=True,
    )
    arrival = Arrival(image, period=period, age=period + image_latency)
    return _add(builder, "markers", part, base, target, sensor="image", arrival=arrival)


def add_scan_part(
    builder: DiagramBuilder,
    base: BaseEstimator,
    target: TargetTracker,
    *,
    config: PerceptionConfig,
    period: float,
    attitude: RotationMatrix | None = None,
) -> SlowPart:
    """Add the slow part ``registration`` with its ``scan_arrival``, and the input port ``scan`` of their Diagram.

    Args:
        builder: The builder of the Diagram ``env`` of the DPS.
        base: The estimator that remembers the base's poses.
        target: The tracker that predicts the target's pose.
        config: The configuration of the evaluation of scans.
        period: The period of the DPS, in s.
        attitude: R_IT to begin with; None if the track begins with markers.

    Returns:
        The part, with the output ``estimate`` (of X_IT).
    """
    function = ScanPose(
        faces=target_faces(),
        X_BL=Servicer().X_BL,
        registration=config.registration,
        deskew=config.deskew,
        attitude=attitude,
        period=period,
    )
    part = SlowPart(
        function,
        inputs={"scan": Scan.empty(), **_ESTIMATES},
        outputs={"estimate": PoseEstimate.missing()},
        memory=PoseEstimate.missing(),
        period=period,
        latency=config.scan_latency,
        offset=period,
        on_request=True,
    )
    arrival = Arrival(Scan.empty(), period=period, age=period)
    return _add(builder, "registration", part, base, target, sensor="scan", arrival=arrival)


# The inputs of both parts beside their sensor.
_ESTIMATES = {"time": 1, "history": HISTORY * POSE, "target": STATE_SIZE, "status": STATUS_SIZE}


def _add(
    builder: DiagramBuilder,
    name: str,
    part: SlowPart,
    base: BaseEstimator,
    target: TargetTracker,
    *,
    sensor: str,
    arrival: Arrival,
) -> SlowPart:
    builder.AddNamedSystem(f"{sensor}_arrival", arrival)
    builder.AddNamedSystem(name, part)
    for output, port in {"sample": sensor, "time": "time", "number": "request"}.items():
        builder.Connect(arrival.GetOutputPort(output), part.GetInputPort(port))
    builder.Connect(base.GetOutputPort("history"), part.GetInputPort("history"))
    builder.Connect(target.GetOutputPort("state"), part.GetInputPort("target"))
    builder.Connect(target.GetOutputPort("status"), part.GetInputPort("status"))
    builder.ExportInput(arrival.GetInputPort("signal"), sensor)
    return part
