"""Assertions about motions, logs and loops: each names the first offending time and address, and writes a plot."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from math import ceil, inf, log
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.campaigns.results import least_rate
from vtbdrake.common.argument_checks import as_addresses, as_array
from vtbdrake.common.failures import error_text
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.statistics import QUANTITIES, LoopStatistics
from vtbdrake.control.stepping import ChangeKind
from vtbdrake.control.switching import checked_continuity
from vtbdrake.machine import MachineStatistics
from vtbdrake.recording.cycle_replay import Target
from vtbdrake.recording.log_reader import ControlLog, read_log
from vtbdrake.recording.replay import replay as replay_log
from vtbdrake.testbed import Signal
from vtbdrake.testbed.switch import Position
from vtbdrake.testing.failure import fail
from vtbdrake.testing.trace import ENERGY, Source, Trace, TraceError, trace_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def assert_bounded(
    source: Source, address: str, *, lower: ArrayLike = -inf, upper: ArrayLike = inf, after: float = 0.0
) -> None:
    """Assert that a value stays within bounds. NaN is out of any bounds.

    Args:
        source: A trace, a rollout or a log, see `trace_of`.
        address: Address of the value.
        lower: The lower bound in the value's unit, a scalar or an array of its shape.
        upper: The upper bound, likewise.
        after: Time in seconds, from the first sample on, before which nothing is asserted.

    Raises:
        AssertionError: It leaves its bounds.
        ValueError: There are no bounds, or of another shape, or there is no sample.
    """
    __tracebackhide__ = True
    trace = trace_of(source, address)
    values = trace[address]
    asserted = _from(trace, address, after)
    lows, highs = _each(f"lower of {address}", lower, values), _each(f"upper of {address}", upper, values)
    if (lows == -inf).all() and (highs == inf).all():
        raise ValueError(f"give lower= or upper= of {address}: nothing is asserted without bounds")
    place = _first(~((values >= lows) & (values <= highs)), asserted)
    if place is None:
        return
    value, low, high = values[place], float(lows[place[1:]]), float(highs[place[1:]])
    limit = f"at least {low:.6g}" if value < low else f"at most {high:.6g}" if value > high else "a number"
    fail(
        f"{_named(address, place)} leaves its bounds at {_when(trace, place)}: {value:.6g}{_unit(trace, address)} "
        f"instead of {limit}",
        name="bounded",
        draw=lambda axes: _draw(axes, trace, address, place, levels=(low, high)),
    )


def assert_settles(source: Source, address: str, *, to: ArrayLike, within: float, tolerance: ArrayLike) -> None:
    """Assert that a value has come close to a target by some time, and stays there.

    Args:
        source: A trace, a rollout or a log, see `trace_of`.
        address: Address of the value.
        to: The target, a scalar or an array of the value's shape.
        within: Time in seconds, from the first sample on, from which the value has to be there.
        tolerance: The largest difference, a scalar or an array.

    Raises:
        AssertionError: It is elsewhere at some later time.
        ValueError: The source ends before, or target or tolerance have another shape.
    """
    __tracebackhide__ = True
    trace = trace_of(source, address)
    values = trace[address]
    asserted = _from(trace, address, within)
    targets, margins = _each(f"to of {address}", to, values), _each(f"tolerance of {address}", tolerance, values)
    place = _first(~(np.abs(values - targets) <= margins), asserted)
    if place is None:
        return
    target, margin = float(targets[place[1:]]), float(margins[place[1:]])
    fail(
        f"{_named(address, place)} has not settled at {_when(trace, place)}: {values[place]:.6g}"
        f"{_unit(trace, address)} instead of {target:.6g} +- {margin:.6g} from {within:g} s on",
        name="settles",
        draw=lambda axes: _draw(axes, trace, address, place, levels=(target - margin, target + margin)),
    )


def assert_energy_never_rises(source: Source, address: str = ENERGY, *, tolerance: float = 0.0) -> None:
    """Assert that an energy never rises above a level to which it has fallen before.

    Args:
        source: A trace, a rollout or a log, see `trace_of`; `simulate` records the `ENERGY` of the plant.
        address: Address of the energy, a scalar.
        tolerance: The largest rise in J. An integrator makes some: measure it in a motion that conserves energy. What
            bodies in compliant contact store is no part of the plant's energy.

    Raises:
        AssertionError: It rises.
    """
    __tracebackhide__ = True
    trace = trace_of(source, address)
    energy = trace[address].reshape(len(trace.times), -1)
    if energy.shape[1] != 1:
        raise TraceError(f"an energy is one number, but {address} has {energy.shape[1]}")
    energy = energy[:, 0]
    least = np.minimum.accumulate(energy)
    place = _first(~(energy - least <= tolerance), np.ones(len(energy), bool))
    if place is None:
        return
    before = int(np.argmin(energy[: place[0] + 1]))
    fail(
        f"{address} rises: {energy[place]:.6g} J at {_when(trace, place)}, after {least[place]:.6g} J at t = "
        f"{trace.times[before]:.6g} s; a rise of {tolerance:g} J is allowed",
        name="energy",
        draw=lambda axes: _draw(axes, trace, address, place, levels=(float(least[place]) + tolerance,)),
    )


def assert_same_motion(
    source: Source,
    reference: Source,
    addresses: str | Sequence[str],
    *,
    tolerance: float | Mapping[str, ArrayLike] = 0.0,
) -> None:
    """Assert that two motions are the same, by default to the last bit.

    Args:
        source: A trace, a rollout or a log, see `trace_of`.
        reference: What it should be, with the same sample times.
        addresses: The addresses that are compared.
        tolerance: The largest difference; or by address, where the others must be the same to the last bit.

    Raises:
        AssertionError: They differ.
        TraceError: They are not sampled at the same times.
    """
    __tracebackhide__ = True
    addresses = as_addresses("what is compared", addresses)
    trace, other = trace_of(source, addresses), trace_of(reference, addresses)
    count = min(len(trace.times), len(other.times))
    if not np.allclose(trace.times[:count], other.times[:count], rtol=0.0, atol=1e-9):
        raise TraceError("two motions are compared at the same times, but these have other sample times")
    firsts: list[tuple[tuple[int, ...], str]] = []
    for address in addresses:
        a, b = trace[address][:count], other[address][:count]
        if a.shape != b.shape:
            raise TraceError(f"{address} has the shape {a.shape[1:]} in one motion, and {b.shape[1:]} in the other")
        allowed = tolerance.get(address, 0.0) if isinstance(tolerance, Mapping) else tolerance
        allowed = _each(f"tolerance of {address}", allowed, a)
        same = (np.abs(a - b) <= allowed) | (a == b) | (np.isnan(a) & np.isnan(b))
        if (place := _first(~same, np.ones(count, bool))) is not None:
            firsts.append((place, address))
    if firsts:
        place, address = min(firsts)
        a, b = trace[address][place], other[address][place]
        fail(
            f"{_named(address, place)} differs first at {_when(trace, place)}: {a!r} instead of {b!r}, a difference of "
            f"{abs(a - b):.3g}{_unit(trace, address)}",
            name="same_motion",
            draw=lambda axes: _draw(axes, trace, address, place, reference=other),
        )
    if len(trace.times) != len(other.times):
        ends = f"{trace.times[-1]:.6g} s, and the other at {other.times[-1]:.6g} s"
        fail(f"the motions are the same as far as both go, but one ends at t = {ends}", name="same_motion")


def assert_continuous_at_switch(
    log: ControlLog | str | os.PathLike[str], *, at_most: Mapping[str, ArrayLike] | None = None
) -> None:
    """Assert that no command jumped where switches were thrown while the loop was recorded.

    Where an actuator signal goes to real, its first sent command is compared with the sensor signal that tells what
    acts there, see ``continuity`` of the scenario's `Deployment`. Where another switch is thrown while it is on real,
    it is compared with the command before; and so is the second command, since a DPS that samples answers late.

    Args:
        log: A log, or the path of its file.
        at_most: The largest difference by actuator signal, a scalar or one per entry. By default, the largest one of
            the deployment where a signal goes to real; else what the rate of the signal allows in a period.

    Raises:
        AssertionError: A command jumped.
        ValueError: The log has no switch, or an actuator signal has no largest difference.
    """
    __tracebackhide__ = True
    log = log if isinstance(log, ControlLog) else read_log(log)
    for signal, cycle, reference, source, limit in _continued_commands(log, at_most or {}):
        sent = log.sent[signal.name][cycle]
        gap = np.abs(sent - reference)  # NaN if nothing was sent.
        if (wrong := np.flatnonzero(gap > limit * (1.0 + 1e-9))).size:
            k, address = int(wrong[0]), f"sent.{signal.name}"
            trace = trace_of(log, address)
            fail(
                f"{address}[{k}] jumps where a switch is thrown, at {_when(trace, (cycle,))}: {sent[k]:.6g} is "
                f"{gap[k]:.3g} {signal.unit} away from {source}; {limit[k]:.3g} is allowed",
                name="continuous_at_switch",
                draw=partial(_draw, trace=trace, address=address, place=(cycle, k)),
            )


def _continued_commands(
    log: ControlLog, at_most: Mapping[str, ArrayLike]
) -> Iterator[tuple[Signal, int, np.ndarray, str, np.ndarray]]:
    """Yield the commands that have to continue something, because a switch was thrown.

    Each is an actuator signal, the index of a cycle, what the command of that cycle continues, where that comes from,
    and the largest difference of each entry.
    """
    scenario = log.scenario
    interface = scenario.interface()
    continuity = checked_continuity(interface, scenario.deployment().continuity, period=log.header.period)
    switches = [(i, change.values) for i, change in log.changes if change.kind == ChangeKind.SWITCH]
    if not switches:
        raise ValueError(f"{log.path} has no switch: nothing is asserted")
    for i, positions in switches:
        for signal in filter(lambda signal: signal.is_vector, interface.act):
            name, sent = signal.name, log.sent[signal.name]
            step = signal.vector(signal.rate) * log.header.period
            steady = signal.vector(at_most[name]) if name in at_most else step if np.isfinite(step).all() else None
            if i > 0 and np.isfinite(sent[i - 1]).all():
                if steady is None:
                    raise ValueError(
                        f"the rate of {name} is not limited: give at_most={{{name!r}: largest difference}}"
                    )
                yield signal, i, sent[i - 1], "the command before", steady
            elif name in continuity and positions.get(f"act.{name}", Position.SIM) != Position.SIM:
                sensor, largest = continuity[name]
                departure = largest + np.where(np.isfinite(step), step, 0.0)
                limit = signal.vector(at_most[name]) if name in at_most else departure
                yield signal, i, log.fed[sensor][i], f"sense.{sensor}", limit
            else:
                continue  # It stays on sim, or it may jump, as the deployment says.
            if i + 1 < len(sent) and steady is not None:
                # A DPS that samples may answer in the next cycle only.
                yield signal, i + 1, sent[i], "the command before", steady


def assert_succeeds(
    trials: Iterable[bool] | Callable[[int], object], *, rate: float, confidence: float = 0.95, count: int | None = None
) -> None:
    """Assert that trials succeed at some rate at least, with some confidence.

    The rate is at least the lower limit of Clopper and Pearson's one-sided interval. That all of n trials succeed shows
    a rate r with the confidence c only if n >= log(1 - c) / log(r): 29 trials for 0.9 with 95 %.

    Args:
        trials: The outcomes, True for success; or a function of the number of the trial (its seed, say), which fails by
            an AssertionError or by returning False, and succeeds by returning True or nothing.
        rate: The rate that has to be shown, between 0 and 1.
        confidence: The confidence, between 0 and 1.
        count: Number of calls of the function; by default twice the number of trials that all have to succeed.

    Raises:
        AssertionError: The rate is not shown.
        ValueError: Not even success in all trials would show it, or an outcome is neither True nor False.
    """
    __tracebackhide__ = True
    if not (0.0 < rate < 1.0 and 0.0 < confidence < 1.0):
        raise ValueError(f"a rate and a confidence lie between 0 and 1, not at {rate} and {confidence}")
    least = ceil(log(1.0 - confidence) / log(rate) - 1e-9)
    reasons: dict[int, str] = {}
    outcomes = []
    if callable(trials):
        for number in range(2 * least if count is None else count):
            try:
                returned = trials(number)
            except AssertionError as error:
                outcomes.append(False)
                reasons.setdefault(number, error_text(error))
            else:
                outcomes.append(True if returned is None else _as_outcome(returned))
    else:
        outcomes = [_as_outcome(outcome) for outcome in trials]
    if len(outcomes) < least:
        raise ValueError(
            f"{len(outcomes)} trials cannot show a rate of {rate:g} with {confidence:.4g} confidence, even if all "
            f"succeed: {least} are needed"
        )
    successes = sum(outcomes)
    shown = least_rate(successes, len(outcomes), confidence)
    if shown >= rate:
        return
    failed = [number for number, outcome in enumerate(outcomes) if not outcome]
    first = f", such as number {failed[0]}" if failed else ""
    because = f": {reasons[failed[0]]}" if failed and failed[0] in reasons else ""
    fail(
        f"{successes} of {len(outcomes)} trials succeed: that shows a rate of {shown:.3f} with {confidence:.4g} "
        f"confidence, not {rate:g}; {len(failed)} fail{first}{because}",
        name="succeeds",
    )


def _as_outcome(value: object) -> bool:
    outcome = value.item() if isinstance(value, np.ndarray | np.generic) and value.size == 1 else value
    if isinstance(outcome, int) and outcome in (0, 1):
        return bool(outcome)
    raise ValueError(f"the outcome of a trial is True or False, not {value!r}")


def assert_replays(log: ControlLog | str | os.PathLike[str], *, target: Target | None = None) -> None:
    """Assert that the DPS of today does in a replay what is in a log, bit for bit: a log is a golden test.

    Args:
        log: A log, or the path of its file.
        target: See `replay`; by default the recorded one.

    Raises:
        AssertionError: A command, the time or a digest of the state differs, or the log is not whole.
        LogError: The file is no log, or its scenario has changed since.
    """
    __tracebackhide__ = True
    log = log if isinstance(log, ControlLog) else read_log(log)
    report = replay_log(log, target)
    if report.identical:
        return
    versions = "".join(f"\n{line}" for line in report.versions)
    difference = report.first_difference
    if difference is None:
        fail(f"{log.path} is not replayed as a whole: {report.ended}{versions}", name="replays")
    draw = None
    if difference.subject in log.actuation:
        address = f"act.{difference.subject}"
        recorded = trace_of(log, address)
        replayed = Trace(report.times, {address: report.actuation[difference.subject]}, recorded.units)
        at = int(np.flatnonzero(log.numbers == difference.cycle)[0])

        def draw_difference(axes: Axes) -> None:
            _draw(axes, replayed, address, (at, 0), reference=recorded)

        draw = draw_difference
    fail(f"{log.path} replays differently: {difference}{versions}", name="replays", draw=draw)


def assert_cycle_budget(
    source: Runtime | LoopStatistics | MachineStatistics,
    *,
    at_most: float,
    percentile: float = 99.0,
    of: str = "cycle",
    against: Runtime | LoopStatistics | MachineStatistics | None = None,
) -> None:
    """Assert that the cycles of a loop take at most some share of their period.

    Args:
        source: A loop, or its statistics.
        at_most: The largest ratio of a cycle's time to the period.
        percentile: The share of the cycles that has to keep it, in percent.
        of: What is measured: ``cycle``, ``step`` (of the DPS alone) or ``lateness``.
        against: Another loop, measured beside it on the same computer: the ratio is to its percentile, instead of to
            the period. Such a ratio does not depend on how fast the computer is today.

    Raises:
        AssertionError: They take longer.
        ValueError: There are no cycles.
    """
    __tracebackhide__ = True
    if of not in QUANTITIES:
        raise ValueError(f"a loop's statistics have {', '.join(QUANTITIES)}, not {of!r}")
    statistics = _statistics(source)
    measured = statistics.histograms[of].percentile(percentile)
    reference = statistics.period if against is None else _statistics(against).histograms[of].percentile(percentile)
    name = "its period" if against is None else "the other loop's"
    ratio = measured / reference
    if not ratio <= at_most:
        fail(
            f"{percentile:g} % of the loop's {statistics.cycles} cycles have a {of} of up to {1e6 * measured:.0f} us, "
            f"{ratio:.3g} times {name} of {1e6 * reference:.0f} us; {at_most:g} times is allowed\n{statistics}",
            name="cycle_budget",
        )


def _statistics(source: Runtime | LoopStatistics | MachineStatistics) -> LoopStatistics:
    statistics = source.statistics if isinstance(source, Runtime) else source
    statistics = statistics.loop if isinstance(statistics, MachineStatistics) else statistics
    if not statistics.cycles:
        raise ValueError("the loop has run no cycle: nothing is asserted")
    return statistics


def _from(trace: Trace, address: str, after: float) -> np.ndarray:
    """Return a mask (n,) of the samples with a value, at least ``after`` seconds behind the first one."""
    asserted = trace.times - trace.times[:1] >= after - 1e-9
    if address in trace.absent:
        asserted = asserted & ~trace.absent[address]
    if not asserted.any():
        raise TraceError(f"{address} has no value {after:g} s after the first sample, or later: nothing is asserted")
    return np.asarray(asserted)


def _first(wrong: np.ndarray, asserted: np.ndarray) -> tuple[int, ...] | None:
    """Return the index of the first sample and entry that is wrong, or None."""
    wrong = wrong & asserted.reshape(-1, *[1] * (wrong.ndim - 1))
    place = np.argwhere(wrong)
    return tuple(place[0].tolist()) if len(place) else None


def _each(name: str, bound: ArrayLike, values: np.ndarray) -> np.ndarray:
    """Return a number, or an array, as one number for each entry of a value, in its shape.

    Args:
        name: The argument's name, for the error message.
        bound: The number or the array.
        values: The samples of the value; the first axis is time.

    Raises:
        ValueError: It has no number for each entry.
    """
    numbers, shape = as_array(name, bound), values.shape[1:]
    try:
        return np.broadcast_to(numbers, shape)
    except ValueError:
        each = f"a number, or an array of its shape {shape}" if shape else "a number"
        raise ValueError(f"{name} has the shape {numbers.shape}; {each} is expected") from None


def _named(address: str, place: tuple[int, ...]) -> str:
    return f"{address}[{', '.join(map(str, place[1:]))}]" if len(place) > 1 else address


def _when(trace: Trace, place: tuple[int, ...]) -> str:
    return f"t = {trace.times[place[0]]:.6g} s"


def _unit(trace: Trace, address: str) -> str:
    unit = trace.units.get(address, "1")
    return "" if unit in ("", "1") or "," in unit else f" {unit}"


def _draw(
    axes: Axes,
    trace: Trace,
    address: str,
    place: tuple[int, ...],
    levels: Iterable[float] = (),
    reference: Trace | None = None,
) -> None:
    """Draw the entry that is wrong over time, what was expected, and the first offending time."""
    from vtbdrake.visualization.plots import FAILED, THRESHOLD, label

    entry: Any = (slice(None), *place[1:])
    name = _named(address, place)
    if reference is not None:
        axes.plot(reference.times, reference[address][entry], color=THRESHOLD, ls=(0, (4, 2)), label="expected")
    axes.plot(trace.times, trace[address][entry], lw=1.4, label=name)
    for level in levels:
        if np.isfinite(level):
            axes.axhline(level, color=THRESHOLD, lw=1, ls=(0, (4, 2)))
    value: Any = trace[address][entry][place[0]]
    axes.axvline(trace.times[place[0]], color=FAILED, lw=0.8)
    axes.plot(trace.times[place[0]], value, "x", color=FAILED, ms=8, mew=2)
    axes.set(xlabel="time t [s]", ylabel=label(name, trace.units.get(address, "")))
    axes.set_title(f"first at {_when(trace, place)}")
    if reference is not None:
        axes.legend(fontsize="small")
