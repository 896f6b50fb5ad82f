cdef class Stream:
    # The unprocessed bytes lie from `begin` to `end`.
    cdef char* buffer
    cdef Py_ssize_t room, begin, end

    cdef char* _space(self, Py_ssize_t size) except NULL
    cdef int _received(self, Py_ssize_t size) except -1
