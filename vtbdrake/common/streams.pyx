"""Compiled buffers that reassemble messages from sockets."""

from cpython.bytes cimport PyBytes_FromStringAndSize
from cpython.exc cimport PyErr_CheckSignals, PyErr_SetFromErrno
from cpython.mem cimport PyMem_Free, PyMem_Realloc
from libc.errno cimport EAGAIN, EINTR, errno
from libc.stdint cimport uint64_t
from libc.string cimport memcpy

cdef extern from "<endian.h>" nogil:
    uint64_t le64toh(uint64_t)

cdef extern from "<sys/socket.h>" nogil:
    const int MSG_DONTWAIT
    ssize_t recv(int, void*, size_t, int)

cdef class Stream:
    """A buffer of received bytes that are not processed yet.

    Its memory grows with what has arrived, not with a length that the sender announces.
    """

    def __dealloc__(self):
        PyMem_Free(self.buffer)

    @property
    def partial(self):
        """Return whether there are unprocessed bytes."""
        return self.end > self.begin

    cdef char* _space(self, Py_ssize_t size) except NULL:
        """Return where ``size`` more bytes (at least one) may be written."""
        cdef Py_ssize_t have = self.end - self.begin
        cdef Py_ssize_t room = self.room
        if self.begin and have <= self.begin:
            memcpy(self.buffer, self.buffer + self.begin, have)
            self.begin, self.end = 0, have
        if not have and room > 4 * size:
            room = 0  # It was large because of a message that is processed: give the memory back.
        if self.end + size > room:
            room = 2 * (self.end + size)
        if room != self.room:
            buffer = <char*>PyMem_Realloc(self.buffer, room)
            if buffer is NULL:
                raise MemoryError
            self.buffer, self.room = buffer, room
        return self.buffer + self.end

    cdef int _received(self, Py_ssize_t size) except -1:
        """Add bytes that were written there."""
        self.end += size
        return 0

    def append(self, const unsigned char[::1] data):
        """Add received bytes."""
        cdef Py_ssize_t size = data.shape[0]
        if size:
            memcpy(self._space(size), &data[0], size)
            self._received(size)

    def receive(self, int fileno, int limit):
        """Receive bytes from a socket without waiting.

        Args:
            fileno: descriptor of the socket.
            limit: the most bytes to receive.

        Returns:
            The number of bytes; 0 if the other side has closed the connection, -1 if nothing has arrived.

        Raises:
            OSError: the connection is lost.
            ValueError: ``limit`` is not positive.
        """
        cdef ssize_t size
        if limit < 1:
            raise ValueError(f"limit is a positive number of bytes, not {limit}")
        while True:
            # In every pass: a signal's handler may have received into this buffer, too.
            size = recv(fileno, self._space(limit), limit, MSG_DONTWAIT)
            if size >= 0:
                self._received(size)
                return size
            if errno == EAGAIN:
                return -1
            if errno != EINTR:
                PyErr_SetFromErrno(OSError)
            PyErr_CheckSignals()


cdef class Frames(Stream):
    """Reassembles frames, each its length (64 bits, little-endian) and its bytes."""

    def frame(self):
        """Return the next frame; None if it is not complete yet."""
        cdef Py_ssize_t have = self.end - self.begin
        cdef uint64_t size
        if have < 8:
            return None
        memcpy(&size, self.buffer + self.begin, 8)
        size = le64toh(size)
        if <uint64_t>(have - 8) < size:
            return None
        frame = PyBytes_FromStringAndSize(self.buffer + self.begin + 8, <Py_ssize_t>size)
        self.begin += 8 + <Py_ssize_t>size
        return frame
