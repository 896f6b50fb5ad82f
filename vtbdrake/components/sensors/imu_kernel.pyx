"""One sample of an `Imu`, compiled."""

from libc.math cimport atan2, cos, sin, sqrt

import numpy as np

cimport numpy as cnp

from vtbdrake.common.array_memory cimport numbers, writable

cnp.import_array()


def sample(state, *, Py_ssize_t orientation, Py_ssize_t velocity, mount, g_W, memory, double period):
    cdef const double* x = numbers(state, state.size)
    cdef const double* X_BF = numbers(mount, 6)
    cdef const double* g = numbers(g_W, 3)
    cdef double* last = writable(memory, 8)
    cdef double q_WB[4]
    cdef double q_BF[4]
    cdef double q_WF[4]
    cdef double q_mid[4]
    cdef double turn[4]
    cdef double v_WF[3]
    cdef double p_BF_W[3]
    cdef double f_W[3]
    cdef const double* w = x + velocity
    cdef double rate = 1.0 / period, sign, sine, scale
    cdef Py_ssize_t i
    reading = np.zeros(6)
    cdef double* y = writable(reading, 6)

    unit(x + orientation, q_WB)
    for i in range(3):
        v_WF[i] = w[3 + i]
    if X_BF[0] or X_BF[1] or X_BF[2]:
        rotate(q_WB, X_BF, p_BF_W)
        v_WF[0] = v_WF[0] + w[1] * p_BF_W[2] - w[2] * p_BF_W[1]
        v_WF[1] = v_WF[1] + w[2] * p_BF_W[0] - w[0] * p_BF_W[2]
        v_WF[2] = v_WF[2] + w[0] * p_BF_W[1] - w[1] * p_BF_W[0]
    quaternion(X_BF[3], X_BF[4], X_BF[5], q_BF)
    product(q_WB, q_BF, q_WF)

    if not last[0]:
        for i in range(3):
            f_W[i] = -g[i]
        rotate_back(q_WF, f_W, y + 3)
    else:
        for i in range(3):
            f_W[i] = (v_WF[i] - last[1 + i]) * rate - g[i]
        # q and -q are the same orientation.
        sign = last[4] * q_WF[0] + last[5] * q_WF[1] + last[6] * q_WF[2] + last[7] * q_WF[3]
        sign = -1.0 if sign < 0.0 else 1.0
        for i in range(4):
            q_mid[i] = sign * last[4 + i]
        conjugate(q_mid, turn)
        product(turn, q_WF, turn)
        sine = sqrt(turn[1] * turn[1] + turn[2] * turn[2] + turn[3] * turn[3])
        scale = (2.0 * atan2(sine, turn[0]) / sine if sine > 1e-12 else 2.0) * rate
        for i in range(4):
            q_mid[i] += q_WF[i]
        unit(q_mid, q_mid)
        for i in range(3):
            y[i] = scale * turn[1 + i]
        rotate_back(q_mid, f_W, y + 3)

    last[0] = 1.0
    for i in range(3):
        last[1 + i] = v_WF[i]
    for i in range(4):
        last[4 + i] = q_WF[i]
    return reading


def specific_force_at_rest(q_WF, g_W):
    f_F = -g_W
    cdef double* f = writable(f_F, 3)
    rotate_back(numbers(q_WF, 4), f, f)
    return f_F


# Quaternions are (w, x, y, z); the result may be one of the arguments.


cdef void unit(const double* q, double* result) noexcept:
    cdef double scale = 1.0 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    cdef Py_ssize_t i
    for i in range(4):
        result[i] = q[i] * scale


cdef void quaternion(double roll, double pitch, double yaw, double* q) noexcept:
    """Compute the quaternion of Rz(yaw) Ry(pitch) Rx(roll)."""
    cdef double[4] qx = [cos(roll / 2), sin(roll / 2), 0.0, 0.0]
    cdef double[4] qy = [cos(pitch / 2), 0.0, sin(pitch / 2), 0.0]
    cdef double[4] qz = [cos(yaw / 2), 0.0, 0.0, sin(yaw / 2)]
    product(qy, qx, q)
    product(qz, q, q)


cdef void conjugate(const double* q, double* result) noexcept:
    result[0], result[1], result[2], result[3] = q[0], -q[1], -q[2], -q[3]


cdef void product(const double* a, const double* b, double* result) noexcept:
    cdef double aw = a[0], ax = a[1], ay = a[2], az = a[3], bw = b[0], bx = b[1], by = b[2], bz = b[3]
    result[0] = aw * bw - ax * bx - ay * by - az * bz
    result[1] = aw * bx + ax * bw + ay * bz - az * by
    result[2] = aw * by - ax * bz + ay * bw + az * bx
    result[3] = aw * bz + ax * by - ay * bx + az * bw


cdef void rotate(const double* q, const double* v, double* result) noexcept:
    """Compute R v for the unit quaternion q of R."""
    cdef double w = q[0], x = q[1], y = q[2], z = q[3], vx = v[0], vy = v[1], vz = v[2]
    cdef double tx = 2.0 * (y * vz - z * vy), ty = 2.0 * (z * vx - x * vz), tz = 2.0 * (x * vy - y * vx)
    result[0] = vx + w * tx + y * tz - z * ty
    result[1] = vy + w * ty + z * tx - x * tz
    result[2] = vz + w * tz + x * ty - y * tx


cdef void rotate_back(const double* q, const double* v, double* result) noexcept:
    """Compute R' v for the unit quaternion q of R."""
    cdef double back[4]
    conjugate(q, back)
    rotate(back, v, result)
