from libc.stdint cimport int64_t

cimport numpy as cnp


cdef inline double* entries_of(object value, Py_ssize_t size) noexcept:
    """Of an array of ``size`` doubles, one after the other; NULL if ``value`` is anything else."""
    if not cnp.PyArray_CheckExact(value):
        return NULL
    cdef cnp.ndarray array = <cnp.ndarray>value
    if (
        cnp.PyArray_NDIM(array) != 1
        or cnp.PyArray_DIM(array, 0) != size
        or cnp.PyArray_TYPE(array) != cnp.NPY_DOUBLE
        or not cnp.PyArray_ISCARRAY_RO(array)
    ):
        return NULL
    return <double*>cnp.PyArray_DATA(array)


cdef void* zeros(Py_ssize_t count, size_t size) except NULL


cdef class Bounds:
    cdef Py_ssize_t size
    cdef double* lower
    cdef double* upper

    cdef bint holds(self, const double* entries) noexcept


cdef class ReceivedSignal:
    cdef public object value
    cdef public double arrived
    cdef public double sent
    cdef public int64_t count
    cdef public dict rejected
    cdef public object range

    cpdef accept(self, value, double arrived, double sent)
