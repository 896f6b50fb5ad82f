"""The perceived environment of the robot: its pose, estimated from its own sensors."""

from __future__ import annotations

from collections.abc import Mapping
from math import pi
from types import SimpleNamespace
from typing import Any

import casadi
import numpy as np
from pydrake.systems.framework import System

from vtbdrake.state import NamedVector, Quantity
from vtbdrake_diagrams.packed_system import packed_system
from vtbdrake_diagrams.space_climber.kinematics import LegKinematics
from vtbdrake_diagrams.space_climber.morphology import JOINT_NAMES, LEGS, Morphology

Expression = Any  # casadi.SX, or numbers

MEASUREMENTS = NamedVector(
    imu=Quantity(np.zeros(6), "rad/s, m/s^2"),
    joint_encoders=Quantity(np.zeros(len(JOINT_NAMES)), "rad"),
    foot_contact=Quantity(np.zeros(len(LEGS)), bounds=(0.0, 1.0)),
)
"""What the estimator reads."""


def make_perceived_environment(*, period: float, morphology: Morphology) -> System:
    r"""Return the estimator: attitude by a complementary filter, position by leg odometry.

    .. pydrake_system::

        name: env
        input_ports:
        - measurements
        output_ports:
        - pose
        - memory

    ``measurements`` is [imu (6), joint_encoders (18), foot_contact (6)], ``pose`` is [roll, pitch, yaw, x, y, height],
    the state of the last sample.

    Attitude: R_WB = Rz(yaw) Ry(pitch) Rx(roll), pitch positive nose down. Each sample turns it by the gyro's mean w
    over the period T, R_WB exp([w T]x): exact, however fast the body turns. Then roll and pitch are drawn to the
    direction of the specific force f with the time constant tau:

        roll_f = atan2(f_y, f_z),   pitch_f = atan2(-f_x, |(f_y, f_z)|)

    Yaw starts where its state starts (0: the robot's own x axis) and drifts with the gyro. The first f that is
    not zero sets roll and pitch.

    Position: feet that are on the ground at two successive samples stand still, so the body moves against their mean
    displacement. The height is the torso's centre's over the ground under the feet, on average.
    """
    legs = LegKinematics(morphology)
    count = len(LEGS)

    def step(x: SimpleNamespace, u: SimpleNamespace, p: SimpleNamespace) -> Mapping[str, Expression]:
        tau = p.time_constant
        slowly = casadi.logic_and(x.attitude_known != 0.0, tau > 0.0)
        trust = casadi.if_else(slowly, 1.0 - casadi.exp(-period / tau), 1.0)
        attitude = casadi.vertcat(x.roll, x.pitch, x.yaw)
        feels = casadi.sum1(u.imu[3:] != 0.0) > 0.0
        attitude = casadi.if_else(feels, complementary_filter(attitude, u.imu, period=period, trust=trust), attitude)
        feet = legs.feet(casadi.reshape(u.joint_encoders, 3, count).T) @ rotation(attitude).T
        stands = u.foot_contact != 0.0
        stood = casadi.logic_and(stands, x.standing != 0.0)
        still, down = casadi.sum1(stood), casadi.sum1(stands)
        moved = casadi.sum1(casadi.repmat(stood, 1, 2) * (x.feet - feet[:, :2])).T / still
        height = morphology.foot_radius - casadi.sum1(stands * feet[:, 2]) / down
        place = casadi.if_else(still > 0.0, x.position[:2] + moved, x.position[:2])
        return {
            "roll": attitude[0],
            "pitch": attitude[1],
            "yaw": attitude[2],
            "position": casadi.vertcat(place, casadi.if_else(down > 0.0, height, x.position[2])),
            "attitude_known": casadi.if_else(feels, 1.0, x.attitude_known),
            "standing": u.foot_contact,
            "feet": feet[:, :2],
        }

    angle, flag = Quantity(0.0, "rad", (-pi, pi)), (0.0, 1.0)
    pose = NamedVector(
        roll=angle, pitch=angle, yaw=angle, position=Quantity([0.0, 0.0, morphology.torso_clearance], "m")
    )
    memory = NamedVector(
        attitude_known=Quantity(0.0, bounds=flag),
        standing=Quantity(np.zeros(count), bounds=flag),
        feet=Quantity(np.zeros((count, 2)), "m"),
    )
    return packed_system(
        "env",
        step,
        state={"pose": pose, "memory": memory},
        inputs={"measurements": MEASUREMENTS},
        parameters=NamedVector(time_constant=Quantity(2.0, "s", (0.0, 1e3))),
        period=period,
    )


def complementary_filter(attitude: Expression, imu: Expression, *, period: float, trust: Expression) -> Expression:
    """Return [roll, pitch, yaw], (3, 1), after one period.

    Args:
        attitude: [roll, pitch, yaw] in rad, (3, 1).
        imu: The angular velocity in rad/s, then the specific force in m/s^2, in the body's frame, (6, 1).
        period: The sample period in s.
        trust: The weight of the specific force, in [0, 1].
    """
    R = rotation(attitude) @ turn(period * imu[:3])
    roll, pitch = casadi.atan2(R[2, 1], R[2, 2]), casadi.atan2(-R[2, 0], casadi.norm_2(R[2, 1:]))
    fx, fy, fz = (imu[k] for k in range(3, 6))
    roll = roll + trust * wrap(casadi.atan2(fy, fz) - roll)
    pitch = pitch + trust * (casadi.atan2(-fx, casadi.sqrt(fy * fy + fz * fz)) - pitch)
    return casadi.vertcat(wrap(roll), pitch, casadi.atan2(R[1, 0], R[0, 0]))


def rotation(attitude: Expression) -> Expression:
    """Return R_WB = Rz(yaw) Ry(pitch) Rx(roll), (3, 3), of [roll, pitch, yaw], (3, 1)."""
    roll, pitch, yaw = attitude[0], attitude[1], attitude[2]
    sr, cr, sp, cp = casadi.sin(roll), casadi.cos(roll), casadi.sin(pitch), casadi.cos(pitch)
    sy, cy = casadi.sin(yaw), casadi.cos(yaw)
    return casadi.vertcat(
        casadi.horzcat(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        casadi.horzcat(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        casadi.horzcat(-sp, cp * sr, cp * cr),
    )


def turn(vector: Expression) -> Expression:
    """Return the rotation matrix exp([v]x), (3, 3), of a turn about the axis v by |v|, v in rad, (3, 1)."""
    angle = casadi.norm_2(vector)
    # sin(angle / 2) / angle, by its limit where there is no turn.
    share = casadi.if_else(angle > 0.0, casadi.sin(0.5 * angle) / casadi.fmax(angle, 1e-300), 0.5)
    w, (x, y, z) = casadi.cos(0.5 * angle), (share * vector[k] for k in range(3))
    return casadi.vertcat(
        casadi.horzcat(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        casadi.horzcat(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        casadi.horzcat(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def wrap(angle: Expression) -> Expression:
    """Return ``angle`` wrapped to [-pi, pi)."""
    turned = casadi.fmod(angle + pi, 2.0 * pi)
    return casadi.if_else(turned < 0.0, turned + 2.0 * pi, turned) - pi
