"""Compiled decoder and encoder of LCM messages whose signals are numbers."""

from cpython.bytes cimport PyBytes_AS_STRING, PyBytes_FromStringAndSize, PyBytes_GET_SIZE
from cpython.mem cimport PyMem_Free
from libc.math cimport NAN, isfinite, rint
from libc.stdint cimport int8_t, int16_t, int32_t, int64_t, uint16_t, uint32_t, uint64_t
from libc.string cimport memcmp

import numpy as np

cimport numpy as cnp

from vtbdrake.control.kernels cimport entries_of, zeros
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

cdef dict _WIDTHS = {"d": 8, "q": 8, "f": 4, "i": 4, "h": 2, "b": 1, "?": 1, "s": 1}  # bytes, by type


class MalformedError(ValueError):
    """A message that does not have the type of its channel; ``reason`` is one that `ReceivedSignal.rejected` counts."""

    def __init__(self, reason):
        super().__init__(reason)
        self.reason = reason


cdef struct Dimension:
    int64_t size  # if it is fixed
    Py_ssize_t field  # that holds the size; -1 if it is fixed


cdef struct Field:
    char code  # type as in `struct`
    Py_ssize_t width  # of a number, in bytes
    Py_ssize_t dimension, dimension_end  # its dimensions among those of the layout
    # In the message that was located last:
    Py_ssize_t offset  # of the first number
    Py_ssize_t count  # of numbers


cdef class MessageLayout:
    """The layout of a message type, which locates the numbers of each of its messages.

    Args:
        fingerprint: the first 8 bytes of every message.
        fields: path, type and dimensions of every field in the order of encoding. Types as in `struct`; ``s`` is a
            string. A dimension is a number or the path of an earlier integer field.
        signals: the paths of the fields that make up each signal, by name.
        stamp: path of the field with the sender's time in microseconds; empty if there is none.
    """

    cdef bytes fingerprint
    cdef Py_ssize_t field_count
    cdef Field* fields
    cdef Dimension* dimensions
    cdef Py_ssize_t stamp  # field; -1 if there is none
    cdef list names  # of the signals
    cdef Py_ssize_t part_count
    cdef Py_ssize_t* parts  # fields of all signals, one signal after the other
    cdef Py_ssize_t* part_ends  # by signal

    def __cinit__(self, bytes fingerprint not None, fields, signals, str stamp="", **_):
        cdef Py_ssize_t i = 0, k = 0
        cdef dict index = {path: i for i, (path, _, _) in enumerate(fields)}
        if len(fingerprint) != 8 or len(index) != len(fields):
            raise ValueError("a message type has a fingerprint of 8 bytes, and fields with different paths")
        self.fingerprint = fingerprint
        self.field_count = len(fields)
        self.fields = <Field*>zeros(len(fields), sizeof(Field))
        self.dimensions = <Dimension*>zeros(sum(len(dimensions) for _, _, dimensions in fields), sizeof(Dimension))
        for i, (_, code, dimensions) in enumerate(fields):
            self.fields[i].code = ord(code)
            self.fields[i].width = _WIDTHS[code]
            self.fields[i].dimension = k
            for dimension in dimensions:
                self.dimensions[k].field = -1
                if isinstance(dimension, str):
                    length = index[dimension]
                    if not (length < i and self.fields[length].code in b"qihb" and not fields[length][2]):
                        raise ValueError(f"{dimension} is no length: it has to be one integer, and to come before")
                    self.dimensions[k].field = length
                else:
                    self.dimensions[k].size = dimension
                k += 1
            self.fields[i].dimension_end = k
        self.stamp = index[stamp] if stamp else -1
        self.names = list(signals)
        paths = [path for parts in signals.values() for path in parts]
        for path in [*paths, stamp] if stamp else paths:
            if fields[index[path]][1] == "s" or (path == stamp and fields[index[path]][2]):
                raise ValueError(f"{path} does not hold numbers, or is a time of several numbers")
        self.part_count = len(paths)
        self.parts = <Py_ssize_t*>zeros(len(paths), sizeof(Py_ssize_t))
        self.part_ends = <Py_ssize_t*>zeros(len(signals), sizeof(Py_ssize_t))
        for i, path in enumerate(paths):
            self.parts[i] = index[path]
        k = 0
        for i, name in enumerate(signals):
            k += len(signals[name])
            self.part_ends[i] = k

    def __dealloc__(self):
        PyMem_Free(self.fields)
        PyMem_Free(self.dimensions)
        PyMem_Free(self.parts)
        PyMem_Free(self.part_ends)

    cdef int locate(self, bytes data) except -1:
        """Find each field in a message. Every byte is checked to be there before it is read."""
        cdef const char* message = PyBytes_AS_STRING(data)
        cdef Py_ssize_t size = PyBytes_GET_SIZE(data), offset = 8, count, i, k
        cdef int64_t length
        cdef Field* field
        if size < 8:
            raise MalformedError("truncated")
        if memcmp(message, PyBytes_AS_STRING(self.fingerprint), 8):
            raise MalformedError("fingerprint")
        for i in range(self.field_count):
            field = &self.fields[i]
            count = 1
            if field.code == b"s":
                if size - offset < 4:
                    raise MalformedError("truncated")
                count = get_uint32(message + offset)
                offset += 4
            for k in range(field.dimension, field.dimension_end):
                length = self.dimensions[k].size
                if self.dimensions[k].field >= 0:
                    length = _integer(message, &self.fields[self.dimensions[k].field])
                if length < 0:
                    raise MalformedError("size")
                # More than the message can hold is as wrong as anything larger; so nothing overflows.
                count = size if length and count > size // length else count * <Py_ssize_t>length
            if count > (size - offset) // field.width:
                raise MalformedError("truncated")
            field.offset, field.count = offset, count
            offset += count * field.width
        if offset != size:
            raise MalformedError("trailing")
        return 0

    cdef Py_ssize_t count(self, Py_ssize_t signal) noexcept:
        """Return how many numbers the signal has in the located message."""
        cdef Py_ssize_t k, count = 0
        for k in range(self.part_ends[signal - 1] if signal else 0, self.part_ends[signal]):
            count += self.fields[self.parts[k]].count
        return count


cdef class MessageDecoder(MessageLayout):
    """Decodes messages whose signals are numbers; the arguments are those of `MessageLayout`."""

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
                    entry[0] = _read(at, field.code)
                    entry += 1
                    at += field.width
            values[self.names[signal]] = value
        return sent, values


cdef class MessageEncoder(MessageLayout):
    """Encodes messages that differ from an example only in their time and in the numbers of their signals.

    Args:
        example: such a message.
        (others): those of `MessageLayout`.
    """

    cdef bytes example

    def __cinit__(self, *_, bytes example not None, **__):
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
                    if not _write(at, field.code, entry[0]):
                        raise OverflowError(f"{entry[0]} of {self.names[signal]} does not fit into its field")
                    entry += 1
                    at += field.width
        return data


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
