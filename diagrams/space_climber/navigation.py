"""The robot's motion over ground: a visual odometer, and the navigator of the DPS that uses it."""

from __future__ import annotations

from collections.abc import Mapping
from math import pi
from types import SimpleNamespace
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, DiscreteValues, System

from vtbdrake.compiled import At, SensorEquations
from vtbdrake.components.casadi_system import clamp
from vtbdrake.components.sensors import ErrorModel, SampledSensor
from vtbdrake.state import NamedVector, Quantity
from vtbdrake_diagrams.packed_system import Expression, packed_system
from vtbdrake_diagrams.space_climber.estimation import rotation, wrap

# The port ``input`` of the navigator.
_INPUT = NamedVector(
    rpy=Quantity(np.zeros(3), "rad"),
    leg_position=Quantity([0.0, 0.0], "m"),
    height=Quantity(0.0, "m"),
    commanded_heading=Quantity(0.0, "rad"),
    commanded_walk=Quantity(0.0),
    visual_odometry=Quantity(np.zeros(3), "m/s"),
)


class VisualOdometer(SampledSensor):
    """A sensor of the velocity of a body over ground, as from successive camera images.

    .. pydrake_system::

        name: VisualOdometer
        input_ports:
        - body_poses
        output_ports:
        - visual_odometry

    ``visual_odometry`` is the displacement since the last sample over the period, (3,) in m/s, in the body's present
    frame B: (R_WB)^T (p_WB(t) - p_WB(t - T)) / T. The first sample is 0.
    """

    def __init__(self, body: BodyIndex, *, period: float, errors: ErrorModel | None = None) -> None:
        """Declare the sensor of the body with this index in the plant."""
        super().__init__(
            "visual_odometry",
            default=np.zeros(3),
            period=period,
            unit="m/s",
            noise={"noise": (3, "m/s")},
            errors=errors,
        )
        self.body = int(body)
        self._poses = self.DeclareAbstractInputPort("body_poses", Value[list[RigidTransform]]())
        # Whether there was a sample, and the position at it.
        self.memory = self.declare_discrete_state(
            sampled=Quantity(0.0, bounds=(0.0, 1.0)), last_position=Quantity(np.zeros(3), "m")
        )

    def _measure(self, context: Context, state: DiscreteValues) -> NDArray[np.float64]:
        X_WB = self._poses.Eval(context)[self.body]
        last, following = self.memory.view(context), self.memory.mutable(state)
        following.sampled, following.last_position = 1.0, X_WB.translation()
        if not last.sampled:
            return np.zeros(3)
        displacement = X_WB.translation() - last.last_position
        velocity: NDArray[np.float64] = X_WB.rotation().inverse() @ (displacement / self.period)
        return velocity

    def compiled_equations(self, context: Context, varied: frozenset[str]) -> VisualOdometerEquations:
        """Return the equations for compiled testbeds.

        Args:
            context: The sensor's own context.
            varied: Names of its variables that will be varied.
        """
        return VisualOdometerEquations(self, context, varied)


class VisualOdometerEquations(SensorEquations):
    """A `VisualOdometer`."""

    def __init__(self, system: VisualOdometer, context: Context, varied: frozenset[str]) -> None:
        def velocity(at: At) -> Expression:
            R, p = at.input("body_poses")(system.body)
            last = at.state(int(system.memory.index))
            return casadi.if_else(last[0] != 0.0, R.T @ ((p - last[1:]) / system.period), casadi.SX.zeros(3, 1))

        super().__init__(system, context, varied, velocity)

    def update(self, at: At) -> dict[int, Expression]:
        system: Any = self.system
        _, p = at.input("body_poses")(system.body)
        return {**super().update(at), int(system.memory.index): casadi.vertcat(1.0, p)}


def make_navigator(*, period: float) -> System:
    r"""Return the system that turns the command "walk in this direction" into heading and walk command of the gait.

    .. pydrake_system::

        name: navigator
        input_ports:
        - input
        output_ports:
        - course
        - walk
        - memory

    ``input`` is [roll, pitch, yaw, x, y, height (the estimated pose), heading, walk (the commands), visual_odometry
    (3)]: everything comes from the robot's own sensors and commands.

    Position: ``position`` (x, y) integrates the visual odometry. Leg odometry would not notice when all feet slip.

    Course: the robot is to walk along the line through the point p_0 where the command began (walk took another sign,
    or the heading changed), in the direction of the heading. With the distance e to the left of that line,

        course = heading - clamp(course_gain e, course_limit),

    and with the other sign where it walks backwards (a negative walk) along that line.

    Slip: ``slip`` is the difference (x, y) between the velocities over ground of leg odometry and visual odometry,
    behind a first-order low-pass with the time constant ``slip_time``; ``slipping`` is 1 while it is larger than
    ``slip_limit``. It is for observers only, and has no effect on the robot.

    Tip: ``tipped`` becomes 1 when the estimated roll or pitch exceeds ``tip_angle``, and stays 1; the robot then stops.
    """

    def step(x: SimpleNamespace, u: SimpleNamespace, p: SimpleNamespace) -> Mapping[str, Expression]:
        velocity = rotation(u.rpy)[:2, :] @ u.visual_odometry
        position = x.position + period * velocity
        share = casadi.if_else(p.slip_time > 0.0, 1.0 - casadi.exp(-period / p.slip_time), 1.0)
        slip = x.slip + share * ((u.leg_position - x.last_step) / period - velocity - x.slip)
        tips = casadi.logic_or(casadi.fabs(u.rpy[0]) > p.tip_angle, casadi.fabs(u.rpy[1]) > p.tip_angle)
        tipped = casadi.if_else(tips, 1.0, x.tipped)
        way = casadi.sign(u.commanded_walk)
        walks = way != 0.0
        goes_on = casadi.logic_and(x.under_way == way, u.commanded_heading == x.heading)
        begins = casadi.logic_and(walks, casadi.logic_not(goes_on))
        origin = casadi.if_else(begins, position, x.origin)
        apart = position - origin
        aside = casadi.cos(u.commanded_heading) * apart[1] - casadi.sin(u.commanded_heading) * apart[0]
        correction = way * clamp(p.course_gain * aside, -p.course_limit, p.course_limit)
        return {
            "course": wrap(u.commanded_heading - correction),
            "walk": casadi.if_else(tipped, 0.0, u.commanded_walk),
            "position": position,
            "slip": slip,
            "slipping": casadi.norm_2(slip) > p.slip_limit,
            "tipped": tipped,
            "under_way": way,
            "origin": origin,
            "heading": u.commanded_heading,
            "last_step": u.leg_position,
        }

    flag, sign, point = Quantity(0.0, bounds=(0.0, 1.0)), Quantity(0.0, bounds=(-1.0, 1.0)), Quantity([0.0, 0.0], "m")
    memory = NamedVector(
        position=point,
        slip=Quantity([0.0, 0.0], "m/s"),
        slipping=flag,
        tipped=flag,
        under_way=sign,
        origin=point,
        heading=Quantity(0.0, "rad"),
        last_step=point,
    )
    parameters = NamedVector(
        course_gain=Quantity(0.3, "rad/m", (0.0, 10.0)),
        course_limit=Quantity(0.5, "rad", (0.0, pi / 2)),
        slip_time=Quantity(2.0, "s", (0.0, 1e3)),
        slip_limit=Quantity(0.05, "m/s", (0.0, 10.0)),
        tip_angle=Quantity(0.8, "rad", (0.0, pi)),
    )
    return packed_system(
        "navigator",
        step,
        state={
            "course": NamedVector(course=Quantity(0.0, "rad")),
            "walk": NamedVector(walk=sign),
            "memory": memory,
        },
        inputs={"input": _INPUT},
        parameters=parameters,
        period=period,
    )
