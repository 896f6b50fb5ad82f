"""One sample of the walking controller, compiled."""

import numpy as np

cimport numpy as cnp

from vtbdrake.common.array_memory cimport numbers, writable
from vtbdrake_diagrams.space_climber.gait cimport Gait, fraction
from vtbdrake_diagrams.space_climber.kinematics cimport LEG_COUNT, LegKinematics
from vtbdrake_diagrams.space_climber.pose_filter cimport wrap

cnp.import_array()


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
    cdef double _nominal[2 * LEG_COUNT]
    cdef double _foot_radius, _sample

    def __init__(self, Gait gait, LegKinematics legs, *, stance, double foot_radius, double period):
        self._gait, self._legs = gait, legs
        self._nominal = np.asarray(stance)[:, :2].ravel().tolist()
        self._foot_radius, self._sample = foot_radius, period

    def step(self, parameters, inputs, state, joint_position):
        """Compute the next state and joint positions in place.

        Args:
            parameters: [period, stroke, clearance, height, ramp_time, heading_gain, yaw_rate_limit, posture_gain,
                lean_limit].
            inputs: [roll, pitch, yaw, x, y, height, heading, walk].
            state: [phase, level, lean_roll, lean_pitch, x0, y0, x1, ...], the feet in the order of LEGS.
            joint_position: The joint positions, (18,).
        """
        cdef const double* p = numbers(parameters, 9)
        cdef const double* u = numbers(inputs, 8)
        cdef double* x = writable(state, 4 + 2 * LEG_COUNT)
        cdef double* q = writable(joint_position, 3 * LEG_COUNT)
        cdef double period = p[0], stroke = p[1], clearance = p[2], height = p[3], ramp_time = p[4]
        cdef double heading_gain = p[5], yaw_rate_limit = p[6], posture_gain = p[7], lean_limit = p[8]
        cdef double roll = u[0], pitch = u[1], yaw = u[2], heading = u[6], walk = u[7]
        cdef double phase = x[0], level = x[1]
        cdef double lean_roll = clamp(x[2] + posture_gain * self._sample * roll, lean_limit)
        cdef double lean_pitch = clamp(x[3] + posture_gain * self._sample * pitch, lean_limit)
        cdef double* feet = x + 4
        cdef double next_phase, turn, scale, foot_x, foot_y, ground, lifted
        cdef double p_BF[3 * LEG_COUNT]
        cdef Py_ssize_t k
        level += clamp(min(max(walk, 0.0), 1.0) - level, self._sample / ramp_time)
        if level > 0.0:
            next_phase = phase + self._sample / period
            turn = clamp(heading_gain * wrap(heading - yaw), yaw_rate_limit)
            scale = level * self._sample
            self._gait.move(
                feet,
                self._nominal,
                phase,
                next_phase,
                scale * self._gait.speed(stroke, period),
                scale * turn,
                self._gait.duty * period / self._sample,
            )
            phase = fraction(next_phase)
        x[0], x[1], x[2], x[3] = phase, level, lean_roll, lean_pitch

        ground = self._foot_radius - height
        lifted = level * clearance
        for k in range(LEG_COUNT):
            foot_x, foot_y = feet[2 * k], feet[2 * k + 1]
            p_BF[3 * k], p_BF[3 * k + 1] = foot_x, foot_y
            p_BF[3 * k + 2] = ground + lifted * self._gait.height(k, phase) - lean_pitch * foot_x + lean_roll * foot_y
        self._legs.angles(p_BF, q)


cdef double clamp(double value, double limit) noexcept:
    """Return ``value`` limited to +- ``limit``."""
    return limit if value > limit else (-limit if value < -limit else value)
