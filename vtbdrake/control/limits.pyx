"""Limits of signals, compiled: bounds of values, jumps of sensor signals, and the limiter of actuator commands."""

from collections import namedtuple

import numpy as np

from libc.math cimport INFINITY, NAN, fabs, floor, isfinite, sqrt
from libc.stdint cimport int64_t

cimport numpy as cnp

from vtbdrake.common.array_memory cimport entries_of
from vtbdrake.control.fault import FaultKind

cnp.import_array()

cdef double LARGEST = np.finfo(float).max
# Stands for "no limit" of a range. Its square is still finite, so that no arithmetic of limits overflows.
cdef double FAR = 1e150
# Relative to a command: a smaller difference comes from rounding and does not count as limiting.
cdef double ROUNDING = 1e-12
# Of a period. Times are rounded: one that is shorter by no more is a whole period. Much shorter ones do not count yet.
cdef double SAME_TIME = 1e-6, SHORTEST = 1e-3

# Limits, as indices of their counts.
cdef enum: NONE = -1, RANGE, RATE, ACCELERATION


cdef class Bounds:
    """The values that a signal can have: finite arrays of its size within its limits, or objects of its type.

    Args:
        signal: A vector or an abstract `Signal`; its ``lower`` and ``upper`` limits count, and its ``values``.
    """

    cdef Py_ssize_t size
    cdef object type
    cdef double[::1] lower, upper, values  # the last is empty if all within the limits are allowed

    def __init__(self, signal):
        self.size = -1 if signal.size is None else signal.size
        if signal.size is None:
            self.type = type(signal.abstract_value().get_value())
        else:
            # Finite bounds exclude infinite values.
            self.lower = np.maximum(signal.vector(signal.lower), -LARGEST)
            self.upper = np.minimum(signal.vector(signal.upper), LARGEST)
            self.values = np.array([] if signal.values is None else list(signal.values), dtype=float)

    def __eq__(self, other):
        return isinstance(other, Bounds) and (<Bounds>self)._key() == (<Bounds>other)._key()

    def __hash__(self):
        return hash((self.size, self.type))

    cdef tuple _key(self):
        return (self.type,) if self.size < 0 else (list(self.lower), list(self.upper), list(self.values))

    def violation(self, value):
        """Return why ``value`` is not one of this signal; empty if it is.

        The reason is ``type``, ``size``, ``not finite``, ``limits``, or ``values``: not one of an enumeration.
        """
        cdef double* entries
        cdef Py_ssize_t i, k
        cdef bint listed = True
        cdef bint inside = True
        if self.size < 0:
            return "" if isinstance(value, self.type) else "type"
        entries = entries_of(value, self.size)
        if entries is NULL:
            try:
                value = np.array(value, dtype=float)
            except (TypeError, ValueError):
                return "type"
            if value.shape != (self.size,):
                return "size"
            entries = entries_of(value, self.size)
        for i in range(self.size):
            if not isfinite(entries[i]):
                return "not finite"
            inside &= self.lower[i] <= entries[i] <= self.upper[i]
            if self.values.shape[0]:
                for k in range(self.values.shape[0]):
                    if entries[i] == self.values[k]:
                        break
                else:
                    listed = False
        if not inside:
            return "limits"
        return "" if listed else "values"


cdef class JumpBounds:
    """The largest possible change of a sensor signal since an earlier sample.

    Args:
        rate: The largest rate of change of each entry, shape (size,), per second.
        tolerance: The change of each entry that is allowed at any time, shape (size,).
    """

    cdef double[::1] rate, tolerance

    def __init__(self, rate, tolerance):
        self.rate = np.array(rate, dtype=float)
        self.tolerance = np.array(tolerance, dtype=float)
        if len(self.rate) != len(self.tolerance):
            raise ValueError(f"rate and tolerance have different sizes: {len(self.rate)} and {len(self.tolerance)}")

    def contains(self, before, value, double seconds):
        """Return whether the signal can change from ``before`` to ``value``, arrays of doubles, in this time."""
        cdef Py_ssize_t i, size = len(self.rate)
        cdef double* b = entries_of(before, size)
        cdef double* v = entries_of(value, size)
        if b is NULL or v is NULL:
            return False
        for i in range(size):
            if not fabs(v[i] - b[i]) <= self.rate[i] * seconds + self.tolerance[i]:  # also for NaN
                return False
        return True


class ActuationError(ValueError):
    """An actuator command that cannot be sent under any limits.

    Attributes:
        kind: The `FaultKind`.
    """

    def __init__(self, kind, reason):
        super().__init__(reason)
        self.kind = kind


LimitCount = namedtuple("LimitCount", ("changed", "largest"))
LimitCount.__doc__ = """The effect of a limit: the number of entries of commands that it changed, and the largest change."""


cdef class RateLimiter:
    """Keeps the commands of a vector actuator signal within its limits of range, rate and acceleration.

    A command counts for the time since the last sent one, at most for a period T, so that commands in quick succession
    move no faster. With r = min(time, T) / T, the command c, the last sent command s and the velocity v / T before it,
    what is sent, s' = s + r w, satisfies, entry by entry,

        |w| <= rate T,    |w - v| <= r a    with a = acceleration T^2,    lower <= s' <= upper,

    and stops in time: afterwards, periods whose steps shrink by a each come to rest within the range. Since w is
    followed by w - a, w - 2 a, ..., the total way is

        f(w) = r w + sum_{j >= 1} max(0, w - j a),

    and the largest w towards an end at the distance d is the solution of f(w) = d: with the largest whole number m for
    which a m (m - 1 + 2 r) / 2 <= d,

        w = (d + a m (m + 1) / 2) / (m + r),

    which is the known approach speed sqrt(2 acceleration d) in steps. For commands once per period no other limiter is
    more generous: a sequence passes unchanged if and only if it can be continued for ever within the limits. Then the
    limits never contradict each other, because the command before respected them, too. Where shorter times make them do
    so, close to an end of the range, the range holds, and v changes by up to a.

    Args:
        signal: The actuator signal with its limits.
        period: T, the time that a command counts for at most, in seconds.

    Attributes:
        needs_start: Whether there is a limit of rate or acceleration, which needs something to depart from.
        has_start: Whether there is something that the next command departs from.

    Raises:
        ValueError: The signal is abstract, the period is not positive, or the limits allow no step at all.
    """

    cdef readonly bint needs_start, has_start
    cdef bint had_start
    cdef Py_ssize_t size
    cdef double period, at, at_before  # the time of the last command; the same before it
    cdef double[::1] steps, changes, lower, upper
    cdef double[:, ::1] state, state_before  # s and v of above; the same before the last command
    cdef int64_t[3] numbers
    cdef double[3] largest

    def __init__(self, signal, *, double period):
        if signal.size is None:
            raise ValueError(f"the actuator signal {signal.name} is abstract: only vectors can be limited")
        if not (period > 0.0 and isfinite(period)):
            raise ValueError(f"commands are limited for a positive period, not {period} s")
        steps, changes = signal.vector(signal.rate) * period, signal.vector(signal.acceleration) * period**2
        if not (steps.min() > 1 / FAR and changes.min() > 1 / FAR):
            raise ValueError(
                f"signal {signal.name}: its rate {signal.rate} and acceleration {signal.acceleration} leave no step at "
                f"a period of {period} s"
            )
        self.size, self.steps, self.changes, self.period = signal.size, steps, changes, period
        self.lower = np.maximum(signal.vector(signal.lower), -FAR)
        self.upper = np.minimum(signal.vector(signal.upper), FAR)
        self.needs_start = np.isfinite(steps).any() or np.isfinite(changes).any()
        self.state, self.state_before = np.zeros((2, self.size)), np.zeros((2, self.size))

    @property
    def counts(self):
        """Return the effect of each limit by its name (``range`` includes stopping before its end), as `LimitCount`.

        An entry that is changed by several limits counts for the last of rate, acceleration and range.
        """
        return {
            "range": LimitCount(self.numbers[RANGE], self.largest[RANGE]),
            "rate": LimitCount(self.numbers[RATE], self.largest[RATE]),
            "acceleration": LimitCount(self.numbers[ACCELERATION], self.largest[ACCELERATION]),
        }

    @property
    def last_sent(self):
        """Return the last sent command, shape (size,); None if there is neither a start nor a command."""
        return np.array(self.state[0]) if self.has_start else None

    def start_from(self, value):
        """Let the next command depart from ``value`` (shape (size,)), at rest; out of range, from the range's end.

        The next command counts for a whole period.

        Raises:
            ActuationError: The value has another size or is not finite.
        """
        cdef double* entries
        cdef Py_ssize_t i
        value = self.checked(value)
        entries = entries_of(value, self.size)
        for i in range(self.size):
            self.state[0, i] = min(max(entries[i], self.lower[i]), self.upper[i])
            self.state[1, i] = 0.0
        self.at = -INFINITY
        self.has_start = True

    def release(self):
        """Forget the last actuator command: from now on another controller commands."""
        self.has_start = False

    def retract(self):
        """Treat the last command as never sent. Call it at most once after each `send`."""
        self.state[...] = self.state_before
        self.at = self.at_before
        self.has_start = self.had_start

    def limit(self, command, double at=NAN):
        """Return what may be sent for ``command``, both of shape (size,); it counts as sent. See `send` for ``at``.

        Raises:
            ActuationError: The command has another size or is not finite, or a limit of rate or acceleration has no
                start.
        """
        return self.send(self.checked(command), at)

    def checked(self, command):
        """Return ``command`` as an array of finite doubles, shape (size,), without sending anything.

        Raises:
            ActuationError: The command has another size or is not finite.
        """
        cdef double* entries = entries_of(command, self.size)
        cdef Py_ssize_t i
        if entries is NULL:
            try:
                command = np.array(command, dtype=float)
            except (TypeError, ValueError) as error:
                raise ActuationError(FaultKind.SIZE, f"is not a vector of {self.size} numbers: {error}") from error
            if command.shape != (self.size,):
                raise ActuationError(FaultKind.SIZE, f"has the shape {command.shape} instead of ({self.size},)")
            entries = entries_of(command, self.size)
        for i in range(self.size):
            if not isfinite(entries[i]):
                raise ActuationError(FaultKind.NOT_FINITE, f"is not finite: {command.tolist()}")
        return command

    def send(self, command, double at=NAN):
        """Return what may be sent for a `checked` command; it counts as sent.

        Args:
            command: The command.
            at: The time of the command in seconds, on a clock of the caller; NaN: a period after the last one.

        Raises:
            ActuationError: A limit of rate or acceleration has no start.
        """
        cdef double* entries = entries_of(command, self.size)
        cdef double* sent
        cdef double s, way, r
        cdef cnp.npy_intp size = self.size
        cdef Py_ssize_t i
        if entries is NULL:
            raise TypeError(f"send() takes what checked() returns, not {command!r}")
        self.had_start = self.has_start
        if not self.has_start:
            if self.needs_start:
                raise ActuationError(FaultKind.NOT_STARTED, "has a limit of its rate or acceleration, and nothing to depart from")
            self.start_from(command)
        r = self._share(at)
        self.at_before = self.at
        if r > 0.0 or at < self.at:  # or if the clock was set back
            self.at = at
        result = cnp.PyArray_SimpleNew(1, &size, cnp.NPY_DOUBLE)
        sent = <double*>cnp.PyArray_DATA(result)
        for i in range(self.size):
            s = self.state[0, i]
            self.state_before[0, i], self.state_before[1, i] = s, self.state[1, i]
            self.state[0, i] = sent[i] = self._limited(entries[i], i, r)
            way = sent[i] - s
            if r > 0.0:
                self.state[1, i] = way / r
        return result

    cdef double _share(self, double at) noexcept:
        """Return the time since the last command as a share of the period, 0 to 1; shorter ones than 0.001 add up."""
        cdef double r = (at - self.at) / self.period
        if not r < 1.0 - SAME_TIME:  # also for NaN
            return 1.0
        return r if r > SHORTEST else 0.0

    cdef double _limited(self, double c, Py_ssize_t i, double r) noexcept:
        """Return one entry of the actuator command to send, for a time of r periods."""
        cdef double s = self.state[0, i], step = self.steps[i], change = self.changes[i]
        cdef double way = c - s, sent, amount
        cdef double before = r * self.state[1, i]
        cdef int acted = NONE
        # An infinite limit stays infinite for r = 0.
        step = step * r if isfinite(step) else step
        if fabs(way) > step:
            way, acted = step if way > 0.0 else -step, RATE
        if isfinite(change) and fabs(way - before) > change * r * r:
            way, acted = before + change * r * r if way > before else before - change * r * r, ACCELERATION
        # The range comes last: where limits contradict each other, it holds exactly.
        if way > _longest_way(self.upper[i] - s, change, r):
            way, acted = _longest_way(self.upper[i] - s, change, r), RANGE
        elif way < -_longest_way(s - self.lower[i], change, r):
            way, acted = -_longest_way(s - self.lower[i], change, r), RANGE
        # Unless a limit acted, c passes as it is, without the rounding of s + way.
        sent = min(max(s + way if acted != NONE else c, self.lower[i]), self.upper[i])
        amount = fabs(sent - c)
        if acted != NONE and amount > ROUNDING * (fabs(s) + fabs(c)):
            self.numbers[acted] += 1
            self.largest[acted] = max(self.largest[acted], amount)
        return sent


cdef double _longest_way(double d, double a, double r) noexcept:
    """Return r w for the w with f(w) = d; see `RateLimiter`."""
    if not isfinite(a) or d <= a * r:
        return d
    cdef double m = floor(0.5 * (1.0 - 2.0 * r + sqrt((1.0 - 2.0 * r) ** 2 + 8.0 * d / a)))
    return r * (d + 0.5 * a * m * (m + 1.0)) / (m + r)


class PassThrough:
    """Replaces `RateLimiter` for an abstract actuator signal: remembers the last actuator command, and limits nothing."""

    needs_start = False

    def __init__(self):
        self.counts = {}
        self.last_sent = self._sent_before = None

    @property
    def has_start(self):
        """Return whether anything was sent."""
        return self.last_sent is not None

    def start_from(self, value):
        """Set the last sent command."""
        self.last_sent = value

    def release(self):
        """Forget the last actuator command."""
        self.last_sent = None

    def retract(self):
        """Treat the last command as never sent."""
        self.last_sent = self._sent_before

    def limit(self, command, at=NAN):
        """Return ``command``; it counts as sent.

        Raises:
            ActuationError: The command is None.
        """
        return self.send(self.checked(command))

    def checked(self, command):
        """Return ``command`` without sending anything.

        Raises:
            ActuationError: The command is None.
        """
        if command is None:
            raise ActuationError(FaultKind.SIZE, "is None")
        return command

    def send(self, command, at=NAN):
        """Return ``command``; it counts as sent."""
        self._sent_before, self.last_sent = self.last_sent, command
        return command
