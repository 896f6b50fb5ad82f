"""Dead reckoning of a carrier on wheels by gyros, accelerometers and wheel speed, and how it corrects scans.

Frames: B is the body of the carrier, with x forward, where the IMU measures. H is its level frame: its origin is Bo, z
is up by gravity, x points in the heading of B. O, the odometry frame, is where H was at the start. L is the frame of
the scanner.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise
from math import atan2, ceil, cos, hypot, inf, sin, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from vtbdrake.components.localization.planar import rotation
from vtbdrake.scan import Scan
from vtbdrake.state import discrete_state, parameter
from vtbdrake.state.declarations import NO_DICT

Array = NDArray[np.float64]

MOTION = 8
"""Size of the port ``motion``: [time (s), roll, pitch (rad), x, y (m), heading (rad), speed (m/s), turn (rad/s)]."""
POSE = 6
"""Size of an entry of the port ``history``: [time (s), roll, pitch (rad), x, y (m), heading (rad)]."""
HISTORY_LENGTH = 1.0
"""The time for which poses are remembered, in s."""

# Once the carrier has stood still for so long, its gyros show their bias, in s.
_SETTLING_TIME = 0.5
# No carrier turns, accelerates or drives as fast, in rad/s, m/s^2 and m/s: such a number is a fault.
_LARGEST = 1e3
# The standard deviation of the gyros' bias at the start, in rad/s.
_BIAS_DEVIATION = 0.005


@dataclass(frozen=True)
class DriftModel:
    """Dead reckoning drifts by random walks, and by errors that last. All values are standard deviations.

    The walks grow with the roots of distance, time and turn. Those along and across are calibrated with the simulated
    carrier of `vtbdrake_diagrams.forest`, which slips on slopes; all others are assumed. What lasts, of the radius of a
    wheel or of the gyros, grows with distance and time themselves: it matters where nothing else tells the pose for
    long.

    Attributes:
        along: Deviation along the path, in m per root metre.
        across: Deviation sideways by slip, in m per root metre.
        heading: Deviation of the heading, in rad per root second.
        turn: Deviation of the heading in turns, in rad per root radian.
        scale: Deviation of the scale of the distance, which lasts, as a share.
        rate: Deviation of the turn rate, which lasts, in rad/s.
    """

    along: float = 0.04
    across: float = 0.03
    heading: float = 0.001
    turn: float = 0.01
    scale: float = 0.02
    rate: float = 5e-4

    def __post_init__(self) -> None:
        for field in fields(self):
            if not 0.0 <= getattr(self, field.name) < inf:
                raise ValueError(
                    f"{field.name} of a drift is a finite deviation of at least 0, not {getattr(self, field.name)!r}"
                )

    def covariance(self, motion: ArrayLike, duration: float, *, since: tuple[float, float] = (0.0, 0.0)) -> Array:
        """Return the covariance (3, 3) of a motion X_AB by dead reckoning, in the order x, y (in A, m), heading (rad).

        Args:
            motion: X_AB = [x, y, heading] from where the carrier was, (3,) in m and rad. It is about an arc.
            duration: How long it took, in s.
            since: The distance in m and the time in s for which it had been dead reckoning alone before. The errors
                that last add up with those of before: the covariance is by how much the variances grow.
        """
        x, y, turned = np.asarray(motion, dtype=float).tolist()
        length, (before, elapsed) = hypot(x, y), since
        along = self.along**2 * length + self.scale**2 * length * (2.0 * before + length)
        heading = self.heading**2 * abs(duration) + self.turn**2 * abs(turned)
        heading += self.rate**2 * duration * (2.0 * elapsed + duration)
        # What the heading has drifted halfway leads aside.
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


class DeadReckoning(LeafSystem):
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
    `HISTORY_LENGTH`, newest first, each laid out as `POSE` says; before the start, the carrier stood still. x, y and
    heading are those of H in O; the heading is continuous, not wrapped.

    *Levelling.* The vertical u in B is turned by the gyros, and led with the time constant ``levelling_time`` to what
    the accelerometers show without the acceleration of Bo, which has the velocity V = [v, -axle w_z, 0] in B:

        u <- exp(-[w T]x) u,   u <- u + k (a / |a| - u),   a = f - dV/dt - w x V,

    where w are the rates without the gyros' bias. k is T / levelling_time, at the start that of a mean: 1, 1/2, 1/3,
    ... Only the direction of a counts, so that gravity need not be known.

    *Path.* A moves along x_B, and Bo stays ahead of it:

        heading <- heading + T (w_y u_y + w_z u_z) / (u_y^2 + u_z^2),
        p_A <- p_A + T v cos(pitch) [cos(heading), sin(heading)], halfway,   [x, y] = p_A - axle [cos(heading), ...].

    *Bias of the gyros.* While the carrier stands still, what the gyros measure is their bias. A Kalman filter estimates
    it: a random walk with the deviation ``bias_drift``, measured with ``gyro_noise``, in which rocking on the springs
    is included. The carrier stands still when for half a second the rates have stayed below ``still_rate``, the mean
    speed, with a time constant of half a second, below ``still_speed``, and no speed was above four times that: wheel
    sensors are noisy at rest, too.

    A sample with a number that is not finite, or with one of 1,000 or more, is left out and counted in ``ignored``:
    speed and turn rate go on.
    """

    __slots__ = NO_DICT

    def __init__(self, *, period: float, axle: float = 0.0) -> None:
        """Declare the system.

        Args:
            period: Sample period of both sensors in s.
            axle: The place on x_B of the point that does not move sideways, in m; behind Bo it is negative.

        Raises:
            ValueError: The period is not positive.
        """
        super().__init__()
        if not 0.0 < period < inf:
            raise ValueError(f"DeadReckoning: the period is positive, in s, not {period!r}")
        self._period = period
        self._imu = self.DeclareVectorInputPort("imu", 6)
        self._odometry = self.DeclareVectorInputPort("odometry", 1)
        length = history_size(period) // POSE
        past = np.zeros((length, POSE))
        past[:, 0] = -period * np.arange(1, length + 1)
        motion = self.DeclareDiscreteState(np.array([-period, *[0.0] * (MOTION - 1)]))
        history = self.DeclareDiscreteState(past.ravel())
        # [up, samples, bias, its variance, samples at rest, ignored, mean speed]
        inner = self.DeclareDiscreteState([0.0, 0.0, 1.0, *[0.0] * 4, _BIAS_DEVIATION**2, *[0.0] * 3])
        self.DeclareStateOutputPort("motion", motion)
        self.DeclareStateOutputPort("history", history)
        self._motion, self._history, self._inner = int(motion), int(history), int(inner)
        settings = self.DeclareNumericParameter(BasicVector([3.0, 0.03, 0.02, 1e-4, 5e-3, axle]))
        bounds = (0.0, inf)
        self.variables = (
            discrete_state("time", self._motion, unit="s"),
            discrete_state("roll", self._motion, start=1, unit="rad"),
            discrete_state("pitch", self._motion, start=2, unit="rad"),
            discrete_state("position", self._motion, start=3, shape=(2,), unit="m"),
            discrete_state("heading", self._motion, start=5, unit="rad"),
            discrete_state("speed", self._motion, start=6, unit="m/s"),
            discrete_state("turn_rate", self._motion, start=7, unit="rad/s"),
            discrete_state("history", self._history, shape=(length, POSE), unit="s, rad, m"),
            discrete_state("up", self._inner, shape=(3,)),
            discrete_state("samples", self._inner, start=3, bounds=bounds),
            discrete_state("gyro_bias", self._inner, start=4, shape=(3,), unit="rad/s"),
            discrete_state("gyro_bias_variance", self._inner, start=7, unit="rad^2/s^2", bounds=bounds),
            discrete_state("samples_at_rest", self._inner, start=8, bounds=bounds),
            discrete_state("ignored", self._inner, start=9, bounds=bounds),
            discrete_state("mean_speed", self._inner, start=10, unit="m/s"),
            parameter("levelling_time", settings, unit="s", bounds=bounds),
            parameter("still_speed", settings, start=1, unit="m/s", bounds=bounds),
            parameter("still_rate", settings, start=2, unit="rad/s", bounds=bounds),
            parameter("bias_drift", settings, start=3, unit="rad/s^1.5", bounds=bounds),
            parameter("gyro_noise", settings, start=4, unit="rad/s", bounds=bounds),
            parameter("axle", settings, start=5, unit="m"),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        _, roll, pitch, x, y, heading, v_before, turn_rate = context.get_discrete_state(self._motion).value().tolist()
        inner = context.get_discrete_state(self._inner).value().tolist()
        sample = [*self._imu.Eval(context).tolist(), *self._odometry.Eval(context).tolist()]
        axle = float(context.get_numeric_parameter(0).value()[5])
        T, now = self._period, context.get_time() - self._period
        # The sample before the first interval is about no motion.
        begun = now > -T / 2.0
        v = v_before
        if not all(abs(number) < _LARGEST for number in sample):
            inner[9] += 1.0
        elif begun:
            v = sample[6]
            bias, inner[7], inner[8] = self._gyro_bias(context, sample, inner)
            w = [rate - offset for rate, offset in zip(sample[:3], bias, strict=True)]
            velocity = (v, -axle * w[2])
            if not inner[3]:  # How fast the carrier was before the first sample is not known.
                v_before, turn_rate = v, w[2]
            before = (v_before, -axle * turn_rate)
            up = self._levelled(context, inner, w, sample[3:6], before=before, after=velocity)
            across = up[1] ** 2 + up[2] ** 2
            turn_rate = (w[1] * up[1] + w[2] * up[2]) / max(across, 1e-9)
            roll, pitch = atan2(up[1], up[2]), atan2(-up[0], sqrt(across))
            inner[:3], inner[3], inner[4:7] = up, inner[3] + 1.0, bias
        if begun:
            way, halfway, turned = T * (v_before + v) / 2.0 * cos(pitch), T * turn_rate / 2.0, T * turn_rate
            x += way * cos(heading + halfway) - axle * (cos(heading + turned) - cos(heading))
            y += way * sin(heading + halfway) - axle * (sin(heading + turned) - sin(heading))
            heading += turned
        motion = [now, roll, pitch, x, y, heading, v, turn_rate]
        state.set_value(self._motion, motion)
        state.set_value(self._inner, inner)
        past = context.get_discrete_state(self._history).value()
        state.set_value(self._history, np.concatenate((motion[:POSE], past[:-POSE])))

    def _gyro_bias(self, context: Context, sample: list[float], inner: list[float]) -> tuple[list[float], float, float]:
        """Return the gyros' bias (rad/s), its variance, and the number of samples at rest; the mean speed goes on."""
        _, still_speed, still_rate, drift, noise, _ = context.get_numeric_parameter(0).value().tolist()
        bias, variance = inner[4:7], inner[7] + drift**2 * self._period
        speed, rates = sample[6], sample[:3]
        inner[10] += max(self._period / _SETTLING_TIME, 1.0 / (inner[3] + 1.0)) * (speed - inner[10])
        moves = abs(inner[10]) > still_speed or abs(speed) > 4.0 * still_speed
        if moves or any(abs(rate) > still_rate for rate in rates):
            return bias, variance, 0.0
        at_rest = inner[8] + 1.0
        if at_rest * self._period > _SETTLING_TIME:
            gain = variance / (variance + max(noise, 1e-9) ** 2)
            bias = [b + gain * (rate - b) for b, rate in zip(bias, rates, strict=True)]
            variance *= 1.0 - gain
        return bias, variance, at_rest

    def _levelled(
        self,
        context: Context,
        inner: list[float],
        w: list[float],
        f: list[float],
        *,
        before: tuple[float, float],
        after: tuple[float, float],
    ) -> list[float]:
        """Return the vertical in B after a sample, (3,).

        Args:
            context: For the parameters.
            inner: The state before.
            w: Angular velocity without bias, in rad/s.
            f: Specific force in m/s^2.
            before: Velocity of Bo along x_B and y_B at the sample before, in m/s.
            after: That at this sample.
        """
        T, u = self._period, _turned_back(inner[:3], w, self._period)
        change = [(new - old) / T for old, new in zip(before, after, strict=True)]
        inward = _cross(w, [(old + new) / 2.0 for old, new in zip(before, after, strict=True)] + [0.0])
        a = [f[0] - change[0] - inward[0], f[1] - change[1] - inward[1], f[2] - inward[2]]
        # The specific force is that of B halfway.
        a = _turned_back(a, w, T / 2.0)
        size = sqrt(sum(e * e for e in a))
        if size > 0.0:
            gain = max(1.0 / (inner[3] + 1.0), T / max(float(context.get_numeric_parameter(0).value()[0]), T))
            u = [e + gain * (b / size - e) for e, b in zip(u, a, strict=True)]
        length = sqrt(sum(e * e for e in u))
        return [e / length for e in u] if length > 0.0 else inner[:3]


def _turned_back(u: list[float], w: list[float], duration: float) -> list[float]:
    """Return exp(-[w duration]x) u, to the second order: a fixed vector, in a body that has turned."""
    first = _cross(w, u)
    second = _cross(w, first)
    return [e - duration * a + duration**2 / 2.0 * b for e, a, b in zip(u, first, second, strict=True)]


def _cross(a: list[float], b: list[float]) -> list[float]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def history_size(period: float) -> int:
    """Return the size of the port ``history`` of a `DeadReckoning` with this period in s: two poses at least."""
    return POSE * max(ceil(HISTORY_LENGTH / period - 1e-6), 2)


def carrier_pose_at(history: ArrayLike, time: float) -> Array:
    """Return [time (s), roll, pitch (rad), x, y (m), heading (rad)] of the carrier at a time in s, (6,).

    It is interpolated between the poses of a `DeadReckoning`; outside its history, it is the newest or the oldest one.

    Args:
        history: The port ``history`` of a `DeadReckoning`, newest first.
        time: The time by the clock of the DPS, in s.
    """
    past = np.reshape(np.asarray(history, dtype=float), (-1, POSE))[::-1]
    return np.array([time, *(np.interp(time, past[:, 0], past[:, k]) for k in range(1, POSE))])


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

    Each ray is turned and moved by the pose that the carrier had when it was fired, against the pose at ``time``. Poses
    between those of the history are interpolated linearly. That the carrier rises and sinks is neglected.

    Args:
        scan: What was measured.
        history: The port ``history`` of a `DeadReckoning`, newest first.
        X_BL: Pose of the scanner in B.
        time: When the scan was complete, by the clock of the DPS, in s.

    Raises:
        ValueError: The history has fewer than two poses.
    """
    knots = np.reshape(np.asarray(history, dtype=float), (-1, POSE))[::-1]
    if len(knots) < 2:
        raise ValueError(f"deskewing needs a history of at least 2 poses, not {len(knots)}: see `history_size`")
    fired = time + scan.times
    first, last = (fired.min(), fired.max()) if len(fired) else (time, time)
    # Only the knots around the scan, at least two.
    low = min(max(int(np.searchsorted(knots[:, 0], first, side="right")) - 1, 0), len(knots) - 2)
    knots = knots[low : max(int(np.searchsorted(knots[:, 0], last)) + 1, low + 2)]
    _, _, _, x, y, heading = carrier_pose_at(history, time).tolist()
    R_OH = rotation(heading)
    turns = np.array([body_rotation(roll, pitch, turned - heading) for _, roll, pitch, _, _, turned in knots.tolist()])
    moves = np.zeros((len(knots), 3))
    moves[:, :2] = (knots[:, 3:5] - [x, y]) @ R_OH
    # Between which knots a ray was fired, and where between them; before the first and after the last, at these.
    place = np.interp(fired, knots[:, 0], np.arange(len(knots)))
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
