"""The data processing system of the cart-pole: it perceives the state and follows a plan of forces."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder, System
from pydrake.systems.primitives import Multiplexer, Saturation, ZeroOrderHold

from vtbdrake.common.spline import Spline
from vtbdrake.components.spline_command import SplineCommand

JOINTS = 2
PERCEIVED = "dps.env.discrete_state_0"
"""The address of the perceived state: positions of cart (m) and pole (rad), then their derivatives, shape (4,)."""
FORCE = "dps.impl.value"
"""The address of the force that the DPS commands, in N."""


def make_dps(plan: Spline, *, period: float, force_limit: float, planner: System | None = None) -> Diagram:
    """Return the DPS: ``env`` perceives, ``impl`` follows the plan, ``act`` limits, and ``planner`` decides.

    Input ports: ``joint_position`` (cart in m, pole in rad), ``joint_velocity`` (their derivatives) and, without a
    planner, the command ``plan`` = [t_begin, knots], see `SplineCommand`. Output port: ``force`` on the cart (1, N).

    Args:
        plan: The curve that the knots define, in N.
        period: Sample period of ``env`` and ``impl`` in seconds.
        force_limit: The largest force in N.
        planner: The system that decides the plan, with the output port ``decision``; None: the plan is a command.
    """
    builder = DiagramBuilder()
    sense = builder.AddNamedSystem("sense", Multiplexer([JOINTS, JOINTS]))
    env = builder.AddNamedSystem("env", ZeroOrderHold(period, 2 * JOINTS))
    # Without a plan there is no force.
    impl = builder.AddNamedSystem("impl", SplineCommand(plan, period=period, after=0.0, unit="N"))
    limit = np.array([force_limit])
    act = builder.AddNamedSystem("act", Saturation(-limit, limit))
    builder.ExportInput(sense.get_input_port(0), "joint_position")
    builder.ExportInput(sense.get_input_port(1), "joint_velocity")
    builder.Connect(sense.get_output_port(), env.get_input_port())
    if planner is None:
        builder.ExportInput(impl.GetInputPort("plan"), "plan")
    else:
        builder.AddNamedSystem("planner", planner)
        builder.Connect(planner.GetOutputPort("decision"), impl.GetInputPort("plan"))
    builder.Connect(impl.GetOutputPort("value"), act.get_input_port())
    builder.ExportOutput(act.get_output_port(), "force")
    dps = builder.Build()
    dps.set_name("dps")
    return dps
