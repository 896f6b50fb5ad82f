"""Splits a byte stream into tcpq records (see `tcpq`); compiled."""

from cpython.bytearray cimport PyByteArray_AS_STRING, PyByteArray_FromStringAndSize, PyByteArray_Resize
from cpython.bytes cimport PyBytes_FromStringAndSize
from libc.stdint cimport UINT32_MAX, uint32_t
from libc.string cimport memcpy

from vtbdrake.lcm.byte_order cimport get_uint32, put_uint32
from vtbdrake.lcm.hub.tcpq import MAGIC_CLIENT, MAX_CHANNEL, VERSION, RecordType, TcpqError
from vtbdrake.common.streams cimport Stream

cdef Py_ssize_t _MAX_CHANNEL = MAX_CHANNEL
cdef uint32_t _GREETING = RecordType.GREETING
cdef uint32_t _PUBLISH = RecordType.PUBLISH
cdef uint32_t _UNSUBSCRIBE = RecordType.UNSUBSCRIBE

# Larger records are received in place: copying them when they are complete would take long.
cdef Py_ssize_t _LARGE = 1 << 18


def publish_record(bytes channel, bytes data):
    """Return the record that publishes ``data`` on a channel.

    Raises:
        ValueError: The channel or the data has 4 GiB or more.
    """
    cdef Py_ssize_t length = len(channel), size = len(data)
    if length > UINT32_MAX or size > UINT32_MAX:
        raise ValueError(f"channel and data must have less than 4 GiB each, not {length} and {size} bytes")
    record = PyBytes_FromStringAndSize(NULL, 12 + length + size)
    cdef char* at = record
    put_uint32(at, _PUBLISH)
    put_uint32(at + 4, <uint32_t>length)
    memcpy(at + 8, <const char*>channel, length)
    put_uint32(at + 8 + length, <uint32_t>size)
    memcpy(at + 12 + length, <const char*>data, size)
    return record


cdef class TcpqReader(Stream):
    """Splits what one client sends into tcpq records.

    Args:
        max_message: largest data of a publication, in bytes.
        greeted: whether the client has greeted already; otherwise its greeting is the first record.

    Attributes:
        greeted: whether the client has greeted.
    """

    cdef readonly bint greeted
    cdef Py_ssize_t max_message
    # Type, length of the channel and size of the next record, as far as they are known.
    cdef uint32_t kind
    cdef Py_ssize_t length, size
    # That record, if it is large, and how many of its bytes have arrived.
    cdef bytearray large
    cdef Py_ssize_t filled

    def __init__(self, *, max_message, greeted=False):
        self.max_message = max_message
        self.greeted = greeted

    @property
    def partial(self):
        """Return whether the buffer contains a record, complete or not."""
        return self.large is not None or self.end > self.begin

    @property
    def buffered(self):
        """Return the number of bytes in the buffer."""
        return self.end - self.begin + (self.filled if self.large is not None else 0)

    def next_record(self):
        """Remove the next record and return its type, its channel or pattern, and all its bytes.

        Returns:
            None if the record is incomplete. The bytes of a large record are a bytearray that the caller owns.

        Raises:
            TcpqError: The client violates the protocol.
        """
        if not self._is_complete():
            return None
        cdef const char* at
        if self.large is not None:
            at = PyByteArray_AS_STRING(self.large)
            whole, self.large = self.large, None
        else:
            at = self.buffer + self.begin
            self.begin += self.size
            whole = PyBytes_FromStringAndSize(at, self.size)
        if self.kind == _GREETING:
            return _GREETING, b"", whole
        return self.kind, PyBytes_FromStringAndSize(at + 8, self.length), whole

    def next_publication(self):
        """Remove the next publication and return its channel and data; other records are skipped.

        Returns:
            None if the publication is incomplete.

        Raises:
            TcpqError: The sender violates the protocol.
        """
        cdef const char* at
        while self._is_complete():
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

    cdef bint _is_complete(self) except -1:
        """Return whether the next record is complete; then its type (0 for a greeting), length and size are known."""
        cdef const char* at = self.buffer + self.begin
        cdef Py_ssize_t have = self.end - self.begin
        if self.large is not None:
            return self.filled == self.size
        if have < 8:
            return False
        self.kind, self.length = get_uint32(at), get_uint32(at + 4)
        if not self.greeted:
            if self.kind != MAGIC_CLIENT:
                raise TcpqError("greeting", f"greeting must be {MAGIC_CLIENT:#010x}, not {self.kind:#010x}")
            if self.length != VERSION:
                raise TcpqError("greeting", f"version of tcpq must be {VERSION:#06x}, not {self.length:#06x}")
            self.greeted = True
            self.kind, self.length, self.size = _GREETING, 0, 8
            return True
        if not _PUBLISH <= self.kind <= _UNSUBSCRIBE:
            raise TcpqError("malformed", f"record type must be 1, 2 or 3, not {self.kind}")
        if not 0 < self.length <= _MAX_CHANNEL:
            raise TcpqError("malformed", f"channel must have 1 to {MAX_CHANNEL} bytes, not {self.length}")
        self.size = 8 + self.length
        if self.kind == _PUBLISH:
            if have < 12 + self.length:
                return False
            size = get_uint32(at + 8 + self.length)
            if size > self.max_message:
                raise TcpqError("too large", f"message of {size} bytes exceeds max_message={self.max_message}")
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

    cdef int _received(self, Py_ssize_t size) except -1:
        if self.large is None or self.filled == self.size:
            return Stream._received(self, size)
        cdef Py_ssize_t beyond = self.filled + size - self.size
        if beyond > 0:  # bytes of the next record
            memcpy(Stream._space(self, beyond), PyByteArray_AS_STRING(self.large) + self.size, beyond)
            Stream._received(self, beyond)
        self.filled += size - max(beyond, 0)
        if self.filled == self.size:
            PyByteArray_Resize(self.large, self.size)
        return 0
