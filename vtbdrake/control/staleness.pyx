"""Detection of stale sensor signals, compiled: the check of the age of each signal in every cycle."""

from libc.math cimport INFINITY
from libc.stdint cimport int64_t

from vtbdrake.control.received_signal cimport ReceivedSignal


# Of `ReceivedSignal.refusals`: more are a fault. That is more than ten refused values in a row, or one of three for a
# while.
cdef int MOST_REFUSALS = 30


cdef class StalenessMonitor:
    """Checks a sensor signal's age in every cycle, and each of its values once.

    A subclass defines ``stale(now, received)``, which returns the fault of a stale signal, ``refusing(now, received)``,
    which returns the fault of a signal that the bridge refuses again and again, and ``examine(now, received)``, which
    returns the fault of a new value, or None.

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

    cpdef fault_at(self, double now, ReceivedSignal received):
        """Return the fault of the signal at the time ``now``, in seconds; None if it has none."""
        if received is None:
            raise TypeError("fault_at() takes the ReceivedSignal of the signal, not None")
        if now - received.arrived > self.max_age or not received.count:
            return self.stale(now, received)
        if received.refusals > MOST_REFUSALS:
            return self.refusing(now, received)
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


def faults_at(double now, dict monitors, received):
    """Return all faults that `StalenessMonitor.fault_at` finds in received signals at the time ``now``.

    Args:
        now: Present time, in seconds.
        monitors: The monitor of each signal, by name.
        received: The received signals to check, by name.
    """
    faults = []
    for name, signal in received.items():
        fault = (<StalenessMonitor?>monitors[name]).fault_at(now, signal)
        if fault is not None:
            faults.append(fault)
    return faults
