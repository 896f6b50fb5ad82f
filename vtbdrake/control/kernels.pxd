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
