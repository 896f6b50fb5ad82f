"""The perception in the DPS of the localization unit: scans become landmarks, and landmarks the pose on the map.

A scan is dated by the clock of the DPS when it arrives (`Arrival`). The slow part ``localizer`` takes it one period
later: the history of the dead reckoning, which then ends one period before the arrival, reaches the scan's time. Pairs
of images may take the place of scans (`vtbdrake_diagrams.forest.stereo`), or come beside them, in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import inf
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues, System
from pydrake.systems.primitives import Adder
from threadpoolctl import ThreadpoolController

from vtbdrake.common.arrays import Array
from vtbdrake.common.scan import Scan
from vtbdrake.components.arrival import Arrival
from vtbdrake.components.localization.dead_reckoning import (
    MOTION,
    POSE,
    DriftModel,
    body_rotation,
    carrier_pose_at,
    deskewed,
    history_size,
)
from vtbdrake.components.localization.landmarks import Landmarks, SensorView
from vtbdrake.components.localization.planar import chord, compose, inverse, rotation
from vtbdrake.components.localization.unit import (
    LOST,
    TRACKING,
    UNIT_STATE_CODEC,
    Localization,
    LocalizationUnit,
    UnitState,
)
from vtbdrake.components.perception.estimate import PoseEstimate
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.testbed.slow_part import SlowPart

# The time in s for which dead reckoning alone gives a valid pose; assumed.
_PATIENCE = 10.0

# Rows of x, y and heading in the covariance of a `PoseEstimate`.
_PLANAR = [3, 4, 2]

SETTLED = 0.5
"""The time in s before which nothing is detected: the vertical, which levels scans and images, must be known first."""

SHOWN = 64
"""The largest number of landmarks that the port ``landmarks`` of the localizer shows: the nearest."""


@dataclass(frozen=True, eq=False)
class ScanLandmarks:
    """Landmarks from scans.

    Attributes:
        detect: The detector, such as `detect_trunks`.
        settings: The second argument of ``detect``, such as a `TrunkDetectorConfig`.
        X_BL: Pose of the scanner in the DPS.
    """

    detect: Callable[..., Landmarks]
    settings: Any
    X_BL: RigidTransform

    def __call__(self, scan: Scan, history: Array, time: float) -> Landmarks:
        """Return the landmarks in the level frame H at the time of the scan.

        A scan with rays that were fired before the history begins has no landmarks: its times are wrong, such as
        milliseconds for seconds.

        Args:
            scan: The scan.
            history: The port ``history`` of the `DeadReckoning`, also as rows of poses.
            time: The time when the scan was complete, by the clock of the DPS, in s.
        """
        if len(scan.times) and time + scan.times.min() < np.ravel(history)[-POSE]:
            return Landmarks.empty()
        points_H = deskewed(scan, history, self.X_BL, time=time)
        pose = carrier_pose_at(history, time)
        p_HoLo_H = body_rotation(pose.roll, pose.pitch) @ self.X_BL.translation()
        return self.detect(points_H, self.settings, p_HoLo_H=p_HoLo_H)


def detect_all(points_H: Array, detectors: Sequence[tuple[Callable[..., Landmarks], Any]], **place: Any) -> Landmarks:
    """Return what several detectors find in the points of one scan, such as trunks and rocks.

    Args:
        points_H: The points in the level frame H, (n, 3) in m.
        detectors: Each detector, such as `detect_trunks`, with its settings.
        place: ``p_HoLo_H`` of the detectors.
    """
    return Landmarks.joined([detect(points_H, settings, **place) for detect, settings in detectors])


@dataclass(frozen=True, eq=False)
class LandmarkSensor:
    """A sensor of a localization unit, and how landmarks are detected with it.

    Attributes:
        detect: The function that returns the landmarks in a scan or in images, such as `ScanLandmarks`.
        signals: The signals that ``detect`` takes, before the history and the time.
        field_of_view: Its horizontal field of view in rad.
        is_scan: Whether its ranges have the bias that the tracker estimates, see `SensorView`.
    """

    detect: Callable[..., Landmarks]
    signals: tuple[str, ...] = ("scan",)
    field_of_view: float = 2.0 * np.pi
    is_scan: bool = True

    def times(self, inputs: Mapping[str, Any]) -> list[float]:
        """Return the times of its samples in s, among the inputs of a `Localizer`."""
        return [float(np.ravel(inputs[f"{name}_time"])[0]) for name in self.signals]

    def view(self, inputs: Mapping[str, Any], history: Array) -> SensorView:
        """Return what it detects, from the inputs of a `Localizer`.

        Samples of different times do not fit together: then nothing is detected, nor before `SETTLED`.
        """
        times = self.times(inputs)
        sees = min(times) == max(times) >= SETTLED
        samples = [inputs[name] for name in self.signals]
        landmarks = self.detect(*samples, history, times[0]) if sees else Landmarks.empty()
        return SensorView(landmarks, self.field_of_view, self.is_scan)


@dataclass(frozen=True, eq=False)
class Localizer:
    """The localization from landmarks to the pose: the function of the slow part ``localizer``.

    Attributes:
        sensors: The sensors of the unit. What they see is fused in the order of its times.
        unit: The localization on the map.
    """

    sensors: tuple[LandmarkSensor, ...]
    unit: LocalizationUnit

    def prepare(self) -> None:
        """Find the libraries of linear algebra, and load what the detectors need."""
        _blas()
        for sensor in self.sensors:
            getattr(sensor.detect, "prepare", lambda: None)()

    def __call__(
        self, *, request: Array, history: Array, memory: UnitState, **inputs: Any
    ) -> tuple[dict[str, Any], UnitState]:
        """Return the outputs of the slow part, and the memory of the unit.

        ``inputs`` has the samples of the signals and their times, such as ``scan`` and ``scan_time``. Each sample of
        a sensor is used once: what is not newer than the last answer is left out.
        """
        groups = self._groups(inputs, after=memory.answer.time)
        with _blas().limit(limits=1, user_api="blas"):
            for taken, sensors in groups:
                views = [sensor.view(inputs, history) for sensor in sensors]
                pose = carrier_pose_at(history, taken)
                X_OH = [pose.x, pose.y, pose.heading]
                answer, memory = self.unit.step(memory, views, X_OH=X_OH, time=taken)
        landmarks = Landmarks.joined([view.landmarks for view in views])
        outputs = {
            "pose": answer.pose,
            "covariance": answer.covariance.ravel(),
            "status": [answer.status],
            "time": [answer.time],
            "odometry": answer.X_OH,
            "detected": [len(landmarks)],
            "matched": [answer.matched],
            "nis": [answer.nis],
            "range_bias": [answer.range_bias],
            "landmarks": shown(landmarks),
        }
        return outputs, memory

    def _groups(self, inputs: Mapping[str, Any], *, after: float) -> list[tuple[float, list[LandmarkSensor]]]:
        """Return the sensors with new samples, by the times of these, in their order.

        If none is new, the last ones: the unit ignores and counts them.
        """
        by_time: dict[float, list[LandmarkSensor]] = {}
        for sensor in self.sensors:
            by_time.setdefault(sensor.times(inputs)[0], []).append(sensor)
        groups = sorted(by_time.items(), key=lambda item: item[0])
        return [group for group in groups if group[0] > after] or groups[-1:]


@cache
def _blas() -> ThreadpoolController:
    """Return the controller of the threads of linear algebra.

    With several threads, small matrices take longer, much longer on a busy computer, and their last bits differ.
    """
    return ThreadpoolController()


def shown(landmarks: Landmarks) -> Array:
    """Return the nearest landmarks as rows of [x, y (m, in H), diameter (m)], (3 `SHOWN`,); rows of NaN fill up."""
    rows = np.full((SHOWN, 3), np.nan)
    nearest = np.argsort(np.linalg.norm(landmarks.positions, axis=1), kind="stable")[:SHOWN]
    rows[: len(nearest), :2] = landmarks.positions[nearest]
    rows[: len(nearest), 2] = landmarks.diameters[nearest]
    return rows.ravel()


class PresentPose(AddressedSystem):
    r"""The present pose of the carrier on the map: the last pose of the localizer, continued by dead reckoning.

    .. pydrake_system::

        name: PresentPose
        input_ports:
        - motion
        - pose
        - covariance
        - status
        - odometry
        - time
        output_ports:
        - pose_estimate

    ``motion`` comes from a `DeadReckoning`; the other inputs come from the slow part ``localizer``: the pose X_WH
    (3,) with its covariance (9,), the status, and the pose X_OH (3,) and the time (s) for which they hold. With the
    present pose in O, which continues with the last speed and turn rate of the axle until the time of the update,

        X_WH(now) = X_WH X_OH^-1 X_OH(now),

    and the covariance grows as the `DriftModel` says. ``pose_estimate`` is [time (s), x, y (m), heading (rad),
    covariance (9,), status]. Without a pose of the localizer, the pose is NaN and its variances are infinite. If the
    last pose is older than the parameter ``patience`` (s), the status is `LOST`.
    """

    def __init__(self, *, period: float, drift: DriftModel, axle: float) -> None:
        """Declare the system.

        Args:
            period: The period of the updates in s.
            drift: The drift of the dead reckoning.
            axle: The x coordinate in B of the point that does not move sideways, in m, as in `DeadReckoning`.
        """
        super().__init__()
        self._drift, self._axle = drift, axle
        sizes = {"motion": MOTION.size, "pose": 3, "covariance": 9, "status": 1, "odometry": 3, "time": 1}
        self._ports = {name: self.DeclareVectorInputPort(name, size) for name, size in sizes.items()}
        first = Localization.unknown()
        self._settings = self.declare_parameters(patience=Quantity(_PATIENCE, "s", (0.0, 3600.0)))
        self._estimate = self.declare_discrete_state(
            time=Quantity(0.0, "s"),
            position=Quantity(first.pose[:2], "m"),
            heading=Quantity(first.pose[2], "rad"),
            covariance=Quantity(first.covariance, "m^2, rad^2"),
            status=Quantity(first.status),
        )
        self.DeclareStateOutputPort("pose_estimate", self._estimate.index)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def pose_estimate(self, context: Context) -> PoseEstimate:
        """Return the pose on the map with its covariance; height, roll and pitch are unknown."""
        estimate = self._estimate.view(context)
        if estimate.status != TRACKING:
            return PoseEstimate.missing(time=estimate.time)
        covariance = np.diag(np.full(6, inf))
        covariance[np.ix_(_PLANAR, _PLANAR)] = estimate.covariance
        X_WH = RigidTransform(RollPitchYaw(0.0, 0.0, estimate.heading), [*estimate.position, 0.0])
        return PoseEstimate.of(X_WH, covariance, time=estimate.time)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        pose, covariance, X_OH = (self._ports[name].Eval(context) for name in ("pose", "covariance", "odometry"))
        status, time = (float(self._ports[name].Eval(context)[0]) for name in ("status", "time"))
        now = context.get_time()
        if np.isfinite(covariance).all() and now - time > self._settings.view(context).patience:
            lost = Localization.unknown(LOST)
            pose, covariance, status = lost.pose, lost.covariance, lost.status
        elif np.isfinite(covariance).all():
            last = MOTION.view(self._ports["motion"].Eval(context))
            elapsed = now - last.time
            X_OA = compose([*last.position.tolist(), last.heading], [self._axle, 0.0, 0.0])
            X_OA_now = compose(X_OA, chord(last.speed * elapsed, last.turn_rate * elapsed))
            X_OH_now = compose(X_OA_now, [-self._axle, 0.0, 0.0])
            X_HH_now = compose(inverse(X_OH), X_OH_now)
            pose, covariance = moved(pose, covariance.reshape(3, 3), X_HH_now, self._drift, now - time)
        estimate = self._estimate.mutable(state)
        estimate.time, estimate.position, estimate.heading = now, pose[:2], pose[2]
        estimate.covariance, estimate.status = np.reshape(covariance, (3, 3)), status


def moved(X_WH: Array, covariance: Array, motion: Array, drift: DriftModel, duration: float) -> tuple[Array, Array]:
    """Return the pose (3,) after a motion by dead reckoning, and its covariance (3, 3).

    Args:
        X_WH: The pose before, (3,) in m and rad.
        covariance: The covariance of this pose, (3, 3).
        motion: The pose after the motion in the frame of the pose before, (3,) in m and rad.
        drift: The drift of the dead reckoning.
        duration: The duration of the motion in s.
    """
    pose = compose(X_WH, motion)
    by_pose, by_motion = np.eye(3), np.eye(3)
    by_pose[:2, 2] = [X_WH[1] - pose[1], pose[0] - X_WH[0]]
    by_motion[:2, :2] = rotation(float(X_WH[2]))
    return pose, by_pose @ covariance @ by_pose.T + by_motion @ drift.covariance(motion, duration) @ by_motion.T


def add_localizer(
    builder: DiagramBuilder,
    reckoning: System,
    localizer: Localizer,
    signals: Mapping[str, Any],
    *,
    period: float,
    latency: float,
) -> SlowPart:
    """Add the slow part ``localizer``, and for each signal, such as ``scan``, its ``scan_arrival`` and the input port.

    Args:
        builder: The builder of the Diagram ``env`` of the DPS.
        reckoning: The dead reckoning, whose port ``history`` the part reads.
        localizer: The function of the part.
        signals: A value of each of the signals that the localizer takes, by name; an array of a vector signal.
        period: The period of the DPS, in s.
        latency: The time from the sample of a scan to its pose, in s.

    Returns:
        The part, with the outputs of `Localizer`.
    """
    first = Localization.unknown()
    part = SlowPart(
        localizer,
        inputs={
            **{name: value.size if isinstance(value, np.ndarray) else value for name, value in signals.items()},
            **{f"{name}_time": 1 for name in signals},
            "history": history_size(period),
        },
        outputs={
            "pose": 3,
            "covariance": 9,
            "status": 1,
            "time": 1,
            "odometry": 3,
            "detected": 1,
            "matched": 1,
            "nis": 1,
            "range_bias": 1,
            "landmarks": 3 * SHOWN,
        },
        initial={
            "pose": first.pose,
            "covariance": first.covariance.ravel(),
            "status": [first.status],
            "time": [first.time],
            "landmarks": shown(Landmarks.empty()),
        },
        memory=localizer.unit.start(),
        codecs={"memory": UNIT_STATE_CODEC},
        period=period,
        latency=latency,
        offset=period,
        on_request=True,
    )
    builder.AddNamedSystem("localizer", part)
    for name, value in signals.items():
        arrival = builder.AddNamedSystem(f"{name}_arrival", Arrival(value, period=period, age=period))
        builder.Connect(arrival.GetOutputPort("sample"), part.GetInputPort(name))
        builder.Connect(arrival.GetOutputPort("time"), part.GetInputPort(f"{name}_time"))
        builder.ExportInput(arrival.GetInputPort("signal"), name)
    # The signals of a sensor arrive together or in their order: the number of its last one counts its samples. The sum
    # over the sensors is the request.
    request = builder.AddNamedSystem("arrivals", Adder(len(localizer.sensors), 1))
    for port, sensor in enumerate(localizer.sensors):
        arrival = builder.GetSubsystemByName(f"{sensor.signals[-1]}_arrival")
        builder.Connect(arrival.GetOutputPort("number"), request.get_input_port(port))
    builder.Connect(request.get_output_port(), part.GetInputPort("request"))
    builder.Connect(reckoning.GetOutputPort("history"), part.GetInputPort("history"))
    return part
