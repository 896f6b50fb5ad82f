"""The compiled numerics of a control cycle: limits, ages of sensor signals, histograms."""

from cpython.mem cimport PyMem_Calloc, PyMem_Free
from libc.math cimport INFINITY, NAN, fabs, isfinite, isnan, log
from libc.stdint cimport int64_t

cimport numpy as cnp

cnp.import_array()


# -- vectors

cdef void* zeros(Py_ssize_t count, size_t size) except NULL:
    cdef void* memory = PyMem_Calloc(max(count, 1), size)
    if memory is NULL:
        raise MemoryError
    return memory


cdef double* _doubles(object numbers) except NULL:
    cdef list given = [float(number) for number in numbers]
    cdef double* copy = <double*>zeros(len(given), sizeof(double))
    cdef Py_ssize_t i
    for i in range(len(given)):
        copy[i] = given[i]
    return copy


def finite(value, Py_ssize_t size):
    """Whether ``value`` is an array of doubles of shape (size,), all finite."""
    cdef double* entries = entries_of(value, size)
    cdef Py_ssize_t i
    if entries is NULL:
        return False
    for i in range(size):
        if not isfinite(entries[i]):
            return False
    return True


cdef class Bounds:
    """Lower and upper limits of a vector, by entry."""

    def __cinit__(self, lower, upper):
        if len(lower) != len(upper):
            raise ValueError(f"a box has as many lower limits as upper ones, not {len(lower)} and {len(upper)}")
        self.size = len(lower)
        self.lower = _doubles(lower)
        self.upper = _doubles(upper)

    def __dealloc__(self):
        PyMem_Free(self.lower)
        PyMem_Free(self.upper)

    cdef bint holds(self, const double* entries) noexcept:
        cdef Py_ssize_t i
        for i in range(self.size):
            if not self.lower[i] <= entries[i] <= self.upper[i]:  # so a NaN is not within
                return False
        return True

    def contains(self, value):
        """Whether ``value`` is an array of doubles of this size, within the limits."""
        cdef double* entries = entries_of(value, self.size)
        return entries is not NULL and self.holds(entries)


cdef class RateLimiter:
    """Limits (step, change, lower, upper) of each entry of a command; see `CommandLimiter`, which names w and f."""

    cdef Py_ssize_t size
    cdef double* limits

    def __cinit__(self, limits):
        self.size = len(limits)
        self.limits = _doubles([number for step, change, lower, upper in limits for number in (step, change, lower, upper)])

    def __dealloc__(self):
        PyMem_Free(self.limits)

    def advance(self, command, sent, step):
        """A copy of ``command`` if it passes as it is, else None.

        If so, it is in ``sent`` afterwards, and the step that led there in ``step``; before, they are those of the cycle
        before. All are arrays of doubles of this size.
        """
        cdef double* c = entries_of(command, self.size)
        cdef double* s = entries_of(sent, self.size)
        cdef double* x = entries_of(step, self.size)
        cdef double* limit = self.limits
        cdef double w, reach, way
        cdef Py_ssize_t i
        if c is NULL or s is NULL or x is NULL:
            return None
        for i in range(self.size):
            w = c[i] - s[i]
            if not (fabs(w) <= limit[0] and limit[2] <= c[i] <= limit[3]):
                return None
            if limit[1] < INFINITY:
                # A parabola half a change ahead lies above f: what it lets pass may pass, and most does.
                reach = fabs(w) + 0.5 * limit[1]
                way = limit[3] - s[i] if w > 0.0 else s[i] - limit[2]
                if not (fabs(w - x[i]) <= limit[1] and reach * reach <= 2.0 * limit[1] * way):
                    return None
            limit += 4
        for i in range(self.size):
            x[i] = c[i] - s[i]
            s[i] = c[i]
        return cnp.PyArray_NewCopy(<cnp.ndarray>command, cnp.NPY_CORDER)


# -- sensor signals

cdef class ReceivedSignal:
    """What is known of one sensor signal; the bridge keeps it up to date in place.

    Attributes:
        value: the newest accepted one: an array of the signal's size, or an abstract value; None before the first.
        arrived: when it arrived, on the clock of `time.monotonic`, in seconds; -inf before the first.
        sent: the sender's own time of it, in seconds, if the message tells; NaN if not.
        count: how many were accepted.
        rejected: how many were not, by the reason: ``fingerprint``, ``truncated``, ``trailing``, ``size``, ``not
            finite``, ``limits``, ``out of order``, ``ahead of time``, ...
        range: the `ValueRange` that the bridge checks every value against before it accepts it; None if it leaves that to
            others.
    """

    def __init__(self, value=None, *, arrived=-INFINITY, sent=NAN, count=0, range=None):
        self.value = value
        self.arrived = arrived
        self.sent = sent
        self.count = count
        self.rejected = {}
        self.range = range

    def __repr__(self):
        return (
            f"ReceivedSignal(value={self.value!r}, arrived={self.arrived}, sent={self.sent}, count={self.count}, "
            f"rejected={self.rejected})"
        )

    def age(self, double now):
        """Seconds since it arrived; infinite before the first."""
        return now - self.arrived

    def reject(self, reason):
        """Counts a message that was not accepted."""
        self.rejected[reason] = self.rejected.get(reason, 0) + 1

    cpdef accept(self, value, double arrived, double sent):
        """Takes note of a value that was."""
        self.value = value
        self.arrived = arrived
        self.sent = sent
        self.count += 1


cdef class StalenessMonitor:
    """Looks at a sensor signal's age in every cycle, and has each of its values examined once; `SensorMonitor` says how.

    Args:
        max_age: in seconds.

    Attributes:
        trusted: the `ReceivedSignal.range` with which values need not be examined; None if all have to be.
        value: the newest sample that nothing was wrong with; None before the first.
        arrived: when that sample arrived, in seconds; -inf before the first.
    """

    cdef readonly double max_age
    cdef readonly object value
    cdef readonly double arrived
    cdef public object trusted
    cdef int64_t count
    cdef object fault

    def __init__(self, double max_age):
        self.max_age = max_age
        self.arrived = -INFINITY

    cpdef check(self, double now, ReceivedSignal reception):
        """What is wrong with the signal at the time ``now``, in seconds; None if nothing is."""
        if reception is None:
            raise TypeError("the age of a signal is that of its ReceivedSignal, not of None")
        if now - reception.arrived > self.max_age or not reception.count:
            return self.stale(now, reception)
        if reception.count != self.count:
            self.count = reception.count
            if self.trusted is not None and self.trusted is reception.range:
                self.fault = None
            else:
                self.fault = self.examine(now, reception)
            if self.fault is None:
                self.value = reception.value
                self.arrived = reception.arrived
        return self.fault

    def accept(self, value, double arrived):
        """Takes a sample for accepted, whatever was found wrong with it."""
        self.value = value
        self.arrived = arrived
        self.fault = None


cdef class JumpBounds:
    """How far the entries of a sensor signal may be from its last accepted sample.

    Args:
        rate: the fastest change of each entry, per second.
        tolerance: the change of each entry that is allowed at any time.
    """

    cdef Py_ssize_t size
    cdef double* rate
    cdef double* tolerance

    def __cinit__(self, rate, tolerance):
        if len(rate) != len(tolerance):
            raise ValueError(f"each entry has a rate and a tolerance, not {len(rate)} rates and {len(tolerance)} tolerances")
        self.size = len(rate)
        self.rate = _doubles(rate)
        self.tolerance = _doubles(tolerance)

    def __dealloc__(self):
        PyMem_Free(self.rate)
        PyMem_Free(self.tolerance)

    def contains(self, before, value, double seconds):
        """Whether entries can change from ``before`` to ``value`` in so many seconds; both are arrays of doubles."""
        cdef double* b = entries_of(before, self.size)
        cdef double* v = entries_of(value, self.size)
        cdef Py_ssize_t i
        if b is NULL or v is NULL:
            return False
        for i in range(self.size):
            if not fabs(v[i] - b[i]) <= self.rate[i] * seconds + self.tolerance[i]:  # so a NaN is not within
                return False
        return True


def found(double now, dict watches, receptions):
    """What `StalenessMonitor.check` finds at the time ``now``, with those of ``watches`` whose receptions are given, by name."""
    faults = []
    for name, reception in receptions.items():
        fault = (<StalenessMonitor?>watches[name]).check(now, reception)
        if fault is not None:
            faults.append(fault)
    return faults


# -- histograms

cdef class Bins:
    """Counts durations, in seconds, in bins of equal ratio.

    Args:
        lowest: bin 0 ends here, bin k > 0 at lowest exp(k / scale).
        highest: here begins the last one, which ends nowhere.
        scale: see above.
        number: of bins.

    Attributes:
        count: of durations.
        total: their sum.
        least, largest: of them; NaN if there is none.
    """

    cdef readonly int64_t count
    cdef readonly double total
    cdef double lowest, highest, scale, shift, _least, _largest
    cdef Py_ssize_t number
    cdef int64_t* bins

    def __cinit__(self, *_, **__):
        self._least, self._largest = INFINITY, -INFINITY

    def __dealloc__(self):
        PyMem_Free(self.bins)

    def __init__(self, double lowest, double highest, double scale, Py_ssize_t number):
        if self.bins is not NULL:
            raise RuntimeError("bins are divided once")
        if number < 2 or not 0.0 < lowest < highest or not 0.0 < scale < INFINITY:
            raise ValueError(f"{number} bins of the scale {scale} from {lowest} to {highest} are none")
        self.bins = <int64_t*>zeros(number, sizeof(int64_t))
        self.number = number
        self.lowest, self.highest, self.scale = lowest, highest, scale
        self.shift = 1.0 - scale * log(lowest)

    def record(self, double seconds):
        """Adds one duration.

        Raises:
            ValueError: it is NaN.
        """
        cdef Py_ssize_t index
        if self.bins is NULL:
            raise RuntimeError("bins have to be divided first")
        if isnan(seconds):
            raise ValueError("NaN is no duration")
        if seconds <= self.lowest:
            index = 0
        elif seconds >= self.highest:
            index = self.number - 1
        else:
            # Limited before it becomes an integer: it need not be one.
            index = <Py_ssize_t>min(max(log(seconds) * self.scale + self.shift, 0.0), <double>(self.number - 1))
        self.bins[index] += 1
        self.count += 1
        self.total += seconds
        if seconds > self._largest:
            self._largest = seconds
        if seconds < self._least:
            self._least = seconds

    def counts(self):
        """By bin."""
        return [self.bins[i] for i in range(self.number)]

    def add(self, counts, double total, double least, double largest):
        """Adds durations of which this is known.

        Raises:
            ValueError: there is another number of bins.
        """
        cdef Py_ssize_t i
        cdef int64_t number
        if len(counts) != self.number:
            raise ValueError(f"this histogram has {self.number} bins, not {len(counts)}")
        cdef list given = [<int64_t>count for count in counts]  # So all of them are added, or none.
        for i in range(self.number):
            number = given[i]
            self.bins[i] += number
            self.count += number
        self.total += total
        self._least = min(self._least, least)
        self._largest = max(self._largest, largest)

    @property
    def least(self):
        return self._least if self.count else NAN

    @property
    def largest(self):
        return self._largest if self.count else NAN
