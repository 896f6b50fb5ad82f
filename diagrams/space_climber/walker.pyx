"""One sample of the walking controller, compiled."""

import numpy as np

from vtbdrake_diagrams.space_climber.gait cimport Gait, fraction
from vtbdrake_diagrams.space_climber.kinematics cimport LEG_COUNT, LegKinematics
from vtbdrake_diagrams.space_climber.pose_filter cimport wrap


cdef class Walker:
    """The calculations of a `GaitGenerator`, whose docstring says what they do.

    Args:
        gait: The gait.
        legs: The kinematics of the legs.
        stance: The nominal feet p_BF, (6, 3).
        foot_radius: The radius of the feet in m.
        period: The sample period in s.
    """

    cdef Gait _gait
    cdef LegKinematics _legs
    cdef double[::1] _nominal
    cdef double _foot_radius, _sample

    def __init__(self, Gait gait, LegKinematics legs, *, stance, double foot_radius, double period):
        self._gait, self._legs = gait, legs
        self._nominal = np.array(stance)[:, :2].ravel()
        self._foot_radius, self._sample = foot_radius, period

    def step(self, const double[::1] parameters, const double[::1] inputs, double[::1] state, double[::1] q):
        """Compute the next state and joint positions in place.

        Args:
            parameters: [period, stroke, clearance, height, ramp_time, heading_gain, yaw_rate_limit, posture_gain,
                lean_limit].
            inputs: [roll, pitch, yaw, x, y, height, heading, walk].
            state: [phase, level, lean_roll, lean_pitch, x0, y0, x1, ...], the feet in the order of LEGS.
            q: The joint positions, (18,).
        """
        cdef double period = parameters[0], stroke = parameters[1], clearance = parameters[2], height = parameters[3]
        cdef double ramp_time = parameters[4], heading_gain = parameters[5], yaw_rate_limit = parameters[6]
        cdef double posture_gain = parameters[7], lean_limit = parameters[8]
        cdef double roll = inputs[0], pitch = inputs[1], yaw = inputs[2], heading = inputs[6], walk = inputs[7]
        cdef double phase = state[0], level = state[1]
        cdef double lean_roll = clamp(state[2] + posture_gain * self._sample * roll, lean_limit)
        cdef double lean_pitch = clamp(state[3] + posture_gain * self._sample * pitch, lean_limit)
        cdef double[::1] feet = state[4:]
        cdef double next_phase, turn, scale, x, y, ground, lifted
        cdef double p_BF[3 * LEG_COUNT]
        cdef Py_ssize_t k
        level += clamp(min(max(walk, 0.0), 1.0) - level, self._sample / ramp_time)
        if level > 0.0:
            next_phase = phase + self._sample / period
            turn = clamp(heading_gain * wrap(heading - yaw), yaw_rate_limit)
            scale = level * self._sample
            self._gait.advance(
                feet,
                self._nominal,
                phase,
                next_phase,
                scale * self._gait.speed(stroke, period),
                scale * turn,
                self._gait.duty * period / self._sample,
            )
            phase = fraction(next_phase)
        state[0], state[1], state[2], state[3] = phase, level, lean_roll, lean_pitch

        ground = self._foot_radius - height
        lifted = level * clearance
        for k in range(LEG_COUNT):
            x, y = feet[2 * k], feet[2 * k + 1]
            p_BF[3 * k], p_BF[3 * k + 1] = x, y
            p_BF[3 * k + 2] = ground + lifted * self._gait.height(k, phase) - lean_pitch * x + lean_roll * y
        self._legs.angles(p_BF, &q[0])


cdef double clamp(double value, double limit) noexcept:
    """Return ``value`` limited to +- ``limit``."""
    return limit if value > limit else (-limit if value < -limit else value)
