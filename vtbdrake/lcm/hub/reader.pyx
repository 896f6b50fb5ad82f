"""What comes from a client of tcpq (see `tcpq`), cut into its records; compiled."""

from cpython.bytearray cimport PyByteArray_AS_STRING, PyByteArray_FromStringAndSize, PyByteArray_Resize
from cpython.bytes cimport PyBytes_FromStringAndSize
from libc.stdint cimport UINT32_MAX, uint32_t
from libc.string cimport memcpy

from vtbdrake.lcm.byte_order cimport get_uint32, put_uint32
from vtbdrake.lcm.hub.tcpq import GREET, MAGIC_CLIENT, MAX_CHANNEL, PUBLISH, UNSUBSCRIBE, VERSION, TcpqError
from vtbdrake.control.streams cimport Stream

cdef Py_ssize_t _MAX_CHANNEL = MAX_CHANNEL
cdef uint32_t _PUBLISH = PUBLISH
cdef uint32_t _UNSUBSCRIBE = UNSUBSCRIBE

# What is larger is not copied once more when it is complete: that would take long.
cdef Py_ssize_t _LARGE = 1 << 18


def publish_record(bytes channel, bytes data):
    """The record that publishes ``data``.

    Raises:
        ValueError: it is too long for its length to be told.
    """
    cdef Py_ssize_t length = len(channel), size = len(data)
    if length > UINT32_MAX or size > UINT32_MAX:
        raise ValueError(f"tcpq carries channels and data of less than 4 GiB, not {length} and {size} bytes")
    record = PyBytes_FromStringAndSize(NULL, 12 + length + size)
    cdef char* at = record
    put_uint32(at, _PUBLISH)
    put_uint32(at + 4, <uint32_t>length)
    memcpy(at + 8, <const char*>channel, length)
    put_uint32(at + 8 + length, <uint32_t>size)
    memcpy(at + 12 + length, <const char*>data, size)
    return record


cdef class TcpqReader(Stream):
    """Cuts what comes from one client into tcpq's records.

    Args:
        max_message: the largest data of a publication, in bytes.
        greeted: whether the client has greeted; else its greeting is the first record.

    Attributes:
        greeted: the same, by now.
    """

    cdef readonly bint greeted
    cdef Py_ssize_t max_message
    # Of the record that begins, as far as it is known.
    cdef uint32_t kind
    cdef Py_ssize_t length, size
    # That record, if it is a large one: it grows where it stays; and how much of it has come.
    cdef bytearray large
    cdef Py_ssize_t filled

    def __init__(self, *, max_message, greeted=False):
        self.max_message = max_message
        self.greeted = greeted

    @property
    def partial(self):
        """Whether a record has begun, and is not taken off."""
        return self.large is not None or self.end > self.begin

    @property
    def held(self):
        """How many bytes have come that are not taken off."""
        return self.end - self.begin + (self.filled if self.large is not None else 0)

    def next_record(self):
        """The next record: its type, its channel or pattern, and the record as it came; None if it is not there yet.

        A large one is a bytearray, which is nobody else's.

        Raises:
            TcpqError: the client is of no use any more.
        """
        if not self._whole():
            return None
        cdef const char* at
        if self.large is not None:
            at = PyByteArray_AS_STRING(self.large)
            whole, self.large = self.large, None
        else:
            at = self.buffer + self.begin
            self.begin += self.size
            whole = PyBytes_FromStringAndSize(at, self.size)
        if self.kind == 0:
            return GREET, b"", whole
        return self.kind, PyBytes_FromStringAndSize(at + 8, self.length), whole

    def next_publication(self):
        """The next publication: channel and data; other records are left out. None if it is not there yet.

        Raises:
            TcpqError: as `record`.
        """
        cdef const char* at
        while self._whole():
            large = self.large
            if large is not None:
                at = PyByteArray_AS_STRING(large)
                self.large = None
            else:
                at = self.buffer + self.begin
                self.begin += self.size
            if self.kind == _PUBLISH:
                return (
                    PyBytes_FromStringAndSize(at + 8, self.length),
                    PyBytes_FromStringAndSize(at + 12 + self.length, self.size - 12 - self.length),
                )
        return None

    cdef bint _whole(self) except -1:
        """Whether the next record is there; then its type (0 for a greeting), length and size are known."""
        cdef const char* at = self.buffer + self.begin
        cdef Py_ssize_t have = self.end - self.begin
        if self.large is not None:
            return self.filled == self.size
        if have < 8:
            return False
        self.kind, self.length = get_uint32(at), get_uint32(at + 4)
        if not self.greeted:
            if self.kind != MAGIC_CLIENT:
                raise TcpqError("greeting", f"begins with {self.kind:#010x}, a tcpq client with {MAGIC_CLIENT:#010x}")
            if self.length != VERSION:
                raise TcpqError(
                    "greeting", f"speaks version {self.length:#06x} of tcpq, the hub {VERSION:#06x}"
                )
            self.greeted = True
            self.kind, self.length, self.size = 0, 0, 8
            return True
        if not _PUBLISH <= self.kind <= _UNSUBSCRIBE:
            raise TcpqError("malformed", f"sends a record of type {self.kind}, there are 1, 2 and 3")
        if not 0 < self.length <= _MAX_CHANNEL:
            raise TcpqError("malformed", f"sends a channel of {self.length} bytes, it has 1 to {MAX_CHANNEL}")
        self.size = 8 + self.length
        if self.kind == _PUBLISH:
            if have < 12 + self.length:
                return False
            size = get_uint32(at + 8 + self.length)
            if size > self.max_message:
                raise TcpqError(
                    "too large", f"sends a message of {size} bytes, the largest allowed has {self.max_message}"
                )
            self.size = 12 + self.length + <Py_ssize_t>size
        if have < self.size and self.size > _LARGE:
            self.large, self.filled = PyByteArray_FromStringAndSize(at, have), have
            self.begin = self.end = 0
        return have >= self.size

    cdef char* _space(self, Py_ssize_t size) except NULL:
        if self.large is None or self.filled == self.size:
            return Stream._space(self, size)
        PyByteArray_Resize(self.large, self.filled + size)
        return PyByteArray_AS_STRING(self.large) + self.filled

    cdef int _came(self, Py_ssize_t size) except -1:
        if self.large is None or self.filled == self.size:
            return Stream._came(self, size)
        cdef Py_ssize_t beyond = self.filled + size - self.size
        if beyond > 0:  # It belongs to the next one.
            memcpy(Stream._space(self, beyond), PyByteArray_AS_STRING(self.large) + self.size, beyond)
            Stream._came(self, beyond)
        self.filled += size - max(beyond, 0)
        if self.filled == self.size:
            PyByteArray_Resize(self.large, self.size)
        return 0
