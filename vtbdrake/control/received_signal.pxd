from libc.stdint cimport int64_t


cdef class ReceivedSignal:
    cdef public object value
    cdef public double arrived
    cdef public double sent
    cdef public int64_t count
    cdef public dict rejected
    cdef public int64_t refused
    cdef public int refusals
    cdef public str refused_reason
    cdef public object refused_value
    cdef public object bounds

    cpdef accept(self, value, double arrived, double sent)
