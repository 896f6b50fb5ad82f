"""The position controller of a Schunk WSG gripper, as `SchunkWsgDriver` of Drake simulates it."""

from __future__ import annotations

from typing import Any

from pydrake.manipulation import (
    MakeMultibodyForceToWsgForceSystem,
    MakeMultibodyStateToWsgStateSystem,
    SchunkWsgController,
    SchunkWsgDriver,
)
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder

from vtbdrake.state import AddressedSystem, Quantity

FORCE_LIMIT = 40.0
"""The largest force in N of a gripper that gets no other."""

STATUS_PERIOD = 0.05
"""The period in s of the gripper's status messages."""

_PERIOD = 0.05  # s, at which the gripper's firmware is polled
_SMALLEST_CHANGE = 1e-4  # m, of a target that is followed
_MAX_SPEED, _MAX_ACCELERATION = 0.42, 5.0  # m/s, m/s^2


def simulated_gripper(config: SchunkWsgDriver) -> Diagram:
    """Return a Schunk WSG's control as Drake simulates it, without its messages.

    Its input ports are ``position`` (the desired distance of the fingers in m), ``force_limit`` (N), and the plant's
    ``state`` and ``generalized_contact_forces``. Its output ports are ``actuation``, ``state_measured`` (distance of
    the fingers and its speed, in m and m/s) and ``force_measured`` (N, never negative).
    """
    builder = DiagramBuilder()
    motion = builder.AddNamedSystem("motion", SchunkWsgMotion())
    # The controller inside of Drake's driver, of C++ systems alone: its state is in the Context.
    drakes = SchunkWsgController(*config.pid_gains)
    (controller,) = (part.Clone() for part in drakes.GetSystems() if part.HasInputPort("desired_grip_state"))
    controller.set_name("controller")
    builder.AddSystem(controller)
    builder.Connect(motion.GetOutputPort("target"), controller.GetInputPort("desired_grip_state"))
    builder.Connect(motion.GetOutputPort("max_force"), controller.GetInputPort("max_force"))
    builder.ExportInput(motion.GetInputPort("desired_position"), "position")
    builder.ExportInput(motion.GetInputPort("force_limit"), "force_limit")
    measured = builder.AddNamedSystem("state_measured", MakeMultibodyStateToWsgStateSystem())
    force = builder.AddNamedSystem("force_measured", MakeMultibodyForceToWsgForceSystem())
    state = builder.ExportInput(motion.GetInputPort("state"), "state")
    builder.ConnectInput(state, controller.GetInputPort("joint_state"))
    builder.ConnectInput(state, measured.get_input_port())
    builder.ExportInput(force.get_input_port(), "generalized_contact_forces")
    builder.ExportOutput(controller.GetOutputPort("control"), "actuation")
    builder.ExportOutput(measured.get_output_port(), "state_measured")
    builder.ExportOutput(force.get_output_port(), "force_measured")
    return builder.Build()


class SchunkWsgMotion(AddressedSystem):
    """Ramps the grip position of a gripper to its target, by the arithmetic of Drake's `SchunkWsgTrajectoryGenerator`.

    .. pydrake_system::

        name: SchunkWsgMotion
        input_ports:
        - desired_position
        - force_limit
        - state
        output_ports:
        - target
        - max_force

    The ports have sizes 1, 1, 4, 2 and 1. The grip position g = q0 - q1 is minus the distance of the fingers, and
    ``target`` is [g, dg/dt]. Every 50 ms, a desired position that has changed by more than 0.1 mm begins a new motion
    from twice the present position of finger 0, at no speed: up to 0.42 m/s with 5 m/s^2.

    Drake's system keeps its motion in itself, where no copy of a context can find it; here it is state.
    """

    def __init__(self) -> None:
        super().__init__()
        self.DeclareVectorInputPort("desired_position", 1)
        self.DeclareVectorInputPort("force_limit", 1)
        self.DeclareVectorInputPort("state", 4)
        self._motion = self.declare_discrete_state(
            last_position=Quantity(0.0, "m"),
            max_force=Quantity(0.0, "N"),
            moving=Quantity(0.0, "1", (0.0, 1.0)),
            start_position=Quantity(0.0, "m"),
            target_position=Quantity(0.0, "m"),
            start_time=Quantity(0.0, "s"),
        )
        state = self.discrete_state_ticket(self._motion.index)
        self.DeclareVectorOutputPort("target", 2, self._calc_target, {state, self.time_ticket()})
        self.DeclareVectorOutputPort("max_force", 1, self._calc_max_force, {state})
        self.timings = ((_PERIOD, 0.0),)
        self.DeclarePeriodicDiscreteUpdateEvent(_PERIOD, 0.0, self._update)

    def _update(self, context: Context, discrete: Any) -> None:
        before, after = self._motion.view(context), self._motion.mutable(discrete)
        target = -float(self.GetInputPort("desired_position").Eval(context)[0])
        position = 2.0 * float(self.GetInputPort("state").Eval(context)[0])
        after.last_position = position
        after.max_force = float(self.GetInputPort("force_limit").Eval(context)[0])
        if not before.moving or abs(before.target_position - target) > _SMALLEST_CHANGE:
            after.moving, after.start_position, after.target_position = 1.0, position, target
            after.start_time = context.get_time()

    def _calc_target(self, context: Context, output: BasicVector) -> None:
        motion = self._motion.view(context)
        if motion.moving:
            elapsed = context.get_time() - motion.start_time
            output.SetFromVector(_ramp(elapsed, motion.start_position, motion.target_position))
        else:
            output.SetFromVector([motion.last_position, 0.0])

    def _calc_max_force(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([self._motion.view(context).max_force])


def _ramp(time: float, start: float, target: float) -> tuple[float, float]:
    """Return position and speed after ``time`` of a motion between two positions at rest, in Drake's arithmetic."""
    delta = abs(target - start)
    if delta == 0.0:
        return start, 0.0
    sign = 1.0 if start < target else -1.0
    ramp_time = _MAX_SPEED / _MAX_ACCELERATION
    ramp = 0.5 * _MAX_ACCELERATION * ramp_time * ramp_time
    if delta < ramp * 2:
        middle = delta / 2
        speed = _MAX_SPEED * (middle / ramp)
        middle_time = speed / _MAX_ACCELERATION
        knots = [
            (0.0, start, 0.0),
            (middle_time, start + middle * sign, speed * sign),
            (middle_time * 2, target, 0.0),
        ]
    else:
        cruise_time = (delta - 2 * ramp) / _MAX_SPEED
        knots = [
            (0.0, start, 0.0),
            (ramp_time, start + (ramp * sign), _MAX_SPEED * sign),
            (ramp_time + cruise_time, target - (ramp * sign), _MAX_SPEED * sign),
            (ramp_time + cruise_time + ramp_time, target, 0.0),
        ]
    # As PiecewisePolynomial does: its segments are [t0, t1), and it is evaluated at its ends beyond them.
    time = min(max(time, 0.0), knots[-1][0])
    segment = 0
    while segment < len(knots) - 2 and time >= knots[segment + 1][0]:
        segment += 1
    (t0, p0, v0), (t1, p1, v1) = knots[segment : segment + 2]
    dt, length = time - t0, t1 - t0
    return p0 + dt * ((p1 - p0) / length), v0 + dt * ((v1 - v0) / length)
