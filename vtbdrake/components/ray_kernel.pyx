"""Rays between moving frames, compiled.

The motion of a frame B in W is an array of 18 numbers: R_WB by rows, p_WB, w_WB and v_WB at the time 0. Both velocities
are constant: R_WB(t) = exp(t [w_WB]) R_WB and p_WB(t) = p_WB + t v_WB.
"""

from libc.math cimport cos, sin, sqrt

import numpy as np

# A division takes as long as several products.
cdef double SIXTH = 1.0 / 6.0, TWENTIETH = 1.0 / 20.0, TWENTY_FOURTH = 1.0 / 24.0, THIRTIETH = 1.0 / 30.0


def to_world(const double[:, ::1] directions_L, const double[::1] times, const double[::1] motion_WL):
    cdef Py_ssize_t n = directions_L.shape[0], i, k
    origins, directions = np.empty((n, 3)), np.empty((n, 3))
    cdef double[:, ::1] p_W = origins
    cdef double[:, ::1] d_W = directions
    cdef const double* X = &motion_WL[0]
    cdef const double* d_L
    cdef double square = length(X + 12) ** 2, a = 0.0, b = 0.0
    cdef double d[3]
    for i in range(n):
        d_L = &directions_L[i, 0]
        for k in range(3):
            p_W[i, k] = X[9 + k] + times[i] * X[15 + k]
            d[k] = X[3 * k] * d_L[0] + X[3 * k + 1] * d_L[1] + X[3 * k + 2] * d_L[2]
        coefficients(square, times[i], &a, &b)
        turn(X + 12, a, b, d)
        for k in range(3):
            d_W[i, k] = d[k]
    return origins, directions


def to_body(
    const double[:, ::1] origins_W,
    const double[:, ::1] directions_W,
    const double[::1] times,
    const double[::1] motion_WB,
    const double[::1] bounds_B,
    const double[::1] nearest,
):
    cdef Py_ssize_t n = origins_W.shape[0], m = 0, i, k
    origins, directions = np.empty((n, 3), dtype=np.float32), np.empty((n, 3), dtype=np.float32)
    limits, rays = np.empty(n, dtype=np.float32), np.empty(n, dtype=np.intp)
    cdef float[:, ::1] p_B = origins
    cdef float[:, ::1] d_B = directions
    cdef float[::1] limit = limits
    cdef Py_ssize_t[::1] ray = rays
    cdef const double* X = &motion_WB[0]
    cdef double ahead, square, distance, radius = bounds_B[3], turning = length(X + 12) ** 2, a = 0.0, b = 0.0
    cdef double center_W[3]
    cdef double p[3]
    cdef double d[3]
    for k in range(3):
        center_W[k] = X[9 + k] + X[3 * k] * bounds_B[0] + X[3 * k + 1] * bounds_B[1] + X[3 * k + 2] * bounds_B[2]
    # A sphere that is at rest and holds the moving one.
    radius += longest(times) * (length(X + 15) + length(X + 12) * length(&bounds_B[0]))
    for i in range(n):
        ahead = square = 0.0
        for k in range(3):
            distance = center_W[k] - origins_W[i, k]
            ahead += distance * directions_W[i, k]
            square += distance * distance
        # Leave out what passes the sphere, ends before it, or begins behind it.
        if square - ahead * ahead > radius * radius or ahead - radius > nearest[i] or ahead + radius < 0.0:
            continue
        for k in range(3):
            p[k] = origins_W[i, k] - X[9 + k] - times[i] * X[15 + k]
            d[k] = directions_W[i, k]
        coefficients(turning, -times[i], &a, &b)
        turn(X + 12, a, b, p)
        turn(X + 12, a, b, d)
        for k in range(3):
            p_B[m, k] = <float>(X[k] * p[0] + X[3 + k] * p[1] + X[6 + k] * p[2])
            d_B[m, k] = <float>(X[k] * d[0] + X[3 + k] * d[1] + X[6 + k] * d[2])
        if misses(&p_B[m, 0], &d_B[m, 0], &bounds_B[4]):
            continue
        limit[m] = <float>nearest[i]
        ray[m] = i
        m += 1
    return origins[:m], directions[:m], limits[:m], rays[:m]


def keep_nearest(
    const float[::1] distances,
    const float[:, ::1] normals,
    const float[:, ::1] directions,
    const Py_ssize_t[::1] rays,
    int body,
    *,
    double[::1] nearest,
    double[::1] cosines,
    int[::1] bodies,
):
    cdef Py_ssize_t k, i
    cdef double x, y, z
    for k in range(rays.shape[0]):
        i = rays[k]
        if distances[k] >= nearest[i]:
            continue
        x, y, z = normals[k, 0], normals[k, 1], normals[k, 2]
        nearest[i] = distances[k]
        cosines[i] = abs(x * directions[k, 0] + y * directions[k, 1] + z * directions[k, 2]) / sqrt(x * x + y * y + z * z)
        bodies[i] = body


cdef double longest(const double[::1] times) noexcept:
    cdef double result = 0.0
    cdef Py_ssize_t i
    for i in range(times.shape[0]):
        result = max(result, abs(times[i]))
    return result


cdef double length(const double* v) noexcept:
    return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


cdef inline bint misses(const float* p, const float* d, const double* box) noexcept:
    """Tell whether a ray passes a box, given as its lower and its upper corner."""
    cdef double begin = 0.0, end = 1e30, slope, near, far
    cdef Py_ssize_t k
    for k in range(3):
        slope = 1.0 / d[k]
        near, far = (box[k] - p[k]) * slope, (box[3 + k] - p[k]) * slope
        if slope < 0.0:
            near, far = far, near
        # False for NaN: along a side of the box, which then decides nothing.
        if near > begin:
            begin = near
        if far < end:
            end = far
    return begin > end


cdef inline void coefficients(double square, double t, double* a, double* b) noexcept:
    """Compute sin(x) t / x and (1 - cos(x)) t^2 / x^2 for x = w t, where ``square`` is w^2."""
    cdef double x = t * t * square, angle
    if x < 0.01:
        # To 1e-9, and several times faster.
        a[0] = t * (1.0 - SIXTH * x * (1.0 - TWENTIETH * x))
        b[0] = t * t * (0.5 - TWENTY_FOURTH * x * (1.0 - THIRTIETH * x))
    else:
        angle = sqrt(x)
        a[0], b[0] = t * sin(angle) / angle, t * t * (1.0 - cos(angle)) / x


cdef inline void turn(const double* w, double a, double b, double* v) noexcept:
    """Turn v by exp(t [w]), by the formula of Rodrigues."""
    cdef double x = w[1] * v[2] - w[2] * v[1], y = w[2] * v[0] - w[0] * v[2], z = w[0] * v[1] - w[1] * v[0]
    v[0] += a * x + b * (w[1] * z - w[2] * y)
    v[1] += a * y + b * (w[2] * x - w[0] * z)
    v[2] += a * z + b * (w[0] * y - w[1] * x)
