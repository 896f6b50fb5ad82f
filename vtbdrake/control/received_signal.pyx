"""The newest value of a received signal, compiled: a bridge updates it, the loop reads it in every cycle."""

from libc.math cimport INFINITY, NAN


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
