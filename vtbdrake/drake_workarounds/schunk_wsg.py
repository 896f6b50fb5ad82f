"""The position controller of a Schunk WSG gripper, as `SchunkWsgDriver` of Drake simulates it.

Fault: Drake's `SchunkWsgTrajectoryGenerator` keeps its trajectory in the system instead of the Context, so that no copy
of a Context can continue it, and a reset does not forget it. Therefore this is a copy of the controller, whose ramp is
state. Issue: https://github.com/RobotLocomotion/drake/issues/23190
"""

from __future__ import annotations

from itertools import pairwise
from math import isfinite
from typing import Any

import numpy as np
from pydrake.manipulation import (
    MakeMultibodyForceToWsgForceSystem,
    MakeMultibodyStateToWsgStateSystem,
    SchunkWsgDriver,
)
from pydrake.systems.framework import BasicVector, Context, ContinuousState, Diagram, DiagramBuilder

from vtbdrake.drake_workarounds.schunk_kernel import actuation, errors
from vtbdrake.state import AddressedSystem, Quantity

FORCE_LIMIT = 40.0
"""The largest force in N of a gripper that gets no other."""

STATUS_PERIOD = 0.05
"""The period in s of the gripper's status messages."""

_PERIOD = 0.05  # s, at which the gripper's firmware is polled
_SMALLEST_CHANGE = 1e-4  # m, of a target that is followed
_MAX_SPEED = 0.42  # m/s
_MAX_ACCELERATION = 5.0  # m/s^2


def simulated_gripper(config: SchunkWsgDriver) -> Diagram:
    """Return a Schunk WSG's control as Drake simulates it, without its messages.

    Its input ports are ``position`` (the desired distance of the fingers in m), ``force_limit`` (N), and the plant's
    ``state`` and ``generalized_contact_forces``; commands that are not finite raise a ValueError. Its output ports are
    ``actuation``, ``state_measured`` (distance of the fingers and its speed, in m and m/s) and ``force_measured`` (N,
    never negative).
    """
    builder = DiagramBuilder()
    kind = SchunkWsgIntegralControl if config.pid_gains[1] else SchunkWsgControl
    control = builder.AddNamedSystem("control", kind(*config.pid_gains))
    for port in ("position", "force_limit"):
        builder.ExportInput(control.GetInputPort(port), port)
    measured = builder.AddNamedSystem("state_measured", MakeMultibodyStateToWsgStateSystem())
    force = builder.AddNamedSystem("force_measured", MakeMultibodyForceToWsgForceSystem())
    state = builder.ExportInput(control.GetInputPort("state"), "state")
    builder.ConnectInput(state, measured.get_input_port())
    builder.ExportInput(force.get_input_port(), "generalized_contact_forces")
    builder.ExportOutput(control.get_output_port(), "actuation")
    builder.ExportOutput(measured.get_output_port(), "state_measured")
    builder.ExportOutput(force.get_output_port(), "force_measured")
    return builder.Build()


class SchunkWsgControl(AddressedSystem):
    """Moves the two fingers of a gripper, by the arithmetic of Drake's `SchunkWsgController`.

    .. pydrake_system::

        name: SchunkWsgControl
        input_ports:
        - position
        - force_limit
        - state
        output_ports:
        - actuation

    The ports have sizes 1, 1, 4 and 2. With the positions q0 and q1 of the fingers, a PD controller each keeps their
    mean m = (q0 + q1) / 2 at zero and moves the grip g = q0 - q1, minus the distance of the fingers, along a ramp; the
    force of the second is limited to half of the force limit in both directions. Every 50 ms, a desired position that
    has changed by more than 0.1 mm begins a new ramp from 2 q0, at no speed: up to 0.42 m/s with 5 m/s^2.

    Drake's system keeps the ramp in itself, where no copy of a context can find it; here it is state. And it integrates
    the errors, whose derivatives evaluate the ramp several times per step, also if their gain is zero: see
    `SchunkWsgIntegralControl`.

    Args:
        kp: The proportional gain.
        ki: The integral gain, which `SchunkWsgIntegralControl` uses.
        kd: The derivative gain.
    """

    def __init__(self, kp: float, ki: float, kd: float) -> None:
        super().__init__()
        self._position_port = self.DeclareVectorInputPort("position", 1)
        self._force_port = self.DeclareVectorInputPort("force_limit", 1)
        self._state_port = self.DeclareVectorInputPort("state", 4)
        self._gains = float(kp), float(ki), float(kd)
        self._motion = self.declare_discrete_state(
            moves=Quantity(0.0, "1", (0.0, 1.0)),
            target=Quantity(0.0, "m"),
            max_force=Quantity(0.0, "N"),
            start=Quantity(0.0, "s"),
            # After the start: when the second and the third part of the ramp begin, and when it ends.
            begins=Quantity(np.zeros(2), "s"),
            end=Quantity(0.0, "s"),
            # [g, dg/dt] at the begin of each part, and their slopes.
            parts=Quantity(np.zeros((3, 4)), "m, m/s, m/s^2"),
        )
        motion = self.discrete_state_ticket(self._motion.index)
        self.DeclareVectorOutputPort(
            "actuation",
            2,
            self._calc_actuation,
            {motion, self.time_ticket(), self.xc_ticket(), self._state_port.ticket()},
        )
        self.timings = ((_PERIOD, 0.0),)
        self.DeclarePeriodicDiscreteUpdateEvent(_PERIOD, 0.0, self._update)

    def _update(self, context: Context, discrete: Any) -> None:
        before, after = self._motion.view(context), self._motion.mutable(discrete)
        target, limit = -float(self._position_port.Eval(context)[0]), float(self._force_port.Eval(context)[0])
        if not (isfinite(target) and isfinite(limit)):
            raise ValueError(f"a gripper is commanded with finite numbers, not to {-target} m with {limit} N")
        after.max_force = limit
        if not before.moves or abs(before.target - target) > _SMALLEST_CHANGE:
            parts, after.end = _ramp(2.0 * float(self._state_port.Eval(context)[0]), target)
            after.moves, after.target, after.start = 1.0, target, context.get_time()
            after.begins, after.parts = [begin for begin, *_ in parts[1:]], [part for _, *part in parts]

    def _integrals(self, context: Context) -> tuple[float, float]:
        """Return the integrals of the errors of mean and grip."""
        return 0.0, 0.0

    def _calc_actuation(self, context: Context, output: BasicVector) -> None:
        actuation(
            self._motion.array(context),
            self._state_port.Eval(context),
            output.get_mutable_value(),
            time=context.get_time(),
            gains=self._gains,
            integrals=self._integrals(context),
        )


class SchunkWsgIntegralControl(SchunkWsgControl):
    """A `SchunkWsgControl` with the integrals of the errors as continuous state."""

    def __init__(self, kp: float, ki: float, kd: float) -> None:
        super().__init__(kp, ki, kd)
        self._integral = self.declare_continuous_state(integral=Quantity(np.zeros(2), "m s"))

    def _integrals(self, context: Context) -> tuple[float, float]:
        mean, grip = self._integral.view(context).integral
        return mean, grip

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        now = errors(self._motion.array(context), self._state_port.Eval(context), time=context.get_time())
        derivatives.get_mutable_vector().SetFromVector(now[:2])


def _ramp(start: float, target: float) -> tuple[list[tuple[float, ...]], float]:
    """Return the three parts of a motion between two positions at rest, and its duration, in Drake's arithmetic.

    A part is its begin, [g, dg/dt] there, and their slopes; of a motion with fewer parts, the last one is repeated.
    """
    delta = abs(target - start)
    if delta == 0.0:
        return [(0.0, start, 0.0, 0.0, 0.0)] * 3, 0.0
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
    parts = [
        (t0, g0, v0, (g1 - g0) / (t1 - t0), (v1 - v0) / (t1 - t0)) for (t0, g0, v0), (t1, g1, v1) in pairwise(knots)
    ]
    return [*parts, *parts[-1:] * (3 - len(parts))], knots[-1][0]
