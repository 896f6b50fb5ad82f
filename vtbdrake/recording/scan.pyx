"""What there is to be done for every event of a log, compiled: to find the events, and the cycles that are whole."""

import zlib

import numpy as np

from cpython.array cimport array, extend_buffer
from cpython.buffer cimport PyBUF_READ
from cpython.bytes cimport PyBytes_FromStringAndSize
from cpython.memoryview cimport PyMemoryView_FromMemory
from libc.stdint cimport int32_t, int64_t, uint32_t, uint64_t
from libc.string cimport memcpy

from vtbdrake.lcm.byte_order cimport get_uint32, get_uint64
from vtbdrake.lcm.maps import LONGEST_CHANNEL_NAME
from vtbdrake.recording.log_format import EVENT, MAX_CHANNELS, MAX_DAMAGES, SYNC, LogError

cdef packed struct Header:  # EVENT, in the byte order of the file
    uint32_t sync
    uint64_t number
    uint64_t utime
    uint32_t name
    uint32_t length

assert sizeof(Header) == EVENT.size

cdef uint32_t _SYNC = SYNC
cdef int64_t _LONGEST_NAME = LONGEST_CHANNEL_NAME


def find_events(content not None):
    cdef const unsigned char[::1] view = content
    cdef int64_t size = view.shape[0], at = 0, begin, end, following
    cdef const unsigned char* data = &view[0] if size else NULL
    cdef const Header* header
    cdef int64_t[4] place
    cdef bint whole, good
    cdef array found
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
            # Where an event lies within another one, the length of that is wrong; else what follows is.
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
                raise LogError(f"the file has events on more than {MAX_CHANNELS} channels: that is no log")
            entry = places[channel] = array("q")
        found = entry
        place[0], place[1] = <int64_t>get_uint64(&header.number), <int64_t>get_uint64(&header.utime)
        place[2], place[3] = begin, end
        extend_buffer(found, <char*>place, 4)
        at = end
    if more:
        damages.append((latest, f"the last of {more} more"))
    return {channel: np.frombuffer(entry, np.int64).reshape(-1, 4) for channel, entry in places.items()}, damages


def whole_cycles(content not None, const int64_t[:, ::1] places, dtype not None):
    if places.shape[1] != 4:
        raise ValueError(f"a place is number, time, begin and end of an event, not {places.shape[1]} numbers")
    cdef const unsigned char[::1] view = content
    cdef const unsigned char* data = &view[0] if view.shape[0] else NULL
    cdef int64_t size = dtype.itemsize, number_at = dtype.fields["number"][1], size_at = dtype.fields["size"][1]
    cdef int64_t begin, end, length, number, newest = -1
    cdef Py_ssize_t i, n = 0
    cdef uint32_t crc
    # The size is what a header says. Only so much memory is asked for as there are bytes in the file.
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
            raise IndexError(f"bytes {begin} to {end} are not all in the {view.shape[0]} that there are")
        what = "a cycle of another length"
        if end - begin == size:
            length = <int32_t>get_uint32(data + begin + size_at)
            number = <int64_t>get_uint64(data + begin + number_at)
            crc = get_uint32(data + end - 4)
            if not size < length <= end or crc != <uint32_t>crc32(
                PyMemoryView_FromMemory(<char*>data + end - length, length - 4, PyBUF_READ)
            ):
                what = f"the checksum of cycle {number} is wrong"
            elif number <= newest:
                what = f"cycle {number} follows cycle {newest}"
            else:
                newest = number
                memcpy(&record[n, 0], data + begin, size)
                frame[n, 0], frame[n, 1] = end - length, end
                n += 1
                continue
        damages.append((begin, what))
    return records[:n].reshape(-1).view(dtype), frames[:n], damages
