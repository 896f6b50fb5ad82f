"""When the systems of a Diagram are updated, to the last bit as Drake's Simulator does it."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, inf
from typing import NamedTuple

import numpy as np

from vtbdrake.common.arrays import Array
from vtbdrake.compiled.equations import Timing


class Instant(NamedTuple):
    """An instant at which something happens: first a sample is taken, then systems are updated.

    Attributes:
        time: In seconds.
        is_sample: Whether the outputs are recorded.
        updates: Which of the timings are due.
    """

    time: float
    is_sample: bool
    updates: tuple[int, ...]


def schedule(timings: Sequence[Timing], samples: Array) -> list[Instant]:
    """Return the instants of a Simulator that begins at the first sample and is advanced from sample to sample.

    A sample precedes the updates of its instant. Those of the last one do not happen any more.

    Args:
        timings: The timings of the updates.
        samples: The times of the samples (s), increasing.
    """
    now = float(samples[0])
    first, due = _next(timings, float(np.nextafter(now, -inf)))
    if first > now:
        due = ()
    instants: list[Instant] = []
    for sample in samples.tolist():
        is_begin = bool(instants)  # A call of AdvanceTo begins, whose first instant is the last sample.
        while now < sample:
            if not is_begin:
                instants.append(Instant(now, False, due))
            is_begin = False
            following, updates = _next(timings, now)
            now, due = (following, updates) if following <= sample else (sample, ())
        instants.append(Instant(sample, True, due if sample < samples[-1] else ()))
    return instants


def _next(timings: Sequence[Timing], now: float) -> tuple[float, tuple[int, ...]]:
    """Return the next time after ``now`` at which updates are due, and which."""
    times = [_next_time(timing, now) for timing in timings]
    earliest = min(times, default=inf)
    return earliest, tuple([i for i, time in enumerate(times) if time == earliest])


def _next_time(timing: Timing, now: float) -> float:
    """Return the first time after ``now``, as Drake's LeafSystem computes it."""
    if now < timing.offset:
        return timing.offset
    k = ceil((now - timing.offset) / timing.period)
    time = timing.offset + k * timing.period
    return time if time > now else timing.offset + (k + 1) * timing.period
