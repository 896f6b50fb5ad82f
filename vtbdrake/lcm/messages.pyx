"""Compiled decoder and encoder of LCM messages whose signals are numbers."""

from cpython.bytes cimport PyBytes_AS_STRING, PyBytes_FromStringAndSize, PyBytes_GET_SIZE
from cpython.mem cimport PyMem_Calloc, PyMem_Free
from libc.math cimport NAN, isfinite, rint
from libc.stdint cimport int8_t, int16_t, int32_t, int64_t, uint16_t, uint32_t, uint64_t
from libc.string cimport memcmp

import numpy as np

cimport numpy as cnp

from vtbdrake.common.array_memory cimport entries_of
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

cdef dict _WIDTHS = {"d": 8, "q": 8, "f": 4, "i": 4, "h": 2, "b": 1, "?": 1, "s": 1, "{": 1}  # bytes, by type


class MalformedError(ValueError):
    """A message that does not have the type of its channel; ``reason`` is one that `ReceivedSignal.rejected` counts."""

    def __init__(self, reason):
        super().__init__(reason)
        self.reason = reason


cdef struct Dimension:
    int64_t size  # if it is fixed
    Py_ssize_t field  # that holds the size; -1 if it is fixed


cdef struct Field:
    char code  # type as in `struct`; "s" for a string, "{" for a message
    Py_ssize_t width  # of a number, in bytes
    Py_ssize_t dimension, dimension_end  # its dimensions among the layout's dimensions
    Py_ssize_t end  # behind its members, which follow it
    # In the message that was located last:
    Py_ssize_t offset  # of the first number
    Py_ssize_t count  # of numbers


cdef void* zeros(Py_ssize_t count, size_t size) except NULL:
    cdef void* memory = PyMem_Calloc(max(count, 1), size)
    if memory is NULL:
        raise MemoryError
    return memory


cdef class MessageLayout:
    """The layout of a message type, which locates the numbers of each of its messages.

    Args:
        fingerprint: the first 8 bytes of every message.
        fields: the `vtbdrake.lcm.maps.Field` of every field, in the order of encoding.
        signals: the paths of the fields that make up each signal, by name.
        stamp: path of the field with the sender's time in microseconds; empty if there is none.
        scale: by signal, the factor from the numbers in the message to its values; 1 for the others.
    """

    cdef bytes fingerprint
    cdef Py_ssize_t field_count
    cdef Field* fields
    cdef Py_ssize_t dimension_count
    cdef Dimension* dimensions
    cdef Py_ssize_t stamp  # field; -1 if there is none
    cdef list names  # of the signals
    cdef Py_ssize_t* parts  # fields of all signals, one signal after the other
    cdef Py_ssize_t* part_ends  # by signal
    cdef double* factors  # by signal

    def __cinit__(self, bytes fingerprint not None, fields, signals, str stamp="", scale=None, **_):
        cdef Py_ssize_t i = 0, k = 0
        cdef list flat = []
        if len(fingerprint) != 8:
            raise ValueError(f"a fingerprint has 8 bytes, not {len(fingerprint)}")
        self.fingerprint = fingerprint
        _flatten(fields, flat, None, True)
        # Only a number that occurs exactly once in every message can belong to a signal or be a time.
        cdef dict single = {field.path: i for i, (field, _, _, is_single) in enumerate(flat) if is_single}
        self.field_count = len(flat)
        self.fields = <Field*>zeros(len(flat), sizeof(Field))
        self.dimensions = <Dimension*>zeros(sum(len(entry[0].dimensions) for entry in flat), sizeof(Dimension))
        for i, (field, end, parent, _) in enumerate(flat):
            self.fields[i].code = ord(field.code)
            self.fields[i].width = _WIDTHS[field.code]
            self.fields[i].end = end
            self.fields[i].dimension = k
            for dimension in field.dimensions:
                self.dimensions[k].field = -1
                if isinstance(dimension, str):
                    self.dimensions[k].field = _length(flat, i, dimension)
                else:
                    self.dimensions[k].size = dimension
                k += 1
            self.fields[i].dimension_end = k
        self.dimension_count = k
        self.stamp = single[stamp] if stamp else -1
        self.names = list(signals)
        paths = [path for parts in signals.values() for path in parts]
        for path in [*paths, stamp] if stamp else paths:
            field = flat[single[path]][0]
            if field.code in "s{" or (path == stamp and field.dimensions):
                raise ValueError(f"{path} does not hold numbers, or is a time of several numbers")
        self.parts = <Py_ssize_t*>zeros(len(paths), sizeof(Py_ssize_t))
        self.part_ends = <Py_ssize_t*>zeros(len(signals), sizeof(Py_ssize_t))
        self.factors = <double*>zeros(len(signals), sizeof(double))
        for i, path in enumerate(paths):
            self.parts[i] = single[path]
        k = 0
        for i, name in enumerate(signals):
            k += len(signals[name])
            self.part_ends[i] = k
            self.factors[i] = (scale or {}).get(name, 1.0)

    def __dealloc__(self):
        PyMem_Free(self.fields)
        PyMem_Free(self.dimensions)
        PyMem_Free(self.parts)
        PyMem_Free(self.part_ends)
        PyMem_Free(self.factors)

    cdef int locate(self, bytes data) except -1:
        """Find each field in a message. Every byte is checked to be there before it is read."""
        cdef Py_ssize_t size = PyBytes_GET_SIZE(data)
        if size < 8:
            raise MalformedError("truncated")
        if memcmp(PyBytes_AS_STRING(data), PyBytes_AS_STRING(self.fingerprint), 8):
            raise MalformedError("fingerprint")
        if self.walk(PyBytes_AS_STRING(data), size, 8, 0, self.field_count) != size:
            raise MalformedError("trailing")
        return 0

    cdef Py_ssize_t walk(
        self, const char* message, Py_ssize_t size, Py_ssize_t offset, Py_ssize_t begin, Py_ssize_t end
    ) except -1:
        """Find some fields, which begin at ``offset``, and return where they end."""
        cdef Py_ssize_t count, before, i = begin, k
        cdef int64_t length
        cdef Field* field
        while i < end:
            field = &self.fields[i]
            count = 1
            for k in range(field.dimension, field.dimension_end):
                length = self.dimensions[k].size
                if self.dimensions[k].field >= 0:
                    length = _integer(message, &self.fields[self.dimensions[k].field])
                if length < 0:
                    raise MalformedError("size")
                # More than the message can hold is as wrong as anything larger; so nothing overflows.
                count = size if length and count > size // length else count * <Py_ssize_t>length
            i = field.end
            if field.code == b"{":
                for k in range(count):
                    before = offset
                    offset = self.walk(message, size, offset, <Py_ssize_t>(field - self.fields) + 1, field.end)
                    if offset == before:  # Such a message is empty, and so are the others.
                        break
                continue
            if field.code == b"s":
                for k in range(count):
                    if size - offset < 4 or size - offset - 4 < <Py_ssize_t>get_uint32(message + offset):
                        raise MalformedError("truncated")
                    offset += 4 + <Py_ssize_t>get_uint32(message + offset)
                continue
            if count > (size - offset) // field.width:
                raise MalformedError("truncated")
            field.offset, field.count = offset, count
            offset += count * field.width
        return offset

    cdef Py_ssize_t count(self, Py_ssize_t signal) noexcept:
        """Return how many numbers the signal has in the located message."""
        cdef Py_ssize_t k, count = 0
        for k in range(self.part_ends[signal - 1] if signal else 0, self.part_ends[signal]):
            count += self.fields[self.parts[k]].count
        return count


cdef class MessageDecoder(MessageLayout):
    """Decodes messages whose signals are numbers; see `MessageLayout` for the arguments."""

    def decode(self, bytes data not None):
        """Decode one message.

        Returns:
            The sender's time in seconds (NaN if the message has none), and by signal its numbers, an array of as many
            doubles as the message has for it.

        Raises:
            MalformedError: ``fingerprint``: the message is of another type; ``truncated``: its end is missing;
                ``trailing``: bytes follow it; ``size``: an array has a negative length.
        """
        cdef const char* message = PyBytes_AS_STRING(data)
        cdef const char* at
        cdef double sent = NAN
        cdef double* entry
        cdef cnp.npy_intp count
        cdef Py_ssize_t signal, k, n
        cdef Field* field
        cdef dict values = {}
        self.locate(data)
        if self.stamp >= 0:
            field = &self.fields[self.stamp]
            sent = _read(message + field.offset, field.code) * 1e-6
        for signal in range(len(self.names)):
            count = self.count(signal)
            value = cnp.PyArray_SimpleNew(1, &count, cnp.NPY_DOUBLE)
            entry = <double*>cnp.PyArray_DATA(value)
            for k in range(self.part_ends[signal - 1] if signal else 0, self.part_ends[signal]):
                field = &self.fields[self.parts[k]]
                at = message + field.offset
                for n in range(field.count):
                    entry[0] = _read(at, field.code) * self.factors[signal]
                    entry += 1
                    at += field.width
            values[self.names[signal]] = value
        return sent, values


cdef class MessageEncoder(MessageLayout):
    """Encodes messages that differ from an example only in their time and in the numbers of their signals.

    Args:
        example: such a message.
        (others): as in `MessageLayout`.
    """

    cdef bytes example

    def __cinit__(self, *_, bytes example not None, **__):
        cdef Py_ssize_t i, k
        for i in range(self.dimension_count):
            for k in range(self.part_ends[len(self.names) - 1] if self.names else 0):
                if self.parts[k] == self.dimensions[i].field:
                    raise ValueError("the length of an array follows from its signal: it cannot be sent as a signal")
        # In __cinit__, as it runs once: the fields stay where they are in this example.
        self.locate(example)
        self.example = example

    def encode(self, values, int64_t utime):
        """Return the message with these vectors, by signal, and this time in microseconds.

        Integers are rounded, half to even.

        Raises:
            ValueError: a vector does not have as many entries as in the example.
            OverflowError: a number does not fit into its field.
        """
        cdef char* message
        cdef char* at
        cdef double* entry
        cdef Py_ssize_t signal, k, n
        cdef Field* field
        data = PyBytes_FromStringAndSize(PyBytes_AS_STRING(self.example), PyBytes_GET_SIZE(self.example))
        message = PyBytes_AS_STRING(data)
        if self.stamp >= 0:
            field = &self.fields[self.stamp]
            if field.code == b"q":
                put_uint64(message + field.offset, <uint64_t>utime)  # exactly: not every integer is a double
            elif not _write(message + field.offset, field.code, <double>utime):
                raise OverflowError(f"the time {utime} us does not fit into its field")
        for signal in range(len(self.names)):
            value = values[self.names[signal]]
            entry = entries_of(value, self.count(signal))
            if entry is NULL:
                value = np.array(value, dtype=float)
                entry = entries_of(value, self.count(signal))
                if entry is NULL:
                    raise ValueError(
                        f"{self.names[signal]} has {self.count(signal)} entries in this message, not shape {value.shape}"
                    )
            for k in range(self.part_ends[signal - 1] if signal else 0, self.part_ends[signal]):
                field = &self.fields[self.parts[k]]
                at = message + field.offset
                for n in range(field.count):
                    if not _write(at, field.code, entry[0] / self.factors[signal]):
                        raise OverflowError(f"{entry[0]} of {self.names[signal]} does not fit into its field")
                    entry += 1
                    at += field.width
        return data


def _flatten(fields, list flat, parent, is_single):
    """Append each field with the index behind its members, its parent, and whether it occurs once in every message."""
    for field in fields:
        index = len(flat)
        flat.append(None)
        _flatten(field.members, flat, index, is_single and not field.dimensions)
        flat[index] = (field, len(flat), parent, is_single)


def _length(list flat, index, path):
    """Return the index of the integer that holds a length of a field: it precedes the field in the same message."""
    for i, (field, _, parent, _) in enumerate(flat[:index]):
        if field.path == path and parent == flat[index][2] and field.code in "qihb" and not field.dimensions:
            return i
    raise ValueError(f"{path} is no length: it has to be one integer that comes before in the same message")


cdef inline int64_t _integer(const char* message, const Field* field) noexcept:
    cdef const char* at = message + field.offset
    if field.code == b"q":
        return <int64_t>get_uint64(at)
    return <int64_t>_read(at, field.code)


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
    """Write a number unless it does not fit; integers are rounded, half to even."""
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
        if not -9223372036854775808.0 <= number < 9223372036854775808.0:
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
