"""The robot's motion over ground: a visual odometer, and the navigator of the DPS that uses it."""

from __future__ import annotations

from math import cos, exp, hypot, pi, sin

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.components.sensors import ErrorModel, SampledSensor
from vtbdrake.state import AddressedSystem, NamedVector, Quantity
from vtbdrake_diagrams.space_climber.pose_filter import wrap

_ANGLE = Quantity(0.0, "rad")
# The port ``input`` of a `Navigator`.
_INPUT = NamedVector(
    roll=_ANGLE,
    pitch=_ANGLE,
    yaw=_ANGLE,
    position=Quantity([0.0, 0.0], "m"),
    height=Quantity(0.0, "m"),
    heading=_ANGLE,
    walk=Quantity(0.0),
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
        self._body = int(body)
        self._poses = self.DeclareAbstractInputPort("body_poses", Value[list[RigidTransform]]())
        # Whether there was a sample, and the position at it.
        self._memory = self.declare_discrete_state(
            known=Quantity(0.0, bounds=(0.0, 1.0)), last_position=Quantity(np.zeros(3), "m")
        )

    def _measure(self, context: Context, state: DiscreteValues) -> NDArray[np.float64]:
        X_WB = self._poses.Eval(context)[self._body]
        last, following = self._memory.view(context), self._memory.mutable(state)
        following.known, following.last_position = 1.0, X_WB.translation()
        if not last.known:
            return np.zeros(3)
        displacement = X_WB.translation() - last.last_position
        velocity: NDArray[np.float64] = X_WB.rotation().inverse() @ (displacement / self.period)
        return velocity


class Navigator(AddressedSystem):
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

    def __init__(self, *, period: float) -> None:
        super().__init__()
        self._period = period
        self._input = self.DeclareVectorInputPort("input", _INPUT.size)
        flag, point = Quantity(0.0, bounds=(0.0, 1.0)), Quantity([0.0, 0.0], "m")
        self._course = self.declare_discrete_state(course=Quantity(0.0, "rad"))
        self._walk = self.declare_discrete_state(walk=flag)
        for port, group in (("course", self._course), ("walk", self._walk)):
            self.DeclareStateOutputPort(port, group.index)
        self._memory = self.declare_discrete_state(
            position=point,
            slip=Quantity([0.0, 0.0], "m/s"),
            slipping=flag,
            tipped=flag,
            under_way=flag,
            origin=point,
            heading=Quantity(0.0, "rad"),
            last_step=point,
        )
        self._settings = self.declare_parameters(
            course_gain=Quantity(0.3, "rad/m", (0.0, 10.0)),
            course_limit=Quantity(0.5, "rad", (0.0, pi / 2)),
            slip_time=Quantity(2.0, "s", (0.0, 1e3)),
            slip_limit=Quantity(0.05, "m/s", (0.0, 10.0)),
            tip_angle=Quantity(0.8, "rad", (0.0, pi)),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        T, settings, memory = self._period, self._settings.view(context), self._memory.mutable(state)
        u = _INPUT.view(self._input.Eval(context))
        heading, walk, roll, pitch = u.heading, u.walk, u.roll, u.pitch
        # Numbers, which are faster than arrays of two.
        leg_x, leg_y, last_x, last_y = *u.position.tolist(), *memory.last_step.tolist()
        x, y, slip_x, slip_y = *memory.position.tolist(), *memory.slip.tolist()
        vx, vy = horizontal(u.visual_odometry.tolist(), roll, pitch, u.yaw)
        x, y = x + T * vx, y + T * vy
        share = 1.0 - exp(-T / settings.slip_time) if settings.slip_time > 0.0 else 1.0
        slip_x += share * ((leg_x - last_x) / T - vx - slip_x)
        slip_y += share * ((leg_y - last_y) / T - vy - slip_y)
        tip_angle, limit = settings.tip_angle, settings.course_limit
        if abs(roll) > tip_angle or abs(pitch) > tip_angle:
            memory.tipped = 1.0
        if walk > 0.0 and not (memory.under_way and heading == memory.heading):
            memory.origin = x, y
        x0, y0 = memory.origin.tolist()
        aside = cos(heading) * (y - y0) - sin(heading) * (x - x0)
        correction = min(max(settings.course_gain * aside, -limit), limit) if walk > 0.0 else 0.0
        memory.position, memory.slip, memory.last_step = (x, y), (slip_x, slip_y), u.position
        memory.slipping = hypot(slip_x, slip_y) > settings.slip_limit
        memory.under_way, memory.heading = walk > 0.0, heading
        self._course.mutable(state).course = wrap(heading - correction)
        self._walk.mutable(state).walk = 0.0 if memory.tipped else walk


def horizontal(v_B: list[float], roll: float, pitch: float, yaw: float) -> tuple[float, float]:
    """Return the horizontal part of a vector of the frame B in the world, for R_WB = Rz(yaw) Ry(pitch) Rx(roll)."""
    vx, vy, vz = v_B
    across = cos(roll) * vy - sin(roll) * vz
    ahead = cos(pitch) * vx + sin(pitch) * (sin(roll) * vy + cos(roll) * vz)
    return cos(yaw) * ahead - sin(yaw) * across, sin(yaw) * ahead + cos(yaw) * across
