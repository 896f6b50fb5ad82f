"""Noise that is a function of (seed, stream, tick).

Nothing is remembered between two samples, so repetitions of a simulation and copies of its Context see the same noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def normal_noise(size: int, *, seed: int, stream: int, tick: int, channel: int = 0) -> NDArray[np.float64]:
    """``size`` independent samples of N(0, 1).

    Every ``channel`` of a stream has noise of its own.

    The generator is Philox 4x64, a function of a key and a counter (Salmon et al., "Parallel Random Numbers: As Easy as
    1, 2, 3", 2011). The key is (seed, stream); the tick is the counter's second word and the channel its third, so that
    the draws of one tick never reach those of the next.
    """
    return _generator(seed, stream, tick, channel).standard_normal(size)


def uniform_noise(*, seed: int, stream: int, tick: int, channel: int = 0) -> float:
    """A sample of the uniform distribution over [0, 1); of the same generator as `normal_noise`."""
    return _generator(seed, stream, tick, channel).random()


def _generator(seed: int, stream: int, tick: int, channel: int) -> np.random.Generator:
    words = [0, tick & 0xFFFFFFFFFFFFFFFF, channel, 0]
    bits = np.random.Philox(counter=np.array(words, dtype=np.uint64), key=np.array([seed, stream], dtype=np.uint64))
    return np.random.Generator(bits)
