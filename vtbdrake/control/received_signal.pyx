"""The newest value of a received signal, compiled: a bridge updates it, the loop reads it in every cycle."""

from libc.math cimport INFINITY, NAN

# What is wrong with a message by its time alone; its values are not examined.
_ORDER = frozenset(("duplicate", "out of order", "ahead of time"))
# By how much `refusals` rises with a refused value, while it falls by one with an accepted one; and its largest value.
cdef int RISE = 3, LARGEST = 33


cdef class ReceivedSignal:
    """The newest value of one received signal, which the bridge updates in place, and counts of its messages.

    Attributes:
        value: The newest accepted value: an array of the signal's size, or an abstract value; None before the first.
        arrived: Arrival time on the clock of `time.monotonic`, in seconds; -inf before the first.
        sent: The sender's own time stamp, in seconds; NaN if the message has none.
        count: Number of accepted values.
        rejected: Number of rejected messages by reason: ``fingerprint``, ``truncated``, ``trailing``, ``size``, ``not
            finite``, ``limits``, ``values``, ``out of order``, ``impossible time``, ...
        refused: Number of rejected messages that were not rejected by their time alone (duplicates, for example).
        refusals: Measure of how often such messages came last: 3 more for each, 1 less for each accepted value, from 0
            to 33.
        refused_reason: The reason of the newest of them; empty before the first.
        refused_value: Its value, if its limits refused it; else None.
        bounds: The `Bounds` that the bridge checks every value against before it accepts it; None if it checks none.
    """

    def __init__(self, value=None, *, arrived=-INFINITY, sent=NAN, count=0, bounds=None):
        self.value = value
        self.arrived = arrived
        self.sent = sent
        self.count = count
        self.rejected = {}
        self.refused = self.refusals = 0
        self.refused_reason = ""
        self.refused_value = None
        self.bounds = bounds

    def __repr__(self):
        return (
            f"ReceivedSignal(value={self.value!r}, arrived={self.arrived}, sent={self.sent}, count={self.count}, "
            f"rejected={self.rejected})"
        )

    def age(self, double now):
        """Return the time since arrival in seconds; infinite before the first value."""
        return now - self.arrived

    def reject(self, reason, value=None):
        """Count a message that was not accepted, whose value is outside of its limits if it is given."""
        self.rejected[reason] = self.rejected.get(reason, 0) + 1
        if reason not in _ORDER:
            self.refused += 1
            self.refusals = min(self.refusals + RISE, LARGEST)
            self.refused_reason, self.refused_value = reason, value

    cpdef accept(self, value, double arrived, double sent):
        """Record a new value with its arrival time and the sender's time stamp, in seconds."""
        self.value = value
        self.arrived = arrived
        self.sent = sent
        self.count += 1
        if self.refusals:
            self.refusals -= 1
