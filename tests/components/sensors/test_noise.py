"""Noise is what numpy's own generator draws."""

from __future__ import annotations

import numpy as np
import pytest

from vtbdrake.components.sensors import normal_noise, uniform_noise
from vtbdrake.components.sensors.noise import noise_of_seeds

BATCH = 512  # Samples that share a counter.


def drawn_by_numpy(size: int, *, seed: int, stream: int, tick: int, channel: int, normal: bool) -> np.ndarray:
    ticks = max(1, BATCH // size)
    batch, place = divmod(tick, ticks)
    counter = np.array([0, batch & 0xFFFFFFFFFFFFFFFF, channel, 0], dtype=np.uint64)
    generator = np.random.Generator(np.random.Philox(counter=counter, key=np.array([seed, stream], dtype=np.uint64)))
    return generator.standard_normal((ticks, size))[place] if normal else generator.random((ticks, size))[place]


@pytest.mark.parametrize(
    ("size", "seed", "stream", "channel"), [(1, 0, 0, 0), (3, 5, 2**64 - 1, 4), (600, 2**53, 7, 1), (40, 3, 1, 2)]
)
@pytest.mark.parametrize("tick", [-5, 0, 1, 170, 171, 10**9])
def test_is_drawn_as_by_numpy(size: int, seed: int, stream: int, channel: int, tick: int) -> None:
    key = {"seed": seed, "stream": stream, "tick": tick, "channel": channel}
    np.testing.assert_array_equal(normal_noise(size, **key), drawn_by_numpy(size, **key, normal=True))
    assert uniform_noise(**key) == drawn_by_numpy(1, **key, normal=False)[0]


def test_many_seeds_and_ticks_in_any_order() -> None:
    seeds, ticks = np.array([4, 2**40, 4], dtype=np.uint64), np.array([3, 4, 200, 7, 7, 0])
    drawn = noise_of_seeds(5, seeds=seeds, stream=9, ticks=ticks, channel=1)
    for s, m in np.ndindex(3, 6):
        expected = drawn_by_numpy(5, seed=int(seeds[s]), stream=9, tick=int(ticks[m]), channel=1, normal=True)
        np.testing.assert_array_equal(drawn[s, m], expected)


def test_has_the_moments_of_a_normal_distribution() -> None:
    """Far tails, which numpy's algorithm draws in another way, are among them."""
    drawn = noise_of_seeds(512, seeds=np.arange(400, dtype=np.uint64), stream=1, ticks=np.array([0]))
    assert abs(np.mean(drawn)) < 0.01
    assert np.var(drawn) == pytest.approx(1.0, abs=0.02)
    assert np.mean(np.abs(drawn) > 3.6542) == pytest.approx(2.58e-4, abs=1.2e-4)  # the begin of the tail
