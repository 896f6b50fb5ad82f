"""Noise that is a function of (seed, stream, tick).

It has no state, so repetitions of a simulation and copies of its Context have the same noise.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from hashlib import blake2b
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vtbdrake.state.declarations import weakly
from vtbdrake.state.systems import UNNAMED, class_name

if TYPE_CHECKING:
    from pydrake.systems.framework import System

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


def random_stream(system: System, number: int | None) -> Callable[[], int]:
    """Return a function that returns the random stream of a system: ``number``, or that of `stream_of` for None.

    Raises:
        ValueError: The number is no stream.
    """
    if number is not None and not (0 <= number < 2**64 and number == int(number)):
        raise ValueError(
            f"{class_name(system)}: stream is a whole number from 0 to 2^64 - 1, or None for one that follows from the "
            f"system's name, not {number!r}"
        )
    return weakly(system, lambda system: stream_of(system) if number is None else int(number))


def stream_of(system: System) -> int:
    """Return the random stream of a system, a number of 64 bits that follows from its path below the root Diagram.

    So systems of different names have independent noise, and a system has the same noise in every build, copy, thread
    and process. The name of the root does not count: a world alone has the noise that it has in its testbed.

    Raises:
        ValueError: The system or a Diagram around it has no name; what Drake calls it changes with every run.
    """
    names = system.GetSystemPathname().split("::")[2:]
    if any(UNNAMED.search(name) for name in names):
        where = "has no name" if UNNAMED.search(names[-1]) else f"{names[-1]} is in a Diagram without a name"
        raise ValueError(
            f"{class_name(system)} {where}, and its random numbers follow from its name: add it by AddNamedSystem, or "
            "give it a stream= of its own"
        )
    return int.from_bytes(blake2b("::".join(names).encode(), digest_size=8).digest(), "big")


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
