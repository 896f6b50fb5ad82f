"""Strategies of Hypothesis from an `Interface`: samples of sensors, commands u, and what must not be."""

from __future__ import annotations

from math import inf, isfinite, nan, nextafter
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.common.extras import extra_module
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.machine import Corrupt, Delay, Drop, Duplicate, Freeze, InjectedFault, Reorder
from vtbdrake.machine.injected_faults import ACT, CORRUPTIONS, SENSE
from vtbdrake.testbed import Interface, Signal

if TYPE_CHECKING:
    from hypothesis import strategies as st
    from hypothesis.strategies import SearchStrategy
else:
    st = extra_module("hypothesis.strategies", purpose="a strategy", extra="testing")

LARGEST = 1e3
"""The largest absolute value of an entry without a limit, in its unit."""


def samples(signal: Signal) -> SearchStrategy[Any]:
    """Return values of a signal, within its limits: arrays of shape (size,), or the model value of an abstract one."""
    if not signal.is_vector:
        return st.just(signal.model_value)
    if signal.values is not None:
        return st.tuples(*signal.vector(0.0).size * [st.sampled_from(list(map(float, signal.values)))]).map(np.array)
    lower, upper = signal.vector(signal.lower), signal.vector(signal.upper)
    lowest = np.where(np.isfinite(lower), lower, np.minimum(upper, 0.0) - LARGEST)
    highest = np.where(np.isfinite(upper), upper, np.maximum(lower, 0.0) + LARGEST)
    lowest, highest = np.maximum(lowest, lower), np.minimum(highest, upper)
    return st.tuples(*map(st.floats, lowest.tolist(), highest.tolist())).map(np.array)


def bad_samples(signal: Signal) -> SearchStrategy[Any]:
    """Return values that a signal must not have: NaN, infinite, beyond a limit, of another size, or no array."""
    if not signal.is_vector:
        return st.just(None)
    lower, upper = signal.vector(signal.lower).tolist(), signal.vector(signal.upper).tolist()
    wrong = [(i, number) for i in range(len(lower)) for number in (nan, inf, -inf)]
    wrong += [(i, nextafter(low, -inf)) for i, low in enumerate(lower) if isfinite(low)]
    wrong += [(i, nextafter(high, inf)) for i, high in enumerate(upper) if isfinite(high)]
    wrong += [(i, nextafter(low, inf)) for i, low in enumerate(lower) if signal.values is not None]

    def put(value: np.ndarray, place: tuple[int, float]) -> np.ndarray:
        value[place[0]] = place[1]
        return value

    return st.one_of(
        st.builds(put, samples(signal), st.sampled_from(wrong)),
        samples(signal).map(lambda value: np.append(value, 0.0)),
        samples(signal).map(lambda value: value[:-1]),
        st.just("no array"),
    )


def sensor_samples(interface: Interface) -> SearchStrategy[dict[str, Any]]:
    """Return a value within its limits for every sensor signal, by name."""
    return st.fixed_dictionaries({signal.name: samples(signal) for signal in interface.sense})


def commands(interface: Interface) -> SearchStrategy[dict[str, Any]]:
    """Return values within the limits of some commands u by address, such as ``u.target``, for `Runtime.write`."""

    def by_address(signal: Signal) -> SearchStrategy[Any]:
        return samples(signal).map(lambda value: float(value[0]) if signal.size == 1 else value)

    return st.fixed_dictionaries({}, optional={f"u.{s.name}": by_address(s) for s in interface.commands})


def injected_faults(protocol: Protocol, *, period: float, late: int = 20) -> SearchStrategy[InjectedFault]:
    """Return a strategy of faults in the messages between a machine and its controller: see `InjectedFault`.

    They are lost, late, repeated, swapped, frozen or corrupted (bits, NaN, cut off, another type), on one side, on some
    channels or on all.

    Args:
        protocol: The channels.
        period: Period of the machine, in seconds.
        late: The largest number of periods by which they are late.
    """

    def on_side(side: str, channels: list[str]) -> SearchStrategy[InjectedFault]:
        some = st.just(()) | st.sampled_from(channels).map(lambda channel: (channel,))
        kinds: list[tuple[type[InjectedFault], dict[str, SearchStrategy[Any]]]] = [
            (Drop, {"fraction": st.sampled_from([1.0, 0.3])}),
            (Delay, {"seconds": st.integers(0, late).map(lambda cycles: cycles * period)}),
            (Duplicate, {"copies": st.integers(1, 3)}),
            (Reorder, {}),
            (Freeze, {}),
            (Corrupt, {"kind": st.sampled_from(list(CORRUPTIONS))}),
        ]
        return st.one_of(*(st.builds(kind, side=st.just(side), channels=some, **options) for kind, options in kinds))

    sides = {SENSE: [map.channel for map in protocol.sense], ACT: [map.channel for map in protocol.act]}
    return st.one_of(*(on_side(side, channels) for side, channels in sides.items() if channels))
