"""Compiled decoders and encoders of LCM messages that hold numbers only."""

from cpython.bytes cimport PyBytes_AS_STRING, PyBytes_FromStringAndSize, PyBytes_GET_SIZE
from cpython.mem cimport PyMem_Free
from libc.math cimport NAN, isfinite, rint
from libc.stdint cimport int8_t, int16_t, int32_t, int64_t, uint16_t, uint32_t, uint64_t
from libc.string cimport memcmp, memcpy

cimport numpy as cnp

from vtbdrake.control.kernels cimport Box, ReceivedSignal, entries_of, zeros
from vtbdrake.lcm.byte_order cimport (
    get_double,
    get_float,
    get_uint16,
    get_uint32,
    get_uint64,
    put_double,
    put_float,
    put_uint16,
    put_uint32,
    put_uint64,
)

cnp.import_array()


cdef struct Run:
    # Numbers of one type, one after the other.
    char code  # as `struct` calls their type
    Py_ssize_t width  # of a number, in bytes
    Py_ssize_t offset  # of the first, in the message
    Py_ssize_t count
    Py_ssize_t vector  # whose they are
    Py_ssize_t begin  # from which of its entries on


cdef Py_ssize_t _width(char code) except -1:
    if code == b"d" or code == b"q":
        return 8
    if code == b"f" or code == b"i":
        return 4
    if code == b"h":
        return 2
    if code == b"b" or code == b"?":
        return 1
    raise ValueError(f"there is no number of type {chr(code)!r} in a message")


cdef Run* _runs(object places, Py_ssize_t size) except NULL:
    """Of (vector, begin, offset, count, code), in a message of ``size`` bytes."""
    cdef list checked = []
    cdef Run run
    cdef Run* runs
    cdef Py_ssize_t i
    for vector, begin, offset, count, code in places:
        run.width = _width(ord(code))
        if not (offset >= 0 and count >= 0 and offset + count * run.width <= size):
            raise ValueError(f"{count} numbers from byte {offset} on are not in a message of {size} bytes")
        checked.append((ord(code), run.width, offset, count, vector, begin))
    runs = <Run*>zeros(len(checked), sizeof(Run))
    for i in range(len(checked)):
        run.code, run.width, run.offset, run.count, run.vector, run.begin = checked[i]
        runs[i] = run
    return runs


cdef Run* _run(object place, Py_ssize_t size) except NULL:
    """Of a single number, as of (offset, 1, code)."""
    offset, _, code = place
    return _runs([(0, 0, offset, 1, code)], size)


cdef inline double _read(const char* at, char code) noexcept:
    if code == b"d":
        return get_double(at)
    if code == b"q":
        return <double><int64_t>get_uint64(at)
    if code == b"f":
        return <double>get_float(at)
    if code == b"i":
        return <double><int32_t>get_uint32(at)
    if code == b"h":
        return <double><int16_t>get_uint16(at)
    if code == b"?":
        return <double>(at[0] != 0)
    return <double>(<const int8_t*>at)[0]


cdef inline bint _write(char* at, char code, double number) noexcept:
    """Whether it could be written: integers are rounded (half to even), and must fit."""
    if code == b"d":
        put_double(at, number)
        return True
    if code == b"f":
        if not isfinite(<float>number):
            return False
        put_float(at, <float>number)
        return True
    number = rint(number)
    if code == b"q":
        if not -9.2e18 < number < 9.2e18:
            return False
        put_uint64(at, <uint64_t><int64_t>number)
    elif code == b"i":
        if not -2147483648.0 <= number <= 2147483647.0:
            return False
        put_uint32(at, <uint32_t><int32_t>number)
    elif code == b"h":
        if not -32768.0 <= number <= 32767.0:
            return False
        put_uint16(at, <uint16_t><int16_t>number)
    elif code == b"b":
        if not -128.0 <= number <= 127.0:
            return False
        at[0] = <char><int8_t>number
    elif not isfinite(number):
        return False
    else:
        at[0] = number != 0.0
    return True


cdef class MessageDecoder:
    """Takes in those messages of a channel that are laid out like an example.

    Args:
        example: of such a message.
        fixed: offset and size of the bytes that all such messages have in common.
        places: where the vectors' entries are, in their order: (vector, its entry, offset, number of entries, type as
            `struct` calls it).
        stamp: offset, number (1) and type of the sender's time in microseconds; None if there is none.
        receptions: of the signals, which are vectors.
        sizes: theirs.
        lower, upper: limits of all entries.
    """

    cdef bytes example
    cdef Run* fixed
    cdef Py_ssize_t fixed_count
    cdef Run* runs
    cdef Py_ssize_t run_count
    cdef Run* stamp
    cdef list receptions
    cdef Py_ssize_t* sizes
    cdef double* numbers
    cdef Box box

    def __cinit__(self, bytes example, *, fixed, places, stamp, receptions, sizes, lower, upper):
        cdef Py_ssize_t i, size = len(example)
        if not (
            sum(place[3] for place in places) == sum(sizes) == len(lower) == len(upper)
            and len(sizes) == len(receptions)
            and min(sizes, default=0) >= 0
        ):
            raise ValueError("the message has other numbers than the signals")
        self.example = example
        self.fixed = _runs([(0, 0, offset, count, "b") for offset, count in fixed], size)
        self.fixed_count = len(fixed)
        self.runs = _runs(places, size)
        self.run_count = len(places)
        self.stamp = _run(stamp, size) if stamp is not None else NULL
        self.receptions = [<ReceivedSignal?>reception for reception in receptions]
        self.sizes = <Py_ssize_t*>zeros(len(sizes), sizeof(Py_ssize_t))
        for i in range(len(sizes)):
            self.sizes[i] = sizes[i]
        self.numbers = <double*>zeros(sum(sizes), sizeof(double))
        self.box = Box(lower, upper)

    def __dealloc__(self):
        PyMem_Free(self.fixed)
        PyMem_Free(self.runs)
        PyMem_Free(self.stamp)
        PyMem_Free(self.sizes)
        PyMem_Free(self.numbers)

    def take(self, bytes data not None, double last, double most, double now):
        """Tells the receptions of a message that came at the time ``now``.

        Returns:
            The sender's time in seconds, NaN if there is none. None if nothing was done: the message is laid out in
            another way, its time is not above ``last`` or above ``most``, or an entry is not within its limits.
        """
        cdef const char* message = PyBytes_AS_STRING(data)
        cdef const char* example = PyBytes_AS_STRING(self.example)
        cdef const char* at
        cdef double* number = self.numbers
        cdef double sent = NAN
        cdef Run* run
        cdef ReceivedSignal reception
        cdef cnp.npy_intp size
        cdef Py_ssize_t i, k
        if PyBytes_GET_SIZE(data) != PyBytes_GET_SIZE(self.example):
            return None
        for i in range(self.fixed_count):
            run = &self.fixed[i]
            if memcmp(message + run.offset, example + run.offset, run.count):
                return None
        if self.stamp is not NULL:
            sent = _read(message + self.stamp.offset, self.stamp.code) * 1e-6
            if not last < sent <= most:
                return None
        for i in range(self.run_count):
            run = &self.runs[i]
            at = message + run.offset
            for k in range(run.count):
                number[0] = _read(at, run.code)
                number += 1
                at += run.width
        if not self.box.holds(self.numbers):
            return None
        number = self.numbers
        for i in range(len(self.receptions)):
            reception = <ReceivedSignal>self.receptions[i]
            size = self.sizes[i]
            value = cnp.PyArray_SimpleNew(1, &size, cnp.NPY_DOUBLE)
            memcpy(cnp.PyArray_DATA(value), number, size * sizeof(double))
            number += size
            reception.accept(value, now, sent)
        return sent


cdef class MessageEncoder:
    """Writes messages that differ from an example only by the time and by entries of vectors.

    Args:
        example: of such a message.
        places, stamp: as of `MessageDecoder`.
        names: of the vectors.
        sizes: theirs.
        boxes: of those that have limits; by default of none.
    """

    cdef bytes example
    cdef Run* runs
    cdef Py_ssize_t run_count
    cdef Run* stamp
    cdef list names
    cdef list boxes
    cdef Py_ssize_t* sizes
    cdef double** vectors

    def __cinit__(self, bytes example, *, places, stamp, names, sizes, boxes=None):
        cdef Py_ssize_t i
        if not len(names) == len(sizes) == (len(names) if boxes is None else len(boxes)):
            raise ValueError(f"{len(names)} vectors have a size each, and a box each if any has one")
        self.example = example
        self.names = list(names)
        self.boxes = [None] * len(self.names) if boxes is None else list(boxes)
        self.runs = _runs(places, len(example))
        self.run_count = len(places)
        self.stamp = _run(stamp, len(example)) if stamp is not None else NULL
        self.vectors = <double**>zeros(len(self.names), sizeof(double*))
        self.sizes = <Py_ssize_t*>zeros(len(self.names), sizeof(Py_ssize_t))
        for i in range(len(self.names)):
            self.sizes[i] = sizes[i]
        for vector, begin, _, count, _ in places:
            if not 0 <= vector < len(names):
                raise ValueError(f"there is no vector {vector} among {', '.join(names)}")
            if not 0 <= begin <= begin + count <= sizes[vector]:
                raise ValueError(f"{names[vector]} has no entries {begin} to {begin + count - 1}")

    def __dealloc__(self):
        PyMem_Free(self.runs)
        PyMem_Free(self.stamp)
        PyMem_Free(self.vectors)
        PyMem_Free(self.sizes)

    def fill(self, values, int64_t utime):
        """The message with these vectors, by name, and this time in microseconds.

        Integers are rounded, half to even. None if one of ``values`` is missing, something else than an array of doubles
        of the right size, or not within its limits, or if a number does not fit its field.
        """
        cdef Box box
        cdef double* entries
        cdef char* message
        cdef char* at
        cdef Run* run
        cdef Py_ssize_t i, k
        # They live as long as this list, even if a mapping makes them when they are asked for.
        cdef list vectors = [values.get(name) for name in self.names]
        for i in range(len(vectors)):
            entries = entries_of(vectors[i], self.sizes[i])
            if entries is NULL:
                return None
            box = self.boxes[i]
            if box is not None and not (box.size == self.sizes[i] and box.holds(entries)):
                return None
            self.vectors[i] = entries
        data = PyBytes_FromStringAndSize(PyBytes_AS_STRING(self.example), PyBytes_GET_SIZE(self.example))
        message = PyBytes_AS_STRING(data)
        if self.stamp is not NULL and not _write_stamp(message + self.stamp.offset, self.stamp.code, utime):
            return None
        for i in range(self.run_count):
            run = &self.runs[i]
            at = message + run.offset
            entries = self.vectors[run.vector] + run.begin
            for k in range(run.count):
                if not _write(at, run.code, entries[k]):
                    return None
                at += run.width
        return data


cdef inline bint _write_stamp(char* at, char code, int64_t utime) noexcept:
    if code != b"q":
        return _write(at, code, <double>utime)
    put_uint64(at, <uint64_t>utime)  # exactly: not every integer is a double
    return True
