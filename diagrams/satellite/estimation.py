"""The servicer's estimate of its own motion: an inertial navigation in a frame I that is fixed at the start."""

from __future__ import annotations

from functools import lru_cache

import casadi
import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.components.casadi_system.kernel import Kernel
from vtbdrake.components.perception.target_tracker import pose_of_state
from vtbdrake.state import AddressedSystem, Quantity

BASE = 14
"""Size of the estimate of the base: [time (s), q_IB (wxyz), p_IoBo (m), w_IB (rad/s), v_IBo (m/s)], in I."""
HISTORY = 50
"""Number of past poses of the base that are kept."""
POSE = 8
"""Size of an entry of that history: [time (s), q_IB (wxyz), p_IoBo (m)]."""


class BaseEstimator(AddressedSystem):
    r"""An inertial navigation: pose and velocity of the base B from its gyros and accelerometers.

    .. pydrake_system::

        name: BaseEstimator
        input_ports:
        - imu
        output_ports:
        - base
        - history

    ``imu`` is [angular velocity (rad/s); specific force (m/s^2)] in B, means over the sample interval T that ended one
    period ago. The estimate therefore holds for that time, its first entry. In free fall the specific force f is the
    acceleration against a frame in free fall, so that

        R <- R exp([w T]x),   v <- v + T R_mid f,   p <- p + T (v_before + v_after) / 2,

    with R_mid halfway. The inertial frame I is where B is at the start, and moves on as B moves then: p = 0, v = 0 at
    first, whatever the orbit. ``base`` is laid out as `BASE` says; ``history`` holds the last `HISTORY` poses (newest
    first), each laid out as `POSE` says, see `pose_at`.
    """

    def __init__(self, *, period: float) -> None:
        super().__init__()
        self._period = period
        self._kernel = _navigation(period)
        self._imu = self.DeclareVectorInputPort("imu", 6)
        self._base = self.declare_discrete_state(
            time=Quantity(-period, "s"),
            orientation=Quantity([1.0, 0.0, 0.0, 0.0]),
            position=Quantity(np.zeros(3), "m"),
            angular_velocity=Quantity(np.zeros(3), "rad/s"),
            velocity=Quantity(np.zeros(3), "m/s"),
        )
        # Poses of the time before the start are those at the start: the base is where it is.
        past = np.tile(self._base.vector.array()[:POSE], (HISTORY, 1))
        past[:, 0] -= period * np.arange(HISTORY)
        self._history = self.declare_discrete_state(history=Quantity(past, "s, 1, m"))
        self.DeclareStateOutputPort("base", self._base.index)
        self.DeclareStateOutputPort("history", self._history.index)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        base, history = self._base.mutable_array(state), self._history.mutable_array(state)
        base[:] = self._kernel.value((base, self._imu.Eval(context)))
        # Its time. The samples before the first interval are over at t = 0 and are about no motion.
        base[0] = context.get_time() - self._period
        history[POSE:] = history[:-POSE]
        history[:POSE] = base[:POSE]


def pose_at(history: ArrayLike, time: float) -> RigidTransform:
    """Return X_IB at ``time``, interpolated between the poses of a `BaseEstimator`.

    Args:
        history: Its port ``history``, shape (`HISTORY` * `POSE`,) or (`HISTORY`, `POSE`).
        time: The time in s. Outside the history, its newest or its oldest pose is returned.
    """
    poses = np.reshape(np.asarray(history, dtype=float), (-1, POSE))
    times = poses[:, 0]
    if time >= times[0]:
        return pose_of_state(poses[0, 1:])
    if time <= times[-1]:
        return pose_of_state(poses[-1, 1:])
    newer = int(np.searchsorted(-times, -time)) - 1
    after, before = poses[newer], poses[newer + 1]
    share = (time - before[0]) / (after[0] - before[0])
    q_before = before[1:5] * np.sign(before[1:5] @ after[1:5] or 1.0)
    # So close together that the mean of the quaternions is the orientation between them.
    return pose_of_state((1.0 - share) * np.concatenate((q_before, before[5:])) + share * after[1:])


@lru_cache
def _navigation(period: float) -> Kernel:
    """Return the step of the navigation as a kernel of (base, imu)."""
    base, imu = casadi.SX.sym("base", BASE), casadi.SX.sym("imu", 6)
    _, q, p, _, v = casadi.vertsplit(base, [0, 1, 5, 8, 11, BASE])
    w, f = imu[:3], imu[3:]
    q_mid, q_next = turned(q, w * period / 2), turned(q, w * period)
    v_next = v + period * rotated(q_mid, f)
    p_next = p + period * (v + v_next) / 2
    following = casadi.vertcat(0, q_next, p_next, rotated(q_next, w), v_next)
    return Kernel("navigation", [base, imu], casadi.densify(following), compile=None)


def turned(q: casadi.SX, theta: casadi.SX) -> casadi.SX:
    """Return the quaternion of R exp([theta]x), for a small angle: to the fourth order."""
    square = casadi.sumsqr(theta) / 4
    a, b = 1 - square / 2 + square**2 / 24, (0.5 - square / 12 + square**2 / 240) * theta
    w, x = q[0], q[1:]
    turned = casadi.vertcat(w * a - casadi.dot(x, b), w * b + a * x + casadi.cross(x, b))
    return turned / casadi.norm_2(turned)


def rotated(q: casadi.SX, u: casadi.SX) -> casadi.SX:
    """Return R u, for R of the quaternion q."""
    t = 2 * casadi.cross(q[1:], u)
    return u + q[0] * t + casadi.cross(q[1:], t)
