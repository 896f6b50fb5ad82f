import numpy as np
from numpy.typing import NDArray

def scatter_tensors(entries: NDArray[np.float64], tensors: list[NDArray[np.floating]]) -> None:
    """Copy entries, shape (n,), into tensors of single or double precision, one after the other, row after row.

    Raises:
        ValueError: A tensor is not a contiguous array of floats of 32 or 64 bits, or they have more than n entries.
    """

def gather_tensors(tensors: list[NDArray[np.floating]], entries: NDArray[np.float64]) -> bool:
    """Copy tensors into entries, the reverse of `scatter_tensors`; return whether all of them are finite.

    Raises:
        ValueError: As in `scatter_tensors`.
    """
