"""The walking controller: gait generator with heading and posture feedback."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace

import casadi
from pydrake.systems.framework import Diagram, DiagramBuilder, System
from pydrake.systems.primitives import Multiplexer

from vtbdrake.components.casadi_system import clamp
from vtbdrake.state import NamedVector, Quantity
from vtbdrake_diagrams.packed_system import Expression, packed_system
from vtbdrake_diagrams.space_climber.estimation import wrap
from vtbdrake_diagrams.space_climber.gait import Gait, fraction
from vtbdrake_diagrams.space_climber.kinematics import LegKinematics
from vtbdrake_diagrams.space_climber.morphology import Morphology
from vtbdrake_diagrams.space_climber.navigation import make_navigator

_ANGLE = Quantity(0.0, "rad")
# The estimated pose and the commands.
_INPUT = NamedVector(
    roll=_ANGLE,
    pitch=_ANGLE,
    yaw=_ANGLE,
    position=Quantity([0.0, 0.0, 0.0], "m"),
    heading=_ANGLE,
    walk=Quantity(0.0),
)


def make_gait_generator(gait: Gait, *, period: float, morphology: Morphology, clearance: float = 0.05) -> System:
    """Return the system that computes joint positions from a walk command and a heading.

    .. pydrake_system::

        name: gait
        input_ports:
        - input
        output_ports:
        - joint_position
        - memory

    ``input`` is [roll, pitch, yaw, x, y, height, heading, walk]: the estimated pose and the commands.

    * Start and stop: ``walk`` in [-1, 1] scales stroke, clearance and turning; less than 0 walks backwards. The level
      follows it at the rate 1 / ``ramp_time``; standing is a level of 0 with a phase that rests.
    * Heading: the robot walks along its own x axis and turns at ``heading_gain * (heading - yaw)``, within
      +- ``yaw_rate_limit``.
    * Posture: the plane of the feet's heights leans against the torso's tilt. The lean grows with ``posture_gain``
      times (roll, pitch), within +- ``lean_limit``.

    ``joint_position`` is a state: the inverse kinematics of the feet, as of the last sample.
    """
    legs, stance = LegKinematics(morphology), morphology.stance

    def step(x: SimpleNamespace, u: SimpleNamespace, p: SimpleNamespace) -> Mapping[str, Expression]:
        tilt = casadi.vertcat(u.roll, u.pitch)
        lean = clamp(x.lean + p.posture_gain * period * tilt, -p.lean_limit, p.lean_limit)
        reach = period / p.ramp_time
        level = x.level + clamp(clamp(u.walk, -1.0, 1.0) - x.level, -reach, reach)
        turn = clamp(p.heading_gain * wrap(u.heading - u.yaw), -p.yaw_rate_limit, p.yaw_rate_limit)
        size, next_phase = casadi.fabs(level), x.phase + period / p.period
        moved = gait.advanced(
            x.feet,
            nominal=casadi.DM(stance[:, :2]),
            phase=x.phase,
            next_phase=next_phase,
            forward=level * period * gait.speed(p.stroke, p.period),
            turn=size * period * turn,
            stance_steps=gait.duty * p.period / period,
        )
        walks = size > 0.0
        phase, feet = casadi.if_else(walks, fraction(next_phase), x.phase), casadi.if_else(walks, moved, x.feet)
        ground = morphology.foot_radius - p.height - lean[1] * feet[:, 0] + lean[0] * feet[:, 1]
        heights = ground + size * p.clearance * gait.heights(phase)
        angles = legs.angles(casadi.horzcat(feet, heights))
        return {
            "phase": phase,
            "level": level,
            "lean": lean,
            "feet": feet,
            "joint_position": casadi.vec(angles.T),
        }

    memory = NamedVector(
        phase=Quantity(0.0, "cycle", (0.0, 1.0)),
        level=Quantity(0.0, bounds=(-1.0, 1.0)),
        lean=Quantity([0.0, 0.0], "rad"),
        feet=Quantity(stance[:, :2], "m"),
    )
    command = NamedVector(joint_position=Quantity(legs.inverse(stance).ravel(), "rad"))
    parameters = NamedVector(
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
    return packed_system(
        "gait",
        step,
        state={"joint_position": command, "memory": memory},
        inputs={"input": _INPUT},
        parameters=parameters,
        period=period,
    )


def make_walking(
    gait: Gait, *, period: float, morphology: Morphology, clearance: float = 0.05, navigator: bool = False
) -> Diagram:
    """Build the subsystem ``gait`` with the input ports ``pose``, ``heading`` and ``walk``.

    With a navigator, its ``memory`` is the output port ``navigation``, beside ``joint_position``.

    Args:
        gait: The gait.
        period: Sample period in s.
        morphology: The robot's.
        clearance: Default height to which the gait lifts the feet, in m.
        navigator: True puts the system of `make_navigator`, with the port ``visual_odometry``, between the commands and
            the gait.
    """
    builder = DiagramBuilder()
    # One vector input costs a Python system a third of three.
    inputs = builder.AddNamedSystem("inputs", Multiplexer([6, 1, 1]))
    generator = make_gait_generator(gait, period=period, morphology=morphology, clearance=clearance)
    builder.AddNamedSystem("gait", generator)
    ports = {signal: inputs.get_input_port(k) for k, signal in enumerate(("pose", "heading", "walk"))}
    builder.ExportInput(ports["pose"], "pose")
    if navigator:
        sensed = builder.AddNamedSystem("navigator_inputs", Multiplexer([6, 1, 1, 3]))
        system = builder.AddNamedSystem("navigator", make_navigator(period=period))
        builder.ConnectInput("pose", sensed.get_input_port(0))
        for k, signal in enumerate(("heading", "walk", "visual_odometry"), start=1):
            builder.ExportInput(sensed.get_input_port(k), signal)
        builder.Connect(sensed.get_output_port(), system.get_input_port())
        builder.Connect(system.GetOutputPort("course"), ports["heading"])
        builder.Connect(system.GetOutputPort("walk"), ports["walk"])
        builder.ExportOutput(system.GetOutputPort("memory"), "navigation")
    else:
        for signal in ("heading", "walk"):
            builder.ExportInput(ports[signal], signal)
    builder.Connect(inputs.get_output_port(), generator.get_input_port())
    builder.ExportOutput(generator.GetOutputPort("joint_position"), "joint_position")
    return builder.Build()
