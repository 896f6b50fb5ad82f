"""The robot's motion over ground: a visual odometer, and the navigator of the DPS that uses it."""

from __future__ import annotations

from math import cos, exp, hypot, pi, sin

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from vtbdrake.components.sensors import ErrorModel, SampledSensor
from vtbdrake.state import discrete_state, parameter
from vtbdrake.state.declarations import NO_DICT
from vtbdrake_diagrams.space_climber.pose_filter import wrap


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

    __slots__ = NO_DICT

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
        self._body = int(body)
        self._poses = self.DeclareAbstractInputPort("body_poses", Value[list[RigidTransform]]())
        # Whether there was a sample, and the position at it.
        self._memory = int(self.DeclareDiscreteState(4))
        self.variables += (
            discrete_state("known", self._memory, bounds=(0.0, 1.0)),
            discrete_state("last_position", self._memory, start=1, shape=(3,), unit="m"),
        )

    def _measure(self, context: Context, state: DiscreteValues) -> NDArray[np.float64]:
        X_WB = self._poses.Eval(context)[self._body]
        known, *last = context.get_discrete_state(self._memory).value()
        state.set_value(self._memory, np.array([1.0, *X_WB.translation()]))
        if not known:
            return np.zeros(3)
        velocity: NDArray[np.float64] = X_WB.rotation().inverse() @ ((X_WB.translation() - last) / self.period)
        return velocity


class Navigator(LeafSystem):
    r"""A system that turns the command "walk in this direction" into the heading and the walk command of the gait.

    .. pydrake_system::

        name: Navigator
        input_ports:
        - input
        output_ports:
        - course
        - walk

    ``input`` is [roll, pitch, yaw, x, y, height (the estimated pose), heading, walk (the commands), visual_odometry
    (3)]: everything comes from the robot's own sensors and commands.

    Position: ``position`` (x, y) integrates the visual odometry. Leg odometry would not notice when all feet slip.

    Course: the robot is to walk along the line through the point p_0 where the command began (walk became positive, or
    the heading changed), in the direction of the heading. With the distance e to the left of that line,

        course = heading - clamp(course_gain e, course_limit).

    Slip: ``slip`` is the difference (x, y) between the velocities over ground of leg odometry and visual odometry,
    behind a first-order low-pass with the time constant ``slip_time``; ``slipping`` is 1 while it is larger than
    ``slip_limit``. It is for observers only, and has no effect on the robot.

    Tip: ``tipped`` becomes 1 when the estimated roll or pitch exceeds ``tip_angle``, and stays 1; the robot then stops.
    """

    __slots__ = NO_DICT

    def __init__(self, *, period: float) -> None:
        super().__init__()
        self._period = period
        self._input = self.DeclareVectorInputPort("input", 6 + 2 + 3)
        self.DeclareStateOutputPort("course", self.DeclareDiscreteState(1))
        self.DeclareStateOutputPort("walk", self.DeclareDiscreteState(1))
        self.DeclareDiscreteState(12)
        defaults = {
            "course_gain": (0.3, "rad/m", (0.0, 10.0)),
            "course_limit": (0.5, "rad", (0.0, pi / 2)),
            "slip_time": (2.0, "s", (0.0, 1e3)),
            "slip_limit": (0.05, "m/s", (0.0, 10.0)),
            "tip_angle": (0.8, "rad", (0.0, pi)),
        }
        self.DeclareNumericParameter(BasicVector([value for value, _, _ in defaults.values()]))
        flag = (0.0, 1.0)
        self.variables = (
            discrete_state("course", 0, unit="rad"),
            discrete_state("walk", 1, bounds=flag),
            discrete_state("position", 2, shape=(2,), unit="m"),
            discrete_state("slip", 2, start=2, shape=(2,), unit="m/s"),
            discrete_state("slipping", 2, start=4, bounds=flag),
            discrete_state("tipped", 2, start=5, bounds=flag),
            discrete_state("under_way", 2, start=6, bounds=flag),
            discrete_state("origin", 2, start=7, shape=(2,), unit="m"),
            discrete_state("heading", 2, start=9, unit="rad"),
            discrete_state("last_step", 2, start=10, shape=(2,), unit="m"),
            *(
                parameter(name, 0, start=k, unit=unit, bounds=bounds)
                for k, (name, (_, unit, bounds)) in enumerate(defaults.items())
            ),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        T = self._period
        course_gain, course_limit, slip_time, slip_limit, tip_angle = context.get_numeric_parameter(0).value().tolist()
        roll, pitch, yaw, leg_x, leg_y, _, heading, walk, *v_B = self._input.Eval(context).tolist()
        x, y, slip_x, slip_y, _, tipped, under_way, x0, y0, last_heading, last_x, last_y = (
            context.get_discrete_state(2).value().tolist()
        )
        vx, vy = horizontal(v_B, roll, pitch, yaw)
        x, y = x + T * vx, y + T * vy
        share = 1.0 - exp(-T / slip_time) if slip_time > 0.0 else 1.0
        slip_x += share * ((leg_x - last_x) / T - vx - slip_x)
        slip_y += share * ((leg_y - last_y) / T - vy - slip_y)
        if abs(roll) > tip_angle or abs(pitch) > tip_angle:
            tipped = 1.0
        if walk > 0.0 and not (under_way and heading == last_heading):
            x0, y0 = x, y
        aside = cos(heading) * (y - y0) - sin(heading) * (x - x0)
        correction = min(max(course_gain * aside, -course_limit), course_limit) if walk > 0.0 else 0.0
        slipping = hypot(slip_x, slip_y) > slip_limit
        memory = (x, y, slip_x, slip_y, slipping, tipped, walk > 0.0, x0, y0, heading, leg_x, leg_y)
        state.set_value(0, np.array([wrap(heading - correction)]))
        state.set_value(1, np.array([0.0 if tipped else walk]))
        state.set_value(2, np.array(memory, dtype=float))


def horizontal(v_B: list[float], roll: float, pitch: float, yaw: float) -> tuple[float, float]:
    """Return the horizontal part of a vector of the frame B in the world, for R_WB = Rz(yaw) Ry(pitch) Rx(roll)."""
    vx, vy, vz = v_B
    across = cos(roll) * vy - sin(roll) * vz
    ahead = cos(pitch) * vx + sin(pitch) * (sin(roll) * vy + cos(roll) * vz)
    return cos(yaw) * ahead - sin(yaw) * across, sin(yaw) * ahead + cos(yaw) * across
