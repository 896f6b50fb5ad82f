"""The robot's data processing system: one function builds it for the testbed, its mental copies and the robot."""

from __future__ import annotations

from math import exp

import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)

from diagrams.space_climber.estimation import PerceivedEnvironment
from diagrams.space_climber.gait import GAITS
from diagrams.space_climber.kinematics import LegKinematics
from diagrams.space_climber.morphology import JOINT_NAMES, LEGS, Morphology
from diagrams.space_climber.walking import GaitGenerator, Posture
from vtbdrake.state import discrete_state, parameter


def make_dps(gait: str = "tripod", *, period: float = 0.02, morphology: Morphology | None = None) -> Diagram:
    """The DPS: ``sense`` calibrates and filters, ``env`` perceives, ``impl`` walks, ``act`` limits.

    Input ports: ``imu`` (gyro in rad/s, then specific force in m/s^2, in the sensor's frame, which is parallel to the torso's),
    ``joint_encoders`` (18, rad), ``foot_contact`` (6, 0 or 1) and the commands ``heading`` (the yaw to walk towards, rad,
    in the world) and ``walk`` (0 stands, 1 walks the full stroke). Output port: ``joint_position`` (18 targets, rad, in the
    order of JOINT_NAMES, which is that of the model's actuators).

    Every part is sampled with ``period`` (s). ``sense``, ``env``, ``posture`` and ``act`` show their own state, the
    gait generator a function of its own: so a change of attitude reaches the command after five periods at most,
    and no input feeds through.
    """
    if gait not in GAITS:
        raise ValueError(f"gait is '{gait}', but must be one of {', '.join(GAITS)}.")
    morphology = morphology or Morphology()
    builder = DiagramBuilder()
    sense = builder.AddNamedSystem("sense", Sense(period=period, morphology=morphology))
    env = builder.AddNamedSystem("env", PerceivedEnvironment(period=period, morphology=morphology))
    impl = builder.AddNamedSystem("impl", _make_impl(gait, period=period, morphology=morphology))
    act = builder.AddNamedSystem("act", CommandLimiter(period=period, morphology=morphology))
    for signal in ("imu", "joint_encoders", "foot_contact"):
        builder.ExportInput(sense.GetInputPort(signal), signal)
        builder.Connect(sense.GetOutputPort(signal), env.GetInputPort(signal))
    for signal in ("heading", "walk"):
        builder.ExportInput(impl.GetInputPort(signal), signal)
    builder.Connect(env.GetOutputPort("attitude"), impl.GetInputPort("attitude"))
    builder.Connect(impl.GetOutputPort("joint_position"), act.GetInputPort("joint_position"))
    builder.ExportOutput(act.GetOutputPort("joint_position"), "joint_position")
    dps = builder.Build()
    dps.set_name("dps")
    return dps


def _make_impl(gait: str, *, period: float, morphology: Morphology) -> Diagram:
    builder = DiagramBuilder()
    posture = builder.AddNamedSystem("posture", Posture(period=period))
    generator = builder.AddNamedSystem("gait", GaitGenerator(GAITS[gait], period=period, morphology=morphology))
    builder.ExportInput(posture.GetInputPort("attitude"), "attitude")
    builder.ConnectInput("attitude", generator.GetInputPort("attitude"))
    builder.Connect(posture.GetOutputPort("lean"), generator.GetInputPort("lean"))
    builder.ExportInput(generator.GetInputPort("heading"), "heading")
    builder.ExportInput(generator.GetInputPort("walk"), "walk")
    builder.ExportOutput(generator.GetOutputPort("joint_position"), "joint_position")
    return builder.Build()


class Sense(LeafSystem):
    """Calibrates the raw sensor values and filters the IMU's.

    .. pydrake_system::

        name: Sense
        input_ports:
        - imu
        - joint_encoders
        - foot_contact
        output_ports:
        - imu
        - joint_encoders
        - foot_contact

    The gyro's bias and the encoders' offsets are subtracted; the IMU's six values pass a first-order low-pass with the
    time constant tau: ``y += (1 - exp(-T / tau)) (u - y)``. The outputs are the states of the last sample.
    """

    def __init__(self, *, period: float, morphology: Morphology) -> None:
        super().__init__()
        self._period = period
        stance = LegKinematics(morphology).inverse(morphology.stance).ravel()
        signals = {"imu": np.zeros(6), "joint_encoders": stance, "foot_contact": np.zeros(len(LEGS))}
        self._input_ports = [self.DeclareVectorInputPort(name, y0.size) for name, y0 in signals.items()]
        for name, y0 in signals.items():
            self.DeclareStateOutputPort(name, self.DeclareDiscreteState(y0))
        self.DeclareNumericParameter(BasicVector([0.02, 0.0, 0.0, 0.0]))
        self.DeclareNumericParameter(BasicVector(np.zeros(stance.size)))
        self.variables = (
            discrete_state("imu", 0, shape=(6,), unit="rad/s, m/s^2"),
            discrete_state("joint_encoders", 1, shape=(stance.size,), unit="rad"),
            discrete_state("foot_contact", 2, shape=(len(LEGS),), bounds=(0.0, 1.0)),
            parameter("imu_time_constant", 0, start=0, unit="s", bounds=(0.0, 10.0)),
            parameter("gyro_bias", 0, shape=(3,), start=1, unit="rad/s"),
            parameter("encoder_offset", 1, shape=(stance.size,), unit="rad"),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        imu_port, encoder_port, contact_port = self._input_ports
        tau, *bias = context.get_numeric_parameter(0).value().tolist()
        share = 1.0 - exp(-self._period / tau) if tau > 0.0 else 1.0
        last = context.get_discrete_state(0).value().tolist()
        raw = imu_port.Eval(context).tolist()
        offsets = (*bias, 0.0, 0.0, 0.0)
        state.set_value(0, [y + share * (u - b - y) for y, u, b in zip(last, raw, offsets, strict=True)])
        state.set_value(1, encoder_port.Eval(context) - context.get_numeric_parameter(1).value())
        state.set_value(2, contact_port.Eval(context))


class CommandLimiter(LeafSystem):
    """Keeps joint commands within the joints' ranges and speed.

    .. pydrake_system::

        name: CommandLimiter
        input_ports:
        - joint_position
        output_ports:
        - joint_position

    The output is the state of the last sample: the input, no further than ``rate * T`` from the command before, and
    between ``lower`` and ``upper``. The first command is the nominal stance.
    """

    def __init__(self, *, period: float, morphology: Morphology) -> None:
        super().__init__()
        self._period = period
        stance = LegKinematics(morphology).inverse(morphology.stance).ravel()
        self._target = self.DeclareVectorInputPort("joint_position", stance.size)
        self.DeclareStateOutputPort("joint_position", self.DeclareDiscreteState(stance))
        self.DeclareNumericParameter(BasicVector([morphology.joint_speed]))
        self.DeclareNumericParameter(BasicVector(morphology.joint_lower))
        self.DeclareNumericParameter(BasicVector(morphology.joint_upper))
        size = len(JOINT_NAMES)
        self.variables = (
            discrete_state("joint_position", 0, shape=(size,), unit="rad"),
            parameter("rate", 0, unit="rad/s", bounds=(0.0, np.inf)),
            parameter("lower", 1, shape=(size,), unit="rad", bounds=(-np.pi, np.pi)),
            parameter("upper", 2, shape=(size,), unit="rad", bounds=(-np.pi, np.pi)),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        reach = context.get_numeric_parameter(0)[0] * self._period
        last = context.get_discrete_state(0).value()
        command = np.minimum(np.maximum(self._target.Eval(context), last - reach), last + reach)
        lower, upper = context.get_numeric_parameter(1).value(), context.get_numeric_parameter(2).value()
        state.set_value(0, np.minimum(np.maximum(command, lower), upper))
