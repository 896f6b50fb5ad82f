import numpy as np
from numpy.typing import NDArray

def fill(
    out: NDArray[np.float64],
    seeds: NDArray[np.uint64],
    stream: int,
    batches: NDArray[np.uint64],
    places: NDArray[np.int64],
    channel: int,
    normal: bool,
) -> None:
    """Fill an array with random numbers: samples of N(0, 1), or of the uniform distribution over [0, 1).

    They are the ones of numpy's ``Generator(Philox(counter=[0, batch, channel, 0], key=[seed, stream]))``, which draws
    the places of a batch one after the other, from place 0.

    Args:
        out: The array, contiguous, shape (n, m, size).
        seeds: The first word of the keys, shape (n,).
        stream: The second word of the keys.
        batches: The batches, shape (m,).
        places: The places within them, shape (m,).
        channel: The third word of the counters.
        normal: Whether the samples are normal; else uniform.
    """
