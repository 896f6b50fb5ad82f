"""The walking controller: gait generator with heading and posture feedback."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, DiscreteValues, LeafSystem
from pydrake.systems.primitives import Multiplexer

from vtbdrake.state import discrete_state, parameter
from vtbdrake.state.declarations import NO_DICT
from vtbdrake_diagrams.space_climber.gait import Gait
from vtbdrake_diagrams.space_climber.kinematics import LegKinematics
from vtbdrake_diagrams.space_climber.morphology import LEGS, Morphology
from vtbdrake_diagrams.space_climber.navigation import Navigator
from vtbdrake_diagrams.space_climber.walker import Walker


class GaitGenerator(LeafSystem):
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

    __slots__ = NO_DICT

    def __init__(self, gait: Gait, *, period: float, morphology: Morphology, clearance: float = 0.05) -> None:
        super().__init__()
        legs = LegKinematics(morphology)
        foot_radius = morphology.foot_radius
        self._walker = Walker(gait, legs, stance=morphology.stance, foot_radius=foot_radius, period=period)
        self._input = self.DeclareVectorInputPort("input", 8)
        self.DeclareDiscreteState(np.concatenate([np.zeros(4), morphology.stance[:, :2].ravel()]))
        command = self.DeclareDiscreteState(legs.inverse(morphology.stance).ravel())
        self.DeclareStateOutputPort("joint_position", command)
        defaults = {
            "period": (2.0, "s", (0.2, 60.0)),
            "stroke": (0.2, "m", (0.0, 0.3)),
            "clearance": (clearance, "m", (0.0, 0.15)),
            "height": (morphology.torso_clearance, "m", (0.1, 0.35)),
            "ramp_time": (1.0, "s", (0.02, 60.0)),
            "heading_gain": (0.5, "1/s", (0.0, 10.0)),
            "yaw_rate_limit": (0.15, "rad/s", (0.0, 1.0)),
            "posture_gain": (1.0, "1/s", (0.0, 10.0)),
            "lean_limit": (0.15, "rad", (0.0, 0.5)),
        }
        self.DeclareNumericParameter(BasicVector([value for value, _, _ in defaults.values()]))
        self.variables = (
            discrete_state("phase", 0, start=0, unit="cycle", bounds=(0.0, 1.0)),
            discrete_state("level", 0, start=1, bounds=(0.0, 1.0)),
            discrete_state("lean", 0, start=2, shape=(2,), unit="rad"),
            discrete_state("feet", 0, start=4, shape=(len(LEGS), 2), unit="m"),
            discrete_state("joint_position", 1, shape=(3 * len(LEGS),), unit="rad"),
            *(
                parameter(name, 0, start=k, unit=unit, bounds=bounds)
                for k, (name, (_, unit, bounds)) in enumerate(defaults.items())
            ),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        self._walker.step(
            context.get_numeric_parameter(0).value(),
            self._input.Eval(context),
            state.get_mutable_value(0),
            state.get_mutable_value(1),
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
