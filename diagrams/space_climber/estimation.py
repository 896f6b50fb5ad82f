"""The perceived environment of the robot: where it is and how it stands, by its own senses."""

from __future__ import annotations

from math import asin, atan2, copysign, cos, exp, hypot, pi, sin

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from diagrams.space_climber.kinematics import LegKinematics
from diagrams.space_climber.morphology import LEGS, Morphology
from vtbdrake.state import discrete_state, parameter


def wrap(angle: float) -> float:
    """``angle`` in [-pi, pi)."""
    return (angle + pi) % (2.0 * pi) - pi


class PerceivedEnvironment(LeafSystem):
    r"""Attitude by a complementary filter, position by counting steps.

    .. pydrake_system::

        name: PerceivedEnvironment
        input_ports:
        - imu
        - joint_encoders
        - foot_contact
        output_ports:
        - attitude
        - position

    ``attitude`` is (roll, pitch, yaw): R_WB = Rz(yaw) Ry(pitch) Rx(roll), pitch positive nose down. The angles integrate
    the gyro's w; roll and pitch are drawn to the direction of the specific force f with the time constant tau:

        roll_f = atan2(f_y, f_z),   pitch_f = atan2(-f_x, |(f_y, f_z)|)

    Yaw starts where its state starts (0: the robot's own x axis) and drifts with the gyro. The first f that is
    not zero sets roll and pitch.

    ``position`` is (x, y, height). Feet that are on the ground at two successive samples stand still, so the body moves
    against their mean displacement; the height is that of the torso's centre over the feet's mean. Both outputs are
    states of the last sample.
    """

    def __init__(self, *, period: float, morphology: Morphology) -> None:
        super().__init__()
        self._period = period
        self._foot_radius = morphology.foot_radius
        self._legs = LegKinematics(morphology)
        self._imu = self.DeclareVectorInputPort("imu", 6)
        self._encoders = self.DeclareVectorInputPort("joint_encoders", 3 * len(LEGS))
        self._contact = self.DeclareVectorInputPort("foot_contact", len(LEGS))
        self._attitude = self.DeclareDiscreteState(np.zeros(3))
        self._position = self.DeclareDiscreteState(np.array([0.0, 0.0, morphology.torso_clearance]))
        # [attitude is set, foot on the ground (6), p_BF_W horizontally (6, 2)]
        self._memory = self.DeclareDiscreteState(1 + 3 * len(LEGS))
        self.DeclareStateOutputPort("attitude", self._attitude)
        self.DeclareStateOutputPort("position", self._position)
        self._time_constant = int(self.DeclareNumericParameter(BasicVector([2.0])))
        self.variables = (
            *(
                discrete_state(name, self._attitude, start=k, unit="rad", bounds=(-pi, pi))
                for k, name in enumerate(("roll", "pitch", "yaw"))
            ),
            discrete_state("position", self._position, shape=(3,), unit="m"),
            discrete_state("attitude_known", self._memory, bounds=(0.0, 1.0)),
            discrete_state("standing", self._memory, start=1, shape=(len(LEGS),), bounds=(0.0, 1.0)),
            discrete_state("feet", self._memory, start=1 + len(LEGS), shape=(len(LEGS), 2), unit="m"),
            parameter("time_constant", self._time_constant, unit="s", bounds=(0.0, 1e3)),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        known, *memory = context.get_discrete_state(self._memory).value().tolist()
        attitude = context.get_discrete_state(self._attitude).value().tolist()
        imu = self._imu.Eval(context).tolist()
        tau = context.get_numeric_parameter(self._time_constant)[0]
        if any(imu[3:]):
            trust = 1.0 - exp(-self._period / tau) if known and tau > 0.0 else 1.0
            attitude = complementary_filter(attitude, imu, period=self._period, trust=trust)
            known = 1.0
        state.set_value(self._attitude, attitude)

        feet = self._feet_in_world(attitude, self._encoders.Eval(context).tolist())
        standing = self._contact.Eval(context).tolist()
        x, y, height = context.get_discrete_state(self._position).value().tolist()
        dx = dy = drop = 0.0
        still = down = 0
        for k, (foot_x, foot_y, foot_z) in enumerate(feet):
            if standing[k]:
                down += 1
                drop += foot_z
                if memory[k]:
                    still += 1
                    dx += memory[6 + 2 * k] - foot_x
                    dy += memory[7 + 2 * k] - foot_y
        if still:
            x, y = x + dx / still, y + dy / still
        if down:
            height = self._foot_radius - drop / down
        state.set_value(self._position, (x, y, height))
        state.set_value(self._memory, (known, *standing, *(c for foot in feet for c in foot[:2])))

    def _feet_in_world(self, attitude: list[float], q: list[float]) -> list[tuple[float, float, float]]:
        """p_BF_W of the six feet."""
        roll, pitch, yaw = attitude
        sr, cr, sp, cp, sy, cy = sin(roll), cos(roll), sin(pitch), cos(pitch), sin(yaw), cos(yaw)
        feet = []
        for x, y, z in self._legs.feet(q):
            y, z = cr * y - sr * z, sr * y + cr * z
            x, z = cp * x + sp * z, cp * z - sp * x
            feet.append((cy * x - sy * y, sy * x + cy * y, z))
        return feet


def complementary_filter(attitude: list[float], imu: list[float], *, period: float, trust: float) -> list[float]:
    """(roll, pitch, yaw) after one period; ``trust`` in [0, 1] is the weight of the specific force."""
    roll, pitch, yaw = attitude
    wx, wy, wz, fx, fy, fz = imu
    sr, cr = sin(roll), cos(roll)
    cp = cos(pitch)
    cp = cp if abs(cp) > 0.05 else copysign(0.05, cp)  # the angles' rates are singular at +-90 deg
    yaw_rate = (sr * wy + cr * wz) / cp
    roll += period * (wx + sin(pitch) * yaw_rate)
    pitch += period * (cr * wy - sr * wz)
    yaw += period * yaw_rate
    roll += trust * wrap(atan2(fy, fz) - roll)
    pitch += trust * (atan2(-fx, hypot(fy, fz)) - pitch)
    if abs(pitch) > pi / 2:  # over the top: the same orientation with its pitch in [-90, 90] deg
        roll, pitch, yaw = roll + pi, asin(sin(pitch)), yaw + pi
    return [wrap(roll), pitch, wrap(yaw)]
