"""Noise that is a function of (seed, stream, tick).

It has no state, so repetitions of a simulation and copies of its Context have the same noise.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

# A generator costs more than its samples: many ticks share one.
_BATCH = 512
_KEPT = 128


def normal_noise(size: int, *, seed: int, stream: int, tick: int, channel: int = 0) -> NDArray[np.float64]:
    """Return ``size`` independent samples of N(0, 1), read-only.

    Every ``channel`` and every ``size`` of a stream has different noise.

    The generator is Philox 4x64, a function of a key and a counter (Salmon et al., "Parallel Random Numbers: As Easy as
    1, 2, 3", 2011). The key is (seed, stream). Ticks are drawn in batches, whose number is the counter's second word,
    and the channel its third, so that the draws of one batch never reach those of the next.
    """
    batch, place = divmod(tick, _ticks(size))
    return _normal(size, seed, stream, batch, channel)[place]


def uniform_noise(*, seed: int, stream: int, tick: int, channel: int = 0) -> float:
    """Return a sample of the uniform distribution over [0, 1), of the same generator as `normal_noise`."""
    batch, place = divmod(tick, _ticks(1))
    return _uniform(seed, stream, batch, channel)[place]


def noise_generator(*, seed: int, stream: int, tick: int, channel: int) -> np.random.Generator:
    """Return a generator for the many random numbers of one tick, such as those of an image.

    The stream's ``channel`` is its own: `normal_noise` and `uniform_noise` use the same generator.
    """
    return _generator(seed, stream, tick, channel)


def _ticks(size: int) -> int:
    return max(1, _BATCH // max(1, size))


@lru_cache(_KEPT)
def _normal(size: int, seed: int, stream: int, batch: int, channel: int) -> NDArray[np.float64]:
    drawn = _generator(seed, stream, batch, channel).standard_normal((_ticks(size), size))
    drawn.flags.writeable = False
    return drawn


@lru_cache(_KEPT)
def _uniform(seed: int, stream: int, batch: int, channel: int) -> list[float]:
    return _generator(seed, stream, batch, channel).random(_ticks(1)).tolist()


def _generator(seed: int, stream: int, batch: int, channel: int) -> np.random.Generator:
    words = [0, batch & 0xFFFFFFFFFFFFFFFF, channel, 0]
    bits = np.random.Philox(counter=np.array(words, dtype=np.uint64), key=np.array([seed, stream], dtype=np.uint64))
    return np.random.Generator(bits)
