"""What comes from a client of tcpq (see `tcpq`), cut into its records; compiled."""

from cpython.bytes cimport PyBytes_FromStringAndSize
from libc.stdint cimport uint32_t
from libc.string cimport memcpy

from vtbdrake.control.hub.tcpq import GREET, MAGIC_CLIENT, MAX_CHANNEL, PUBLISH, UNSUBSCRIBE, VERSION, ProtocolError
from vtbdrake.control.streams cimport Stream

cdef extern from "<arpa/inet.h>" nogil:
    uint32_t ntohl(uint32_t)
    uint32_t htonl(uint32_t)

cdef Py_ssize_t _MAX_CHANNEL = MAX_CHANNEL
cdef uint32_t _PUBLISH = PUBLISH
cdef uint32_t _UNSUBSCRIBE = UNSUBSCRIBE


cdef inline uint32_t _word(const char* at) noexcept:
    cdef uint32_t word
    memcpy(&word, at, 4)
    return ntohl(word)


def publication(bytes channel, bytes data):
    """The record that publishes ``data``."""
    cdef Py_ssize_t length = len(channel), size = len(data)
    cdef uint32_t head[2]
    cdef uint32_t count = htonl(<uint32_t>size)
    record = PyBytes_FromStringAndSize(NULL, 12 + length + size)
    cdef char* at = record
    head[0], head[1] = htonl(_PUBLISH), htonl(<uint32_t>length)
    memcpy(at, head, 8)
    memcpy(at + 8, <const char*>channel, length)
    memcpy(at + 8 + length, &count, 4)
    memcpy(at + 12 + length, <const char*>data, size)
    return record


cdef class Reader(Stream):
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

    def __init__(self, *, max_message, greeted=False):
        self.max_message = max_message
        self.greeted = greeted

    def record(self):
        """The next record: its type, its channel or pattern, and the record as it came; None if it is not there yet.

        Raises:
            ProtocolError: the client is of no use any more.
        """
        if not self._whole():
            return None
        cdef const char* at = self.buffer + self.begin
        self.begin += self.size
        whole = PyBytes_FromStringAndSize(at, self.size)
        if self.kind == 0:
            return GREET, b"", whole
        return self.kind, PyBytes_FromStringAndSize(at + 8, self.length), whole

    def publication(self):
        """The next publication: channel and data; other records are left out. None if it is not there yet.

        Raises:
            ProtocolError: as `record`.
        """
        cdef const char* at
        while self._whole():
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
        if have < 8:
            return False
        self.kind, self.length = _word(at), _word(at + 4)
        if not self.greeted:
            if self.kind != MAGIC_CLIENT:
                raise ProtocolError("greeting", f"begins with {self.kind:#010x}, a tcpq client with {MAGIC_CLIENT:#010x}")
            if self.length != VERSION:
                raise ProtocolError(
                    "greeting", f"speaks version {self.length:#06x} of tcpq, the hub {VERSION:#06x}"
                )
            self.greeted = True
            self.kind, self.length, self.size = 0, 0, 8
            return True
        if not _PUBLISH <= self.kind <= _UNSUBSCRIBE:
            raise ProtocolError("malformed", f"sends a record of type {self.kind}, there are 1, 2 and 3")
        if not 0 < self.length <= _MAX_CHANNEL:
            raise ProtocolError("malformed", f"sends a channel of {self.length} bytes, it has 1 to {MAX_CHANNEL}")
        self.size = 8 + self.length
        if self.kind == _PUBLISH:
            if have < 12 + self.length:
                return False
            size = _word(at + 8 + self.length)
            if size > self.max_message:
                raise ProtocolError(
                    "too large", f"sends a message of {size} bytes, the largest allowed has {self.max_message}"
                )
            self.size = 12 + self.length + <Py_ssize_t>size
        return have >= self.size
