"""Rollouts in segments, between which variables may be set: each rollout at its own place, all in one call."""

from __future__ import annotations

from itertools import chain, pairwise

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array
from vtbdrake.compiled.compiled_rollouts import CompiledRollouts
from vtbdrake.compiled.equations import UnsupportedTestbedError
from vtbdrake.compiled.program import Program
from vtbdrake.compiled.schedule import Instant, schedule
from vtbdrake.testbed.instants import sample_instants

# The largest number of segments for which random numbers are drawn at once, and of the numbers of one rollout in them.
_MOST_AHEAD = 64
_MOST_NUMBERS = 1 << 15


class SegmentedRollouts:
    """A compiled rollout from t0 that stops at each k-th sample, as Drake's Simulator would at a boundary time.

    A segment begins with the updates of its first instant, which so see what was set there, and ends with the last
    sample, before the updates of that instant.

    Args:
        rollouts: The compiled Diagram, with what is recorded.
        times: The sample times from the begin (s), the first is 0, the last the end of the last segment.
        every: The number of samples of a segment.
        t0: The time at which the rollouts begin (s).

    Raises:
        UnsupportedTestbedError: A system may end the simulation.

    Attributes:
        instants: The simulator's times at the samples (s), shape (segments * every + 1,).
        record_size: The number ny of recorded values of a sample, see `CompiledRollouts.columns`; the last one, the
            doubt, is positive where the rollout has departed from Drake's.
    """

    def __init__(self, rollouts: CompiledRollouts, times: Array, *, every: int, t0: float) -> None:
        self._rollouts, self._walker = rollouts, rollouts.walker
        if self._walker.endings:
            raise UnsupportedTestbedError(
                f"{self._walker.endings[0][0]} ends the simulation, which segments do not: keep this testbed in Drake"
            )
        self.instants = sample_instants(times, t0, rollouts.timings)
        instants = schedule(self._walker.timings, self.instants)
        at_samples = [k for k, instant in enumerate(instants) if instant.is_sample]
        ends = at_samples[::every]
        self._parts = [
            [
                instants[begin]._replace(is_sample=False),
                *instants[begin + 1 : end],
                instants[end]._replace(updates=()),
            ]
            for begin, end in pairwise(ends)
        ]
        self._program: Program = rollouts.program(max(self._parts, key=len))
        self._plans = np.array([self._program.plan(part) for part in self._parts])
        self.record_size: int = self._program.function.size1_out(1)
        samples = np.array(at_samples[1:]).reshape(-1, every)
        self._samples = samples - np.array(ends[:-1])[:, np.newaxis]
        self._first = [Instant(float(self.instants[0]), True, ())]
        self._ahead = max(1, min(_MOST_AHEAD, _MOST_NUMBERS // (self._program.count * max(1, self._walker.draws.size))))
        # (seeds, number of the block of segments) -> random numbers, shape (segments, count, noise).
        self._drawn_blocks: dict[tuple[bytes, int], Array] = {}

    def begin(self, z: Array) -> Array:
        """Return the records of the first sample of rollouts that begin at z, shape (n, ny).

        Args:
            z: State and parameters, shape (n, nz).
        """
        records = np.empty((len(z), self.record_size))
        plan = self._program.plan(self._first)
        noise = None
        if self._walker.draws.size:
            noise = self._walker.draws.numbers(self._walker.draws.seeds(z), self._first, self._program.count)
        for chunk in self._chunks(len(z)):
            each = None if noise is None else noise[chunk]
            records[chunk] = self._program.run(z[chunk], each, plan)[1][:, 0]
        return records

    def advance(self, z: Array, segments: NDArray[np.intp]) -> tuple[Array, Array]:
        """Simulate one segment of each rollout.

        Args:
            z: State and parameters at the begin of the segments, shape (n, nz).
            segments: The number of the segment of each rollout, from 0 on, shape (n,).

        Returns:
            z at the end, shape (n, nz), and the records of the samples, shape (n, every, ny).
        """
        samples = self._samples[segments]
        after = np.empty_like(z)
        records = np.empty((*samples.shape, self.record_size))
        is_same = bool((segments == segments[0]).all())
        plans = self._plans[segments[0]] if is_same else self._plans[segments]
        noise = self._noise(z, segments)
        for chunk in self._chunks(len(z)):
            each = None if noise is None else noise[chunk]
            after[chunk], recorded = self._program.run(z[chunk], each, plans if is_same else plans[chunk])
            if is_same:
                records[chunk] = recorded[:, samples[0]]
            else:
                records[chunk] = np.take_along_axis(recorded, samples[chunk, :, np.newaxis], axis=1)
        return after, records

    def _chunks(self, count: int) -> list[slice]:
        return [slice(k, k + self._program.most) for k in range(0, count, self._program.most)]

    def _noise(self, z: Array, segments: NDArray[np.intp]) -> Array | None:
        """Return the random numbers of all rollouts in their segments, shape (n, count, noise), if there are some.

        They are drawn for several segments ahead: one after the other, they would take longer than the rollouts.
        """
        if not self._walker.draws.size:
            return None
        seeds = self._walker.draws.seeds(z)
        blocks, places = np.divmod(segments, self._ahead)
        keys = list(zip(map(np.ndarray.tobytes, seeds), blocks.tolist(), strict=True))
        missing: dict[int, dict[bytes, int]] = {}
        for row, key in enumerate(keys):
            if key not in self._drawn_blocks:
                missing.setdefault(key[1], {})[key[0]] = row
        for block, rows in missing.items():
            numbers = self._drawn_block(seeds[list(rows.values())], block)
            self._drawn_blocks |= {(seed, block): each.copy() for seed, each in zip(rows, numbers, strict=True)}
        if len(self._drawn_blocks) > 2 * len(keys):
            self._drawn_blocks = {key: self._drawn_blocks[key] for key in keys}
        return np.array([self._drawn_blocks[key][place] for key, place in zip(keys, places.tolist(), strict=True)])

    def _drawn_block(self, seeds: Array, number: int) -> Array:
        """Return the random numbers of a block of segments, shape (n, segments, count, noise).

        Args:
            seeds: The seeds of the draws, shape (n, draws).
            number: The number of the block.
        """
        count, parts = self._program.count, self._parts[number * self._ahead : (number + 1) * self._ahead]
        padded = [[*part, *[Instant(part[-1].time, False, ())] * (count - len(part))] for part in parts]
        numbers = self._walker.draws.numbers(seeds, list(chain.from_iterable(padded)), count * len(parts))
        return numbers.reshape(len(seeds), len(parts), count, -1)
