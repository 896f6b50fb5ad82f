"""Compiled writing and reading of logs: the event of a cycle, and the search for events and whole cycles in a file."""

import zlib

import numpy as np

cimport numpy as cnp
from cpython.array cimport array, extend_buffer
from cpython.buffer cimport PyBUF_READ
from cpython.bytes cimport PyBytes_FromStringAndSize
from cpython.memoryview cimport PyMemoryView_FromMemory
from libc.stdint cimport int32_t, int64_t, uint32_t, uint64_t
from libc.string cimport memcpy, memset

from vtbdrake.lcm.byte_order cimport get_uint32, get_uint64, put_double, put_uint32, put_uint64
from vtbdrake.common.array_memory cimport entries_of
from vtbdrake.lcm.maps import LONGEST_CHANNEL_NAME
from vtbdrake.recording.log_format import (
    COMMANDED,
    CYCLE,
    EVENT,
    MAX_CHANNELS,
    MAX_DAMAGES,
    SENT,
    SYNC,
    VECTOR,
    LogError,
)

cnp.import_array()

cdef packed struct Header:  # EVENT, in the byte order of the file
    uint32_t sync
    uint64_t number
    uint64_t utime
    uint32_t name
    uint32_t length

assert sizeof(Header) == EVENT.size

cdef int64_t _VECTOR = VECTOR
cdef int _COMMANDED = COMMANDED
cdef int _SENT = SENT
cdef uint32_t _SYNC = SYNC
cdef int64_t _LONGEST_NAME = LONGEST_CHANNEL_NAME


# -- writing


cdef class CycleWriter:
    """Writes the ``VTB_CYCLE`` events of one loop, each over the one before.

    Args:
        layout: A `CycleLayout`, the layout of the events' data.
        runtime: The loop.
    """

    cdef bytearray buffer
    cdef Py_ssize_t begin, source, act, frame_size
    cdef dict fed, actuation, sent  # by signal: its index, and offset and number of its entries, see `_places`
    cdef dict initial, abstract, sensed
    cdef Py_ssize_t num_sense, num_act

    def __init__(self, layout, runtime):
        interface, context = runtime.target.interface, runtime.context
        channel, dtype = CYCLE.encode(), layout.dtype
        prefix = EVENT.size + len(channel)
        self.buffer = bytearray(prefix) + layout.blank().tobytes()
        EVENT.pack_into(self.buffer, 0, SYNC, 0, 0, len(channel), dtype.itemsize)
        self.buffer[EVENT.size : prefix] = channel
        at = {name: prefix + field[1] for name, field in dtype.fields.items()}
        assert [at[name] - at["utime"] for name in ("number", "time", "now", "ok")] == [8, 16, 24, 32]
        self.begin, self.source, self.act, self.frame_size = at["utime"], at["source"], at["act"], at["size"]
        self.num_sense, self.num_act = len(interface.sense), len(interface.act)
        self.fed = _places(interface.sense, layout.fed, at["fed"])
        self.actuation = _places(interface.act, layout.actuation, at["commands"])
        self.sent = _places(interface.act, layout.actuation, at["sent"])
        # Values at the real ports before the first cycle count as new in it.
        self.initial = {}
        for signal in interface.sense:
            port = runtime.target.diagram.GetInputPort(f"real.sense.{signal.name}")
            if signal.is_vector and port.HasValue(context):
                self.initial[signal.name] = np.array(port.Eval(context))
        self.abstract = {
            signal.name: _MessageOrigin(runtime.bridge.channels[signal.name])
            for signal in interface.sense
            if not signal.is_vector
        }
        self.sensed = runtime.bridge.sensed

    def note_message(self, channel, event):
        """Note the event number of a message on a channel, before the bridge decodes it."""
        for name, origin in self.abstract.items():
            if origin.channel == channel:
                origin.update(self.sensed[name].count)
                origin.newest = event

    def event(self, cycle, int64_t number, int64_t utime, Py_ssize_t before):
        """Return the event of a cycle without its last four bytes, the checksum.

        Args:
            cycle: The `Cycle`.
            number: Number of the event.
            utime: Time of day in microseconds since 1970.
            before: Bytes of the other events of this cycle.
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
        if self.initial:
            fed = {**self.initial, **fed}
            self.initial = {}
        for name, value in fed.items():
            self._put_sensed(message, name, value)
        memset(message + self.act, 0, self.num_act)
        for name, value in cycle.actuation.items():
            self._put_actuation(message, self.actuation[name], value, _COMMANDED)
        for name, value in verdict.actuation.items():
            self._put_actuation(message, self.sent[name], value, _SENT)
        put_uint32(message + self.frame_size, <uint32_t>(before + size))
        return PyBytes_FromStringAndSize(message, size - 4)

    cdef int _put_sensed(self, char* message, str name, object value) except -1:
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

    cdef int _put_actuation(self, char* message, tuple place, object value, int bit) except -1:
        cdef Py_ssize_t i, offset, size
        i, offset, size = place
        message[self.act + i] |= bit
        if offset:
            _put_vector(message + offset, value, size)
        return 0


cdef int _put_vector(char* at, object value, Py_ssize_t size) except -1:
    cdef double* entries = entries_of(value, size)
    cdef Py_ssize_t i
    if entries is NULL:
        value = np.array(value, dtype=float).reshape(-1)
        entries = entries_of(value, size)
        if entries is NULL:
            raise ValueError(f"the vector must have {size} entries, not {len(value)}")
    for i in range(size):
        put_double(at + 8 * i, entries[i])
    return 0


def _places(signals, parts, begin):
    """Return the index, offset and number of entries by signal; the last two are 0 for an abstract signal."""
    places = {}
    for i, signal in enumerate(signals):
        part = parts.get(signal.name, slice(0, 0))
        places[signal.name] = (i, begin + 8 * part.start if signal.is_vector else 0, part.stop - part.start)
    return places


class _MessageOrigin:
    """Finds the message that the newest value of an abstract signal comes from.

    It is the newest message after which the count of values had increased.
    """

    def __init__(self, channel):
        self.channel = channel
        self.newest = 0  # event of the last message
        self._count = 0
        self._accepted = 0

    def update(self, count):
        """Update with the count of values after the message `newest` has been decoded."""
        if count > self._count:
            self._count, self._accepted = count, self.newest

    def accepted(self, count):
        """Return the event of the message with the newest of ``count`` values."""
        self.update(count)
        return self._accepted


# -- reading


def find_events(content not None, keep not None, Py_ssize_t together):
    """Find the events of a file. Where there is none, the search goes on at the next sync word.

    Args:
        content: Bytes of the file, or their map.
        keep: A function of a channel (bytes) and of its next events, in the order of the file, as integers of shape
            (n, 4): number, time in microseconds, begin and end of the data.
        together: The number of events of a channel that are kept in one call; the last call has fewer.

    Returns:
        Offset and kind of all bytes that are not events.
    """
    cdef const unsigned char[::1] view = content
    cdef int64_t size = view.shape[0], at = 0, begin, end, following
    cdef const unsigned char* data = &view[0] if size else NULL
    cdef const Header* header
    cdef int64_t[4] place
    cdef bint whole, good
    cdef array places_of_channel
    cdef dict places = {}
    cdef int64_t more = 0, latest = 0
    damages, sync = [], SYNC.to_bytes(4, "big")
    while at < size:
        header = <const Header*>(data + at)
        whole = size - at >= <int64_t>sizeof(Header)
        good = whole and get_uint32(&header.sync) == _SYNC and 0 < get_uint32(&header.name) <= _LONGEST_NAME
        if good:
            begin = at + <int64_t>sizeof(Header) + get_uint32(&header.name)
            end = begin + get_uint32(&header.length)
            good = end <= size
        if not good or (end < size and (size - end < 4 or get_uint32(data + end) != _SYNC)):
            following = content.find(sync, at + 1)
            # If an event lies within this one, its length is wrong; otherwise the bytes after it are damaged.
            if not good or 0 <= following < end:
                torn = following < 0 and (not whole or get_uint32(&header.sync) == _SYNC)
                if len(damages) < MAX_DAMAGES:
                    damages.append((at, "the file ends in the middle of an event" if torn else "no event"))
                else:
                    more, latest = more + 1, at
                if following < 0:
                    break
                at = following
                continue
        channel = PyBytes_FromStringAndSize(
            <const char*>data + at + sizeof(Header), begin - at - <int64_t>sizeof(Header)
        )
        entry = places.get(channel)
        if entry is None:
            if len(places) >= MAX_CHANNELS:
                raise LogError(f"the file is not a log: it has events on more than {MAX_CHANNELS} channels")
            entry = places[channel] = array("q")
        places_of_channel = entry
        place[0], place[1] = <int64_t>get_uint64(&header.number), <int64_t>get_uint64(&header.utime)
        place[2], place[3] = begin, end
        extend_buffer(places_of_channel, <char*>place, 4)
        if len(places_of_channel) >= 4 * together:
            keep(channel, _rows(places_of_channel))
            places[channel] = array("q")
        at = end
    if more:
        damages.append((latest, f"the last of {more} more"))
    for channel, entry in places.items():
        if len(entry):
            keep(channel, _rows(entry))
    return damages


def _rows(places):
    return np.frombuffer(places, np.int64).reshape(-1, 4)


def whole_cycles(content not None, const int64_t[:, ::1] places, dtype not None):
    """Find the cycles that are whole, in order.

    Args:
        content: Bytes of the file, or their map.
        places: Events of the cycles, of shape (n, 4), as `find_events` returns them.
        dtype: NumPy type of a cycle, see `CycleLayout`.

    Returns:
        Records of that type, of shape (m,); begin and end of the bytes of each cycle in the file, of shape (m, 2); and
        offset and kind of the cycles that do not count: of another length, with a wrong checksum, or with a number that
        does not increase.

    Raises:
        IndexError: A place is outside the file.
    """
    if places.shape[1] != 4:
        raise ValueError(f"a place is number, time, begin and end of an event, not {places.shape[1]} numbers")
    cdef const unsigned char[::1] view = content
    cdef const unsigned char* data = &view[0] if view.shape[0] else NULL
    cdef int64_t size = dtype.itemsize, number_at = dtype.fields["number"][1], size_at = dtype.fields["size"][1]
    cdef int64_t begin, end, length, number, newest = -1
    cdef Py_ssize_t i, n = 0
    cdef uint32_t crc
    # The header of a log may claim any size: allocate only for events that have it.
    cdef Py_ssize_t fitting = 0
    for i in range(places.shape[0]):
        fitting += places[i, 3] - places[i, 2] == size
    records, frames = np.empty((fitting, size), np.uint8), np.empty((fitting, 2), np.int64)
    cdef unsigned char[:, ::1] record = records
    cdef int64_t[:, ::1] frame = frames
    damages, crc32 = [], zlib.crc32
    for i in range(places.shape[0]):
        begin, end = places[i, 2], places[i, 3]
        if not 0 <= begin <= end <= view.shape[0]:
            raise IndexError(f"bytes {begin} to {end} are outside the file, which has {view.shape[0]}")
        kind = "a cycle of another length"
        if end - begin == size:
            length = <int32_t>get_uint32(data + begin + size_at)
            number = <int64_t>get_uint64(data + begin + number_at)
            crc = get_uint32(data + end - 4)
            if not size < length <= end or crc != <uint32_t>crc32(
                PyMemoryView_FromMemory(<char*>data + end - length, length - 4, PyBUF_READ)
            ):
                kind = f"the checksum of cycle {number} is wrong"
            elif number <= newest:
                kind = f"cycle {number} follows cycle {newest}"
            else:
                newest = number
                memcpy(&record[n, 0], data + begin, size)
                frame[n, 0], frame[n, 1] = end - length, end
                n += 1
                continue
        damages.append((begin, kind))
    return records[:n].reshape(-1).view(dtype), frames[:n], damages
