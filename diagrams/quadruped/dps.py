"""The data processing system of the quadruped: it perceives its state, and trots by a plan of offsets."""

from __future__ import annotations

import casadi
import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder, System
from pydrake.systems.primitives import Multiplexer

from vtbdrake.common.spline import Spline
from vtbdrake.components.casadi_system import CasadiSystem
from vtbdrake_diagrams.quadruped.gait import Trot, desired_state
from vtbdrake_diagrams.quadruped.model import JOINT_NAMES, LEGS, Quadruped

SENSED = {"base_pose": 7, "joint_position": len(JOINT_NAMES), "base_twist": 6, "joint_velocity": len(JOINT_NAMES)}
"""The sensor signals with their sizes, in the order of the plant's state."""
PERCEIVED = "dps.env.state"
"""The address of the perceived state: as the plant's, shape (37,)."""
OFFSET = "dps.impl.offset"
"""The address of the offsets of the trot, shape (6,); see `OFFSETS`."""


def make_dps(
    quadruped: Quadruped, trot: Trot, plan: Spline, *, period: float, planner: System | None = None
) -> Diagram:
    """Return the DPS: ``env`` perceives, ``impl`` trots by a plan of offsets, ``planner`` decides.

    Input ports: the sensor signals of `SENSED`; the command ``velocity`` (2, m/s); and without a planner, the command
    ``plan`` = [t_begin, knots of `OFFSETS`], see `desired_state`. Output port: ``joint_desired`` (24), the angles that
    the drives hold for a period, and their derivatives.

    Args:
        quadruped: The robot.
        trot: The trot.
        plan: The curve that the knots define, of order ``linear``.
        period: Sample period of ``env`` in seconds, for which the drives hold what is desired.
        planner: The system that decides the plan, with the output port ``decision``; None: the plan is a command.
    """
    builder = DiagramBuilder()
    sense = builder.AddNamedSystem("sense", Multiplexer([*SENSED.values()]))
    env = builder.AddNamedSystem("env", make_hold(standing(quadruped), period=period))
    impl = builder.AddNamedSystem(
        "impl", CasadiSystem(desired_state(quadruped, trot, plan, lead=period), time="t", compile=None)
    )
    for k, name in enumerate(SENSED):
        builder.ExportInput(sense.get_input_port(k), name)
    builder.Connect(sense.get_output_port(), env.GetInputPort("sensed"))
    builder.ExportInput(impl.GetInputPort("velocity"), "velocity")
    builder.ExportOutput(impl.GetOutputPort("desired"), "joint_desired")
    if planner is None:
        builder.ExportInput(impl.GetInputPort("plan"), "plan")
    else:
        builder.AddNamedSystem("planner", planner)
        builder.Connect(planner.GetOutputPort("decision"), impl.GetInputPort("plan"))
    dps = builder.Build()
    dps.set_name("dps")
    return dps


def make_hold(first: np.ndarray, *, period: float) -> System:
    """Return a system that samples ``sensed`` and shows it until the next sample, and ``first`` before.

    Args:
        first: The state before the first sample.
        period: Sample period in s.
    """
    sensed = casadi.SX.sym("sensed", first.size)
    hold = casadi.Function("hold", [sensed], [sensed], ["sensed"], ["state_next"])
    return CasadiSystem(update=hold, state={"state": first}, period=period)


def standing(quadruped: Quadruped) -> np.ndarray:
    """Return the state of the plant, [q; v], in which the robot stands still at the origin, shape (37,)."""
    pose, angles = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, quadruped.stance], np.tile(quadruped.posture, len(LEGS))
    return np.concatenate([pose, angles, np.zeros(6 + angles.size)])
