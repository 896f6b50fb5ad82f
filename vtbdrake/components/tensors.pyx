"""Conversions between entries in double precision and tensors in single or double precision, compiled."""

cimport numpy as cnp
from libc.math cimport isfinite

cnp.import_array()


cdef cnp.ndarray checked(array, Py_ssize_t free):
    """Return a contiguous array of at most ``free`` floats of 32 or 64 bits."""
    cdef cnp.ndarray tensor = <cnp.ndarray?>array
    cdef int kind = cnp.PyArray_TYPE(tensor)
    if not cnp.PyArray_ISCARRAY(tensor) or (kind != cnp.NPY_FLOAT and kind != cnp.NPY_DOUBLE):
        raise ValueError("a tensor must be a writable, contiguous array of floats of 32 or 64 bits")
    if cnp.PyArray_SIZE(tensor) > free:
        raise ValueError(f"the tensors have more than the remaining {free} entries")
    return tensor


def scatter_tensors(const double[::1] entries, list tensors not None):
    cdef Py_ssize_t i, size, start = 0
    cdef cnp.ndarray tensor
    cdef float* single
    cdef double* wide
    for array in tensors:
        tensor = checked(array, entries.shape[0] - start)
        size = cnp.PyArray_SIZE(tensor)
        if cnp.PyArray_TYPE(tensor) == cnp.NPY_FLOAT:
            single = <float*>cnp.PyArray_DATA(tensor)
            for i in range(size):
                single[i] = <float>entries[start + i]
        else:
            wide = <double*>cnp.PyArray_DATA(tensor)
            for i in range(size):
                wide[i] = entries[start + i]
        start += size


def gather_tensors(list tensors not None, double[::1] entries):
    cdef Py_ssize_t i, size, start = 0
    cdef cnp.ndarray tensor
    cdef float* single
    cdef double* wide
    cdef bint finite = True
    for array in tensors:
        tensor = checked(array, entries.shape[0] - start)
        size = cnp.PyArray_SIZE(tensor)
        if cnp.PyArray_TYPE(tensor) == cnp.NPY_FLOAT:
            single = <float*>cnp.PyArray_DATA(tensor)
            for i in range(size):
                entries[start + i] = single[i]
        else:
            wide = <double*>cnp.PyArray_DATA(tensor)
            for i in range(size):
                entries[start + i] = wide[i]
        for i in range(start, start + size):
            finite = finite and isfinite(entries[i])
        start += size
    return finite
