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

from vtbdrake.components.sensors.noise_kernel import fill
from vtbdrake.state.declarations import weakly
from vtbdrake.state.systems import UNNAMED, class_name

if TYPE_CHECKING:
    from pydrake.systems.framework import System

# Many ticks share a counter: a call costs more than the samples of one tick.
_BATCH = 512
_KEPT = 128


def normal_noise(size: int, *, seed: int, stream: int, tick: int, channel: int = 0) -> NDArray[np.float64]:
    """Return ``size`` independent samples of N(0, 1), read-only.

    Every ``channel`` and every ``size`` of a stream has different noise.

    The generator is Philox 4x64, a function of a key and a counter (Salmon et al., "Parallel Random Numbers: As Easy as
    1, 2, 3", 2011). The key is (seed, stream). Ticks are drawn in batches, whose number is the counter's second word,
    and the channel its third, so that the draws of one batch never reach the next batch's.

    Args:
        size: Number of samples.
        seed: Seed of the experiment.
        stream: Number of the sensor's stream.
        tick: Number of the sample in time.
        channel: Number of the kind of noise within the sensor.
    """
    batch, place = divmod(tick, _ticks(size))
    return _batch(size, seed, stream, batch, channel, True)[place]


def uniform_noise(*, seed: int, stream: int, tick: int, channel: int = 0) -> float:
    """Return a sample of the uniform distribution over [0, 1), of the same generator as `normal_noise`.

    Args:
        seed: Seed of the experiment.
        stream: Number of the sensor's stream.
        tick: Number of the sample in time.
        channel: Number of the kind of noise within the sensor.
    """
    batch, place = divmod(tick, _ticks(1))
    return float(_batch(1, seed, stream, batch, channel, False)[place, 0])


def noise_of_seeds(
    size: int,
    *,
    seeds: NDArray[np.uint64],
    stream: int,
    ticks: NDArray[np.int64],
    channel: int = 0,
    normal: bool = True,
) -> NDArray[np.float64]:
    """Return the samples of `normal_noise` or `uniform_noise` for many seeds and ticks, shape (n, m, size).

    Args:
        size: Number of samples per tick; 1 for `uniform_noise`.
        seeds: Seeds of the experiments, shape (n,).
        stream: Number of the sensor's stream.
        ticks: Numbers of the samples in time, shape (m,); quickly if they increase.
        channel: Number of the kind of noise within the sensor.
        normal: Whether the samples are normal; else uniform.
    """
    out = np.empty((len(seeds), len(ticks), size))
    batches, places = np.divmod(ticks, _ticks(size))
    fill(out, seeds, stream, batches.astype(np.uint64), places, channel, normal)
    return out


def noise_generator(*, seed: int, stream: int, tick: int, channel: int) -> np.random.Generator:
    """Return a generator for the many random numbers of one tick, such as an image's noise.

    The stream's ``channel`` is its own: `normal_noise` and `uniform_noise` use the same generator.

    Args:
        seed: Seed of the experiment.
        stream: Number of the sensor's stream.
        tick: Number of the sample in time.
        channel: Number of the kind of noise within the sensor.
    """
    return _generator(seed, stream, tick, channel)


def random_stream(system: System, number: int | None) -> Callable[[], int]:
    """Return a function that returns the random stream of a system: ``number``, or `stream_of` for None.

    Args:
        system: The system, which is not kept alive by the function.
        number: The number of the stream, from 0 to 2^64 - 1; None for the one that follows from the system's name.

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
def _batch(size: int, seed: int, stream: int, batch: int, channel: int, normal: bool) -> NDArray[np.float64]:
    """Return the noise of all ticks of a batch, shape (ticks, size), read-only."""
    ticks = np.arange(_ticks(size), dtype=np.int64) + batch * _ticks(size)
    seeds = np.array([seed], dtype=np.uint64)
    drawn = noise_of_seeds(size, seeds=seeds, stream=stream, ticks=ticks, channel=channel, normal=normal)[0]
    drawn.flags.writeable = False
    return drawn


def _generator(seed: int, stream: int, batch: int, channel: int) -> np.random.Generator:
    words = [0, batch & 0xFFFFFFFFFFFFFFFF, channel, 0]
    bits = np.random.Philox(counter=np.array(words, dtype=np.uint64), key=np.array([seed, stream], dtype=np.uint64))
    return np.random.Generator(bits)
