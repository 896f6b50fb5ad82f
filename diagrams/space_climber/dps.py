"""The robot's data processing system: one function builds it for the testbed, its mental copies and the robot."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, DiscreteValues, LeafSystem
from pydrake.systems.primitives import Multiplexer

from vtbdrake.state import discrete_state, parameter
from vtbdrake.state.declarations import NO_DICT
from vtbdrake_diagrams.space_climber.conditioning import calibrate, limit
from vtbdrake_diagrams.space_climber.estimation import PerceivedEnvironment
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
    towards, rad, in the world) and ``walk`` (0 stands, 1 walks the full stroke). Output port: ``joint_position`` (18
    targets, rad, in the order of JOINT_NAMES, which is that of the model's actuators).

    Every part is sampled with ``period`` (s) and shows its own state: no input feeds through, and what the sensors see
    reaches the command four periods later. Feet are lifted by ``clearance`` (m). With a
    `Navigator`, which takes the port ``visual_odometry`` (3, m/s), the robot keeps a line over the ground in the
    direction of the heading, and stops when it tips.
    """
    if gait not in GAITS:
        raise ValueError(f"gait is '{gait}', but must be one of {', '.join(GAITS)}.")
    morphology = morphology or Morphology()
    builder = DiagramBuilder()
    sense = builder.AddNamedSystem("sense", _make_sense(period=period, morphology=morphology))
    env = builder.AddNamedSystem("env", PerceivedEnvironment(period=period, morphology=morphology))
    walking = make_walking(GAITS[gait], period=period, morphology=morphology, clearance=clearance, navigator=navigator)
    impl = builder.AddNamedSystem("impl", walking)
    act = builder.AddNamedSystem("act", CommandLimiter(period=period, morphology=morphology))
    for signal in SENSOR_SIGNALS:
        builder.ExportInput(sense.GetInputPort(signal), signal)
    for signal in ("heading", "walk", *(["visual_odometry"] if navigator else [])):
        builder.ExportInput(impl.GetInputPort(signal), signal)
    builder.Connect(sense.get_output_port(), env.get_input_port())
    builder.Connect(env.GetOutputPort("pose"), impl.GetInputPort("pose"))
    builder.Connect(impl.GetOutputPort("joint_position"), act.GetInputPort("joint_position"))
    builder.ExportOutput(act.GetOutputPort("joint_position"), "joint_position")
    dps = builder.Build()
    dps.set_name("dps")
    return dps


def _make_sense(*, period: float, morphology: Morphology) -> Diagram:
    builder = DiagramBuilder()
    raw = builder.AddNamedSystem("raw", Multiplexer(list(SENSOR_SIGNALS.values())))
    calibration = builder.AddNamedSystem("calibration", Calibration(period=period, morphology=morphology))
    for k, signal in enumerate(SENSOR_SIGNALS):
        builder.ExportInput(raw.get_input_port(k), signal)
    builder.Connect(raw.get_output_port(), calibration.get_input_port())
    builder.ExportOutput(calibration.get_output_port(), "measurements")
    return builder.Build()


class Calibration(LeafSystem):
    """A system that calibrates the raw sensor values and filters those of the IMU.

    .. pydrake_system::

        name: Calibration
        input_ports:
        - raw
        output_ports:
        - measurements

    Both ports are [imu (6), joint_encoders (18), foot_contact (6)]. The IMU's biases and the encoders' offsets are
    subtracted; then the IMU's values pass a first-order low-pass with the time constant tau,
    ``y += (1 - exp(-T / tau)) (u - y)``. The output is the state of the last sample.
    """

    __slots__ = NO_DICT

    def __init__(self, *, period: float, morphology: Morphology) -> None:
        super().__init__()
        self._period = period
        stance = LegKinematics(morphology).inverse(morphology.stance).ravel()
        joints, feet = stance.size, len(LEGS)
        self._raw = self.DeclareVectorInputPort("raw", 6 + joints + feet)
        measurements = self.DeclareDiscreteState(np.concatenate([np.zeros(6), stance, np.zeros(feet)]))
        self.DeclareStateOutputPort("measurements", measurements)
        # What is subtracted from every raw value, then tau.
        self.DeclareNumericParameter(BasicVector([*np.zeros(6 + joints + feet), 0.02]))
        self.variables = (
            discrete_state("imu", 0, shape=(6,), unit="rad/s, m/s^2"),
            discrete_state("joint_encoders", 0, start=6, shape=(joints,), unit="rad"),
            discrete_state("foot_contact", 0, start=6 + joints, shape=(feet,), bounds=(0.0, 1.0)),
            parameter("gyro_bias", 0, shape=(3,), unit="rad/s", bounds=(-1.0, 1.0)),
            parameter("accelerometer_bias", 0, start=3, shape=(3,), unit="m/s^2", bounds=(-1.0, 1.0)),
            parameter("encoder_offset", 0, start=6, shape=(joints,), unit="rad", bounds=(-0.1, 0.1)),
            parameter("imu_time_constant", 0, start=6 + joints + feet, unit="s", bounds=(0.0, 10.0)),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        parameters = context.get_numeric_parameter(0).value()
        raw, measurements = self._raw.Eval(context), state.get_mutable_value(0)
        calibrate(parameters, raw, measurements, filtered=SENSOR_SIGNALS["imu"], period=self._period)


class CommandLimiter(LeafSystem):
    """A system that keeps joint commands within the ranges and the speed of the joints.

    .. pydrake_system::

        name: CommandLimiter
        input_ports:
        - joint_position
        output_ports:
        - joint_position

    The output is the state of the last sample: the input, no further than ``rate * T`` from the command before, and
    between ``lower`` and ``upper``. The first command is the nominal stance.
    """

    __slots__ = NO_DICT

    def __init__(self, *, period: float, morphology: Morphology) -> None:
        super().__init__()
        self._period = period
        stance = LegKinematics(morphology).inverse(morphology.stance).ravel()
        self._target = self.DeclareVectorInputPort("joint_position", stance.size)
        self.DeclareStateOutputPort("joint_position", self.DeclareDiscreteState(stance))
        limits = [*morphology.joint_lower, *morphology.joint_upper, morphology.joint_speed]
        self.DeclareNumericParameter(BasicVector(limits))
        size = len(JOINT_NAMES)
        self.variables = (
            discrete_state("joint_position", 0, shape=(size,), unit="rad"),
            parameter("lower", 0, shape=(size,), unit="rad", bounds=(-np.pi, np.pi)),
            parameter("upper", 0, start=size, shape=(size,), unit="rad", bounds=(-np.pi, np.pi)),
            parameter("rate", 0, start=2 * size, unit="rad/s", bounds=(0.0, morphology.joint_speed)),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        limits = context.get_numeric_parameter(0).value()
        limit(limits, self._target.Eval(context), state.get_mutable_value(0), period=self._period)
