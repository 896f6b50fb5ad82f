"""Replay of a log: the DPS repeats its recorded behaviour bit for bit."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from vtbdrake.control.stepping import (
    Change,
    ChangeKind,
    RealPorts,
    numeric_parameters,
    time_after,
)
from vtbdrake.control.switching import throw
from vtbdrake.failures import FAILURES, error_text
from vtbdrake.lcm.maps import Decoder
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.recording.log_format import DPS, TESTBED, LogError, installed_versions, target_kind
from vtbdrake.recording.log_reader import ControlLog, read_log
from vtbdrake.recording.recorder import StateDigest
from vtbdrake.state import Snapshot, SnapshotError
from vtbdrake.testbed import DpsAlone, VirtualTestbed, slow_parts
from vtbdrake.testbed.addressed import AddressedDiagram
from vtbdrake.testbed.interrupt import Interruptible
from vtbdrake.testbed.switch import COMMAND, T_ACT, T_SENSE, Position

IDENTICAL, DIFFERENT, NOT_COMPARED = "identical", "different", "not compared"

Target = VirtualTestbed | DpsAlone

_TICK = "tick"  # key of a sample's number in a result of a slow part
_KEPT_PERIOD, _MOST_KEPT = 1.0, 500  # s between two states that are kept, and how many


class Difference(NamedTuple):
    """A difference between a replay and its log.

    It has the number of the cycle, the DPS's time after it in seconds, the ``subject`` that differs (an actuator
    signal, ``time``, or ``state`` by its digest), and what was recorded and replayed.
    """

    cycle: int
    time: float
    subject: str
    recorded: Any
    replayed: Any

    def __str__(self) -> str:
        return f"{self.subject} in cycle {self.cycle} (t = {self.time:g} s): {self.replayed} instead of {self.recorded}"


@dataclass(frozen=True, eq=False)
class ReplayReport:
    """The outcome of a replay; n is the number of cycles that were replayed."""

    # ``identical`` (every actuator command, the time after every cycle and every digest, to the last bit),
    # ``different``, or ``not compared`` (the replay had other values)
    outcome: str
    cycles: int  # number of replayed cycles
    ended: str  # why not all cycles of the recorded run were replayed, or may be missing; empty if all were
    first_difference: Difference | None  # the first difference; None if there is none
    # largest absolute difference by vector actuator signal; inf where an actuator command is missing on one side or not
    # finite
    max_difference: Mapping[str, float]
    digests: int  # number of digests of the DPS's state that were compared
    # the software whose version differs from the recorded one; results may differ for that reason
    versions: tuple[str, ...]
    times: np.ndarray  # times of the DPS at the ends of the cycles, in seconds, (n,)
    # actuator commands of the DPS by vector signal, (n, size); NaN where there is none
    actuation: Mapping[str, np.ndarray]
    errors: Mapping[int, str]  # exceptions of the DPS, by the number of the cycle
    # recorded values at the ends of the cycles by address, (n, ...); a list, if they are not arrays
    record: Mapping[str, Any]

    @property
    def identical(self) -> bool:
        """Return whether the whole recorded run was replayed and everything is the same to the last bit."""
        return self.outcome == IDENTICAL and not self.ended

    def __str__(self) -> str:
        lines = [f"{self.cycles} cycles replayed, {self.digests} digests of the state: {self.outcome}"]
        if self.first_difference is not None:
            lines.append(f"the first difference: {self.first_difference}")
            lines += [f"{name}: up to {value:.3g}" for name, value in self.max_difference.items() if value]
        return "\n".join([*lines, *([self.ended] if self.ended else []), *self.versions])


def replay(
    log: ControlLog | str | os.PathLike[str],
    target: Target | None = None,
    *,
    values: Mapping[str, Any] | None = None,
    record: Sequence[str] = (),
) -> ReplayReport:
    """Replay a log and compare.

    The replay begins in the recorded state, feeds in every cycle what was fed, and steps as the loop did; the DPS's
    actuator commands, its time and the digests of its state must be the same to the last bit. A cycle in which the DPS
    raised raises again. The replay ends where cycles are missing in the log.

    Args:
        log: A log, or the path of its file.
        target: The testbed or DPS to step; by default the recorded one, built from the log's scenario. A `DpsAlone` can
            replay the log of a testbed whose sensor signals were all on real. A testbed can replay the log of a DPS
            alone; its simulated world is idle then.
        values: Values of variables by address, which replace the recorded ones from the beginning on, for example to
            find the commands with another gain. Nothing is compared then.
        record: Addresses of variables or output ports to be read after every cycle.

    Raises:
        OSError: The file cannot be read.
        LogError: The file is not a log, or is one of another scenario or of another version of it; the error lists the
            differences.
        AddressError: An address is unknown.
    """
    log = log if isinstance(log, ControlLog) else read_log(log)
    run = _Replay(log, target or _recorded_target(log), dict(values or {}), record)
    with Interruptible() as interruptible:
        while run.index < run.count:
            interruptible.raise_interrupt()
            run.advance()
    differences = run.differences()
    outcome = NOT_COMPARED if values else DIFFERENT if differences else IDENTICAL
    here = installed_versions()
    return ReplayReport(
        outcome=outcome,
        cycles=run.count,
        ended=run.ended or log.incomplete,
        first_difference=differences[0] if outcome == DIFFERENT else None,
        max_difference={} if values else _largest_differences(log, run.actuation),
        digests=len(run.digests),
        versions=tuple(
            f"recorded with {name} {version}, replayed with {here.get(name)}"
            for name, version in log.header.versions.items()
            if here.get(name) != version
        ),
        times=run.times,
        actuation=run.actuation,
        errors=run.errors,
        record={address: _stacked(samples) for address, samples in run.record.items()},
    )


def _stacked(samples: list[Any]) -> Any:
    return np.array(samples) if all(isinstance(sample, float | np.ndarray) for sample in samples) else samples


def _recorded_target(log: ControlLog) -> Target:
    scenario = log.scenario
    return DpsAlone(scenario) if log.header.target == DPS else scenario.build()


class _ReplayState(NamedTuple):
    """Where a replay stands: the cycles that it has replayed, the steps of the DPS, whether it idles, and its state."""

    cycles: int
    steps: int
    idle: bool
    snapshot: Snapshot


class _Replay:
    """A replay cycle by cycle, up to the first gap.

    Attributes:
        same_kind: Whether the target is of the recorded kind, testbed or DPS alone.
        errors: Exceptions of the DPS, by the number of the cycle.
        index: The number of cycles that have been replayed; ``count`` of them can be.
    """

    def __init__(self, log: ControlLog, target: Target, values: dict[str, Any], record: Sequence[str]) -> None:
        header = log.header
        self.same_kind = target_kind(target) == header.target
        self._log, self._target, self._values = log, target, values
        self._context = context = target.default_context()
        _restore(log, target, context)
        target.write(context, values)
        self._simulator = self._new_simulator(restored=header.initialized)
        # Keep alive: stops pydrake from re-wrapping the parameters in every step.
        self._parameters = numeric_parameters(target.diagram, context)
        self._ports = RealPorts(target, context)
        self._slow_parts = slow_parts(target.diagram)
        self._idle, self._steps = header.idle, header.steps
        self._digest = StateDigest(target, context)
        self._readers = {address: target.reader(address) for address in record}
        self._decoders = _abstract_decoders(log, target)
        # Where each vector sensor signal has a new value, its name, and its values.
        self._vectors = [
            (_changed(values, log.sources[name]).tolist(), name, values) for name, values in log.fed.items()
        ]
        self._changes: dict[int, list[Change]] = {}
        for i, change in log.changes:
            self._changes.setdefault(i, []).append(change)
        self._digested = {i for i, _ in log.digests}
        self._handlers: dict[str, Callable[[Mapping[str, Any]], None]] = {
            ChangeKind.WRITE: self._write,
            ChangeKind.SWITCH: self._switch,
            # The guards are not replayed: the sent actuator commands are in the log.
            ChangeKind.RESET: lambda values: None,
            ChangeKind.RESULT: self._deliver,
        }
        self.index = 0
        self.count = n = int(np.searchsorted(log.numbers, log.gaps[0].first)) if log.gaps else len(log)
        self.ended = f"the replay ends where the log lacks {log.gaps[0]}" if log.gaps else ""
        self.times = np.empty(n)
        self.actuation = {name: np.full((n, values.shape[1]), np.nan) for name, values in log.actuation.items()}
        self.commanded = {name: np.zeros(n, bool) for name in log.commanded}
        self.digests: list[tuple[int, bytes]] = []
        self.errors: dict[int, str] = {}
        self.record: dict[str, list[Any]] = {address: [] for address in record}
        self._now, self._next = self._time(self._steps), self._time(self._steps + 1)
        self._outputs: list[tuple[Callable[[Context], Any], np.ndarray | None, np.ndarray]] = []
        self._find_outputs()

    def _new_simulator(self, *, restored: bool) -> Simulator:
        simulator = self._target.simulator(self._context, restored=restored)
        simulator.set_target_realtime_rate(0.0)
        return simulator

    def _time(self, steps: int) -> float:
        return time_after(steps, start=self._log.header.start_time, period=self._log.header.period)

    def advance(self) -> None:
        """Replay the next cycle."""
        i, feed = self.index, self._ports.feed
        for changed, name, values in self._vectors:
            if changed[i]:
                feed(name, values[i])
        for name, decode in self._decoders.items():
            if event := self._log.sources[name][i]:
                feed(name, decode(event))
        # After the feed: a switch may let the DPS see it.
        for change in self._changes.get(i, ()):
            self._apply(change)
        if not self._idle:
            self._step(i)
        self.times[i] = self._now
        if i in self._digested:
            self.digests.append((i, self._digest()))
        for address, read in self._readers.items():
            self.record[address].append(read(self._context))
        self.index += 1

    def state(self) -> _ReplayState:
        """Return where the replay stands, for `go_to`."""
        return _ReplayState(self.index, self._steps, self._idle, self._target.snapshot(self._context))

    def go_to(self, state: _ReplayState) -> None:
        """Stand again where the replay has stood."""
        log, stepped = self._log, state.steps > self._log.header.steps
        self._target.restore(self._context, state.snapshot)
        self._simulator = self._new_simulator(restored=log.header.initialized or stepped)
        for name, values in log.fed.items():
            if log.sources[name][: state.cycles].any():
                self._ports.feed(name, values[state.cycles - 1])
        for name, decode in self._decoders.items():
            events = log.sources[name][: state.cycles]
            if events.any():
                self._ports.feed(name, decode(events[events != 0][-1]))
        self.index, self._steps, self._idle = state.cycles, state.steps, state.idle
        self._now, self._next = self._time(self._steps), self._time(self._steps + 1)
        self._find_outputs()

    @property
    def context(self) -> Context:
        """Return the context of the replay."""
        return self._context

    def _step(self, i: int) -> None:
        try:
            self._simulator.AdvanceTo(self._next)
            self._steps += 1
            self._now, self._next = self._next, self._time(self._steps + 1)
            for evaluate, values, commanded in self._outputs:
                value = evaluate(self._context)
                if values is not None:
                    values[i] = value
                commanded[i] = True
        except FAILURES as error:
            # The loop may have had the same exception and gone on without actuator commands: the comparison shows.
            self.errors[int(self._log.numbers[i])] = error_text(error)
            for _, values, commanded in self._outputs:
                commanded[i] = False
                if values is not None:
                    values[i] = np.nan

    def _find_outputs(self) -> None:
        """Find the output ports of the actuator signals that are on real."""
        self._outputs = [
            (
                self._target.diagram.GetOutputPort(f"real.act.{name}").Eval,
                self.actuation.get(name),
                self.commanded[name],
            )
            for name in (() if self._idle else self._ports.active())
        ]

    def differences(self) -> list[Difference]:
        """Return the first difference of every kind from the log, in the order of the cycles."""
        log, differences = self._log, []

        def look(subject: str, differs: np.ndarray, recorded: np.ndarray, replayed: np.ndarray) -> None:
            if differs.any():
                i = int(np.argmax(differs))
                differences.append(
                    Difference(int(log.numbers[i]), float(log.times[i]), subject, recorded[i], replayed[i])
                )

        n = len(self.times)
        look("time", log.times[:n] != self.times, log.times, self.times)
        for name, commanded in self.commanded.items():
            expected = log.commanded[name][:n]
            # Targets of different kinds have other switches: one may command where the other does not.
            differs = commanded != expected if self.same_kind else expected & ~commanded
            look(name, differs, log.commanded[name], commanded)
            if name in self.actuation:
                bits = (_bits(self.actuation[name]) != _bits(log.actuation[name][:n])).any(axis=1)
                look(name, commanded & expected & bits, log.actuation[name], self.actuation[name])
        digests = dict(log.digests)
        for i, digest in self.digests:
            if digest != digests[i]:
                both = digests[i].hex(), digest.hex()
                differences.append(Difference(int(log.numbers[i]), float(log.times[i]), "state", *both))
                break
        return sorted(differences, key=lambda difference: difference.cycle)

    # -- changes

    def _apply(self, change: Change) -> None:
        if change.kind not in self._handlers:
            raise LogError(
                f"the log has a change of the kind {change.kind!r}, which this version of vtbdrake does not know; it "
                f"knows {', '.join(self._handlers)}"
            )
        self._handlers[change.kind](change.values)

    def _write(self, values: Mapping[str, Any]) -> None:
        # The DPS alone has no variables of the simulated world.
        self._target.write(self._context, {a: value for a, value in values.items() if a in self._target.variables()})
        self._target.write(self._context, self._values)

    def _switch(self, values: Mapping[str, Any]) -> None:
        if self.same_kind and isinstance(self._target, VirtualTestbed):
            sides: dict[str, dict[str, str]] = {"sense": {}, "act": {}}
            for name, position in values.items():
                side, _, signal = name.partition(".")
                sides[side][signal] = position
            throw(self._target, self._context, sides["sense"], sides["act"])
        elif isinstance(self._target, VirtualTestbed):
            self._target.switch(self._context, "real")
        self._idle = False
        self._find_outputs()

    def _deliver(self, values: Mapping[str, Any]) -> None:
        for path, result in values.items():
            arrays = {name: np.asarray(array) for name, array in result.items() if name != _TICK}
            self._slow_parts[path].deliver(self._context, result[_TICK], arrays)


class RewindableReplay:
    """A replay that stands at any cycle of its log, and can be moved to another one.

    The state before some cycles is kept: going back continues from one of them. With an integrator with error control
    the DPS then differs from the recorded one by about its accuracy.

    Args:
        log: The log.
        testbed: A testbed of its scenario. If the log is of a DPS alone, its simulated world is idle.

    Attributes:
        log: The log.
        times: Times of the DPS at the ends of the cycles that can be replayed, in seconds, shape (n,).
        ended: Why not all cycles of the recorded run can be replayed; empty if all can.

    Raises:
        LogError: The log is of another scenario, or of another version of it; the error lists the differences.
    """

    def __init__(self, log: ControlLog, testbed: VirtualTestbed) -> None:
        self._replay = _Replay(log, testbed, {}, ())
        self.log = log
        self.times = log.times[: self._replay.count]
        self.ended = self._replay.ended or log.incomplete
        self._every = max(1, round(_KEPT_PERIOD / log.header.period))
        self._kept = [self._replay.state()]

    @property
    def context(self) -> Context:
        """Return the context of the replay, always the same one."""
        return self._replay.context

    @property
    def time(self) -> float:
        """Return the DPS's time, in seconds."""
        return float(self.context.get_time())

    @property
    def index(self) -> int:
        """Return the number of cycles before the present."""
        return self._replay.index

    @property
    def is_over(self) -> bool:
        """Return whether all cycles have been replayed."""
        return self._replay.index >= self._replay.count

    def advance(self) -> None:
        """Replay the next cycle."""
        index = self.index
        if index % self._every == 0 and index > self._kept[-1].cycles:
            self._kept.append(self._replay.state())
            if len(self._kept) > _MOST_KEPT:
                self._kept, self._every = self._kept[::2], 2 * self._every
        self._replay.advance()

    def go_to(self, index: int) -> None:
        """Go to where ``index`` cycles have been replayed."""
        index = min(max(index, 0), len(self.times))
        if index < self.index:
            self._replay.go_to([state for state in self._kept if state.cycles <= index][-1])
        while self.index < index:
            self.advance()


def _bits(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=float).view(np.uint64)


def _changed(values: np.ndarray, sources: np.ndarray) -> np.ndarray:
    """Return where a vector signal has a new value of other bits than before, which is all that must be fed."""
    bits, new = values.view(np.uint64), sources != 0
    new[1:] &= (bits[1:] != bits[:-1]).any(axis=1) | (np.cumsum(new)[1:] == 1)
    return new


def _largest_differences(log: ControlLog, actuation: Mapping[str, np.ndarray]) -> dict[str, float]:
    largest = {}
    for name, replayed in actuation.items():
        recorded = log.actuation[name][: len(replayed)]
        same = _bits(recorded) == _bits(replayed)
        with np.errstate(invalid="ignore"):
            apart = np.where(same, 0.0, np.abs(recorded - replayed))
        largest[name] = float(np.where(np.isnan(apart), np.inf, apart).max(initial=0.0))
    return largest


# -- the beginning


def _restore(log: ControlLog, target: Target, context: Context) -> None:
    """Bring a context of ``target`` into the state before the first recorded cycle."""
    log.header.check_scenario(target.scenario)
    if isinstance(target, DpsAlone) and log.header.target == TESTBED:
        _check_fed_by_machine(log)
    try:
        if isinstance(target, DpsAlone) or log.header.target == TESTBED:
            target.restore(context, log.start)
        else:
            _restore_dps(target, context, log.start)
            if not log.header.idle:  # It has been started before: there is no change of a switch in the log.
                target.write(context, dict.fromkeys(_switches(target), Position.REAL.number))
    except SnapshotError as error:
        raise LogError(f"the scenario is built in another way than the one of {log.path}: {error}") from error


def _restore_dps(testbed: VirtualTestbed, context: Context, start: Snapshot) -> None:
    """Restore the DPS and its commands u; the simulated world restarts."""
    snapshot = testbed.snapshot(context)
    groups = {key: value for key, value in start.groups.items() if key.partition("/")[0].split(".")[0] == "dps"}
    values = {address: value for address, value in start.values.items() if address.startswith("dps.")}
    testbed.restore(context, Snapshot(start.time, {**snapshot.values, **values}, {**snapshot.groups, **groups}))
    commands = [f"{COMMAND}{signal.name}" for signal in testbed.interface.commands]
    testbed.write(context, {a: start[a] for a in commands if a in testbed.variables()})


def _switches(testbed: VirtualTestbed) -> list[str]:
    """Return the addresses of all switches; as variables they can be thrown before anything feeds the real ports."""
    interface = testbed.interface
    return [*(f"{T_SENSE}{signal.name}" for signal in interface.sense), *(f"{T_ACT}{s.name}" for s in interface.act)]


def _check_fed_by_machine(log: ControlLog) -> None:
    positions = {f"sense.{name}": position for name, position in log.header.positions["sense"].items()}
    switched = [change.values for _, change in log.changes if change.kind == ChangeKind.SWITCH]
    for values in (positions, *switched):
        simulated = [
            name for name, position in values.items() if name.startswith("sense.") and position != Position.REAL
        ]
        if simulated:
            raise LogError(
                f"{', '.join(simulated)} came from the simulated world in {log.path}, which the DPS alone does not "
                "have: replay it through the testbed"
            )


def _abstract_decoders(log: ControlLog, target: AddressedDiagram) -> dict[str, Callable[[int], Any]]:
    """Return by abstract sensor signal a function from the number of a message's event to the signal's value."""
    signals = {signal.name: signal for signal in target.interface.sense}
    abstract = [name for name, signal in signals.items() if not signal.is_vector]
    if not abstract:
        return {}
    if target.scenario is None:
        raise LogError(f"the target has no scenario, whose protocol says how to decode {', '.join(abstract)}")
    decoders = {}
    for map in protocol_of(target.scenario).sense:
        decoder = map.decoder([signals[name] for name in map.signals])
        for name in map.signals:
            if name in abstract:
                decoders[name] = _message_decoder(log, map.channel, decoder, name)
    return decoders


def _message_decoder(log: ControlLog, channel: str, decoder: Decoder, name: str) -> Callable[[int], Any]:
    places = {number: (begin, end) for number, _, begin, end in log.events.on(channel)}

    def decode(event: int) -> Any:
        if event not in places:
            raise LogError(f"{log.path} lacks the message with the value of {name}, event {event} on {channel}")
        return decoder(log.events.data(*places[event]))[1][name]

    return decode
