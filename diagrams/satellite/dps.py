"""The data processing system of the servicer: one function builds it for the testbed, its copies and the satellite."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import (
    ConstantValueSource,
    Saturation,
)

from vtbdrake.common.spline import Spline
from vtbdrake.components.perception.estimate import PoseEstimate
from vtbdrake.components.perception.target_tracker import STATE_SIZE, MotionModel, TargetTracker
from vtbdrake.components.sensors.raw_values import make_calibration
from vtbdrake.components.spline_command import SplineCommand
from vtbdrake.testbed import SlowPart
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, JOINT_NAMES, Servicer
from vtbdrake_diagrams.satellite.control import ACCELERATION, UNLIMITED, ArmController, AttitudeController
from vtbdrake_diagrams.satellite.estimation import BASE, BaseEstimator
from vtbdrake_diagrams.satellite.perception import PerceptionConfig, add_marker_part, add_scan_part
from vtbdrake_diagrams.satellite.pose_sensor import PoseReader
from vtbdrake_diagrams.satellite.relative_motion import RelativeMotion
from vtbdrake_diagrams.satellite.supervisor import GUIDANCE, PLAN, PLAN_KNOTS, PLAN_TIME_OF_NONE, Supervisor

if TYPE_CHECKING:
    from pydrake.systems.sensors import CameraInfo

PERIOD = 0.02
"""The period of the DPS and of the sensors that it needs in every sample, in s."""
POSE_PERIOD = 0.1
"""The period of the pose sensor, in s."""

# The signals of the sensors, and the names of the tracker's ports for them.
_SIGNALS = {"camera": "image", "scanner": "scan"}
_SOURCES = {"camera": "markers", "scanner": "registration", "pose_sensor": "pose"}


@dataclass(frozen=True)
class TargetSensors:
    """The sensors with which the DPS perceives the target.

    Attributes:
        guides: The sensors that the tracker follows: some of ``camera``, ``scanner`` and ``pose_sensor``.
        aboard: Those of ``camera`` and ``scanner`` whose data are evaluated, whether the tracker follows them or not.
        config: How images and scans are evaluated.
        image: Size of the images and intrinsics of the camera, if it is aboard.
        X_BC: Pose of the camera on the base.
        image_latency: How old the images are when they are shown, in s.
        pose_latency: How old the poses of the pose sensor are when they are shown, in s.
    """

    guides: tuple[str, ...]
    aboard: tuple[str, ...]
    config: PerceptionConfig
    image: CameraInfo | None
    X_BC: RigidTransform
    image_latency: float
    pose_latency: float


@dataclass(frozen=True)
class ApproachConfig:
    """The settings of the planned approach of the arm.

    Attributes:
        duration: The duration of the move, in s.
        latency: The time that planning may take, in s.
    """

    duration: float
    latency: float


def make_dps(
    sensing: TargetSensors,
    *,
    period: float = PERIOD,
    wheels: bool = False,
    approach: ApproachConfig | None = None,
) -> Diagram:
    """Return the DPS: ``sense`` calibrates, ``env`` perceives, ``impl`` leads the capture, ``act`` limits.

    Input ports: ``joint_position`` (9: the arm's joints in rad, the fingers in m), ``imu`` (6), ``target_pose`` (7, see
    `PoseSensor`), ``image`` and ``scan`` if the sensors are aboard, and the command ``capture`` (1: go ahead, 0: wait,
    -1: abort). Output ports: ``joint_position`` (9) and, with ``wheels``, ``wheel_torque`` (3, N m, on the base about
    its axes).

    Every part is sampled with ``period`` (s) and shows its own state: no input feeds through. With ``approach``,
    ``impl`` has two more: the slow part ``planner`` plans the arm's approach, and ``approach`` tells where the plan is.
    """
    builder = DiagramBuilder()
    sense = builder.AddNamedSystem(
        "sense",
        make_calibration({"joint_position": len(JOINT_NAMES), "imu": 6}, largest={"joint_position": 0.1, "imu": 1.0}),
    )
    env = builder.AddNamedSystem("env", _make_env(sensing, period=period))
    impl = builder.AddNamedSystem("impl", _make_impl(sensing.config, period=period, wheels=wheels, approach=approach))
    act = builder.AddNamedSystem("act", _make_act(wheels=wheels))
    for signal in ("joint_position", "imu"):
        builder.ExportInput(sense.GetInputPort(signal), signal)
    for signal in ("target_pose", *(_SIGNALS[sensor] for sensor in sensing.aboard)):
        builder.ExportInput(env.GetInputPort(signal), signal)
    builder.ExportInput(impl.GetInputPort("capture"), "capture")
    builder.Connect(sense.GetOutputPort("imu"), env.GetInputPort("imu"))
    builder.Connect(sense.GetOutputPort("joint_position"), impl.GetInputPort("joints"))
    for port in ("base", "target", "status"):
        builder.Connect(env.GetOutputPort(port), impl.GetInputPort(port))
    for port in ("joint_position", *(["wheel_torque"] if wheels else [])):
        builder.Connect(impl.GetOutputPort(port), act.GetInputPort(port))
        builder.ExportOutput(act.GetOutputPort(port), port)
    dps = builder.Build()
    dps.set_name("dps")
    return dps


def _make_env(sensing: TargetSensors, *, period: float) -> Diagram:
    """Return the perceived environment: where the base is in its inertial frame I, and how the target moves there.

    The tracker has an input port for every source that is aboard; those that do not guide it show no estimate there.
    So a DPS that is guided by the pose sensor can continue from the state of one that sees.
    """
    builder = DiagramBuilder()
    base = builder.AddNamedSystem("base", BaseEstimator(period=period))
    reader = PoseReader(period=period, latency=sensing.pose_latency)
    builder.AddNamedSystem("pose_reader", reader)
    sensors = (*sensing.aboard, "pose_sensor")
    starting = [_SOURCES[sensor] for sensor in sensing.guides if sensor != "scanner"] or [_SOURCES["scanner"]]
    tracker = TargetTracker(
        [_SOURCES[sensor] for sensor in sensors], starting=starting, period=period, motion=sensing.config.motion
    )
    target = builder.AddNamedSystem("target", tracker)
    sources = {"pose_sensor": reader.GetOutputPort("estimate")}
    if sensing.image is not None:
        markers = add_marker_part(
            builder,
            base,
            target,
            config=sensing.config,
            period=period,
            info=sensing.image,
            X_BC=sensing.X_BC,
            image_latency=sensing.image_latency,
        )
        sources["camera"] = markers.GetOutputPort("estimate")
    if "scanner" in sensing.aboard:
        attitude = RotationMatrix() if sensing.guides == ("scanner",) else None
        registration = add_scan_part(builder, base, target, config=sensing.config, period=period, attitude=attitude)
        sources["scanner"] = registration.GetOutputPort("estimate")
    for sensor in sensors:
        port = sources[sensor]
        if sensor not in sensing.guides:
            unused = builder.AddNamedSystem(
                f"no_{_SOURCES[sensor]}", ConstantValueSource(Value(PoseEstimate.missing()))
            )
            port = unused.get_output_port()
        builder.Connect(port, target.GetInputPort(_SOURCES[sensor]))
    builder.Connect(base.GetOutputPort("history"), reader.GetInputPort("history"))
    builder.ExportInput(base.GetInputPort("imu"), "imu")
    builder.ExportInput(reader.GetInputPort("target_pose"), "target_pose")
    builder.ExportOutput(base.GetOutputPort("base"), "base")
    builder.ExportOutput(target.GetOutputPort("state"), "target")
    builder.ExportOutput(target.GetOutputPort("status"), "status")
    return builder.Build()


def _make_impl(config: PerceptionConfig, *, period: float, wheels: bool, approach: ApproachConfig | None) -> Diagram:
    """Return the supervisor and the controllers that it leads."""
    builder = DiagramBuilder()
    relative = builder.AddNamedSystem("relative", RelativeMotion(period=period))
    acceleration, duration = ACCELERATION if wheels else UNLIMITED, approach.duration if approach else None
    supervisor = builder.AddNamedSystem(
        "supervisor", Supervisor(period=period, acceleration=acceleration, plan_duration=duration)
    )
    controller = builder.AddNamedSystem(
        "controller", ArmController(period=period, wheels=wheels, plans=approach is not None)
    )
    for port in ("base", "target", "status"):
        builder.ExportInput(relative.GetInputPort(port), port)
    builder.ExportInput(supervisor.GetInputPort("capture"), "capture")
    for k, system in enumerate((relative, supervisor, controller)):
        port = system.GetInputPort("joint_position")
        if k:
            builder.ConnectInput("joints", port)
            builder.Connect(relative.get_output_port(), system.GetInputPort("relative"))
        else:
            builder.ExportInput(port, "joints")
    builder.Connect(supervisor.GetOutputPort("guidance"), controller.GetInputPort("guidance"))
    if approach is not None:
        _add_planner(
            builder, supervisor, controller, approach=approach, motion=config.motion, period=period, wheels=wheels
        )
    builder.ExportOutput(controller.GetOutputPort("joint_position"), "joint_position")
    if wheels:
        attitude = builder.AddNamedSystem("attitude", AttitudeController(period=period))
        builder.ConnectInput("base", attitude.GetInputPort("base"))
        builder.ConnectInput("joints", attitude.GetInputPort("joint_position"))
        for port, source in (("reaction", controller), ("guidance", supervisor)):
            builder.Connect(source.GetOutputPort(port), attitude.GetInputPort(port))
        builder.ExportOutput(attitude.get_output_port(), "wheel_torque")
    return builder.Build()


def _add_planner(
    builder: DiagramBuilder,
    supervisor: Supervisor,
    controller: ArmController,
    *,
    approach: ApproachConfig,
    motion: MotionModel,
    period: float,
    wheels: bool,
) -> None:
    """Add the slow part that plans the approach, and what follows the plan."""
    # Imported here: without it, the DPS needs no optimization.
    from vtbdrake_diagrams.satellite.approach import ApproachPlanner

    s = Servicer()
    function = ApproachPlanner(
        duration=approach.duration, period=period, latency=approach.latency, wheels=wheels, motion=motion
    )
    none = np.concatenate([[PLAN_TIME_OF_NONE], np.tile(s.stowed, PLAN_KNOTS)])
    part = SlowPart(
        function,
        inputs={"base": BASE, "target": STATE_SIZE, "guidance": GUIDANCE, "joint_position": len(JOINT_NAMES)},
        outputs={"plan": PLAN, "fixture": 3, "disturbance": 1},
        period=period,
        latency=approach.latency,
        offset=period,
        initial={"plan": none},
        on_request=True,
    )
    planner = builder.AddNamedSystem("planner", part)
    spline = Spline("bspline", PLAN_KNOTS, approach.duration)
    follower = builder.AddNamedSystem(
        "approach", SplineCommand(spline, period=period, size=ARM_JOINTS, initial=s.stowed, unit="rad")
    )
    builder.ConnectInput("base", planner.GetInputPort("base"))
    builder.ConnectInput("target", planner.GetInputPort("target"))
    builder.ConnectInput("target", supervisor.GetInputPort("target"))
    builder.Connect(supervisor.GetOutputPort("guidance"), planner.GetInputPort("guidance"))
    builder.Connect(supervisor.GetOutputPort("request"), planner.GetInputPort("request"))
    builder.Connect(controller.GetOutputPort("joint_position"), planner.GetInputPort("joint_position"))
    builder.Connect(planner.GetOutputPort("plan"), follower.GetInputPort("plan"))
    for port in ("plan", "fixture", "missed"):
        builder.Connect(planner.GetOutputPort(port), supervisor.GetInputPort(port))
    builder.Connect(supervisor.GetOutputPort("arrival"), controller.GetInputPort("arrival"))
    builder.Connect(follower.GetOutputPort("value"), controller.GetInputPort("plan_position"))


def _make_act(*, wheels: bool) -> Diagram:
    """Return the system that keeps the commands within the limits of joints and wheels."""
    builder = DiagramBuilder()
    s = Servicer()
    lower, upper = np.concatenate((s.lower, [0.0, 0.0])), np.concatenate((s.upper, [s.opening, s.opening]))
    limits = {"joint_position": (lower, upper)}
    if wheels:
        limits["wheel_torque"] = (np.full(3, -s.wheel_torque), np.full(3, s.wheel_torque))
    for name, (least, most) in limits.items():
        limited = builder.AddNamedSystem(name, Saturation(least, most))
        builder.ExportInput(limited.get_input_port(), name)
        builder.ExportOutput(limited.get_output_port(), name)
    return builder.Build()
