r"""The control laws: joint impedance, Cartesian impedance, admittance, and inverse dynamics as a baseline.

q, v are measured; q_r, v_r, a_r and, for the tip T, X_r, V_r, A_r are the reference; ID(q, v, a) = M a + C v + g is
the arm's inverse dynamics; J is the tip's Jacobian, J+ its pseudo-inverse, N = 1 - J+ J; wrenches and velocities are
[angular; linear], in the world. e is the pose error [sin(angle) axis; p_r - p].

joint impedance (Hogan, "Impedance Control", 1985)

    tau = K (q_r - q) + D (v_r - v) + ID(q, v, a_r)

Cartesian impedance (Ott, "Cartesian Impedance Control of Redundant and Flexible-Joint Robots", 2008)

    tau = J' (K e + D (V_r - J v)) + N (K_0 (q_r - q) + D_0 (v_r - v)) + ID(q, v, J+ (A_r - Jdot v))

admittance: the wrench F that the environment exerts on the tip moves the reference by x, of mass, damper and spring

    M_a x'' + D_a x' + K_a x = F

and the arm follows it by its inverse dynamics (resolved acceleration: Luh, Walker, Paul, 1980), with F compensated

    tau = ID(q, v, a) - J' F,   with a the sum of
          J+ (A_r + x'' + D_p (V_r + x' - J v) + K_p (e + x) - Jdot v)   and   N (K_0 (q_r - q) + D_0 (v_r - v))

inverse dynamics (Luh, Walker, Paul, 1980; Drake's ``InverseDynamicsController``, without its integral)

    tau = ID(q, v, a_r + k_p (q_r - q) + k_d (v_r - v))

J+ is of the least squares: N torques do not move the tip of an arm at rest, so that in statics the tip feels K e and
nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import casadi
import numpy as np
from numpy.typing import ArrayLike

from vtbdrake_diagrams.manipulator.dynamics import ArmDynamics, Expression, FrameMotion
from vtbdrake_diagrams.manipulator.motions import Reference

# Name -> (value, unit, bounds).
Declared = dict[str, tuple[object, str, tuple[ArrayLike, ArrayLike]]]


def _gain(value: ArrayLike, unit: str, most: float, *, least: float = 0.0) -> tuple[object, str, tuple[Any, Any]]:
    """Return a gain of a `Law` that lies between ``least`` and ``most`` times its value.

    At either end, with the other gains as they are, the arm in free space is stable at a period of 1 ms, as a test
    shows. A gain that is written while the arm moves, in a wrong unit say, is refused rather than obeyed.
    """
    return value, unit, (least * np.asarray(value), most * np.asarray(value))


_NULL_SPACE: Declared = {
    "posture_stiffness": _gain(20.0, "1", 10.0),
    "posture_damping": _gain(10.0, "1", 8.0),
}


@dataclass(frozen=True)
class Instant:
    """The arguments of a `Law` at one instant.

    Attributes:
        model: The arm that the controller assumes.
        q, v: The measured joint positions and velocities.
        wrench: The wrench of the environment on the tip.
        reference: The reference of the motion.
        state: What the law remembers, and the joint ``reference`` of the last instant.
        parameters: The gains of the law and of the motion.
        period: The sample period in s.
    """

    model: ArmDynamics
    q: Expression
    v: Expression
    wrench: Expression
    reference: Reference
    state: dict[str, Expression]
    parameters: dict[str, Expression]
    period: float


@dataclass(frozen=True)
class Law:
    """A control law.

    Attributes:
        parameters: Value, unit and bounds of its gains.
        state: Initial value and unit of what it remembers beside the motion.
        torque: Returns the torque and the next state.
    """

    parameters: Declared
    torque: Callable[[Instant], tuple[Expression, dict[str, Expression]]]
    state: dict[str, tuple[object, str]] = field(default_factory=dict)


class _Projection:
    """J+ and N of least squares with a little damping, which keeps them finite where J loses rank."""

    def __init__(self, J: Expression) -> None:
        self._J = J
        self._root = casadi.chol(J @ J.T + 1e-8 * casadi.SX.eye(6))

    def inverse(self, V: Expression) -> Expression:
        """Return J+ V."""
        return self._J.T @ self._solved(V)

    def null(self, tau: Expression) -> Expression:
        """Return N tau."""
        return tau - self._J.T @ self._solved(self._J @ tau)

    def _solved(self, b: Expression) -> Expression:
        return casadi.solve(self._root, casadi.solve(self._root.T, b))


def _pose_error(R: Expression, p: Expression, R_r: Expression, p_r: Expression) -> Expression:
    turns = [casadi.cross(R[:, k], R_r[:, k]) for k in range(3)]
    return casadi.vertcat((turns[0] + turns[1] + turns[2]) / 2, p_r - p)


def _linear(value: Expression) -> Expression:
    return casadi.vertcat(casadi.SX.zeros(3), value)


@dataclass(frozen=True)
class _JointReference:
    """The reference in joint space: q_r, v_r, a_r, and what the law remembers as its ``reference``."""

    q: Expression
    v: Expression
    a: Expression
    following: Expression


def _joint_reference(now: Instant) -> _JointReference:
    # Cartesian motions become joint motions by closed-loop inverse kinematics, from where the reference is. Without the
    # pull to the home pose, an arm with a joint to spare ends each circle in another posture, in the end at its stops.
    model, r, p, last = now.model, now.reference, now.parameters, now.state["reference"]
    start, tip = model.tip(r.q), model.tip(last)
    least = _Projection(tip.J)
    error = _pose_error(tip.R, tip.p, start.R, start.p + r.dp)
    pull = r.ease * p["posture_rate"] * (p["home"] - last)
    v_c = least.inverse(_linear(r.dv) + p["tracking_rate"] * error) + least.null(pull)
    a_c = least.inverse(_linear(r.da) - model.tip_bias(last, v_c))
    return _JointReference(
        q=casadi.if_else(r.in_joints, r.q, last),
        v=casadi.if_else(r.in_joints, r.v, v_c),
        a=casadi.if_else(r.in_joints, r.a, a_c),
        following=casadi.if_else(r.in_joints, r.q, last + now.period * v_c),
    )


def _joint_impedance(now: Instant) -> tuple[Expression, dict[str, Expression]]:
    p, r = now.parameters, _joint_reference(now)
    tau = p["stiffness"] * (r.q - now.q) + p["damping"] * (r.v - now.v) + now.model.inverse_dynamics(now.q, now.v, r.a)
    return tau, {"reference": r.following}


def _inverse_dynamics(now: Instant) -> tuple[Expression, dict[str, Expression]]:
    p, r = now.parameters, _joint_reference(now)
    a = r.a + p["position_gain"] * (r.q - now.q) + p["velocity_gain"] * (r.v - now.v)
    return now.model.inverse_dynamics(now.q, now.v, a), {"reference": r.following}


def _cartesian(now: Instant) -> tuple[FrameMotion, _Projection, Expression, Expression, Expression, Expression]:
    """Return the tip, its projection and bias, and e, V_r - J v and A_r for the reference."""
    model, q, v, r = now.model, now.q, now.v, now.reference
    tip, goal = model.tip(q), model.tip(r.q)
    error = _pose_error(tip.R, tip.p, goal.R, goal.p + r.dp)
    V_r = goal.J @ r.v + _linear(r.dv)
    A_r = goal.J @ r.a + model.tip_bias(r.q, r.v) + _linear(r.da)
    return tip, _Projection(tip.J), model.tip_bias(q, v), error, V_r - tip.J @ v, A_r


def _posture(now: Instant) -> Expression:
    r, p = now.reference, now.parameters
    return p["posture_stiffness"] * (r.q - now.q) + p["posture_damping"] * (r.v - now.v)


def _cartesian_impedance(now: Instant) -> tuple[Expression, dict[str, Expression]]:
    p = now.parameters
    tip, least, bias, error, speed_error, A_r = _cartesian(now)
    tau = tip.J.T @ (p["stiffness"] * error + p["damping"] * speed_error) + least.null(_posture(now))
    tau += now.model.inverse_dynamics(now.q, now.v, least.inverse(A_r - bias))
    return tau, {"reference": now.reference.q}


def _admittance(now: Instant) -> tuple[Expression, dict[str, Expression]]:
    # The implicit midpoint rule, entry by entry: exact in statics, and of second order.
    r, p, wrench, h = now.reference, now.parameters, now.wrench, now.period
    x, rate = now.state["offset"], now.state["offset_rate"]
    M, D, K = p["inertia"], p["damping"], p["stiffness"]
    next_rate = ((M - h / 2 * D - h**2 / 4 * K) * rate + h * (wrench - K * x)) / (M + h / 2 * D + h**2 / 4 * K)
    next_rate = (1 - r.following) * next_rate
    next_x = (1 - r.following) * (x + h / 2 * (rate + next_rate))
    yielding = (next_rate - rate) / h

    tip, least, bias, error, speed_error, A_r = _cartesian(now)
    pull = p["tracking_stiffness"] * (error + x) + p["tracking_damping"] * (speed_error + rate)
    a = least.inverse(A_r + yielding + (1 - r.following) * pull - bias) + least.null(_posture(now))
    tau = now.model.inverse_dynamics(now.q, now.v, a) - (1 - r.following) * tip.J.T @ wrench
    return tau, {"reference": r.q, "offset": next_x, "offset_rate": next_rate}


_SIX = "N m/rad, N/m"
_JOINT_REFERENCE: Declared = {
    "tracking_rate": _gain(20.0, "1/s", 10.0),
    "posture_rate": _gain(4.0, "1/s", 10.0),
}
LAWS = {
    "joint_impedance": Law(
        {
            "stiffness": _gain((800.0, 800.0, 600.0, 600.0, 300.0, 150.0, 100.0), "N m/rad", 10.0),
            "damping": _gain((60.0, 60.0, 40.0, 40.0, 20.0, 8.0, 6.0), "N m s/rad", 3.0),
            **_JOINT_REFERENCE,
        },
        _joint_impedance,
    ),
    "cartesian_impedance": Law(
        {
            "stiffness": _gain((100.0, 100.0, 100.0, 1500.0, 1500.0, 1500.0), _SIX, 10.0),
            "damping": _gain((8.0, 8.0, 8.0, 150.0, 150.0, 150.0), "N m s/rad, N s/m", 3.0),
            **_NULL_SPACE,
        },
        _cartesian_impedance,
    ),
    "admittance": Law(
        {
            "inertia": _gain((0.5, 0.5, 0.5, 8.0, 8.0, 8.0), "kg m^2, kg", 10.0, least=0.1),
            "damping": _gain((15.0, 15.0, 15.0, 160.0, 160.0, 160.0), "N m s/rad, N s/m", 20.0),
            "stiffness": _gain((50.0, 50.0, 50.0, 500.0, 500.0, 500.0), _SIX, 20.0),
            "tracking_stiffness": _gain(900.0, "1/s^2", 10.0),
            "tracking_damping": _gain(60.0, "1/s", 5.0),
            **_NULL_SPACE,
        },
        _admittance,
        {"offset": ((0.0,) * 6, "rad, m"), "offset_rate": ((0.0,) * 6, "rad/s, m/s")},
    ),
    "inverse_dynamics": Law(
        {
            "position_gain": _gain(900.0, "1/s^2", 10.0),
            "velocity_gain": _gain(60.0, "1/s", 5.0),
            **_JOINT_REFERENCE,
        },
        _inverse_dynamics,
    ),
}
