"""Noise that is a function of (seed, stream, tick).

Nothing is remembered between two samples, so repetitions of a simulation and copies of its Context see the same noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def normal_noise(size: int, *, seed: int, stream: int, tick: int) -> NDArray[np.float64]:
    """``size`` independent samples of N(0, 1).

    The generator is Philox 4x64, a function of a key and a counter (Salmon et al., "Parallel Random Numbers: As Easy as
    1, 2, 3", 2011). The key is (seed, stream); the tick is the counter's second word, so that the draws of one tick
    never reach those of the next.
    """
    words = [0, tick & 0xFFFFFFFFFFFFFFFF, 0, 0]
    bits = np.random.Philox(counter=np.array(words, dtype=np.uint64), key=np.array([seed, stream], dtype=np.uint64))
    return np.random.Generator(bits).standard_normal(size)
