from libc.stdint cimport int64_t

cimport numpy as cnp


cdef inline double* entries_of(object value, Py_ssize_t size) noexcept:
    """Return the data of a contiguous array of ``size`` doubles; NULL if ``value`` is anything else."""
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


cdef class ReceivedSignal:
    cdef public object value
    cdef public double arrived
    cdef public double sent
    cdef public int64_t count
    cdef public dict rejected
    cdef public object bounds

    cpdef accept(self, value, double arrived, double sent)
