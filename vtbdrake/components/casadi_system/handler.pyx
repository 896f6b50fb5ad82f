"""What Drake calls in every step, compiled."""

import numpy as np

cimport numpy as cnp
from libc.string cimport memcpy

cnp.import_array()


def handler(
    *, tuple states, bint updates, bint clock, parameters, tuple inputs, state_value, vector_value, compute, deliver
):
    def handle(context, target):
        cdef list blocks = []
        if states:
            # What is to be updated comes with the values that it has in the context, and is at hand.
            state = target if updates else context.get_discrete_state()
            for i in states:
                blocks.append(state_value(state, i))
        if clock:
            blocks.append((context.get_time(),))
        if parameters is not None:
            blocks.append(vector_value(parameters(context, 0)))
        for read in inputs:
            blocks.append(read(context))
        # All has been read before the kernel's arrays are touched: an input may evaluate this system too.
        deliver(target, compute(blocks or [()]))

    return handle


def gather(blocks, cnp.ndarray z not None):
    cdef char* to = <char*>cnp.PyArray_DATA(z)
    cdef Py_ssize_t free = cnp.PyArray_NBYTES(z), size
    cdef cnp.ndarray part
    for block in blocks:
        if not cnp.PyArray_CheckExact(block):
            break
        part = <cnp.ndarray>block
        size = cnp.PyArray_NBYTES(part)
        if (
            cnp.PyArray_NDIM(part) != 1
            or cnp.PyArray_TYPE(part) != cnp.NPY_DOUBLE
            or not cnp.PyArray_ISCARRAY_RO(part)
            or size > free
        ):
            break
        memcpy(to, cnp.PyArray_DATA(part), size)
        to += size
        free -= size
    else:
        if not free:
            return
    np.concatenate(blocks, out=z)
