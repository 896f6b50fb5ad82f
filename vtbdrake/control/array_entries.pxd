"""Access to the numbers in an array, without a copy."""

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
