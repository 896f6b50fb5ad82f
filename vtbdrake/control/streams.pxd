cdef class Stream:
    # What has come and is not cut yet lies from `begin` to `end`.
    cdef char* buffer
    cdef Py_ssize_t room, begin, end

    cdef int _make_room(self, Py_ssize_t size) except -1
