"""Values of splines at one instant, compiled."""

import numpy as np

cimport numpy as cnp

from vtbdrake.common.array_memory cimport numbers, writable

cnp.import_array()

# Of a piece: an instant that is this close to its end belongs to the next one, as k * period is rounded.
cdef double _ROUNDING = 1e-9


cdef struct Place:
    const double* piece  # 4 n coefficients
    double[4] powers


cdef Place place(pieces, Py_ssize_t n, double step, double t, int derivative):
    """Return the piece that holds at ``t``, and (1, s, s^2, s^3) or its derivative at the time s since its beginning."""
    cdef Py_ssize_t count = pieces.shape[0], i = max(min(<Py_ssize_t>(t / step + _ROUNDING), count - 1), 0)
    cdef double s = max(t - i * step, 0.0)
    cdef Place result
    result.piece = numbers(pieces, 4 * n * count) + 4 * n * i
    if derivative == 0:
        result.powers[:] = [1.0, s, s * s, s * s * s]
    elif derivative == 1:
        result.powers[:] = [0.0, 1.0, 2.0 * s, 3.0 * s * s]
    elif derivative == 2:
        result.powers[:] = [0.0, 0.0, 2.0, 6.0 * s]
    else:
        result.powers[:] = [0.0, 0.0, 0.0, 6.0]
    return result


cdef inline double weight(const Place* at, Py_ssize_t n, Py_ssize_t k) noexcept:
    """Return the weight of knot ``k`` of ``n``."""
    cdef const double* c = at.piece + k
    return at.powers[0] * c[0] + at.powers[1] * c[n] + at.powers[2] * c[2 * n] + at.powers[3] * c[3 * n]


def weights_at(pieces, double step, double t, int derivative):
    cdef Py_ssize_t n = pieces.shape[2], k
    cdef Place at = place(pieces, n, step, t, derivative)
    weights = np.empty(n)
    cdef double* to = writable(weights, n)
    for k in range(n):
        to[k] = weight(&at, n, k)
    return weights


def value_at(pieces, double step, double t, knots, out):
    cdef Py_ssize_t n = pieces.shape[2], m = out.size, k, j
    cdef Place at = place(pieces, n, step, t, 0)
    cdef const double* w = numbers(knots, n * m)
    cdef double* y = writable(out, m)
    cdef double b
    for j in range(m):
        y[j] = 0.0
    for k in range(n):
        b = weight(&at, n, k)
        for j in range(m):
            y[j] += b * w[k * m + j]
