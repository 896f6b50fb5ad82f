"""The steps of a replay: the DPS in the recorded state gets, cycle by cycle, what it got in the recorded run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from vtbdrake.common.failures import FAILURES
from vtbdrake.control.stepping import Change, ChangeKind, RealPorts, numeric_parameters, time_after
from vtbdrake.control.switching import throw
from vtbdrake.lcm.maps import Decoder
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.recording.log_format import TESTBED, LogError, target_kind
from vtbdrake.recording.log_reader import ControlLog
from vtbdrake.state import Snapshot, SnapshotError
from vtbdrake.testbed import DpsAlone, VirtualTestbed, slow_parts
from vtbdrake.testbed.switch import COMMAND, T_ACT, T_SENSE, Position

Target = VirtualTestbed | DpsAlone

_TICK = "tick"  # key of a sample's number in a result of a slow part
_BLOCK = 4096  # cycles that are read from the log together


class CycleReplay:
    """A replay cycle by cycle, up to the first gap. The log is read a block of cycles at a time.

    Args:
        log: The log.
        target: The testbed or DPS that is stepped.
        values: Values of variables by address, which replace the recorded ones from the beginning on.

    Attributes:
        same_kind: Whether the target is of the recorded kind, testbed or DPS alone.
        context: The context of the target, always the same one.
        index: The number of cycles that have been replayed; ``count`` of them can be.
        ended: Why not all cycles of the recorded run can be replayed; empty if all can.
    """

    def __init__(self, log: ControlLog, target: Target, values: dict[str, Any]) -> None:
        header = log.header
        self.same_kind = target_kind(target) == header.target
        self._log, self._target, self._values = log, target, values
        self.context = context = target.default_context()
        _restore(log, target, context)
        target.write(context, values)
        self._simulator = self._new_simulator(restored=header.initialized)
        # Keep alive: stops pydrake from re-wrapping the parameters in every step.
        self._parameters = numeric_parameters(target.diagram, context)
        self._ports = RealPorts(target, context)
        self._slow_parts = slow_parts(target.diagram)
        self._idle, self._steps = header.idle, header.steps
        self._decoders = _abstract_decoders(log, target)
        self._changes: dict[int, list[Change]] = {}
        for i, change in log.changes:
            self._changes.setdefault(i, []).append(change)
        self._handlers: dict[str, Callable[[Mapping[str, Any]], None]] = {
            ChangeKind.WRITE: self._write,
            ChangeKind.SWITCH: self._switch,
            # The guards are not replayed: the sent actuator commands are in the log.
            ChangeKind.RESET: lambda values: None,
            ChangeKind.RESULT: self._deliver,
        }
        self.index = 0
        self.count = int(np.searchsorted(log.numbers, log.gaps[0].first)) if log.gaps else len(log)
        self.ended = f"the replay ends where the log lacks {log.gaps[0]}" if log.gaps else ""
        self._now, self._next = self._time(self._steps), self._time(self._steps + 1)
        # The block that has been read: its cycles, where each vector signal has a new value that must be fed, its name
        # and its values; and the events with the values of the abstract signals.
        self._first = self._last = 0
        self._vectors: list[tuple[list[bool], str, np.ndarray]] = []
        self._messages: list[tuple[list[int], str, Callable[[int], Any]]] = []
        # The signals that have had a value before the block, where they have new ones in it, and the event with the
        # newest value of each abstract signal.
        self._fed: set[str] = set()
        self._new: dict[str, np.ndarray] = {}
        self._events: dict[str, int] = {}

    def _new_simulator(self, *, restored: bool) -> Simulator:
        simulator = self._target.simulator(self.context, restored=restored)
        simulator.set_target_realtime_rate(0.0)
        return simulator

    def _time(self, steps: int) -> float:
        return time_after(steps, start=self._log.header.start_time, period=self._log.header.period)

    def advance(self) -> None:
        """Replay the next cycle."""
        if self.index >= self._last:
            self._read_block()
        i, feed = self.index - self._first, self._ports.feed
        for changed, name, values in self._vectors:
            if changed[i]:
                feed(name, values[i])
        for events, name, decode in self._messages:
            if event := events[i]:
                feed(name, decode(event))
                self._events[name] = event
        # After the feed: a switch may let the DPS see it.
        for change in self._changes.get(self.index, ()):
            self._apply(change)
        if not self._idle:
            self._step()
        self.index += 1

    def _read_block(self) -> None:
        """Read the block that begins with the next cycle."""
        log, first = self._log, self.index
        self._fed = self._fed_before(first)
        self._first, self._last = first, min(first + _BLOCK, self.count)
        fed, sources = log.fed_in(first, self._last)
        before, _ = log.fed_in(max(first - 1, 0), first)
        self._new = {name: sources[name] != 0 for name in fed}
        self._vectors = []
        for name, values in fed.items():
            last = before[name][-1] if name in self._fed else None
            self._vectors.append((_changed(values, self._new[name], last).tolist(), name, values))
        self._messages = [(sources[name].tolist(), name, decode) for name, decode in self._decoders.items()]

    def _fed_before(self, index: int) -> set[str]:
        """Return the vector signals that have had a value before a cycle of the block."""
        return self._fed | {name for name, new in self._new.items() if new[: index - self._first].any()}

    def _step(self) -> None:
        try:
            self._simulator.AdvanceTo(self._next)
            self._steps += 1
            self._now, self._next = self._next, self._time(self._steps + 1)
            self._evaluate()
        except FAILURES as error:
            self._fail(error)

    def _evaluate(self) -> None:
        """Evaluate what is compared after a step."""

    def _fail(self, error: BaseException) -> None:
        """Note an exception of the DPS. The loop had the same one, and went on without actuator commands."""

    def _find_outputs(self) -> None:
        """Find out what is evaluated after a step; a switch changes it."""

    def state(self) -> Snapshot:
        """Return the present state of the replay, for `go_to`."""
        notes: dict[str, Any] = {"cycles": self.index, "steps": self._steps, "idle": self._idle}
        notes |= {"fed": sorted(self._fed_before(self.index)), "events": dict(self._events)}
        return replace(self._target.snapshot(self.context), notes=notes)

    def go_to(self, state: Snapshot) -> None:
        """Stand again where the replay, or another one of the log, has stood."""
        log, notes = self._log, state.notes
        self.index, self._steps, self._idle = notes["cycles"], notes["steps"], notes["idle"]
        self._target.restore(self.context, state)
        self._simulator = self._new_simulator(restored=log.header.initialized or self._steps > log.header.steps)
        self._fed, self._new, self._events = set(notes["fed"]), {}, dict(notes["events"])
        newest, _ = log.fed_in(max(self.index - 1, 0), self.index)
        for name in self._fed:
            self._ports.feed(name, newest[name][-1])
        for name, event in self._events.items():
            self._ports.feed(name, self._decoders[name](event))
        self._first = self._last = self.index
        self._now, self._next = self._time(self._steps), self._time(self._steps + 1)
        self._find_outputs()

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
        self._target.write(self.context, {a: value for a, value in values.items() if a in self._target.variables()})
        self._target.write(self.context, self._values)

    def _switch(self, values: Mapping[str, Any]) -> None:
        if self.same_kind and isinstance(self._target, VirtualTestbed):
            sides: dict[str, dict[str, str]] = {"sense": {}, "act": {}}
            for name, position in values.items():
                side, _, signal = name.partition(".")
                sides[side][signal] = position
            throw(self._target, self.context, sides["sense"], sides["act"])
        elif isinstance(self._target, VirtualTestbed):
            self._target.switch(self.context, "real")
        self._idle = False
        self._find_outputs()

    def _deliver(self, values: Mapping[str, Any]) -> None:
        for path, result in values.items():
            arrays = {name: np.asarray(array) for name, array in result.items() if name != _TICK}
            self._slow_parts[path].deliver(self.context, result[_TICK], arrays)


def bit_patterns(values: np.ndarray) -> np.ndarray:
    """Return the bit patterns of floats, by which values are compared to the last bit, NaN among them."""
    return np.ascontiguousarray(values, dtype=float).view(np.uint64)


def _changed(values: np.ndarray, new: np.ndarray, before: np.ndarray | None) -> np.ndarray:
    """Return a mask of the new values of a vector signal with other bits than before: only these must be fed.

    Args:
        values: Its values in some cycles, shape (n, size).
        new: Where they are new, shape (n,).
        before: The value before them; None if there was none.
    """
    bits = bit_patterns(values)
    differs = np.ones(len(bits), bool)
    differs[1:] = (bits[1:] != bits[:-1]).any(axis=1)
    if before is not None:
        differs[:1] = (bits[:1] != bit_patterns(before)).any(axis=1)
    elif new.any():
        differs[np.argmax(new)] = True
    return np.asarray(new & differs)


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


def _abstract_decoders(log: ControlLog, target: Target) -> dict[str, Callable[[int], Any]]:
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
    places = log.events.places(channel)
    # The last one of equal numbers counts, which only a damaged log has.
    order = np.argsort(places[:, 0], kind="stable")
    numbers = places[order, 0]

    def decode(event: int) -> Any:
        at = int(np.searchsorted(numbers, event, side="right")) - 1
        if at < 0 or numbers[at] != event:
            raise LogError(f"{log.path} lacks the message with the value of {name}, event {event} on {channel}")
        return decoder(log.events.data(*places[order[at], 2:].tolist()))[1][name]

    return decode
