"""Replay of a log: the DPS repeats its recorded behaviour bit for bit."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from time import monotonic, thread_time
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from vtbdrake.common.closing import Closing
from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.control.stepping import (
    Change,
    ChangeKind,
    RealPorts,
    numeric_parameters,
    time_after,
)
from vtbdrake.control.switching import throw
from vtbdrake.drake_workarounds.lost_interrupts import Interruptible
from vtbdrake.lcm.maps import Decoder
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.recording.kept_states import KeptStates
from vtbdrake.recording.log_format import DPS, TESTBED, LogError, installed_versions, target_kind
from vtbdrake.recording.log_reader import ControlLog, read_log
from vtbdrake.recording.recorder import StateDigest
from vtbdrake.state import Snapshot, SnapshotError
from vtbdrake.testbed import DpsAlone, VirtualTestbed, slow_parts
from vtbdrake.testbed.switch import COMMAND, T_ACT, T_SENSE, Position

IDENTICAL = "identical"
DIFFERENT = "different"
NOT_COMPARED = "not compared"

Target = VirtualTestbed | DpsAlone

_TICK = "tick"  # key of a sample's number in a result of a slow part
_BLOCK = 4096  # cycles that are read from the log together

KEPT_WORK = 0.25
"""Processor time (s) that a replay takes from one kept state to the next: less than what a person waits for."""
_KEPT_SHARE = 4.0  # least processor time between two kept states, over the time that keeping one takes


class ReplayDifference(NamedTuple):
    """A difference between a replay and its log.

    It has the number of the cycle, the DPS's time after it in seconds, the ``subject`` that differs (an actuator
    signal, ``time``, or ``state`` by its digest), and what was recorded and replayed.

    Attributes:
        cycle: The number of the cycle.
        time: The DPS's time after the cycle, in seconds.
        subject: What differs: an actuator signal, ``time``, or ``state`` by its digest.
        recorded: The recorded value.
        replayed: The replayed value.
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
    """The outcome of a replay; n is the number of cycles that were replayed.

    Attributes:
        outcome: ``identical`` (every actuator command, the time after every cycle and every digest, to the last bit),
            ``different``, or ``not compared`` (the replay had other values).
        cycles: Number of replayed cycles.
        ended: Why not all cycles of the recorded run were replayed, or may be missing; empty if all were.
        first_difference: The first difference; None if there is none.
        max_difference: Largest absolute difference by vector actuator signal; inf where an actuator command is missing
            on one side or not finite.
        digests: Number of digests of the DPS's state that were compared.
        versions: The software whose version differs from the recorded one; results may differ for that reason.
        times: Times of the DPS at the ends of the cycles, in seconds, (n,).
        actuation: Actuator commands of the DPS by vector signal, (n, size); NaN where there is none.
        errors: Exceptions of the DPS, by the number of the cycle.
        record: Recorded values at the ends of the cycles by address, (n, ...); a list, if they are not arrays.
    """

    outcome: str
    cycles: int
    ended: str
    first_difference: ReplayDifference | None
    max_difference: Mapping[str, float]
    digests: int
    versions: tuple[str, ...]
    times: np.ndarray
    actuation: Mapping[str, np.ndarray]
    errors: Mapping[int, str]
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
    run = _ComparedReplay(log, target or _recorded_target(log), dict(values or {}), record)
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


class _Replay:
    """A replay cycle by cycle, up to the first gap. The log is read a block of cycles at a time.

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


class _ComparedReplay(_Replay):
    """A replay from beginning to end, with what is compared with the log.

    Attributes:
        times, actuation, commanded, digests, errors, record: See `ReplayReport`.
    """

    def __init__(self, log: ControlLog, target: Target, values: dict[str, Any], record: Sequence[str]) -> None:
        super().__init__(log, target, values)
        n = self.count
        self._digest = StateDigest(target, self.context)
        self._digested = {i for i, _ in log.digests}
        self._readers = {address: target.reader(address) for address in record}
        self.times = np.empty(n)
        self.actuation = {name: np.full((n, values.shape[1]), np.nan) for name, values in log.actuation.items()}
        self.commanded = {name: np.zeros(n, bool) for name in log.commanded}
        self.digests: list[tuple[int, bytes]] = []
        self.errors: dict[int, str] = {}
        self.record: dict[str, list[Any]] = {address: [] for address in record}
        self._outputs: list[tuple[Callable[[Context], Any], np.ndarray | None, np.ndarray]] = []
        self._find_outputs()

    def advance(self) -> None:
        i = self.index
        super().advance()
        self.times[i] = self._now
        if i in self._digested:
            self.digests.append((i, self._digest()))
        for address, read in self._readers.items():
            self.record[address].append(read(self.context))

    def _evaluate(self) -> None:
        for evaluate, values, commanded in self._outputs:
            value = evaluate(self.context)
            if values is not None:
                values[self.index] = value
            commanded[self.index] = True

    def _fail(self, error: BaseException) -> None:
        # The loop may have had the same exception and gone on without actuator commands: the comparison shows.
        self.errors[int(self._log.numbers[self.index])] = error_text(error)
        for _, values, commanded in self._outputs:
            commanded[self.index] = False
            if values is not None:
                values[self.index] = np.nan

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

    def differences(self) -> list[ReplayDifference]:
        """Return the first difference of every kind from the log, in the order of the cycles."""
        log, differences = self._log, []

        def look(subject: str, differs: np.ndarray, recorded: np.ndarray, replayed: np.ndarray) -> None:
            if differs.any():
                i = int(np.argmax(differs))
                differences.append(
                    ReplayDifference(int(log.numbers[i]), float(log.times[i]), subject, recorded[i], replayed[i])
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
                differences.append(ReplayDifference(int(log.numbers[i]), float(log.times[i]), "state", *both))
                break
        return sorted(differences, key=lambda difference: difference.cycle)


class RewindableReplay(Closing):
    """A replay that stands at any cycle of its log, and can be moved to another one.

    States along the log are kept in a file beside it, so that a way of any length takes as long as that from one of
    them to the next: `approach` goes on from the nearest. They come about while it plays, and ahead of it by
    `prepare`. With an integrator with error control the DPS behind a kept state differs from the recorded one by about
    its accuracy.

    Args:
        log: The log.
        testbed: A testbed of its scenario. If the log is of a DPS alone, its simulated world is idle.
        kept_work: Processor time of the replay from one kept state to the next, in seconds; 0 keeps every state.

    Attributes:
        log: The log.
        times: Times of the DPS at the ends of the cycles that can be replayed, in seconds, shape (n,).
        ended: Why not all cycles of the recorded run can be replayed; empty if all can.

    Raises:
        LogError: The log is of another scenario, or of another version of it; the error lists the differences.
    """

    def __init__(self, log: ControlLog, testbed: VirtualTestbed, *, kept_work: float = KEPT_WORK) -> None:
        self._replay, self._testbed, self._kept_work = _Replay(log, testbed, {}), testbed, kept_work
        self.log = log
        self.times = log.times[: self._replay.count]
        self.ended = self._replay.ended or log.incomplete
        self._begin = self._replay.state()
        # The processor time of each replay since it stood at a kept state, and the time of keeping one.
        self._work: dict[_Replay, float] = {self._replay: 0.0}
        self._keeping = 0.0
        self._ahead: _Replay | None = None
        self._states = KeptStates(log.path, {"log": log.identity, "versions": installed_versions()})
        self._check_kept()

    def close(self) -> None:
        """Close the file with the states."""
        self._states.close()

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

    def advance_until(self, time: float) -> None:
        """Replay until the DPS's time is ``time``, in seconds, or to the end."""
        context = self.context
        self._advance(self._replay, lambda: context.get_time() >= time)

    def approach(self, index: int, deadline: float = inf) -> bool:
        """Go towards where ``index`` cycles have been replayed; return whether it stands there.

        Args:
            index: The number of cycles.
            deadline: When it stops on its way, on the clock of ``time.monotonic``; it makes one cycle at least.
        """
        index = min(max(index, 0), self._replay.count)
        self._go_back_or_ahead(self._replay, index)
        self._advance(self._replay, lambda: self._replay.index >= index, deadline)
        return self._replay.index == index

    def go_to(self, index: int) -> None:
        """Go to where ``index`` cycles have been replayed."""
        self.approach(index)

    @property
    def prepared(self) -> float:
        """Return the part of the log, from 0 to 1, up to which states are kept."""
        ahead = 0 if self._ahead is None else self._ahead.index
        return max(ahead, self._states.last) / max(self._replay.count, 1)

    def prepare(self, deadline: float = inf) -> bool:
        """Replay ahead of all kept states, and keep more; return whether they reach to the end of the log.

        Args:
            deadline: As in `approach`.
        """
        ahead = self._ahead
        if ahead is None:
            ahead = self._ahead = _Replay(self.log, self._testbed, {})
            self._work[ahead] = 0.0
        self._go_back_or_ahead(ahead, ahead.count)
        self._advance(ahead, lambda: ahead.index >= ahead.count, deadline)
        return ahead.index >= ahead.count

    def _go_back_or_ahead(self, replay: _Replay, index: int) -> None:
        """Let a replay go on from the last kept state before ``index``, if it does not stand nearer."""
        last = bisect_right(self._states.cycles, index)
        nearest = self._states.cycles[last - 1] if last else 0
        if replay.index <= index and nearest <= replay.index:
            return
        replay.go_to(self._states.before(index) or self._begin)
        self._work[replay] = 0.0

    def _advance(self, replay: _Replay, is_there: Callable[[], bool], deadline: float = inf) -> None:
        """Replay until it is there or the deadline is over, and keep states."""
        begin = thread_time()
        while replay.index < replay.count and not is_there():
            replay.advance()
            work = self._work[replay] + thread_time() - begin
            if work >= self._kept_work and work >= _KEPT_SHARE * self._keeping and replay.index > self._states.last:
                before = thread_time()
                self._states.add(replay.index, replay.state())
                begin = thread_time()
                self._work[replay], self._keeping = 0.0, begin - before if self._kept_work else 0.0
            if monotonic() >= deadline:
                break
        self._work[replay] += thread_time() - begin

    def _check_kept(self) -> None:
        """Discard what another version of the user's code has kept: its first state is not the one of this replay."""
        if not self._states.cycles:
            return
        first = self._states.before(self._states.cycles[0])
        while first is not None and self._replay.index < first.notes["cycles"]:
            self._replay.advance()
        here = self._replay.state()
        if first is None or here.compare(first) or here.notes != first.notes:
            self._states.discard()
        self._replay.go_to(self._begin)


def _bits(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=float).view(np.uint64)


def _changed(values: np.ndarray, new: np.ndarray, before: np.ndarray | None) -> np.ndarray:
    """Return a mask of the new values of a vector signal with other bits than before: only these must be fed.

    Args:
        values: Its values in some cycles, shape (n, size).
        new: Where they are new, shape (n,).
        before: The value before them; None if there was none.
    """
    bits = _bits(values)
    differs = np.ones(len(bits), bool)
    differs[1:] = (bits[1:] != bits[:-1]).any(axis=1)
    if before is not None:
        differs[:1] = (bits[:1] != _bits(before)).any(axis=1)
    elif new.any():
        differs[np.argmax(new)] = True
    return np.asarray(new & differs)


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
