"""At which instants a simulation is sampled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def sample_times(horizon: float, sample_period: float) -> NDArray[np.float64]:
    """Return the sample times from 0 to the horizon, in seconds: the multiples of the sample period, and the end.

    Args:
        horizon: The last sample time, in seconds, at least 0.
        sample_period: The time between two samples, in seconds, above 0.
    """
    times = np.arange(np.floor(horizon / sample_period * (1.0 + 1e-12)) + 1.0) * sample_period
    rest = horizon - times[-1]
    return np.append(times, horizon) if rest > 1e-9 * sample_period else times


def sample_instants(
    times: NDArray[np.float64], t0: float, timings: Sequence[tuple[float, float]]
) -> NDArray[np.float64]:
    """Return the simulator's time at each sample: t0 + t, or the first event's that coincides up to rounding.

    Drake puts an event at offset + n * period. 3 * 0.1 and 15 * 0.02 differ in the last bit: a simulation that is
    advanced to the one would take another step, of 1e-16 s, to the other. And the updates of the other would have
    happened at some of the samples, which are to show the state before all updates of their instant.

    Args:
        times: Times of the samples from the begin, in seconds; the first is 0.
        t0: Time at which the simulation begins, in seconds.
        timings: (period, offset) of the periodic events, see `AddressedDiagram.event_timings`.
    """
    absolute = t0 + times
    # Two ways to compute an instant may differ by some roundings.
    close = 8.0 * np.spacing(np.maximum(np.abs(absolute), 1.0))
    first = np.full(absolute.shape, np.inf)
    for period, offset in timings:
        events = offset + np.maximum(np.round((absolute - offset) / period), 0.0) * period
        first = np.where(np.abs(events - absolute) <= close, np.minimum(first, events), first)
    instants = np.where(np.isfinite(first), first, absolute)
    instants[0] = t0
    return instants
