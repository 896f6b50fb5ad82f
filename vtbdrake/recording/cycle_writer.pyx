"""Makes the event of a cycle, quickly: compiled."""

from cpython.bytes cimport PyBytes_FromStringAndSize
from libc.stdint cimport int64_t, uint32_t, uint64_t
from libc.string cimport memset

import numpy as np

cimport numpy as cnp

from vtbdrake.lcm.byte_order cimport put_double, put_uint32, put_uint64
from vtbdrake.control.kernels cimport entries_of
from vtbdrake.recording.log_format import COMMANDED, CYCLE, EVENT, SENT, SYNC, VECTOR

cnp.import_array()

cdef int64_t _VECTOR = VECTOR
cdef int _COMMANDED = COMMANDED
cdef int _SENT = SENT


cdef int _put_vector(char* at, object value, Py_ssize_t size) except -1:
    cdef double* entries = entries_of(value, size)
    cdef Py_ssize_t i
    if entries is NULL:
        value = np.array(value, dtype=float).reshape(-1)
        entries = entries_of(value, size)
        if entries is NULL:
            raise ValueError(f"a vector has {size} entries, not {len(value)}")
    for i in range(size):
        put_double(at + 8 * i, entries[i])
    return 0


cdef class CycleWriter:
    """The ``VTB_CYCLE`` events of one loop.

    They are all alike: each is the one before with other numbers in it.

    Args:
        layout: of the events' data, a `CycleLayout`.
        runtime: the loop.
    """

    cdef bytearray buffer
    cdef Py_ssize_t begin, source, act, frame_size
    cdef dict fed, commands, sent  # by vector signal: its index, and offset and size of its entries; by others: index
    cdef dict news, abstract, sensed
    cdef Py_ssize_t num_sense, num_act

    def __init__(self, layout, runtime):
        interface, context = runtime.target.interface, runtime.context
        channel, dtype = CYCLE.encode(), layout.dtype
        prefix = EVENT.size + len(channel)
        self.buffer = bytearray(prefix) + layout.blank().tobytes()
        EVENT.pack_into(self.buffer, 0, SYNC, 0, 0, len(channel), dtype.itemsize)
        self.buffer[EVENT.size : prefix] = channel
        at = {name: prefix + field[1] for name, field in dtype.fields.items()}
        # One after the other: the times of day, the cycle's number, the DPS's time, the clock's, and `ok`.
        assert [at[name] - at["utime"] for name in ("number", "time", "now", "ok")] == [8, 16, 24, 32]
        self.begin, self.source, self.act, self.frame_size = at["utime"], at["source"], at["act"], at["size"]
        self.num_sense, self.num_act = len(interface.sense), len(interface.act)
        self.fed = _places(interface.sense, layout.fed, at["fed"])
        self.commands = _places(interface.act, layout.commands, at["commands"])
        self.sent = _places(interface.act, layout.commands, at["sent"])
        # What lay at the real ports before the first cycle counts as new in it.
        self.news = {}
        for signal in interface.sense:
            port = runtime.target.diagram.GetInputPort(f"real.sense.{signal.name}")
            if signal.is_vector and port.HasValue(context):
                self.news[signal.name] = np.array(port.Eval(context))
        self.abstract = {
            signal.name: _Origin(runtime.bridge.channels[signal.name])
            for signal in interface.sense
            if not signal.is_vector
        }
        self.sensed = runtime.bridge.sensed

    def hear(self, channel, event):
        """Notes that a message has come on a channel, before the bridge looks at it."""
        for name, origin in self.abstract.items():
            if origin.channel == channel:
                origin.note(self.sensed[name].count)
                origin.newest = event

    def event(self, cycle, int64_t number, int64_t utime, Py_ssize_t before):
        """The event of ``cycle`` without its last four bytes, the checksum.

        Args:
            number: of the event.
            utime: in microseconds.
            before: bytes of the other events of this cycle.
        """
        cdef char* message = self.buffer
        cdef char* at = message + self.begin
        cdef Py_ssize_t size = len(self.buffer)
        cdef dict fed = cycle.fed
        verdict = cycle.verdict
        put_uint64(message + 4, <uint64_t>number)  # in the event's head, after the sync word
        put_uint64(message + 12, <uint64_t>utime)
        put_uint64(at, <uint64_t>utime)
        put_uint64(at + 8, <uint64_t><int64_t>cycle.number)
        put_double(at + 16, cycle.time)
        put_double(at + 24, cycle.now)
        at[32] = bool(verdict.ok)
        memset(message + self.source, 0, 8 * self.num_sense)
        if self.news:
            fed = {**self.news, **fed}
            self.news = {}
        for name, value in fed.items():
            self._feed(message, name, value)
        memset(message + self.act, 0, self.num_act)
        for name, value in cycle.commands.items():
            self._put(message, self.commands[name], value, _COMMANDED)
        for name, value in verdict.commands.items():
            self._put(message, self.sent[name], value, _SENT)
        put_uint32(message + self.frame_size, <uint32_t>(before + size))
        return PyBytes_FromStringAndSize(message, size - 4)

    cdef int _feed(self, char* message, str name, object value) except -1:
        cdef int64_t source
        cdef Py_ssize_t i, offset, size
        i, offset, size = self.fed[name]
        if offset:
            _put_vector(message + offset, value, size)
            put_uint64(message + self.source + 8 * i, <uint64_t>_VECTOR)
        else:
            source = self.abstract[name].accepted(self.sensed[name].count)
            put_uint64(message + self.source + 8 * i, <uint64_t>source)
        return 0

    cdef int _put(self, char* message, tuple place, object value, int bit) except -1:
        cdef Py_ssize_t i, offset, size
        i, offset, size = place
        message[self.act + i] |= bit
        if offset:
            _put_vector(message + offset, value, size)
        return 0


def _places(signals, parts, begin):
    """By signal its index, and offset and number of its entries; for an abstract one these are 0."""
    places = {}
    for i, signal in enumerate(signals):
        part = parts.get(signal.name, slice(0, 0))
        places[signal.name] = (i, begin + 8 * part.start if signal.is_vector else 0, part.stop - part.start)
    return places


class _Origin:
    """Which message the value of an abstract signal comes from: the newest one after which there was one value more.

    Attributes:
        channel: of the messages.
        newest: the event of the last one.
    """

    def __init__(self, channel):
        self.channel = channel
        self.newest = 0
        self._count = 0
        self._accepted = 0

    def note(self, count):
        """Takes note of how many values there have been, when all messages up to `newest` have been looked at."""
        if count > self._count:
            self._count, self._accepted = count, self.newest

    def accepted(self, count):
        """The event of the message with the newest value, of which there have been ``count``."""
        self.note(count)
        return self._accepted
