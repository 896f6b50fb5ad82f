"""What the DPS does to sensor values before it uses them, and to joint commands before they leave it, compiled."""

from libc.math cimport exp


def calibrate(
    const double[::1] parameters, const double[::1] raw, double[::1] measurements, *, Py_ssize_t filtered, double period
):
    """Compute the next measurements of a `Calibration` in place.

    Args:
        parameters: What is subtracted from every raw value, then the time constant of the low-pass in s.
        raw: The sensor values.
        measurements: The measurements.
        filtered: The number of values, from the first on, that pass the low-pass.
        period: The sample period in s.
    """
    cdef Py_ssize_t size = raw.shape[0], k
    cdef double tau = parameters[size], decay = exp(-period / tau) if tau > 0.0 else 0.0, value
    for k in range(size):
        value = raw[k] - parameters[k]
        if k < filtered and decay > 0.0:
            value += decay * (measurements[k] - value)
        measurements[k] = value


def limit(const double[::1] parameters, const double[::1] target, double[::1] command, *, double period):
    """Compute the next command of a `CommandLimiter` in place.

    Args:
        parameters: The lower limits, the upper limits, and the rate limit in rad/s.
        target: The joint positions asked for, in rad.
        command: The command.
        period: The sample period in s.
    """
    cdef Py_ssize_t size = target.shape[0], k
    cdef double reach = parameters[2 * size] * period, step, value, lower, upper
    for k in range(size):
        lower, upper = parameters[k], parameters[size + k]
        step = target[k] - command[k]
        step = reach if step > reach else (-reach if step < -reach else step)
        value = command[k] + step
        value = lower if value < lower else value
        command[k] = upper if value > upper else value
