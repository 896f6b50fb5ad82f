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
    # Without a plan there is no force.
    impl = SplineCommand(plan, period=period, after=0.0, unit="N")
    builder, _ = _begin(impl, period=period, force_limit=force_limit, output="value")
    if planner is None:
        builder.ExportInput(impl.GetInputPort("plan"), "plan")
    else:
        builder.AddNamedSystem("planner", planner)
        builder.Connect(planner.GetOutputPort("decision"), impl.GetInputPort("plan"))
    return _built(builder)


def make_policy_dps(policy: System, *, period: float, force_limit: float) -> Diagram:
    """Return the DPS: ``env`` perceives, ``impl`` is a policy, and ``act`` limits its force.

    It has the same input and output ports as `make_dps` makes, but no plan.

    Args:
        policy: The system whose output port ``force`` (1, N) follows from its input port ``state`` (4), which is
            [x, theta, x', theta'].
        period: Sample period of ``env`` in seconds.
        force_limit: The largest force in N.
    """
    builder, sense = _begin(policy, period=period, force_limit=force_limit, output="force")
    builder.Connect(sense.get_output_port(), policy.GetInputPort("state"))
    return _built(builder)


def make_pushed_dps(*, period: float, force_limit: float) -> Diagram:
    """Return the DPS: ``env`` perceives, ``impl`` holds the command ``push`` (1, N), and ``act`` limits it.

    A push takes effect when the force of a policy would that is sampled at the same time: see `make_policy_dps`.

    Args:
        period: Sample period of ``env`` and ``impl`` in seconds.
        force_limit: The largest force in N.
    """
    impl = ZeroOrderHold(period, 1)
    builder, _ = _begin(impl, period=period, force_limit=force_limit, output=impl.get_output_port().get_name())
    builder.ExportInput(impl.get_input_port(), "push")
    return _built(builder)


def _begin(impl: System, *, period: float, force_limit: float, output: str) -> tuple[DiagramBuilder, System]:
    """Return the builder of a DPS without the inputs of ``impl``, and ``sense``."""
    builder = DiagramBuilder()
    sense = builder.AddNamedSystem("sense", Multiplexer([JOINTS, JOINTS]))
    env = builder.AddNamedSystem("env", ZeroOrderHold(period, 2 * JOINTS))
    builder.AddNamedSystem("impl", impl)
    limit = np.array([force_limit])
    act = builder.AddNamedSystem("act", Saturation(-limit, limit))
    builder.ExportInput(sense.get_input_port(0), "joint_position")
    builder.ExportInput(sense.get_input_port(1), "joint_velocity")
    builder.Connect(sense.get_output_port(), env.get_input_port())
    builder.Connect(impl.GetOutputPort(output), act.get_input_port())
    builder.ExportOutput(act.get_output_port(), "force")
    return builder, sense


def _built(builder: DiagramBuilder) -> Diagram:
    dps = builder.Build()
    dps.set_name("dps")
    return dps
