"""Rotations as CasADi expressions; quaternions are (w, x, y, z)."""

from __future__ import annotations

import casadi
import numpy as np


def exponential(theta: casadi.SX) -> casadi.SX:
    """Return exp([θ]×) (3, 3) for a rotation vector (3, 1) in rad, by Rodrigues' formula."""
    angle = casadi.fmax(casadi.norm_2(theta), 1e-150)
    K = casadi.skew(theta)
    return casadi.SX.eye(3) + casadi.sin(angle) / angle * K + 2 * (casadi.sin(angle / 2) / angle) ** 2 * K @ K


def rotation_matrix(q: casadi.SX) -> casadi.SX:
    """Return R (3, 3) of a unit quaternion (4, 1)."""
    w, v = q[0], q[1:4]
    return (w**2 - casadi.dot(v, v)) * casadi.SX.eye(3) + 2 * v @ v.T + 2 * w * casadi.skew(v)


def quaternion(R: casadi.SX) -> casadi.SX:
    """Return the unit quaternion (4, 1) of R (3, 3), by way of its largest number; w is not negative."""
    trace = casadi.trace(R)
    # Rows of 4 q q', each in proportion to q.
    squares = [1 + trace, *(1 + 2 * R[k, k] - trace for k in range(3))]
    spin = casadi.vertcat(R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    rows = [casadi.vertcat(squares[0], spin)]
    for k in range(3):
        rows.append(casadi.vertcat(spin[k], *(squares[1 + k] if j == k else R[j, k] + R[k, j] for j in range(3))))
    row, largest = rows[0], squares[0]
    for other, square in zip(rows[1:], squares[1:], strict=True):
        row, largest = casadi.if_else(square > largest, other, row), casadi.fmax(largest, square)
    return casadi.if_else(row[0] < 0, -row, row) / casadi.norm_2(row)


def rotation_vector(R: casadi.SX) -> casadi.SX:
    """Return θ (3, 1) in rad with exp([θ]×) = R (3, 3) and a length of at most π."""
    q = quaternion(R)
    sine = casadi.fmax(casadi.norm_2(q[1:]), 1e-150)
    return 2 * casadi.atan2(sine, q[0]) / sine * q[1:]


def roll_pitch_yaw_angles(R: casadi.SX) -> casadi.SX:
    """Return the angles (3, 1) of R (3, 3) as Drake's RollPitchYaw does, exact also where the pitch is near π / 2."""
    w, x, y, z = casadi.vertsplit(quaternion(R))
    pitch = casadi.atan2(-R[2, 0], casadi.sqrt((R[0, 0] ** 2 + R[1, 0] ** 2 + R[2, 1] ** 2 + R[2, 2] ** 2) / 2))
    half_sum, half_difference = casadi.atan2(x + z, w - y), casadi.atan2(z - x, w + y)
    angles = casadi.vertcat(half_sum - half_difference, half_sum + half_difference)
    angles -= 2 * np.pi * casadi.sign(angles) * (casadi.fabs(angles) > np.pi)
    return casadi.vertcat(angles[0], pitch, angles[1])
