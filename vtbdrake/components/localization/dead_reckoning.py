"""Dead reckoning of a wheeled carrier from gyros, accelerometers and wheel speed, and the de-skewing of scans by it.

Frames: B is the body of the carrier, with x forward, where the IMU measures. H is its level frame: its origin is Bo, z
is up by gravity, x points in the heading of B. O, the odometry frame, is where H was at the start. L is the frame of
the scanner.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import atan2, ceil, copysign, cos, hypot, inf, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.common.arrays import Array
from vtbdrake.common.scan import Scan
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.localization.planar import rotation
from vtbdrake.state import AddressedSystem, NamedVector, Quantity
from vtbdrake.state.declarations import NamedView

MOTION = NamedVector(
    time=Quantity(unit="s"),
    roll=Quantity(unit="rad"),
    pitch=Quantity(unit="rad"),
    position=Quantity([0.0, 0.0], "m"),
    heading=Quantity(unit="rad"),
    speed=Quantity(unit="m/s"),
    turn_rate=Quantity(unit="rad/s"),
)
"""The port ``motion``."""


class CarrierPose(NamedTuple):
    """The pose of the carrier at one time, an entry of the port ``history``: x, y and heading describe H in O.

    Attributes:
        time: The time in s.
        roll: Roll in rad.
        pitch: Pitch in rad.
        x: Position in m.
        y: Position in m.
        heading: Heading in rad.
    """

    time: float
    roll: float = 0.0
    pitch: float = 0.0
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0


POSE = len(CarrierPose._fields)
"""Size of an entry of the port ``history``."""
HISTORY_LENGTH = 1.0
"""The time for which poses are remembered, in s."""

# After a standstill of this time in s, the gyros' rates are taken for their bias.
_SETTLING_TIME = 0.5
# Readings of at least this size, in rad/s, m/s^2 or m/s, are faults: no carrier turns, accelerates or drives so fast.
_LARGEST = 1e3
# The lower limit of divisors.
_TINY = 1e-30
# The standard deviation of the gyros' bias at the start, in rad/s.
_BIAS_DEVIATION = 0.005


@dataclass(frozen=True)
class DriftModel:
    """The drift of dead reckoning as random walks: deviations grow with the square roots of distance, time and turn.

    ``along`` and ``across`` are calibrated with the simulated carrier of `vtbdrake_diagrams.forest`, which slips on
    slopes; the others are assumed. The scale error of the wheels and the bias of the gyros, which last longer, are not
    part of this model: a `Tracker` estimates them.
    """

    along: float = setting(0.04, "Standard deviation along the path.", unit="m/sqrt(m)", ge=0)
    across: float = setting(0.03, "Standard deviation sideways by slip.", unit="m/sqrt(m)", ge=0)
    heading: float = setting(0.001, "Standard deviation of the heading.", unit="rad/sqrt(s)", ge=0)
    turn: float = setting(0.01, "Standard deviation of the heading in turns.", unit="rad/sqrt(rad)", ge=0)

    def __post_init__(self) -> None:
        check_settings(self)

    def covariance(self, motion: ArrayLike, duration: float) -> Array:
        """Return the covariance (3, 3) of a motion X_AB by dead reckoning, in the order x, y (in A, m), heading (rad).

        Args:
            motion: The motion X_AB = [x, y, heading], (3,) in m and rad, assumed to follow an arc.
            duration: The duration of the motion in s.
        """
        x, y, turned = np.asarray(motion, dtype=float).tolist()
        length = hypot(x, y)
        along = self.along**2 * length
        heading = self.heading**2 * abs(self.extent(motion, duration)) + self.turn**2 * abs(turned)
        # The drift of the heading on the way displaces the end sideways.
        across = self.across**2 * length + heading * length**2 / 3.0
        in_chord = np.array(
            [
                [along, 0.0, 0.0],
                [0.0, across, heading * length / 2.0],
                [0.0, heading * length / 2.0, heading],
            ]
        )
        turn = np.eye(3)
        turn[:2, :2] = rotation(atan2(y, x))
        covariance: Array = turn @ in_chord @ turn.T
        return covariance

    def extent(self, motion: ArrayLike, duration: float) -> float:
        """Return the duration of a motion: the error of the heading grows with it, as its rate is measured.

        Args:
            motion: The motion X_AB = [x, y, heading], (3,) in m and rad; not used.
            duration: The duration of the motion in s.
        """
        return duration


@dataclass(frozen=True)
class SteeringDriftModel(DriftModel):
    """The drift of dead reckoning by speed and steering angle, which measures a curvature in place of a turn rate.

    An error of the angle turns the carrier while it drives, and not while it stands: the heading's error grows with the
    distance. The lasting error g of a `Tracker` is then an error of the curvature, ``rate_deviation`` and ``rate_walk``
    are in rad/m and rad/m^1.5. A wrong scale of the angle, which adds up in a curve, is not part of this model: the
    tracker has the lasting error f for it, with ``turn_deviation``. The defaults fit a car on grass: rounded from the
    first half of the drive in Victoria Park, see `vtbdrake_diagrams.park`.
    """

    along: float = setting(0.05, "Standard deviation along the path.", unit="m/sqrt(m)", ge=0)
    across: float = setting(0.03, "Standard deviation sideways by slip.", unit="m/sqrt(m)", ge=0)
    heading: float = setting(0.006, "Standard deviation of the heading.", unit="rad/sqrt(m)", ge=0)
    turn: float = setting(0.02, "Standard deviation of the heading in turns.", unit="rad/sqrt(rad)", ge=0)

    def extent(self, motion: ArrayLike, duration: float) -> float:
        """Return the distance of a motion, negative backwards: the error of the heading grows with it.

        Args:
            motion: The motion X_AB = [x, y, heading], (3,) in m and rad.
            duration: The duration of the motion in s; not used.
        """
        x, y, _ = np.asarray(motion, dtype=float).tolist()
        return copysign(hypot(x, y), x)


class DeadReckoning(AddressedSystem):
    r"""Roll, pitch, and the path in the plane, from an IMU and the speed of the wheels.

    .. pydrake_system::

        name: DeadReckoning
        input_ports:
        - imu
        - odometry
        output_ports:
        - motion
        - history

    ``imu`` is [angular velocity (rad/s); specific force (m/s^2)] of B, means over the sample interval T that ended one
    period ago. ``odometry`` is the speed v (m/s) by the wheels at its end: along x_B, of the point A that does not move
    sideways, the middle of an axle that is not steered, at x = ``axle`` in B. The estimates therefore hold for that
    time, the first entry of ``motion``, which is laid out as `MOTION` says. ``history`` has the poses of the last
    `HISTORY_LENGTH`, newest first, each a `CarrierPose`; before the start, the carrier stood still. x, y and
    heading describe H in O; the heading is continuous, not wrapped.

    *Levelling.* The reaction g to gravity, expressed in B, points up. It is rotated by the gyros, and corrected towards
    the specific force f less the acceleration of Bo, whose velocity in B is V = [v, -axle w_z, 0]:

        g <- exp(-[w T]x) g,   g <- g + k (a - g),   b <- b + l g x a / g^2,   a = f - dV/dt - w x V,

    where w are the rates without the gyros' bias b; V = 0 in samples that show no motion (below). Only the direction
    u = g / |g| is used, so that gravity need not be known. k and l are the gains of a Kalman filter for the errors of
    u and of the part of b perpendicular to it, the same in all directions: gyros have the noise ``gyro_noise`` per
    sample, and b is a random walk with the deviation ``bias_drift``. Accelerations that the wheels do not show, as when
    the carrier sways or slips, count as noise with the deviation ``sway`` per sample. In the steady state, the time
    constant T / k is about sway / (|g| gyro_noise).

    *Path.* A moves along x_B, and Bo is ahead of it by -axle:

        heading <- heading + T (w_y u_y + w_z u_z) / (u_y^2 + u_z^2),
        p_A <- p_A + T v cos(pitch) [cos(heading), sin(heading)],   [x, y] = p_A - axle [cos(heading), sin(heading)],

    with the heading in the middle of the interval, and the mean of v at its ends, in the step of p_A.

    *Bias about the vertical.* Accelerometers do not show it. But while the carrier stands still, the rate of the gyros
    about the vertical is their bias, which another Kalman filter with the same noise estimates. (About other axes, the
    gyros measure the rocking on the springs, too.) The carrier stands still when for half a second the rates have
    stayed below ``still_rate``, the mean speed, with a time constant of half a second, below ``still_speed``, and no
    speed was above four times that, as wheel sensors are noisy at rest, too. A failed wheel sensor also shows no speed.
    Therefore the accelerometers must agree: the root mean square of the difference between specific force and its mean,
    with the same time constant for both, is at most twice the least one so far, or ``still_force``.

    A sample with a number that is not finite, or with one of 1,000 or more, is left out and counted in ``ignored``:
    speed and turn rate keep their values.
    """

    def __init__(self, *, period: float, axle: float = 0.0, sway: float = 0.1, still_rate: float = 0.02) -> None:
        """Declare the system.

        Args:
            period: Sample period of both sensors in s.
            axle: The x coordinate in B, in m, of the point A that does not move sideways; negative behind Bo.
            sway: The initial value of the parameter ``sway``, in m/s^2; more for a unit that a walker carries.
            still_rate: The initial value of the parameter ``still_rate``, in rad/s; 0 for a carrier that is never
                still, as a unit in the hand.

        Raises:
            ValueError: The period is not positive.
        """
        super().__init__()
        if not 0.0 < period < inf:
            raise ValueError(f"DeadReckoning: the period is positive, in s, not {period!r}")
        self._period = period
        self._imu = self.DeclareVectorInputPort("imu", 6)
        self._odometry = self.DeclareVectorInputPort("odometry", 1)
        variance = _BIAS_DEVIATION**2
        count = Quantity(bounds=(0.0, inf))
        self._motion = self.declare_discrete_state(**{**MOTION.quantities, "time": Quantity(-period, "s")})
        self._history = self.declare_discrete_state(history=Quantity(history_at_start(period), "s, rad, m"))
        self._levelling = self.declare_discrete_state(
            gravity=Quantity(np.zeros(3), "m/s^2"),
            velocity=Quantity(np.zeros(2), "m/s"),
            gyro_bias=Quantity(np.zeros(3), "rad/s"),
        )
        # Variance of u, its covariance with the bias across u, variances of that bias and of the one about u.
        self._variances = self.declare_discrete_state(
            levelling_covariance=Quantity([1.0, 0.0, variance], "rad^2, rad^2/s, rad^2/s^2"),
            vertical_bias_variance=Quantity(variance, "rad^2/s^2", (0.0, inf)),
        )
        self._counts = self.declare_discrete_state(
            samples=count,
            samples_at_rest=count,
            ignored=count,
            mean_speed=Quantity(unit="m/s"),
            mean_force=Quantity(np.zeros(3), "m/s^2"),
            shaking=Quantity(0.0, "m^2/s^4", (0.0, inf)),
            least_shaking=Quantity(_LARGEST**2, "m^2/s^4", (0.0, inf)),
        )
        for port, group in (("motion", self._motion), ("history", self._history)):
            self.DeclareStateOutputPort(port, group.index)
        self._settings = self.declare_parameters(
            sway=Quantity(sway, "m/s^2", (0.0, 10.0)),
            still_speed=Quantity(0.03, "m/s", (0.0, 1.0)),
            still_rate=Quantity(still_rate, "rad/s", (0.0, 1.0)),
            bias_drift=Quantity(3e-5, "rad/s^1.5", (0.0, 1.0)),
            gyro_noise=Quantity(2e-3, "rad/s", (0.0, 1.0)),
            axle=Quantity(axle, "m", (-10.0, 10.0)),
            still_force=Quantity(3e-3, "m/s^2", (0.0, 10.0)),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        motion, past = self._motion.mutable(state), self._history.array(context)
        counts, settings = self._counts.mutable(state), self._settings.view(context)
        sample = [*self._imu.Eval(context).tolist(), *self._odometry.Eval(context).tolist()]
        T, now = self._period, context.get_time() - self._period
        # The first sample belongs to an interval before the start.
        begun = now > -T / 2.0
        v = v_before = motion.speed
        if not all(abs(number) < _LARGEST for number in sample):
            counts.ignored += 1.0
        elif begun:
            v = sample[6]
            if not counts.samples:  # How fast the carrier was before the first sample is not known.
                v_before = v
            self._count(counts, sample, settings)
            up, w = self._level(state, sample, counts, settings)
            across = up[1] ** 2 + up[2] ** 2
            motion.turn_rate = (w[1] * up[1] + w[2] * up[2]) / max(across, 1e-9)
            motion.roll, motion.pitch = atan2(up[1], up[2]), atan2(-up[0], sqrt(across))
        if begun:
            x, y = motion.position.tolist()
            heading, axle, turn_rate = motion.heading, settings.axle, motion.turn_rate
            way, halfway, turned = T * (v_before + v) / 2.0 * cos(motion.pitch), T * turn_rate / 2.0, T * turn_rate
            x += way * cos(heading + halfway) - axle * (cos(heading + turned) - cos(heading))
            y += way * sin(heading + halfway) - axle * (sin(heading + turned) - sin(heading))
            motion.position, motion.heading = (x, y), heading + turned
        motion.time, motion.speed = now, v
        pose = self._motion.mutable_array(state)[:POSE]
        self._history.mutable_array(state)[:] = np.concatenate((pose, past[:-POSE]))

    def _count(self, counts: NamedView, sample: list[float], settings: NamedView) -> None:
        """Bring the counters and means to what they are after a sample."""
        speed, force = sample[6], sample[3:6]
        gain = max(self._period / _SETTLING_TIME, 1.0 / (counts.samples + 1.0))
        mean_speed, shaking = counts.mean_speed, counts.shaking
        mean_speed += gain * (speed - mean_speed)
        mean_force = [mean + gain * (f - mean) for mean, f in zip(counts.mean_force.tolist(), force, strict=True)]
        shaking += gain * (sum((f - mean) ** 2 for f, mean in zip(force, mean_force, strict=True)) - shaking)
        counts.mean_speed, counts.mean_force, counts.shaking = mean_speed, mean_force, shaking
        if counts.samples * self._period > _SETTLING_TIME:
            counts.least_shaking = min(counts.least_shaking, shaking)
        moves = abs(mean_speed) > settings.still_speed or abs(speed) > 4.0 * settings.still_speed
        moves = moves or any(abs(rate) > settings.still_rate for rate in sample[:3])
        moves = moves or shaking > max(4.0 * counts.least_shaking, settings.still_force**2)
        counts.samples += 1.0
        counts.samples_at_rest = 0.0 if moves else counts.samples_at_rest + 1.0

    def _level(
        self, state: DiscreteValues, sample: list[float], counts: NamedView, settings: NamedView
    ) -> tuple[list[float], list[float]]:
        """Return the vertical in B, (3,), and the angular velocity without bias (rad/s), (3,).

        Args:
            state: The state, in which gravity, velocity, bias and variances become those after the sample.
            sample: Angular velocity (rad/s), specific force (m/s^2) and speed (m/s), (7,).
            counts: The counters after the sample.
            settings: The parameters.
        """
        levelling, variances = self._levelling.mutable(state), self._variances.mutable(state)
        gravity, before, bias = levelling.gravity.tolist(), levelling.velocity.tolist(), levelling.gyro_bias.tolist()
        tilt, both, level = variances.levelling_covariance.tolist()
        T, bias_drift, gyro_noise = self._period, settings.bias_drift, settings.gyro_noise
        vertical = variances.vertical_bias_variance + bias_drift**2 * T
        is_first, at_rest = counts.samples == 1.0, counts.samples_at_rest * T > _SETTLING_TIME
        if at_rest:
            up = _direction(gravity)
            K = vertical / max(vertical + gyro_noise**2, _TINY)
            excess = K * sum((rate - b) * e for rate, b, e in zip(sample, bias, up, strict=False))
            bias = [b + excess * e for b, e in zip(bias, up, strict=True)]
            vertical *= 1.0 - K
        w = [rate - b for rate, b in zip(sample, bias, strict=False)]
        velocity = [0.0, 0.0] if counts.samples_at_rest else [sample[6], -settings.axle * w[2]]
        if is_first:
            before = velocity
        change = [(new - old) / T for old, new in zip(before, velocity, strict=True)]
        inward = _cross(w, [(old + new) / 2.0 for old, new in zip(before, velocity, strict=True)] + [0.0])
        a = [sample[3] - change[0] - inward[0], sample[4] - change[1] - inward[1], sample[5] - inward[2]]
        # The mean specific force is expressed in B as it is in the middle of the interval.
        a = _turned_back(a, w, T / 2.0)
        gravity = a if is_first else _turned_back(gravity, w, T)
        square = max(sum(e * e for e in gravity), _TINY)
        tilt += T * (2.0 * both + T * level) + (gyro_noise * T) ** 2
        both += T * level
        level += bias_drift**2 * T
        S = max(tilt + settings.sway**2 / square, _TINY)
        K, K_bias = tilt / S, both / S
        bias = [b + K_bias * e / square for b, e in zip(bias, _cross(gravity, a), strict=True)]
        gravity = [e + K * (b - e) for e, b in zip(gravity, a, strict=True)]
        levelling.gravity, levelling.velocity, levelling.gyro_bias = gravity, velocity, bias
        variances.levelling_covariance = ((1.0 - K) * tilt, (1.0 - K) * both, level - K_bias * both)
        variances.vertical_bias_variance = vertical
        return _direction(gravity), w


def _direction(u: list[float]) -> list[float]:
    """Return the direction of a vector in B, (3,); z_B if its length is 0."""
    length = sqrt(sum(e * e for e in u))
    return [e / length for e in u] if length > _TINY else [0.0, 0.0, 1.0]


def _turned_back(u: list[float], w: list[float], duration: float) -> list[float]:
    """Return exp(-[w duration]x) u, to the second order: a fixed vector, expressed in a body after its rotation."""
    first = _cross(w, u)
    second = _cross(w, first)
    return [e - duration * a + duration**2 / 2.0 * b for e, a, b in zip(u, first, second, strict=True)]


def _cross(a: list[float], b: list[float]) -> list[float]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def history_size(period: float) -> int:
    """Return the size of the port ``history`` of a `DeadReckoning` with this period in s: two poses at least."""
    return POSE * max(ceil(HISTORY_LENGTH / period - 1e-6), 2)


def history_at_start(period: float) -> Array:
    """Return the history of a carrier that stood still before the start, by this period in s, shape (n, `POSE`)."""
    count = history_size(period) // POSE
    return np.array([CarrierPose(time=-period * k) for k in range(1, count + 1)])


def carrier_pose_at(history: ArrayLike, time: float) -> CarrierPose:
    """Return the pose of the carrier at a time in s.

    It is interpolated between the poses of a `DeadReckoning`; outside its history, it is the newest or the oldest one.

    Args:
        history: The port ``history`` of a `DeadReckoning`, newest first.
        time: The time by the clock of the DPS, in s.
    """
    past = _poses(history)
    return CarrierPose(time, *(float(np.interp(time, past["time"], past[name])) for name in CarrierPose._fields[1:]))


def _poses(history: ArrayLike) -> np.ndarray:
    """Return the poses of a history, oldest first, (n,), with the fields of `CarrierPose`."""
    fields = [(name, float) for name in CarrierPose._fields]
    return np.ravel(np.asarray(history, dtype=float)).view(fields)[::-1]


def body_rotation(roll: float, pitch: float, heading: float = 0.0) -> Array:
    """Return the rotation matrix (3, 3) of a body with this roll and pitch in a level frame, R_HB if heading is 0.

    Args:
        roll: Roll of the body in rad.
        pitch: Pitch of the body in rad.
        heading: Angle from the x axis of the level frame to the heading of the body in rad.
    """
    matrix: Array = RollPitchYaw(roll, pitch, heading).ToRotationMatrix().matrix()
    return matrix


def deskewed(scan: Scan, history: ArrayLike, X_BL: RigidTransform, *, time: float) -> Array:
    """Return the points of a scan in the level frame H at one time, (n, 3) in m.

    Each point is transformed from the pose of the carrier when its ray was fired to the pose at ``time``. Poses between
    the history's are interpolated linearly. The vertical motion of the carrier is neglected.

    Args:
        scan: The scan.
        history: The port ``history`` of a `DeadReckoning`, newest first.
        X_BL: Pose of the scanner in B.
        time: The time when the scan was complete, by the clock of the DPS, in s.

    Raises:
        ValueError: The history has fewer than two poses.
    """
    knots = _poses(history)
    if len(knots) < 2:
        raise ValueError(f"deskewing needs a history of at least 2 poses, not {len(knots)}: see `history_size`")
    fired = time + scan.times
    first, last = (fired.min(), fired.max()) if len(fired) else (time, time)
    # Only the knots around the scan, at least two.
    low = min(max(int(np.searchsorted(knots["time"], first, side="right")) - 1, 0), len(knots) - 2)
    knots = knots[low : max(int(np.searchsorted(knots["time"], last)) + 1, low + 2)]
    now = carrier_pose_at(history, time)
    poses = [CarrierPose(*knot) for knot in knots.tolist()]
    turns = np.array([body_rotation(pose.roll, pose.pitch, pose.heading - now.heading) for pose in poses])
    moves = np.zeros((len(knots), 3))
    moves[:, :2] = np.array([(pose.x - now.x, pose.y - now.y) for pose in poses]) @ rotation(now.heading)
    # The segment between two knots in which each ray was fired, and its share of it; beyond the knots, at the nearest.
    place = np.interp(fired, knots["time"], np.arange(len(knots)))
    segments = np.minimum(place.astype(int), len(knots) - 2)
    share = (place - segments)[:, np.newaxis]
    order = np.argsort(segments, kind="stable")
    p_BQ = (scan.points() @ X_BL.rotation().matrix().T + X_BL.translation())[order]
    points = np.empty_like(p_BQ)
    ends = np.searchsorted(segments[order], np.arange(len(knots)))
    for segment, (begin, end) in enumerate(pairwise(ends.tolist())):
        rows, following = slice(begin, end), segment + 1
        moved = p_BQ[rows] @ (turns[following] - turns[segment]).T + (moves[following] - moves[segment])
        points[order[rows]] = p_BQ[rows] @ turns[segment].T + moves[segment] + share[order[rows]] * moved
    return points
