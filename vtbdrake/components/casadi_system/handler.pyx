"""The calculations that Drake calls in every step of a `CasadiSystem`, compiled."""

import numpy as np

cimport numpy as cnp
from libc.string cimport memcpy

cnp.import_array()


cdef bint are_floats(array):
    return (
        cnp.PyArray_CheckExact(array)
        and cnp.PyArray_TYPE(<cnp.ndarray>array) == cnp.NPY_DOUBLE
        and cnp.PyArray_ISCARRAY_RO(<cnp.ndarray>array)
    )


def handler(
    *, tuple states, bint updates, bint clock, parameters, tuple inputs, state_value, vector_value, compute, deliver
):
    cdef Py_ssize_t groups = len(states)

    def handle(context, target):
        cdef list blocks = []
        if groups:
            # The state to update already holds the values of the context.
            state = target if updates else context.get_discrete_state()
            for i in states:
                blocks.append(state_value(state, i))
        if clock:
            blocks.append((context.get_time(),))
        if parameters is not None:
            blocks.append(vector_value(parameters(context, 0)))
        for read in inputs:
            blocks.append(read(context))
        # Read everything before the kernel's arrays are touched: an input may evaluate this system too.
        result = compute(blocks or [()])
        if deliver is None:
            scatter(result, blocks[:groups])
        else:
            deliver(target, result)

    return handle


def evaluator(buffers):
    def value(blocks):
        z, evaluate, y = buffers.parts
        gather(blocks, z)
        evaluate()
        return y

    return value


def gather(blocks, cnp.ndarray z not None):
    cdef char* to = <char*>cnp.PyArray_DATA(z)
    cdef Py_ssize_t free = cnp.PyArray_NBYTES(z), size
    cdef cnp.ndarray part
    for block in blocks:
        if not are_floats(block):
            break
        part = <cnp.ndarray>block
        size = cnp.PyArray_NBYTES(part)
        if cnp.PyArray_NDIM(part) != 1 or size > free:
            break
        memcpy(to, cnp.PyArray_DATA(part), size)
        to += size
        free -= size
    else:
        if not free:
            return
    np.concatenate(blocks, out=z)


def scatter(y, list blocks not None):
    if not are_floats(y):
        raise ValueError(f"y must be a contiguous array of floats, but is {y!r}.")
    cdef char* start = <char*>cnp.PyArray_DATA(<cnp.ndarray>y)
    cdef Py_ssize_t left = cnp.PyArray_NBYTES(<cnp.ndarray>y), size
    cdef cnp.ndarray part
    for block in blocks:
        if not (are_floats(block) and cnp.PyArray_ISWRITEABLE(<cnp.ndarray>block)):
            raise ValueError(f"the blocks must be writable, contiguous arrays of floats, but one is {block!r}.")
        part = <cnp.ndarray>block
        size = cnp.PyArray_NBYTES(part)
        if size > left:
            raise ValueError(f"the blocks must have {len(y)} entries at most, but have more.")
        memcpy(cnp.PyArray_DATA(part), start, size)
        start += size
        left -= size
