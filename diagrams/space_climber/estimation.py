"""The perceived environment of the robot: its pose, estimated from its own sensors."""

from __future__ import annotations

from math import asin, atan2, copysign, cos, exp, hypot, pi, sin

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from vtbdrake.state import discrete_state, parameter
from vtbdrake.state.declarations import NO_DICT
from vtbdrake_diagrams.space_climber.kinematics import LegKinematics
from vtbdrake_diagrams.space_climber.morphology import LEGS, Morphology


def wrap(angle: float) -> float:
    """Return ``angle`` wrapped to [-pi, pi)."""
    return (angle + pi) % (2.0 * pi) - pi


class PerceivedEnvironment(LeafSystem):
    r"""An estimator: attitude by a complementary filter, position by leg odometry.

    .. pydrake_system::

        name: PerceivedEnvironment
        input_ports:
        - measurements
        output_ports:
        - pose

    ``measurements`` is [imu (6), joint_encoders (18), foot_contact (6)], ``pose`` is [roll, pitch, yaw, x, y, height],
    the state of the last sample.

    Attitude: R_WB = Rz(yaw) Ry(pitch) Rx(roll), pitch positive nose down. The angles integrate the gyro's w; roll and
    pitch are drawn to the direction of the specific force f with the time constant tau:

        roll_f = atan2(f_y, f_z),   pitch_f = atan2(-f_x, |(f_y, f_z)|)

    Yaw starts where its state starts (0: the robot's own x axis) and drifts with the gyro. The first f that is
    not zero sets roll and pitch.

    Position: feet that are on the ground at two successive samples stand still, so the body moves against their mean
    displacement. The height is that of the torso's centre over the ground under the feet, on average.
    """

    __slots__ = NO_DICT

    def __init__(self, *, period: float, morphology: Morphology) -> None:
        super().__init__()
        self._period = period
        self._foot_radius = morphology.foot_radius
        self._legs = LegKinematics(morphology)
        legs = len(LEGS)
        self._measurements = self.DeclareVectorInputPort("measurements", 6 + 4 * legs)
        pose = self.DeclareDiscreteState(np.array([0.0, 0.0, 0.0, 0.0, 0.0, morphology.torso_clearance]))
        self.DeclareStateOutputPort("pose", pose)
        self.DeclareDiscreteState(1 + 3 * legs)
        self.DeclareNumericParameter(BasicVector([2.0]))
        self.variables = (
            *(
                discrete_state(name, 0, start=k, unit="rad", bounds=(-pi, pi))
                for k, name in enumerate(("roll", "pitch", "yaw"))
            ),
            discrete_state("position", 0, start=3, shape=(3,), unit="m"),
            discrete_state("attitude_known", 1, start=0, bounds=(0.0, 1.0)),
            discrete_state("standing", 1, start=1, shape=(legs,), bounds=(0.0, 1.0)),
            discrete_state("feet", 1, start=1 + legs, shape=(legs, 2), unit="m"),
            parameter("time_constant", 0, unit="s", bounds=(0.0, 1e3)),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        measurements = self._measurements.Eval(context).tolist()
        imu, encoders, standing = measurements[:6], measurements[6:24], measurements[24:]
        *attitude, x, y, height = context.get_discrete_state(0).value().tolist()
        known, *memory = context.get_discrete_state(1).value().tolist()
        if any(imu[3:]):
            tau = context.get_numeric_parameter(0)[0]
            trust = 1.0 - exp(-self._period / tau) if known and tau > 0.0 else 1.0
            attitude = complementary_filter(attitude, imu, period=self._period, trust=trust)
            known = 1.0

        dx = dy = drop = 0.0
        still = down = 0
        remembered = [known, *standing]
        for k, (foot_x, foot_y, foot_z) in enumerate(self._feet_in_world(attitude, encoders)):
            remembered += (foot_x, foot_y)
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
        state.set_value(0, np.array((*attitude, x, y, height)))
        state.set_value(1, np.array(remembered))

    def _feet_in_world(self, attitude: list[float], q: list[float]) -> list[tuple[float, float, float]]:
        """Return p_BF_W of the six feet."""
        roll, pitch, yaw = attitude
        sr, cr, sp, cp, sy, cy = sin(roll), cos(roll), sin(pitch), cos(pitch), sin(yaw), cos(yaw)
        feet = []
        for x, y, z in self._legs.feet(q):
            y, z = cr * y - sr * z, sr * y + cr * z
            x, z = cp * x + sp * z, cp * z - sp * x
            feet.append((cy * x - sy * y, sy * x + cy * y, z))
        return feet


def complementary_filter(attitude: list[float], imu: list[float], *, period: float, trust: float) -> list[float]:
    """Return (roll, pitch, yaw) after one period; ``trust`` in [0, 1] is the weight of the specific force."""
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
