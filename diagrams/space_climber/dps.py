"""The robot's data processing system: one function builds it for the testbed, its mental copies and the robot."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace

import casadi
import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder, System
from pydrake.systems.primitives import Multiplexer

from vtbdrake.components.casadi_system import clamp
from vtbdrake.state import NamedVector, Quantity
from vtbdrake_diagrams.packed_system import Expression, packed_system
from vtbdrake_diagrams.space_climber.estimation import make_perceived_environment
from vtbdrake_diagrams.space_climber.gait import GAITS
from vtbdrake_diagrams.space_climber.kinematics import LegKinematics
from vtbdrake_diagrams.space_climber.morphology import JOINT_NAMES, LEGS, Morphology
from vtbdrake_diagrams.space_climber.walking import make_walking

SENSOR_SIGNALS = {"imu": 6, "joint_encoders": len(JOINT_NAMES), "foot_contact": len(LEGS)}


def make_dps(
    gait: str = "tripod",
    *,
    period: float,
    morphology: Morphology | None = None,
    clearance: float = 0.05,
    navigator: bool = False,
) -> Diagram:
    """Build the DPS: ``sense`` calibrates and filters, ``env`` perceives, ``impl`` walks, ``act`` limits.

    Input ports: ``imu`` (gyro in rad/s, then specific force in m/s^2, in the sensor's frame, which is parallel to the
    torso's), ``joint_encoders`` (18, rad), ``foot_contact`` (6, 0 or 1) and the commands ``heading`` (the yaw to walk
    towards, rad, in the world) and ``walk`` (0 stands, 1 walks the full stroke, -1 backwards). Output port:
    ``joint_position`` (18 targets, rad, in the order of JOINT_NAMES, which equals the model's actuators').

    Every part is sampled with ``period`` (s) and shows its own state: no input feeds through, and what the sensors see
    reaches the command four periods later. Feet are lifted by ``clearance`` (m). With a
    `Navigator`, which takes the port ``visual_odometry`` (3, m/s), the robot keeps a line over the ground in the
    direction of the heading, and stops when it tips.
    """
    builder = DiagramBuilder()
    impl = add_walker(builder, gait, period=period, morphology=morphology, clearance=clearance, navigator=navigator)
    for signal in ("heading", "walk", *(["visual_odometry"] if navigator else [])):
        builder.ExportInput(impl.GetInputPort(signal), signal)
    dps = builder.Build()
    dps.set_name("dps")
    return dps


def add_walker(
    builder: DiagramBuilder,
    gait: str,
    *,
    period: float,
    morphology: Morphology | None = None,
    clearance: float = 0.05,
    navigator: bool = False,
) -> Diagram:
    """Add the subsystems of a DPS that walks, with the ports of its sensor signals and its command; see `make_dps`.

    Args:
        builder: The builder of the DPS.
        gait: The gait.
        period: Sample period in s.
        morphology: The robot's.
        clearance: Height to which the feet are lifted, in m.
        navigator: Whether there is a `Navigator`.

    Returns:
        The subsystem ``impl``; its ports ``heading``, ``walk`` and, with a navigator, ``visual_odometry`` are free.
    """
    if gait not in GAITS:
        raise ValueError(f"gait is '{gait}', but must be one of {', '.join(GAITS)}.")
    morphology = morphology or Morphology()
    sense = builder.AddNamedSystem("sense", _make_sense(period=period, morphology=morphology))
    env = builder.AddNamedSystem("env", make_perceived_environment(period=period, morphology=morphology))
    walking = make_walking(GAITS[gait], period=period, morphology=morphology, clearance=clearance, navigator=navigator)
    impl = builder.AddNamedSystem("impl", walking)
    act = builder.AddNamedSystem("act", make_command_limiter(period=period, morphology=morphology))
    for signal in SENSOR_SIGNALS:
        builder.ExportInput(sense.GetInputPort(signal), signal)
    builder.Connect(sense.get_output_port(), env.get_input_port())
    builder.Connect(env.GetOutputPort("pose"), impl.GetInputPort("pose"))
    builder.Connect(impl.GetOutputPort("joint_position"), act.GetInputPort("target"))
    builder.ExportOutput(act.GetOutputPort("joint_position"), "joint_position")
    return impl


def _make_sense(*, period: float, morphology: Morphology) -> Diagram:
    builder = DiagramBuilder()
    raw = builder.AddNamedSystem("raw", Multiplexer(list(SENSOR_SIGNALS.values())))
    calibration = builder.AddNamedSystem("calibration", make_calibration(period=period, morphology=morphology))
    for k, signal in enumerate(SENSOR_SIGNALS):
        builder.ExportInput(raw.get_input_port(k), signal)
    builder.Connect(raw.get_output_port(), calibration.get_input_port())
    builder.ExportOutput(calibration.get_output_port(), "measurements")
    return builder.Build()


def make_calibration(*, period: float, morphology: Morphology) -> System:
    """Return the system that calibrates the raw sensor values and filters the IMU's.

    .. pydrake_system::

        name: calibration
        input_ports:
        - raw
        output_ports:
        - measurements

    Both ports are [imu (6), joint_encoders (18), foot_contact (6)]. The IMU's biases and the encoders' offsets are
    subtracted; then the IMU's values pass a first-order low-pass with the time constant tau,
    ``y += (1 - exp(-T / tau)) (u - y)``. The output is the state of the last sample.

    Args:
        period: The sample period T in s.
        morphology: The robot's, whose nominal stance is the first measurement.
    """
    stance = LegKinematics(morphology).inverse(morphology.stance).ravel()

    def step(x: SimpleNamespace, u: SimpleNamespace, p: SimpleNamespace) -> Mapping[str, Expression]:
        tau = p.imu_time_constant
        decay = casadi.if_else(tau > 0.0, casadi.exp(-period / tau), 0.0)
        imu = u.imu_raw - casadi.vertcat(p.gyro_bias, p.accelerometer_bias)
        return {
            "imu": imu + casadi.if_else(decay > 0.0, decay * (x.imu - imu), 0.0),
            "joint_encoders": u.joint_encoders_raw - p.encoder_offset,
            "foot_contact": u.foot_contact_raw,
        }

    raw = NamedVector(**{f"{signal}_raw": Quantity(np.zeros(size)) for signal, size in SENSOR_SIGNALS.items()})
    measurements = NamedVector(
        imu=Quantity(np.zeros(6), "rad/s, m/s^2"),
        joint_encoders=Quantity(stance, "rad"),
        foot_contact=Quantity(np.zeros(len(LEGS)), bounds=(0.0, 1.0)),
    )
    parameters = NamedVector(
        gyro_bias=Quantity(np.zeros(3), "rad/s", (-1.0, 1.0)),
        accelerometer_bias=Quantity(np.zeros(3), "m/s^2", (-1.0, 1.0)),
        encoder_offset=Quantity(np.zeros(stance.size), "rad", (-0.1, 0.1)),
        imu_time_constant=Quantity(0.02, "s", (0.0, 10.0)),
    )
    return packed_system(
        "calibration",
        step,
        state={"measurements": measurements},
        inputs={"raw": raw},
        parameters=parameters,
        period=period,
    )


def make_command_limiter(*, period: float, morphology: Morphology) -> System:
    """Return the system that keeps joint commands within the ranges and the speed of the joints.

    .. pydrake_system::

        name: act
        input_ports:
        - target
        output_ports:
        - joint_position

    The output is the state of the last sample: the target, no further than ``rate * T`` from the command before, and
    between ``lower`` and ``upper``. The first command is the nominal stance.

    Args:
        period: The sample period T in s.
        morphology: The robot's, with the ranges and the speed of its joints.
    """
    stance = LegKinematics(morphology).inverse(morphology.stance).ravel()

    def step(x: SimpleNamespace, u: SimpleNamespace, p: SimpleNamespace) -> Mapping[str, Expression]:
        reach = p.rate * period
        command = x.joint_position + clamp(u.angles - x.joint_position, -reach, reach)
        return {"joint_position": clamp(command, p.lower, p.upper)}

    parameters = NamedVector(
        lower=Quantity(morphology.joint_lower, "rad", (-np.pi, np.pi)),
        upper=Quantity(morphology.joint_upper, "rad", (-np.pi, np.pi)),
        rate=Quantity(morphology.joint_speed, "rad/s", (0.0, morphology.joint_speed)),
    )
    return packed_system(
        "act",
        step,
        state={"joint_position": NamedVector(joint_position=Quantity(stance, "rad"))},
        inputs={"target": NamedVector(angles=Quantity(stance, "rad"))},
        parameters=parameters,
        period=period,
    )
