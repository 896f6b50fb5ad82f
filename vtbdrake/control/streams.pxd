cdef class Stream:
    # What has come and is not cut yet lies from `begin` to `end`.
    cdef char* buffer
    cdef Py_ssize_t room, begin, end

    cdef char* _space(self, Py_ssize_t size) except NULL
    cdef int _came(self, Py_ssize_t size) except -1
