"""The forces of a `SchunkWsgControl`, compiled."""

import numpy as np

cimport numpy as cnp

from vtbdrake.common.array_memory cimport numbers, writable

cnp.import_array()


def errors(motion, state, *, double time):
    result = np.empty(4)
    cdef double* e = writable(result, 4)
    calculate_errors(numbers(motion, 19), numbers(state, 4), time, e)
    return result


def actuation(motion, state, output, *, double time, tuple gains not None, tuple integrals not None):
    cdef const double* m = numbers(motion, 19)
    cdef double* force = writable(output, 2)
    cdef double kp = gains[0], ki = gains[1], kd = gains[2], most = 0.5 * m[2], mean_force, grip_force
    cdef double e[4]
    calculate_errors(m, numbers(state, 4), time, e)
    mean_force = kp * e[0] + kd * e[2] + ki * <double>integrals[0]
    grip_force = kp * e[1] + kd * e[3] + ki * <double>integrals[1]
    if -most > grip_force:
        grip_force = -most
    if most < grip_force:
        grip_force = most
    force[0] = 0.5 * mean_force + grip_force
    force[1] = 0.5 * mean_force - grip_force


cdef void calculate_errors(const double* motion, const double* state, double time, double* e) noexcept:
    # As PiecewisePolynomial does: a part lasts until the next one begins, and beyond its ends nothing moves.
    cdef double elapsed = min(max(time - motion[3], 0.0), motion[6]), begin = 0.0
    cdef const double* part = motion + 7
    if elapsed >= motion[5]:
        begin, part = motion[5], motion + 15
    elif elapsed >= motion[4]:
        begin, part = motion[4], motion + 11
    e[0] = -(0.5 * state[0] + 0.5 * state[1])
    e[1] = part[0] + (elapsed - begin) * part[2] - (state[0] - state[1])
    e[2] = -(0.5 * state[2] + 0.5 * state[3])
    e[3] = part[1] + (elapsed - begin) * part[3] - (state[2] - state[3])
