"""Detection of stale sensor signals, compiled: the newest value of each signal, and the check of its age in every cycle."""

from cpython.mem cimport PyMem_Calloc
from libc.math cimport INFINITY, NAN

cimport numpy as cnp

cnp.import_array()


cdef void* zeros(Py_ssize_t count, size_t size) except NULL:
    cdef void* memory = PyMem_Calloc(max(count, 1), size)
    if memory is NULL:
        raise MemoryError
    return memory


cdef class ReceivedSignal:
    """The newest value of one received signal, which the bridge updates in place, and counts of its messages.

    Attributes:
        value: The newest accepted value: an array of the signal's size, or an abstract value; None before the first.
        arrived: Arrival time on the clock of `time.monotonic`, in seconds; -inf before the first.
        sent: The sender's own time stamp, in seconds; NaN if the message has none.
        count: Number of accepted values.
        rejected: Number of rejected messages by reason: ``fingerprint``, ``truncated``, ``trailing``, ``size``, ``not
            finite``, ``limits``, ``out of order``, ``ahead of time``, ...
        bounds: The `Bounds` that the bridge checks every value against before it accepts it; None if it checks none.
    """

    def __init__(self, value=None, *, arrived=-INFINITY, sent=NAN, count=0, bounds=None):
        self.value = value
        self.arrived = arrived
        self.sent = sent
        self.count = count
        self.rejected = {}
        self.bounds = bounds

    def __repr__(self):
        return (
            f"ReceivedSignal(value={self.value!r}, arrived={self.arrived}, sent={self.sent}, count={self.count}, "
            f"rejected={self.rejected})"
        )

    def age(self, double now):
        """Return the time since arrival in seconds; infinite before the first value."""
        return now - self.arrived

    def reject(self, reason):
        """Count a message that was not accepted."""
        self.rejected[reason] = self.rejected.get(reason, 0) + 1

    cpdef accept(self, value, double arrived, double sent):
        """Record a new value with its arrival time and the sender's time stamp, in seconds."""
        self.value = value
        self.arrived = arrived
        self.sent = sent
        self.count += 1


cdef class StalenessMonitor:
    """Checks a sensor signal's age in every cycle, and each of its values once.

    A subclass defines ``stale(now, received)``, which returns the fault of a stale signal, and ``examine(now,
    received)``, which returns what is wrong with a new value, or None.

    Args:
        max_age: Largest age of a value, in seconds.

    Attributes:
        trusted: Values that the bridge has checked against these bounds need not be examined; None: examine all.
        value: The newest accepted sample; None before the first.
        arrived: Arrival time of that sample, in seconds; -inf before the first.
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

    cpdef check(self, double now, ReceivedSignal received):
        """Return the fault of the signal at the time ``now``, in seconds; None if it has none."""
        if received is None:
            raise TypeError("check() takes the ReceivedSignal of the signal, not None")
        if now - received.arrived > self.max_age or not received.count:
            return self.stale(now, received)
        if received.count != self.count:
            self.count = received.count
            if self.trusted is not None and self.trusted is received.bounds:
                self.fault = None
            else:
                self.fault = self.examine(now, received)
            if self.fault is None:
                self.value = received.value
                self.arrived = received.arrived
        return self.fault

    def accept(self, value, double arrived):
        """Accept a sample, even if a check has rejected it."""
        self.value = value
        self.arrived = arrived
        self.fault = None


def check_all(double now, dict monitors, received):
    """Return all faults that `StalenessMonitor.check` finds in received signals at the time ``now``.

    Args:
        now: Present time, in seconds.
        monitors: The monitor of each signal, by name.
        received: The received signals to check, by name.
    """
    faults = []
    for name, signal in received.items():
        fault = (<StalenessMonitor?>monitors[name]).check(now, signal)
        if fault is not None:
            faults.append(fault)
    return faults
