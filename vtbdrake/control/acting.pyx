"""What a machine reports as acting is compared with what was sent, compiled: for each actuator signal in every cycle."""

import numpy as np

from libc.math cimport fabs
from libc.stdint cimport int64_t

cimport numpy as cnp

from vtbdrake.control.received_signal cimport ReceivedSignal
from vtbdrake.common.array_memory cimport entries_of

cnp.import_array()

# Number of the newest commands that are remembered. A machine that acts later than the oldest of them counts as one
# that does not act on commands at all.
cdef enum: KEPT = 1024
# Of the tolerance. A machine whose report does not change at all while commands change by more does not get them.
cdef double STUCK = 0.02
# Relative difference of two reports that are the same but for rounding.
cdef double ROUNDING = 1e-9


cdef class ActingMonitor:
    """Compares the command that a machine reports as acting with the commands that were sent to it.

    A report r fits the newest n commands c if, in every entry,

        min c - tolerance <= r <= max c + tolerance,

    where n is the latency. The reports *depart* while they do not fit; while they stay exactly the same though commands
    of more than n cycles ago, and of up to 4 n, differ by more than 0.02 of the tolerance; or while n commands are sent
    without any report. In the first n commands after `begin`, none departs: the machine may act on something else
    until they arrive.

    A machine whose reports depart either acts on the commands later than declared, or it has *lost* them: it goes on
    with an old one, or does something else (it brakes). It is late as long as its reports change from one command that
    was sent to another. It is lost if they stay the same, or change to what was never sent; and remains lost until they
    change to a command again, which was on its way or has been sent meanwhile.

    Args:
        size: Number of entries of the actuator signal.
        latency: n, the number of commands within which a command acts and is reported; at least 1, at most 255.
        tolerance: The difference between a report and a command that counts as none, shape (size,).

    Attributes:
        departs: Whether the reports depart from the commands.
        is_lost: Whether the machine has lost the commands.
        is_held: Whether the newest report is the last command that acted.
        is_unreported: Whether no report has come for longer than the latency.
    """

    cdef readonly bint departs, is_lost, is_held, is_unreported
    cdef Py_ssize_t size
    cdef int64_t latency, sent_count, acted, reports, unreported, unchanged, changed_at
    cdef double[::1] tolerance, report
    cdef double[:, ::1] sent

    def __init__(self, Py_ssize_t size, *, int64_t latency, tolerance):
        if not 1 <= latency < KEPT // 4:
            raise ValueError(f"the latency of actuator commands is 1 to {KEPT // 4 - 1} cycles, not {latency}")
        self.size, self.latency = size, latency
        self.tolerance = np.array(np.broadcast_to(tolerance, size), dtype=float)
        self.report, self.sent = np.zeros(size), np.zeros((KEPT, size))
        self.begin()

    def begin(self):
        """Forget the commands: the machine gets the first ones only now, or again."""
        self.sent_count = self.unreported = self.unchanged = self.changed_at = 0
        self.acted = -1
        self.departs = self.is_lost = self.is_held = self.is_unreported = False

    def note_sent(self, command):
        """Remember a command that has left, shape (size,)."""
        cdef double* entries = entries_of(command, self.size)
        cdef Py_ssize_t i
        if entries is NULL:
            raise TypeError(f"a command that was sent is an array of {self.size} numbers, not {command!r}")
        for i in range(self.size):
            self.sent[self.sent_count % KEPT, i] = entries[i]
        self.sent_count += 1
        self.unreported += 1

    def compare(self, ReceivedSignal received not None):
        """Compare the newest report with the commands; call it once before each command. Return `departs`."""
        cdef double* entries = NULL
        cdef bint changed = False
        if received.count != self.reports:
            entries = entries_of(received.value, self.size)
        if entries is not NULL:
            changed = self._note(entries)
            self.reports, self.unreported = received.count, 0
        self.is_unreported = self.unreported >= self.latency
        if self.sent_count < self.latency:
            return False
        if entries is not NULL:
            self._judge(changed)
        self.departs = self.departs or self.is_unreported
        return self.departs

    def range_of_sent(self):
        """Return the least and the largest entries of the newest n commands, two arrays of shape (size,)."""
        cdef int64_t k, first = max(self.sent_count - self.latency, 0)
        cdef Py_ssize_t i
        low, high = np.full(self.size, np.inf), np.full(self.size, -np.inf)
        cdef double[::1] lowest = low, highest = high
        for k in range(first, self.sent_count):
            for i in range(self.size):
                lowest[i] = min(lowest[i], self.sent[k % KEPT, i])
                highest[i] = max(highest[i], self.sent[k % KEPT, i])
        return low, high

    cdef bint _note(self, double* entries) noexcept:
        """Take over a report; return whether it differs from the one before."""
        cdef Py_ssize_t i
        cdef bint changed = False
        for i in range(self.size):
            changed |= not fabs(entries[i] - self.report[i]) <= ROUNDING * (1.0 + fabs(entries[i]))
            self.report[i] = entries[i]
        self.unchanged = 0 if changed else self.unchanged + 1
        if changed:
            self.changed_at = self.sent_count
        return changed

    cdef void _judge(self, bint changed) noexcept:
        """Decide by a new report whether the machine departs from the commands, and whether it has lost them."""
        cdef int64_t newest = self._newest_like(max(self.acted + 1, self.sent_count - KEPT))
        cdef bint stays, advances = newest >= 0
        self.is_held = advances or self._is_like(self.acted)
        if advances:
            self.acted = newest
        self.departs = not (self.acted >= self.sent_count - self.latency and self.is_held) and not self._is_between()
        self.departs = self.departs or self._is_stuck()
        if self.is_lost:
            self.is_lost = not (changed and self._was_sent())
        elif self.departs:
            stays = self.unchanged >= (self.latency + 1) // 2
            self.is_lost = stays or (changed and not advances and not self._was_sent())

    cdef int64_t _newest_like(self, int64_t first) noexcept:
        """Return the number of the newest command that the report is like, from number ``first`` on; -1 if none is."""
        cdef int64_t k
        for k in range(self.sent_count - 1, first - 1, -1):
            if self._is_like(k):
                return k
        return -1

    cdef bint _was_sent(self) noexcept:
        """Return whether the report is, but for rounding, one of the commands that are remembered."""
        cdef int64_t k
        cdef Py_ssize_t i
        for k in range(self.sent_count - 1, max(0, self.sent_count - KEPT) - 1, -1):
            for i in range(self.size):
                if not fabs(self.report[i] - self.sent[k % KEPT, i]) <= ROUNDING * (1.0 + fabs(self.report[i])):
                    break
            else:
                return True
        return False

    cdef bint _is_like(self, int64_t number) noexcept:
        cdef Py_ssize_t i
        if number < 0 or number < self.sent_count - KEPT:
            return False
        for i in range(self.size):
            if not fabs(self.report[i] - self.sent[number % KEPT, i]) <= self.tolerance[i]:
                return False
        return True

    cdef bint _is_between(self) noexcept:
        """Return whether the report is in the range of the newest commands."""
        cdef int64_t k
        cdef Py_ssize_t i
        cdef double low, high, c
        for i in range(self.size):
            low = high = self.sent[(self.sent_count - 1) % KEPT, i]
            for k in range(self.sent_count - self.latency, self.sent_count - 1):
                c = self.sent[k % KEPT, i]
                low, high = min(low, c), max(high, c)
            if not low - self.tolerance[i] <= self.report[i] <= high + self.tolerance[i]:
                return False
        return True

    cdef bint _is_stuck(self) noexcept:
        """Return whether the report has stayed the same though commands that must have acted since differ."""
        cdef int64_t k, first = max(self.changed_at, self.sent_count - 4 * self.latency)
        cdef Py_ssize_t i
        cdef double low, high, c
        for i in range(self.size):
            low = high = self.sent[first % KEPT, i]
            for k in range(first + 1, self.sent_count - self.latency):
                c = self.sent[k % KEPT, i]
                low, high = min(low, c), max(high, c)
            if high - low > STUCK * self.tolerance[i]:
                return True
        return False
