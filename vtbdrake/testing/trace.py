"""What an assertion looks at: values over time, from a simulation, a rollout, a log or a loop."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.common.argument_checks import as_addresses, suggestion
from vtbdrake.control.stepping import time_after
from vtbdrake.recording.log_reader import ControlLog, read_log
from vtbdrake.recording.replay import replay
from vtbdrake.rollout import RolloutResult
from vtbdrake.testbed import DpsAlone, VirtualTestbed

ENERGY = "energy"
"""The address of the mechanical energy of the plant, kinetic and potential, in J."""


class TraceError(ValueError):
    """What an assertion should look at has not been recorded."""


@dataclass(frozen=True, eq=False)
class Trace:
    """Values over time.

    Attributes:
        times: Times in seconds, shape (n,).
        values: Values at these times by address, shape (n, ...).
        units: Units by address, where they are known.
        absent: By address, at which times there is no value, shape (n,): nothing was received yet, or nothing was
            commanded. Nothing is asserted there.
        log: The log of the loop that they come from, if there is one.
    """

    times: np.ndarray
    values: Mapping[str, np.ndarray]
    units: Mapping[str, str] = field(default_factory=dict)
    absent: Mapping[str, np.ndarray] = field(default_factory=dict)
    log: Path | None = None

    def __getitem__(self, address: str) -> np.ndarray:
        if address not in self.values:
            raise TraceError(f"{address} has not been recorded{suggestion(address, self.values)}")
        return self.values[address]


Source = Trace | RolloutResult | ControlLog | str | os.PathLike[str]
"""A trace, a rollout with ``record=``, or a log or its path; see `trace_of`."""


def trace_of(source: Source, addresses: str | Sequence[str]) -> Trace:
    """Return the values at some addresses over time.

    Args:
        source: A `Trace`; a rollout, whose problem has recorded the addresses; or a log (or its path). A log has
            ``sense.<signal>`` (what the DPS got), ``act.<signal>`` (what it commanded) and ``sent.<signal>`` (what
            left, after the guards); all other addresses are read in a replay.
        addresses: One address, or several.

    Raises:
        TraceError: An address has not been recorded.
        AssertionError: The rollout failed.
    """
    addresses = as_addresses("the addresses of a trace", addresses)
    if isinstance(source, RolloutResult):
        if source.failed:
            raise AssertionError(f"the rollout failed: {source.message}")
        source = Trace(source.times, {address: np.asarray(values) for address, values in source.record.items()})
    elif isinstance(source, ControlLog | str | os.PathLike):
        source = _of_log(source if isinstance(source, ControlLog) else read_log(source), addresses)
    for address in addresses:
        if np.shape(source[address])[:1] != source.times.shape or source[address].dtype.kind not in "biuf":
            raise TraceError(f"{address} is no number and no array: a trace has vectors only")
    return source


def _of_log(log: ControlLog, addresses: Sequence[str]) -> Trace:
    values: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    absent: dict[str, np.ndarray] = {}
    for side, recorded, signals in (
        ("sense", log.fed, log.header.sense),
        ("act", log.actuation, log.header.act),
        ("sent", log.sent, log.header.act),
    ):
        values |= {f"{side}.{name}": numbers for name, numbers in recorded.items()}
        units |= {f"{side}.{signal.name}": signal.unit for signal in signals}
        absent |= {f"{side}.{name}": np.isnan(numbers).all(axis=1) for name, numbers in recorded.items()}
    # NaN that was commanded is a value.
    absent |= {f"act.{name}": ~log.commanded[name] for name in log.actuation}
    others = [address for address in addresses if address not in values]
    if others:
        values |= replay(log, record=others).record
    return Trace(log.times, values, units, absent, log.path)


def reader_of(target: VirtualTestbed | DpsAlone, address: str) -> Callable[[Context], Any]:
    """Return a function that reads from any context what a trace records at an address.

    Args:
        target: The testbed, or the DPS alone.
        address: Address of a variable or an output port; `ENERGY` of the plant; ``sense.<signal>``, what the DPS gets
            at present, or ``act.<signal>``, what it commands, wherever the switches stand.

    Raises:
        AddressError: There is no such address.
        TraceError: The testbed has no plant, or the signal is abstract.
    """
    side, _, name = address.partition(".")
    signals = {"sense": target.interface.sense, "act": target.interface.act}.get(side, ())
    if signal := next((signal for signal in signals if signal.name == name), None):
        if not signal.is_vector:
            raise TraceError(f"{address} is abstract: a trace has vectors only")
        port = target.dps.GetInputPort(name) if side == "sense" else target.dps.GetOutputPort(name)
        unknown = np.full(port.size(), np.nan)

        def read_signal(root: Context) -> np.ndarray:
            context = target.dps.GetMyContextFromRoot(root)
            return np.array(port.Eval(context) if side == "act" or port.HasValue(context) else unknown)

        return read_signal
    if address != ENERGY:
        return target.reader(address)
    plant = getattr(target, "plant", None)
    if plant is None:
        raise TraceError(f"{target!r} has no plant, and so no energy: record the energy of your own systems by address")

    def read_energy(root: Context) -> float:
        context = plant.GetMyContextFromRoot(root)
        return float(plant.CalcKineticEnergy(context) + plant.CalcPotentialEnergy(context))

    return read_energy


def units_of(target: VirtualTestbed | DpsAlone, addresses: Sequence[str]) -> dict[str, str]:
    """Return the units of addresses, where they are known.

    Args:
        target: The testbed, or the DPS alone, to which the addresses belong.
        addresses: Addresses of variables and of signals, ``sense.<name>`` and ``act.<name>``.
    """
    interface, variables = target.interface, target.variables()
    units = {f"sense.{signal.name}": signal.unit for signal in interface.sense}
    units |= {f"act.{signal.name}": signal.unit for signal in interface.act} | {ENERGY: "J"}
    units |= {address: variables[address].unit for address in addresses if address in variables}
    return {address: units[address] for address in addresses if address in units}


def simulate(
    testbed: VirtualTestbed,
    seconds: float,
    *,
    record: str | Sequence[str],
    sample_period: float = 0.01,
    context: Context | None = None,
    values: Mapping[str, Any] | None = None,
) -> Trace:
    """Simulate a testbed, and return what was recorded.

    Args:
        testbed: The testbed.
        seconds: How long to simulate, in seconds.
        record: Addresses to record, see `reader_of`.
        sample_period: Time between two samples, in seconds.
        context: Where the simulation starts, and ends; by default a new default context. A context at a later time
            continues: no initialization event happens.
        values: Values of variables by address that are set before.
    """
    addresses = as_addresses("what is recorded", record)
    count = round(seconds / sample_period)
    if count < 1:
        raise ValueError(f"simulate for at least a sample period of {sample_period:g} s, not for {seconds:g} s")
    readers = [reader_of(testbed, address) for address in addresses]
    restored = context is not None and context.get_time() > 0.0
    context = testbed.default_context() if context is None else context
    testbed.write(context, values or {})
    simulator = testbed.simulator(context, restored=restored)
    if not restored:
        simulator.Initialize()
    start = context.get_time()
    times = np.array([time_after(k, start=start, period=sample_period) for k in range(count + 1)])
    samples = [[read(context) for read in readers]]
    for time in times[1:].tolist():
        simulator.AdvanceTo(time)
        samples.append([read(context) for read in readers])
    columns = {address: np.array([row[i] for row in samples]) for i, address in enumerate(addresses)}
    return Trace(times, columns, units_of(testbed, addresses))
