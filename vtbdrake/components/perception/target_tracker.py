"""A filter that follows a freely moving, tumbling rigid body through pose estimates from several sources."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import ceil, hypot, inf, isqrt

import casadi
import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import RotationalInertia
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.casadi_system.kernel import Kernel
from vtbdrake.components.casadi_system.rotations import exponential, quaternion, roll_pitch_yaw_angles
from vtbdrake.components.estimation import kalman_update
from vtbdrake.components.perception.estimate import (
    PoseEstimate,
    rotation_matrix,
    rotation_vector,
)
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.state.systems import POSE_UNIT


@dataclass(frozen=True, eq=False)
class Track:
    """The estimated motion of a body T in an inertial frame I at one instant.

    The error is [θ; d; δω; δv]: θ and d as in `PoseEstimate`, all expressed in I.

    Attributes:
        time: The instant, in s.
        R: R_IT, (3, 3).
        p: p_IoTo_I, (3,) in m; To is the body's centre of mass.
        w: The angular velocity ω in I, (3,) in rad/s.
        v: The velocity of To in I, (3,) in m/s.
        P: The covariance of the error, (12, 12).
    """

    time: float
    R: Array
    p: Array
    w: Array
    v: Array
    P: Array

    @property
    def X(self) -> RigidTransform:
        """The pose X_IT."""
        return RigidTransform(RotationMatrix.ProjectToRotationMatrix(self.R), self.p)

    def numbers(self) -> Array:
        """Return the track as one vector, (`TRACK_SIZE`,)."""
        return np.concatenate([[self.time], self.R.ravel(), self.p, self.w, self.v, self.P.ravel()])

    @staticmethod
    def of(numbers: ArrayLike) -> Track:
        """Return the track that `numbers` made a vector of."""
        x = np.asarray(numbers, dtype=float)
        return Track(float(x[0]), x[1:10].reshape(3, 3), x[10:13], x[13:16], x[16:19], x[19:].reshape(12, 12))


TRACK_SIZE = 1 + 9 + 9 + 144


SPHERE = (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
"""The inertia of a body whose angular velocity is constant in free flight, whatever its axis."""


@dataclass
class MotionModel:
    r"""The assumed motion of a body in free fall: momentum is conserved, up to white noise.

    With the inertia J in T, the angular momentum L = J_I ω, J_I = R J R', is constant, and ω follows from it: Euler's
    equations. The error of attitude moves by θ' = J_I^-1 ([L]× θ + δL), with δL = (J_I [ω]× - [L]×) θ + J_I δω.

    A body of unknown inertia may be taken for a `SPHERE`, whose ω is constant. ``rate_noise`` must then cover what ω
    does between estimates that are dt apart: (I_max - I_min) / I_mid ω^2 sqrt(dt), 0.0012 rad/s^1.5 for principal
    moments of 1, 0.6 and 0.4 at 3 deg/s, five times a second.

    The inertia is the body's about its centre of mass, in T; only its ratios matter.
    """

    rate_noise: float = setting(
        1e-3, "Square root of the spectral density of the angular acceleration.", unit="rad/s^1.5", ge=0
    )
    velocity_noise: float = setting(
        1e-3, "Square root of the spectral density of the acceleration.", unit="m/s^1.5", ge=0
    )
    first_rate: float = setting(0.1, "Initial standard deviation of the angular velocity.", unit="rad/s", gt=0)
    first_velocity: float = setting(0.1, "Initial standard deviation of the velocity.", unit="m/s", gt=0)
    inertia: list[float] = setting(doc="[Ixx, Iyy, Izz, Ixy, Ixz, Iyz].", default_factory=lambda: list(SPHERE))

    def check(self) -> None:
        """Raise ValueError if a setting is out of range, or no body has this inertia."""
        check_settings(self)
        if len(self.inertia) != 6 or not RotationalInertia(*self.inertia).CouldBePhysicallyValid():
            raise ValueError(
                "MotionModel.inertia must be [Ixx, Iyy, Izz, Ixy, Ixz, Iyz] of a body: positive, no principal moment "
                f"larger than the sum of the others; not {self.inertia!r}"
            )

    def begin(self, estimate: PoseEstimate) -> Track:
        """Return the track that begins with one pose."""
        P = np.zeros((12, 12))
        P[:6, :6] = estimate.covariance
        P[6:, 6:] = np.diag(np.repeat([self.first_rate**2, self.first_velocity**2], 3))
        return Track(estimate.time, estimate.matrix[:, :3], estimate.matrix[:, 3], np.zeros(3), np.zeros(3), P)

    def predict(self, track: Track, time: float) -> Track:
        """Return the track at a later (or the same) time.

        Args:
            track: The track at its own time.
            time: The later time, in s.
        """
        return Track.of(_predicted().value(self._flight(track.numbers(), time)).copy())

    def present(self, track: Array, time: float) -> Array:
        """Return the pose and velocity of a track at another time, as one vector (21,).

        Args:
            track: The `Track.numbers`.
            time: The time in s.

        Returns:
            The `body_state` (13,), the pose [x, y, z, roll, pitch, yaw] in m and rad, and the standard deviations of
            attitude (rad) and position (m): the roots of the mean variances, of first order in the angle turned since.
        """
        return _present().value(self._flight(track, time)).copy()

    def _flight(self, track: Array, time: float) -> tuple[Array, Array, Array]:
        """Return the arguments of the kernels that lead a track to ``time``: itself, its flight, and how it went.

        Each of some equal steps turns the body by at most 0.1 rad, unless the track has long been lost.
        """
        then, w = track.item(0), track[13:16].tolist()
        steps = min(max(1, ceil(hypot(*w) * abs(time - then) / 0.1)), 30)
        conditions = np.array([time, (time - then) / steps, self.rate_noise**2, self.velocity_noise**2, *self.inertia])
        flight = np.concatenate([track[1:10], track[13:16], _NOT_TURNED])
        for _ in range(steps):
            flight = _turned().value((track, flight, conditions))
        return track, flight, conditions

    def fuse(self, track: Track, estimate: PoseEstimate) -> tuple[Track, float]:
        r"""Return the track with a measured pose, and the normalized innovation squared (six degrees of freedom).

        A measurement newer than the track moves it to its own time. One older by Δt corrects the track where it is:
        it measures F(-Δt) x, with the process noise of Δt added to its own. This neglects the correlation of that noise
        with the track; the exact solution is in Bar-Shalom, "Update with out-of-sequence measurements in tracking",
        2002.

        Args:
            track: The track at its own time.
            estimate: A valid estimate of the pose X_IT of the body.
        """
        covariance = estimate.covariance
        if estimate.time >= track.time:
            track = self.predict(track, estimate.time)
            H, R, p = np.eye(6, 12), track.R, track.p
        else:
            there = _looked_back().value(self._flight(track.numbers(), estimate.time)).copy()
            H, R, p = there[:72].reshape(6, 12), there[72:81].reshape(3, 3), there[81:84]
            covariance = covariance + np.diag(there[84:])
        nu = np.concatenate([rotation_vector(estimate.matrix[:, :3] @ R.T), estimate.matrix[:, 3] - p])
        step, P, squares = kalman_update(track.P, nu, H=H, R=covariance)
        fused = replace(
            track,
            R=rotation_matrix(step[:3]) @ track.R,
            p=track.p + step[3:6],
            w=track.w + step[6:9],
            v=track.v + step[9:],
            P=P,
        )
        return fused, float(squares)


# A and B of a flight that begins, see `_turned`.
_NOT_TURNED = np.concatenate([np.eye(3).ravel(), np.zeros(9)])


@dataclass(frozen=True)
class _Flight:
    """The symbols of a flight, from which kernels are made.

    Attributes:
        track: `Track.numbers` at its start, (163, 1).
        flight: [R, ω, A, B] at its present end: with the error of attitude θ(0) at the start, and δL of the angular
            momentum, which holds for all the flight, θ = A θ(0) + B δL. (30, 1).
        conditions: [the time at its end, the length of a step, the spectral densities of the angular acceleration and
            of the acceleration, the inertia], (10, 1).
    """

    track: casadi.SX = field(default_factory=lambda: casadi.SX.sym("track", TRACK_SIZE))
    flight: casadi.SX = field(default_factory=lambda: casadi.SX.sym("flight", 30))
    conditions: casadi.SX = field(default_factory=lambda: casadi.SX.sym("conditions", 10))

    def start(self) -> tuple[casadi.SX, ...]:
        """Return time, R, p, ω, v and P at the start."""
        time, R, p, w, v, P = casadi.vertsplit(self.track, [0, 1, 10, 13, 16, 19, TRACK_SIZE])
        return time, _matrix(R), p, w, v, _matrix(P)

    def end(self) -> tuple[casadi.SX, ...]:
        """Return R, ω, A and B at its end."""
        R, w, A, B = casadi.vertsplit(self.flight, [0, 9, 12, 21, 30])
        return _matrix(R), w, _matrix(A), _matrix(B)

    def inertia(self, R_IT: casadi.SX, *, inverse: bool = False) -> casadi.SX:
        """Return J_I, or its inverse."""
        xx, yy, zz, xy, xz, yz = casadi.vertsplit(self.conditions[4:])
        J_T = casadi.blockcat([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        return R_IT @ (casadi.inv(J_T) if inverse else J_T) @ R_IT.T

    def duration(self) -> casadi.SX:
        """Return its duration."""
        return self.conditions[0] - self.track[0]

    def position(self) -> casadi.SX:
        """Return the position at its end."""
        _, _, p, _, v, _ = self.start()
        return p + self.duration() * v

    def transition(self) -> casadi.SX:
        """Return F, which carries the error of a track over the flight, (12, 12)."""
        _, R_start, _, w_start, _, _ = self.start()
        R, w, A, B = self.end()
        J = self.inertia(R_start)
        turning = casadi.skew(J @ w_start)
        before = J @ casadi.skew(w_start) - turning  # δL = before θ + J δω
        after, inverse = self.inertia(R) @ casadi.skew(w) - turning, self.inertia(R, inverse=True)
        F = casadi.SX.eye(12)
        F[:3, :3], F[:3, 6:9] = A + B @ before, B @ J
        F[6:9, :3], F[6:9, 6:9] = inverse @ (before - after @ F[:3, :3]), inverse @ (J - after @ F[:3, 6:9])
        F[3:6, 9:] = self.duration() * casadi.SX.eye(3)
        return F

    def kernel(self, name: str, *values: casadi.SX) -> Kernel:
        """Return values as a kernel of the flight; matrices are written row after row."""
        y = casadi.densify(casadi.vertcat(*(casadi.vec(value.T) if value.is_square() else value for value in values)))
        return Kernel(name, [self.track, self.flight, self.conditions], y, compile=None)


@lru_cache
def _turned() -> Kernel:
    """Return the flight after another step, which is of second order, and exact for a `SPHERE`."""
    f = _Flight()
    (_, R_start, _, w_start, _, _), (R, w, A, B), h = f.start(), f.end(), f.conditions[1]
    L, eye = f.inertia(R_start) @ w_start, casadi.SX.eye(3)
    K = f.inertia(exponential(0.5 * h * w) @ R, inverse=True)  # in the middle of the step
    R = exponential(h * (K @ L)) @ R
    M = h * K @ casadi.skew(L)
    E = eye + M + M @ M @ (eye / 2 + M / 6)
    B = E @ B + h * (eye + M / 2 + M @ M / 6) @ K
    return f.kernel("turned", R, f.inertia(R, inverse=True) @ L, E @ A, B)


@lru_cache
def _predicted() -> Kernel:
    """Return the track at the end of a flight."""
    f = _Flight()
    (_, _, _, _, v, P), (R, w, _, _), F, dt = f.start(), f.end(), f.transition(), f.duration()
    Q = casadi.kron(
        casadi.blockcat([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]),
        casadi.diag(casadi.vertcat(*[f.conditions[2]] * 3, *[f.conditions[3]] * 3)),
    )
    return f.kernel("predicted", f.conditions[0], R, f.position(), w, v, F @ P @ F.T + Q)


@lru_cache
def _looked_back() -> Kernel:
    """Return the kernel of a late measurement: [the rows H of F for the pose, R, p, variances of the noise since]."""
    f = _Flight()
    R, _, _, _ = f.end()
    H, since = f.transition()[:6, :], -f.duration()
    noise = since**3 / 3 * casadi.vertcat(*[f.conditions[2]] * 3, *[f.conditions[3]] * 3)
    return f.kernel("looked_back", casadi.vec(H.T), R, f.position(), noise)


@lru_cache
def _present() -> Kernel:
    """Return the kernel of `MotionModel.present`."""
    f = _Flight()
    (_, _, _, _, v, P), (R, w, _, _), p, dt = f.start(), f.end(), f.position(), f.duration()
    variances, shared = casadi.diag(P), casadi.diag(P[:6, 6:])
    pose = variances[:6] + 2 * dt * shared + dt**2 * variances[6:]
    deviations = [
        casadi.sqrt((casadi.sum1(pose[3 * k : 3 * k + 3]) + f.conditions[2 + k] * dt**3) / 3) for k in range(2)
    ]
    return f.kernel("present", quaternion(R), p, w, v, p, roll_pitch_yaw_angles(R), *deviations)


def _matrix(numbers: casadi.SX) -> casadi.SX:
    """Return the square matrix whose rows follow one another in ``numbers``."""
    n = isqrt(numbers.numel())
    return casadi.reshape(numbers, n, n).T


STATE_SIZE = 13
STATUS_SIZE = 4


def body_state(X_IT: RigidTransform, w: ArrayLike, v: ArrayLike) -> Array:
    """Return pose and velocities of a body as Drake orders them for a floating body.

    Args:
        X_IT: The pose.
        w: The angular velocity in I, (3,) in rad/s.
        v: The velocity of the body's origin in I, (3,) in m/s.

    Returns:
        The quaternion (w, x, y, z), the position, the angular velocity and the velocity, (13,).
    """
    return np.concatenate([X_IT.rotation().ToQuaternion().wxyz(), X_IT.translation(), w, v])


def pose_of_state(state: ArrayLike) -> RigidTransform:
    """Return the pose in a `body_state` (13,); its quaternion may be of any length but 0."""
    x = np.asarray(state, dtype=float)
    return RigidTransform(Quaternion(x[:4] / np.linalg.norm(x[:4])), x[4:7])


class TargetTracker(AddressedSystem):
    """The filter of `MotionModel` as a system: the target in the perceived environment.

    .. pydrake_system::

        name: TargetTracker
        input_ports:
        - <source> (PoseEstimate of X_IT, one port each)
        output_ports:
        - state
        - status

    Every period it fuses the new estimates of its sources: each once, at its own time, which may be earlier than that
    of estimates fused before. Estimates that are too far from the expected pose (``gate``, on the normalized innovation
    squared) are rejected; after ``patience`` of them in succession, the track begins anew with the next estimate of a
    source that needs no prediction. An estimate with a time that is later than the present by more than ``lost_after``
    is ignored.

    ``state`` is the target at the present, as `body_state` orders it: (13,). Before the first estimate it is the
    identity at rest. ``status`` is [valid, age, attitude, position]: valid is 1 if the track has had ``fewest``
    estimates and is not older than ``lost_after``; age is the time in s since the last estimate held (at first
    infinite); attitude (rad) and position (m) are the present standard deviations, the roots of the mean variances.

    A track that is lost is kept, until a new one begins.

    Args:
        sources: The names of the input ports.
        starting: The sources that need no prediction.
        period: Sample period in s.
        motion: The assumed motion of the target.
    """

    def __init__(
        self, sources: Sequence[str], *, starting: Sequence[str], period: float, motion: MotionModel | None = None
    ) -> None:
        super().__init__()
        if not set(starting) <= set(sources) or not starting:
            raise ValueError(
                f"a track begins with an estimate of one of the sources {', '.join(sources)}, not of {list(starting)}"
            )
        self._starting = [name in starting for name in sources]
        self._inputs = [self.DeclareAbstractInputPort(name, Value(PoseEstimate.missing())) for name in sources]
        model = motion or MotionModel()
        model.check()
        # Made before threads use them: CasADi's expressions are not for several threads.
        for kernel in (_turned, _predicted, _looked_back, _present):
            kernel()
        positive = (0.0, inf)
        self._pose = self.declare_discrete_state(pose=Quantity(np.zeros(6), POSE_UNIT))
        self._state = self.declare_discrete_state(
            orientation=Quantity([1.0, 0.0, 0.0, 0.0]),
            position=Quantity(np.zeros(3), "m"),
            velocity=Quantity(np.zeros(6), "rad/s, m/s"),
        )
        self._status = self.declare_discrete_state(
            valid=Quantity(0.0, bounds=(0.0, 1.0)),
            age=Quantity(inf, "s"),
            attitude_deviation=Quantity(inf, "rad"),
            position_deviation=Quantity(inf, "m"),
        )
        # Estimates fused, left out in succession, left out in all, and when the last one of each source held.
        self._counts = self.declare_discrete_state(
            fused=Quantity(0.0, bounds=positive),
            left_out_now=Quantity(0.0, bounds=positive),
            left_out=Quantity(0.0, bounds=positive),
            last_times=Quantity(np.full(len(sources), -inf), "s"),
        )
        self._track = self.declare_discrete_state(track=Quantity(np.zeros(TRACK_SIZE)))
        self._settings = self.declare_parameters(
            rate_noise=Quantity(model.rate_noise, "rad/s^1.5", (0.0, 1.0)),
            velocity_noise=Quantity(model.velocity_noise, "m/s^1.5", (0.0, 1.0)),
            first_rate=Quantity(model.first_rate, "rad/s", (0.0, 10.0)),
            first_velocity=Quantity(model.first_velocity, "m/s", (0.0, 10.0)),
            gate=Quantity(22.5, "", (0.0, 1e3)),
            patience=Quantity(5.0, "", (1.0, 1e6)),
            fewest=Quantity(4.0, "", (1.0, 1e6)),
            lost_after=Quantity(3.0, "s", (0.0, 3600.0)),
        )
        self._inertia = self.declare_parameters(inertia=Quantity(model.inertia, "kg m^2", (-1e6, 1e6)))
        groups = (self._settings, self._inertia)
        tickets = {self.numeric_parameter_ticket(group.index) for group in groups}
        self._model = self.declare_cache("motion model", self._calc_model, tickets)
        self.DeclareStateOutputPort("state", self._state.index)
        self.DeclareStateOutputPort("status", self._status.index)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def pose_estimate(self, context: Context) -> PoseEstimate:
        """Return the pose X_IT with its covariance, at the time of the last estimate that was fused."""
        if not self._counts.view(context).fused:
            return PoseEstimate.missing()
        track = Track.of(self._track.array(context))
        return PoseEstimate.of(track.X, track.P[:6, :6], time=track.time)

    def _calc_model(self, context: Context) -> MotionModel:
        settings = self._settings.view(context)
        return MotionModel(
            rate_noise=settings.rate_noise,
            velocity_noise=settings.velocity_noise,
            first_rate=settings.first_rate,
            first_velocity=settings.first_velocity,
            inertia=self._inertia.array(context).tolist(),
        )

    def _update(self, context: Context, state: DiscreteValues) -> None:
        settings, counts = self._settings.view(context), self._counts.mutable(state)
        model: MotionModel = self._model(context)
        times = counts.last_times
        fresh: list[tuple[float, int, PoseEstimate]] = []
        for k, port in enumerate(self._inputs):
            estimate: PoseEstimate = port.Eval(context)
            # A time in the future is a fault, after which every other estimate would be old.
            if estimate.valid and times[k] < estimate.time <= context.get_time() + settings.lost_after:
                times[k] = estimate.time
                fresh.append((estimate.time, k, estimate))
        if not (fresh or counts.fused):
            return
        numbers = self._track.mutable_array(state)
        track = Track.of(numbers.copy()) if fresh and counts.fused else None
        for _, k, estimate in sorted(fresh, key=lambda entry: entry[:2]):
            if track is None or (counts.left_out_now >= settings.patience and self._starting[k]):
                if self._starting[k]:
                    track, counts.fused, counts.left_out_now = model.begin(estimate), 1.0, 0.0
                continue
            candidate, distance = model.fuse(track, estimate)
            if distance <= settings.gate:
                track, counts.fused, counts.left_out_now = candidate, counts.fused + 1.0, 0.0
            else:
                counts.left_out_now += 1.0
                counts.left_out += 1.0
        if track is not None:
            numbers[:] = track.numbers()
        elif not counts.fused:
            return
        time, now = numbers.item(0), context.get_time()
        age, present = now - time, model.present(numbers, max(now, time))
        self._state.mutable_array(state)[:] = present[:13]
        self._pose.mutable_array(state)[:] = present[13:19]
        status = self._status.mutable(state)
        status.valid, status.age = counts.fused >= settings.fewest and age <= settings.lost_after, age
        status.attitude_deviation, status.position_deviation = present[19:]
