"""One sample of the pose estimator, compiled: attitude by a complementary filter, position by leg odometry."""

from libc.math cimport asin, atan2, copysign, cos, exp, fabs, fmod, hypot, pi, sin

cimport numpy as cnp

from vtbdrake.common.array_memory cimport numbers, writable
from vtbdrake_diagrams.space_climber.kinematics cimport LEG_COUNT, LegKinematics

cnp.import_array()


cdef class PoseFilter:
    """The calculations of a `PerceivedEnvironment`, whose docstring says what they do.

    Args:
        legs: The kinematics of the legs.
        foot_radius: The radius of the feet in m.
        period: The sample period in s.
    """

    cdef LegKinematics _legs
    cdef double _foot_radius, _period

    def __init__(self, LegKinematics legs, *, double foot_radius, double period):
        self._legs, self._foot_radius, self._period = legs, foot_radius, period

    def step(self, double time_constant, measurements, pose, memory):
        """Compute the next pose and memory in place.

        Args:
            time_constant: The time constant with which roll and pitch follow the specific force, in s.
            measurements: [imu (6), joint_encoders (18), foot_contact (6)].
            pose: [roll, pitch, yaw, x, y, height].
            memory: [attitude_known, standing (6), x0, y0, x1, ...], the feet of the last sample in the world.
        """
        cdef const double* imu = numbers(measurements, 6 + 3 * LEG_COUNT + LEG_COUNT)
        cdef const double* angles = imu + 6
        cdef const double* standing = angles + 3 * LEG_COUNT
        cdef double* x = writable(pose, 6)
        cdef double* attitude_known = writable(memory, 1 + 3 * LEG_COUNT)
        cdef double* stood = attitude_known + 1
        cdef double* last = stood + LEG_COUNT
        cdef double tau = time_constant, trust = 1.0
        cdef double feet[3 * LEG_COUNT]
        cdef double dx = 0.0, dy = 0.0, drop = 0.0
        cdef Py_ssize_t still = 0, down = 0, k
        if imu[3] or imu[4] or imu[5]:
            if attitude_known[0] and tau > 0.0:
                trust = 1.0 - exp(-self._period / tau)
            follow(x, imu, self._period, trust)
            attitude_known[0] = 1.0
        self._legs.feet(angles, feet)
        turn_to_world(x, feet)
        for k in range(LEG_COUNT):
            if standing[k]:
                down += 1
                drop += feet[3 * k + 2]
                if stood[k]:
                    still += 1
                    dx += last[2 * k] - feet[3 * k]
                    dy += last[2 * k + 1] - feet[3 * k + 1]
            stood[k] = standing[k]
            last[2 * k], last[2 * k + 1] = feet[3 * k], feet[3 * k + 1]
        if still:
            x[3] += dx / still
            x[4] += dy / still
        if down:
            x[5] = self._foot_radius - drop / down


def complementary_filter(attitude, imu, *, double period, double trust):
    """Return [roll, pitch, yaw] after one period.

    Args:
        attitude: [roll, pitch, yaw] in rad.
        imu: The angular velocity in rad/s, then the specific force in m/s^2, in the body's frame.
        period: The sample period in s.
        trust: The weight of the specific force, in [0, 1].
    """
    cdef double angles[3]
    cdef double values[6]
    angles, values = attitude, imu
    follow(angles, values, period, trust)
    return list(angles)


cdef void follow(double* attitude, const double* imu, double period, double trust) noexcept:
    """Compute `complementary_filter` in place."""
    cdef double roll = attitude[0], pitch = attitude[1], yaw = attitude[2]
    cdef double wx = imu[0], wy = imu[1], wz = imu[2], fx = imu[3], fy = imu[4], fz = imu[5]
    cdef double sr = sin(roll), cr = cos(roll), cp = cos(pitch), yaw_rate
    cp = cp if fabs(cp) > 0.05 else copysign(0.05, cp)  # the angles' rates are singular at +-90 deg
    yaw_rate = (sr * wy + cr * wz) / cp
    roll += period * (wx + sin(pitch) * yaw_rate)
    pitch += period * (cr * wy - sr * wz)
    yaw += period * yaw_rate
    roll += trust * wrap(atan2(fy, fz) - roll)
    pitch += trust * (atan2(-fx, hypot(fy, fz)) - pitch)
    if fabs(pitch) > pi / 2:  # over the top: the same orientation with its pitch in [-90, 90] deg
        roll, pitch, yaw = roll + pi, asin(sin(pitch)), yaw + pi
    attitude[0], attitude[1], attitude[2] = wrap(roll), pitch, wrap(yaw)


cdef void turn_to_world(const double* attitude, double* feet) noexcept:
    """Turn the feet from p_BF to p_BF_W."""
    cdef double sr = sin(attitude[0]), cr = cos(attitude[0]), sp = sin(attitude[1]), cp = cos(attitude[1])
    cdef double sy = sin(attitude[2]), cy = cos(attitude[2]), x, y, z
    cdef Py_ssize_t k
    for k in range(LEG_COUNT):
        x, y, z = feet[0], feet[1], feet[2]
        y, z = cr * y - sr * z, sr * y + cr * z
        x, z = cp * x + sp * z, cp * z - sp * x
        feet[0], feet[1], feet[2] = cy * x - sy * y, sy * x + cy * y, z
        feet += 3


cpdef double wrap(double angle) noexcept:
    """Return ``angle`` wrapped to [-pi, pi)."""
    cdef double turned = fmod(angle + pi, 2.0 * pi)
    return (turned + 2.0 * pi if turned < 0.0 else turned) - pi
