"""Compiled calibration and filters of sensor values, and limits of joint commands."""

from libc.math cimport exp

cimport numpy as cnp

from vtbdrake.common.array_memory cimport numbers, writable

cnp.import_array()


def calibrate(parameters, raw, measurements, *, Py_ssize_t filtered, double period):
    """Compute the next measurements of a `Calibration` in place.

    Args:
        parameters: What is subtracted from every raw value, then the time constant of the low-pass in s.
        raw: The sensor values.
        measurements: The measurements.
        filtered: The number of values, from the first on, that pass the low-pass.
        period: The sample period in s.
    """
    cdef Py_ssize_t size = raw.size, k
    cdef const double* p = numbers(parameters, size + 1)
    cdef const double* u = numbers(raw, size)
    cdef double* y = writable(measurements, size)
    cdef double tau = p[size], decay = exp(-period / tau) if tau > 0.0 else 0.0, value
    for k in range(size):
        value = u[k] - p[k]
        if k < filtered and decay > 0.0:
            value += decay * (y[k] - value)
        y[k] = value


def limit(parameters, target, command, *, double period):
    """Compute the next command of a `CommandLimiter` in place.

    Args:
        parameters: The lower limits, the upper limits, and the rate limit in rad/s.
        target: The joint positions asked for, in rad.
        command: The command.
        period: The sample period in s.
    """
    cdef Py_ssize_t size = target.size, k
    cdef const double* p = numbers(parameters, 2 * size + 1)
    cdef const double* u = numbers(target, size)
    cdef double* q = writable(command, size)
    cdef double reach = p[2 * size] * period, step, value, lower, upper
    for k in range(size):
        lower, upper = p[k], p[size + k]
        step = u[k] - q[k]
        step = reach if step > reach else (-reach if step < -reach else step)
        value = q[k] + step
        value = lower if value < lower else value
        q[k] = upper if value > upper else value
