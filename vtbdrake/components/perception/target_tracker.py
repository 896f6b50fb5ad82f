"""A filter that follows a freely moving, tumbling rigid body through pose estimates from several sources."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import ceil, hypot, inf, sqrt

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import RotationalInertia
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.arrays import Array
from vtbdrake.components.estimation import kalman_update
from vtbdrake.components.perception.estimate import (
    PoseEstimate,
    cross_matrix,
    rotation_matrix,
    rotation_vector,
)
from vtbdrake.settings import check_settings, setting
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.state.systems import POSE_UNIT, pose_to_array


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

    The inertia is that of the body about its centre of mass, in T, of which only ratios matter.
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
        """Raise ValueError if a setting is out of range, or the inertia is not that of a body."""
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
        """Return the track at a later (or the same) time."""
        flight = list(self._flight(track, time - track.time))
        F = self._transition(track, time - track.time, flight)
        return replace(_landed(track, time, flight), P=F @ track.P @ F.T + self._noise(time - track.time))

    def moved(self, track: Track, time: float) -> Track:
        """Return the track at another time, without its covariance there."""
        return _landed(track, time, list(self._flight(track, time - track.time)))

    def _flight(self, track: Track, dt: float) -> Iterator[tuple[Array, Array, Array]]:
        """Yield R_IT and ω after each of some equal steps over ``dt``, with J_I^-1 in the middle of it: (R, J_I^-1, ω).

        The steps are of second order, and exact for a `SPHERE`.
        """
        J, inverse = _inertia(*self.inertia)
        R, w = track.R, track.w
        L = R @ (J @ (w @ R))
        # Each step turns the body by at most 0.1 rad, unless the track has long been lost.
        steps = min(max(1, ceil(hypot(*w.tolist()) * abs(dt) / 0.1)), 30)
        h = dt / steps
        for _ in range(steps):
            middle = rotation_matrix(0.5 * h * w) @ R
            K = middle @ inverse @ middle.T
            R = rotation_matrix(h * (K @ L)) @ R
            w = R @ (inverse @ (L @ R))
            yield R, K, w

    def _transition(self, track: Track, dt: float, flight: list[tuple[Array, Array, Array]]) -> Array:
        """Return F(dt), which carries the error of a track over its flight during ``dt``, (12, 12)."""
        J_T, _ = _inertia(*self.inertia)
        J = track.R @ J_T @ track.R.T
        turning, h = cross_matrix(J @ track.w), dt / len(flight)
        before = J @ cross_matrix(track.w) - turning  # δL = before θ + J δω
        A, B = np.eye(3), np.zeros((3, 3))  # θ = A θ(0) + B δL
        for _, K, _ in flight:
            M = h * K @ turning
            square = M @ M
            E = np.eye(3) + M + square @ (np.eye(3) / 2.0 + M / 6.0)
            A, B = E @ A, E @ B + h * (np.eye(3) + M / 2.0 + square / 6.0) @ K
        F = np.eye(12)
        F[:3, :3], F[:3, 6:9] = A + B @ before, B @ J
        R, _, w = flight[-1]
        J_after = R @ J_T @ R.T
        after = J_after @ cross_matrix(w) - turning
        F[6:9, :3] = np.linalg.solve(J_after, before - after @ F[:3, :3])
        F[6:9, 6:9] = np.linalg.solve(J_after, J - after @ F[:3, 6:9])
        F[3:6, 9:] = dt * np.eye(3)
        return F

    def _noise(self, dt: float) -> Array:
        density = np.repeat([self.rate_noise**2, self.velocity_noise**2], 3)
        pose, velocity = np.arange(6), np.arange(6, 12)
        Q = np.zeros((12, 12))
        Q[pose, pose], Q[velocity, velocity] = density * dt**3 / 3.0, density * dt
        Q[pose, velocity] = Q[velocity, pose] = density * dt**2 / 2.0
        return Q

    def deviations(self, track: Track, time: float) -> tuple[float, float]:
        """Return the standard deviations of attitude (rad) and position (m) at a later time.

        They are the roots of the mean variances, of first order in the angle turned since.
        """
        dt = time - track.time
        # The variances of the pose's six numbers, and their covariances with their rates.
        variances, shared = track.P.diagonal(), track.P.diagonal(6)
        rotation, translation = (
            (variances[:6] + 2.0 * dt * shared + dt**2 * variances[6:]).reshape(2, 3).sum(1).tolist()
        )
        return (
            sqrt((rotation + self.rate_noise**2 * dt**3) / 3.0),
            sqrt((translation + self.velocity_noise**2 * dt**3) / 3.0),
        )

    def fuse(self, track: Track, estimate: PoseEstimate) -> tuple[Track, float]:
        r"""Return the track with a measured pose, and the normalized innovation squared (six degrees of freedom).

        A measurement newer than the track moves it to its own time. One older by Δt corrects the track where it is:
        it measures F(-Δt) x, with the process noise of Δt added to its own. This neglects the correlation of that noise
        with the track; the exact solution is in Bar-Shalom, "Update with out-of-sequence measurements in tracking",
        2002.
        """
        if estimate.time > track.time:
            track = self.predict(track, estimate.time)
        dt = estimate.time - track.time
        H, there = np.eye(6, 12), track
        if dt < 0.0:
            flight = list(self._flight(track, dt))
            H, there = self._transition(track, dt, flight)[:6], _landed(track, estimate.time, flight)
        nu = np.concatenate([rotation_vector(estimate.matrix[:, :3] @ there.R.T), estimate.matrix[:, 3] - there.p])
        step, P, squares = kalman_update(track.P, nu, H=H, R=estimate.covariance + self._noise(-dt)[:6, :6])
        fused = replace(
            track,
            R=rotation_matrix(step[:3]) @ track.R,
            p=track.p + step[3:6],
            w=track.w + step[6:9],
            v=track.v + step[9:],
            P=P,
        )
        return fused, float(squares)


@lru_cache
def _inertia(xx: float, yy: float, zz: float, xy: float, xz: float, yz: float) -> tuple[Array, Array]:
    """Return the inertia J in T, (3, 3), and its inverse."""
    J = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return J, np.linalg.inv(J)


def _landed(track: Track, time: float, flight: list[tuple[Array, Array, Array]]) -> Track:
    """Return the track at the end of a flight, without its covariance there."""
    R, _, w = flight[-1]
    return replace(track, time=time, R=R, p=track.p + (time - track.time) * track.v, w=w)


STATE_SIZE, STATUS_SIZE = 13, 4


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
    from pydrake.common.eigen_geometry import Quaternion

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
        track = Track.of(self._track.array(context)) if counts.fused else None
        fresh: list[tuple[float, int, PoseEstimate]] = []
        for k, port in enumerate(self._inputs):
            estimate: PoseEstimate = port.Eval(context)
            # A time in the future is a fault, after which every other estimate would be old.
            if estimate.valid and times[k] < estimate.time <= context.get_time() + settings.lost_after:
                times[k] = estimate.time
                fresh.append((estimate.time, k, estimate))
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
        if track is None:
            return
        if fresh:
            self._track.mutable(state).track = track.numbers()
        now, age = max(context.get_time(), track.time), context.get_time() - track.time
        present = model.moved(track, now)
        X_IT = present.X
        self._state.mutable_array(state)[:] = body_state(X_IT, present.w, track.v)
        self._pose.mutable(state).pose = pose_to_array(X_IT)
        status = self._status.mutable(state)
        status.valid, status.age = counts.fused >= settings.fewest and age <= settings.lost_after, age
        status.attitude_deviation, status.position_deviation = model.deviations(track, now)
