"""The walking controller: gait generator with heading and posture feedback."""

from __future__ import annotations

from pydrake.systems.framework import Context, Diagram, DiagramBuilder, DiscreteValues
from pydrake.systems.primitives import Multiplexer

from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake_diagrams.space_climber.gait import Gait
from vtbdrake_diagrams.space_climber.kinematics import LegKinematics
from vtbdrake_diagrams.space_climber.morphology import Morphology
from vtbdrake_diagrams.space_climber.navigation import Navigator
from vtbdrake_diagrams.space_climber.walker import Walker


class GaitGenerator(AddressedSystem):
    """A system that computes joint positions from a walk command and a heading.

    .. pydrake_system::

        name: GaitGenerator
        input_ports:
        - input
        output_ports:
        - joint_position

    ``input`` is [roll, pitch, yaw, x, y, height, heading, walk]: the estimated pose and the commands.

    * Start and stop: ``walk`` in [0, 1] scales stroke, clearance and turning. The level follows it at the rate
      1 / ``ramp_time``; standing is a level of 0 with a phase that rests.
    * Heading: the robot walks along its own x axis and turns at ``heading_gain * (heading - yaw)``, within
      +- ``yaw_rate_limit``.
    * Posture: the plane of the feet's heights leans against the torso's tilt. The lean grows with ``posture_gain``
      times (roll, pitch), within +- ``lean_limit``.

    ``joint_position`` is a state: the inverse kinematics of the feet, as of the last sample.
    """

    def __init__(self, gait: Gait, *, period: float, morphology: Morphology, clearance: float = 0.05) -> None:
        super().__init__()
        legs = LegKinematics(morphology)
        foot_radius = morphology.foot_radius
        self._walker = Walker(gait, legs, stance=morphology.stance, foot_radius=foot_radius, period=period)
        self._input = self.DeclareVectorInputPort("input", 8)
        self._gait = self.declare_discrete_state(
            phase=Quantity(0.0, "cycle", (0.0, 1.0)),
            level=Quantity(0.0, bounds=(0.0, 1.0)),
            lean=Quantity([0.0, 0.0], "rad"),
            feet=Quantity(morphology.stance[:, :2], "m"),
        )
        self._command = self.declare_discrete_state(
            joint_position=Quantity(legs.inverse(morphology.stance).ravel(), "rad")
        )
        self.DeclareStateOutputPort("joint_position", self._command.index)
        self._settings = self.declare_parameters(
            period=Quantity(2.0, "s", (0.2, 60.0)),
            stroke=Quantity(0.2, "m", (0.0, 0.3)),
            clearance=Quantity(clearance, "m", (0.0, 0.15)),
            height=Quantity(morphology.torso_clearance, "m", (0.1, 0.35)),
            ramp_time=Quantity(1.0, "s", (0.02, 60.0)),
            heading_gain=Quantity(0.5, "1/s", (0.0, 10.0)),
            yaw_rate_limit=Quantity(0.15, "rad/s", (0.0, 1.0)),
            posture_gain=Quantity(1.0, "1/s", (0.0, 10.0)),
            lean_limit=Quantity(0.15, "rad", (0.0, 0.5)),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        self._walker.step(
            self._settings.array(context),
            self._input.Eval(context),
            self._gait.mutable_array(state),
            self._command.mutable_array(state),
        )


def make_walking(
    gait: Gait, *, period: float, morphology: Morphology, clearance: float = 0.05, navigator: bool = False
) -> Diagram:
    """Build the subsystem ``gait`` with the input ports ``pose``, ``heading`` and ``walk``.

    Args:
        gait: The gait.
        period: Sample period in s.
        morphology: The robot's.
        clearance: Default height to which the gait lifts the feet, in m.
        navigator: True puts a `Navigator`, with the port ``visual_odometry``, between the commands and the gait.
    """
    builder = DiagramBuilder()
    # One vector input costs a Python system a third of three.
    inputs = builder.AddNamedSystem("inputs", Multiplexer([6, 1, 1]))
    generator = GaitGenerator(gait, period=period, morphology=morphology, clearance=clearance)
    builder.AddNamedSystem("gait", generator)
    ports = {signal: inputs.get_input_port(k) for k, signal in enumerate(("pose", "heading", "walk"))}
    builder.ExportInput(ports["pose"], "pose")
    if navigator:
        sensed = builder.AddNamedSystem("navigator_inputs", Multiplexer([6, 1, 1, 3]))
        system = builder.AddNamedSystem("navigator", Navigator(period=period))
        builder.ConnectInput("pose", sensed.get_input_port(0))
        for k, signal in enumerate(("heading", "walk", "visual_odometry"), start=1):
            builder.ExportInput(sensed.get_input_port(k), signal)
        builder.Connect(sensed.get_output_port(), system.get_input_port())
        builder.Connect(system.GetOutputPort("course"), ports["heading"])
        builder.Connect(system.GetOutputPort("walk"), ports["walk"])
    else:
        for signal in ("heading", "walk"):
            builder.ExportInput(ports[signal], signal)
    builder.Connect(inputs.get_output_port(), generator.get_input_port())
    builder.ExportOutput(generator.get_output_port(), "joint_position")
    return builder.Build()
