r"""The motion `led`: the tip follows a pose that a hand commands, and stays where it is while the hand lets go.

The command ``hand`` is [c; w, x, y, z; p]: c is 1 while the hand leads, the others are the quaternion and the position
of the pose X_WT that the tip is to take. The joint reference q_r follows it by closed-loop inverse kinematics, with the
Jacobian J and the pose X_r of the tip at q_r, and e = [sin(angle) axis; p - p_r]:

    V   approaches  limit(k e),  or 0 while c = 0,  with a limited acceleration
    v_r = J* V + N* s (home - q_r),  q_r' = v_r,     J* = J' (J J' + d^2)^-1,  N* = 1 - J* J

(Chiaverini, Siciliano, Egeland, "Review of the Damped Least-Squares Inverse Kinematics", 1994). J* stays finite where J
loses rank. The pull to the home pose grows with the motion of the tip, s = min(1, |w| + |v|) in rad/s and m/s, so that
an arm at rest has no motion of its own. v_r is limited to the share `SPEED_SHARE` of the joints' speeds, and to a rate
with which q_r does not leave their ranges. As q_r is a joint reference like any other, each control law follows it.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi
import numpy as np

from vtbdrake.components.casadi_system import clamp
from vtbdrake.components.casadi_system.rotations import rotation_matrix
from vtbdrake_diagrams.manipulator.arm import JOINTS
from vtbdrake_diagrams.manipulator.dynamics import ArmDynamics, Expression

REST = (0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""The command of a hand that does not lead."""

SPEED_SHARE = 0.5
"""The largest speed of a joint that is led, as a share of what the joint can do."""

_DAMPING = 1e-3  # d^2
_MARGIN = 0.05  # rad, from the ends of the joints' ranges
_RANGE_RATE = 10.0  # 1/s; the largest speed towards an end of the range by the distance from it
_FEEDFORWARD = 20.0  # rad/s^2; the largest acceleration that the laws are told

GAINS: dict[str, tuple[object, str, tuple[float, float]]] = {
    "lead_rate": (10.0, "1/s", (0.0, 50.0)),
    "lead_speed": (0.3, "m/s", (0.0, 1.0)),
    "lead_turn_rate": (1.2, "rad/s", (0.0, 3.0)),
    "lead_acceleration": (3.0, "m/s^2", (0.5, 10.0)),
    "lead_turn_acceleration": (12.0, "rad/s^2", (2.0, 40.0)),
    "lead_posture_rate": (0.5, "1/s", (0.0, 5.0)),
}
"""Value, unit and bounds of the parameters; with less acceleration, a tip that is let go would go on for long."""

TIP_POSE_UNIT = ", ".join(["1, 1, 1, m"] * 3)
"""Units of the rows of a pose [R | p]."""

STATE: dict[str, tuple[object, str]] = {
    "lead_twist": ((0.0,) * 6, "rad/s, m/s"),
    "lead_velocity": ((0.0,) * JOINTS, "rad/s"),
    "tip_pose": ((0.0,) * 12, TIP_POSE_UNIT),
}
"""Initial value and unit of what is remembered: V, v_r, and the rows of [R_r | p_r]."""


@dataclass(frozen=True)
class Lead:
    """The joint reference at one instant.

    Attributes:
        q, v, a: The reference (7).
        pose: X_r as the rows of [R | p] (12), of the instant before.
    """

    q: Expression
    v: Expression
    a: Expression
    twist: Expression
    pose: Expression


def lead(
    model: ArmDynamics,
    hand: Expression,
    engaged: Expression,
    reference: Expression,
    twist: Expression,
    velocity: Expression,
    p: dict[str, Expression],
    *,
    period: float,
) -> Lead:
    """Return the joint reference of an arm that a hand leads.

    Args:
        model: The arm.
        hand: The command, shape (8,).
        engaged: 1 if it is to be obeyed, else 0.
        reference: The joint reference of the instant before, shape (7,), in rad.
        twist: V of the instant before, shape (6,).
        velocity: v_r of the instant before, shape (7,), in rad/s.
        p: The values of `GAINS`, and ``home``.
        period: The sample period, in seconds.
    """
    tip = model.tip(reference)
    quaternion = hand[1:5]
    norm = casadi.norm_2(quaternion)
    leads = engaged * (hand[0] > 0.5) * (norm > 0.5)
    R = rotation_matrix(quaternion / casadi.fmax(norm, 0.5))
    turns = [casadi.cross(tip.R[:, k], R[:, k]) for k in range(3)]
    error = casadi.vertcat((turns[0] + turns[1] + turns[2]) / 2, hand[5:8] - tip.p)
    parts = []
    for rows, speed, acceleration in (
        (slice(0, 3), "lead_turn_rate", "lead_turn_acceleration"),
        (slice(3, 6), "lead_speed", "lead_acceleration"),
    ):
        aim = leads * _limited(p["lead_rate"] * error[rows], p[speed])
        parts.append(twist[rows] + _limited(aim - twist[rows], period * p[acceleration]))
    V = casadi.vertcat(*parts)
    root = casadi.chol(tip.J @ tip.J.T + _DAMPING * casadi.SX.eye(6))
    # One solution serves both: J* V + N* u = J* (V - J u) + u.
    moving = casadi.fmin(1, casadi.norm_2(parts[0]) + casadi.norm_2(parts[1]))
    pull = moving * p["lead_posture_rate"] * (p["home"] - reference)
    v = tip.J.T @ casadi.solve(root, casadi.solve(root.T, V - tip.J @ pull)) + pull
    limits = SPEED_SHARE * model.arm.speeds
    v /= casadi.fmax(1, casadi.mmax(casadi.fabs(v) / limits))
    lower, upper = model.arm.lower + _MARGIN, model.arm.upper - _MARGIN
    v = clamp(v, casadi.fmin(0, _RANGE_RATE * (lower - reference)), casadi.fmax(0, _RANGE_RATE * (upper - reference)))
    a = clamp((v - velocity) / period, -_FEEDFORWARD, _FEEDFORWARD)
    rows = [casadi.horzcat(tip.R[k, :], tip.p[k]) for k in range(3)]
    return Lead(reference + period * v, v, a, V, casadi.horzcat(*rows).T)


def is_at_rest(twist: Expression) -> Expression:
    """Return whether the reference stands still: without V, nothing moves it."""
    return casadi.mmax(casadi.fabs(twist)) < 1e-12


def pose_matrix(model: ArmDynamics) -> np.ndarray:
    """Return the pose of the tip at home as the rows of [R | p], shape (12,)."""
    q = casadi.SX.sym("q", JOINTS)
    tip = model.tip(q)
    rows = [casadi.horzcat(tip.R[k, :], tip.p[k]) for k in range(3)]
    home: np.ndarray = casadi.Function("pose", [q], [casadi.horzcat(*rows).T])(model.arm.home).full().ravel()
    return home


def _limited(value: Expression, most: Expression) -> Expression:
    """Return a vector in the direction of ``value`` that is no longer than ``most``."""
    length = casadi.norm_2(value)
    return value * casadi.fmin(1, most / casadi.fmax(length, 1e-12))
