"""One replay of a log, cycle by cycle."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from vtbdrake.control.boundary import RealPorts
from vtbdrake.control.cycle import RESET, RESULT, SWITCH, WRITE, Change, time_after
from vtbdrake.control.parameters import parameters_at_hand
from vtbdrake.control.switching import throw
from vtbdrake.recording.abstract_values import abstract_values
from vtbdrake.recording.control_log import ControlLog
from vtbdrake.recording.digest import StateDigest
from vtbdrake.recording.log_format import LogError
from vtbdrake.recording.log_header import kind_of
from vtbdrake.recording.replay_report import Difference, differences
from vtbdrake.recording.replay_start import Target, begin
from vtbdrake.testbed import VirtualTestbed, slow_parts
from vtbdrake.testbed.interrupt import Interruptible

TICK = "tick"
"""Of the values of a result: the number of its sample."""


class ReplayRun:
    """One replay, up to the first gap.

    Attributes:
        same_kind: whether the target is what was recorded.
        errors: what the DPS raised, by the number of the cycle.
    """

    def __init__(self, log: ControlLog, target: Target, values: dict[str, Any], record: Sequence[str]) -> None:
        header = log.header
        self.same_kind = kind_of(target) == header.target
        self._log, self._target, self._values = log, target, values
        self._context = context = self._new_context()
        begin(log, target, context)
        target.write(context, values)
        self._simulator = self._new_simulator()
        # Nobody reads it: to be held is what it is for.
        self._at_hand = parameters_at_hand(target.diagram, context)
        self._ports = RealPorts(target, context)
        self._slow_parts = slow_parts(target.diagram)
        self._idle, self._steps = header.idle, header.steps
        self._digest = StateDigest(target, context)
        self._readers = {address: target.reader(address) for address in record}
        self._decoders = abstract_values(log, target)
        self.count = n = _until_gap(log)
        self.ended = f"the log lacks {log.gaps[0]}: what came then cannot be repeated" if log.gaps else ""
        self.times = np.empty(n)
        self.commands = {name: np.full((n, values.shape[1]), np.nan) for name, values in log.commands.items()}
        self.commanded = {name: np.zeros(n, bool) for name in log.commanded}
        self.digests: list[tuple[int, bytes]] = []
        self.errors: dict[int, str] = {}
        self.record: dict[str, list[Any]] = {address: [] for address in record}
        self._now, self._next = self._time(self._steps), self._time(self._steps + 1)
        self._outputs: list[tuple[Callable[[Context], Any], np.ndarray | None, np.ndarray]] = []
        self._look()

    def _new_context(self) -> Context:
        return self._target.default_context()

    def _new_simulator(self) -> Simulator:
        return self._target.simulator(self._context, restored=self._log.header.initialized)

    def differences(self) -> list[Difference]:
        """From the log; see there."""
        told = self.same_kind
        return differences(self._log, self.times, self.commands, self.commanded, self.digests, all_told=told)

    def run(self) -> None:
        """All cycles."""
        log, feed, context = self._log, self._ports.feed, self._context
        vectors = [(_differs(values, log.sources[name]).tolist(), name, values) for name, values in log.fed.items()]
        changes = self._changes()
        digests = {i for i, _ in log.digests}
        with Interruptible() as interruptible:
            for i in range(self.count):
                interruptible.check()
                for new, name, values in vectors:
                    if new[i]:
                        feed(name, values[i])
                for name, value in self._decoders.items():
                    if event := log.sources[name][i]:
                        feed(name, value(event))
                # What is fed is there before a switch lets the DPS see it.
                for change in changes.get(i, ()):
                    self._apply(change)
                if not self._idle:
                    self._step(i)
                self.times[i] = self._now
                if i in digests:
                    self.digests.append((i, self._digest()))
                for address, read in self._readers.items():
                    self.record[address].append(read(context))

    def _time(self, steps: int) -> float:
        return time_after(steps, start=self._log.header.start_time, period=self._log.header.period)

    def _step(self, i: int) -> None:
        try:
            self._simulator.AdvanceTo(self._next)
            self._steps += 1
            self._now, self._next = self._next, self._time(self._steps + 1)
            for evaluate, values, there in self._outputs:
                value = evaluate(self._context)
                if values is not None:
                    values[i] = value
                there[i] = True
        except (Exception, SystemExit) as error:  # A failed assertion inside Drake arrives as SystemExit.
            # As it may have done in the loop, which then had no command and went on: the comparison tells.
            self.errors[int(self._log.numbers[i])] = f"{type(error).__name__}: {error}"
            for _, values, there in self._outputs:
                there[i] = False
                if values is not None:
                    values[i] = np.nan

    def _look(self) -> None:
        """Looks which signals the DPS commands."""
        self._outputs = [
            (self._target.diagram.GetOutputPort(f"real.act.{name}").Eval, self.commands.get(name), self.commanded[name])
            for name in (() if self._idle else self._ports.active())
        ]

    # -- changes

    def _changes(self) -> Mapping[int, list[Change]]:
        """By the index of the cycle before whose step they were."""
        changes: dict[int, list[Change]] = {}
        for i, change in self._log.changes:
            changes.setdefault(i, []).append(change)
        return changes

    def _apply(self, change: Change) -> None:
        if change.kind not in self._CHANGES:
            raise LogError(
                f"the log has a change of the kind {change.kind!r}, this version of vtbdrake knows none such"
            )
        self._CHANGES[change.kind](self, change.values)

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
        self._look()

    def _reset(self, values: Mapping[str, Any]) -> None:
        """The guards are not replayed: what was sent is in the log."""

    def _deliver(self, values: Mapping[str, Any]) -> None:
        for path, result in values.items():
            arrays = {name: np.asarray(array) for name, array in result.items() if name != TICK}
            self._slow_parts[path].deliver(self._context, result[TICK], arrays)

    _CHANGES: ClassVar[Mapping[str, Callable[[Any, Mapping[str, Any]], None]]] = {
        WRITE: _write,
        SWITCH: _switch,
        RESET: _reset,
        RESULT: _deliver,
    }


def _differs(values: np.ndarray, sources: np.ndarray) -> np.ndarray:
    """Where a vector signal has a new value of other bits than before: only those must be fed."""
    bits, new = values.view(np.uint64), sources != 0
    new[1:] &= (bits[1:] != bits[:-1]).any(axis=1) | (np.cumsum(new)[1:] == 1)
    return new


def _until_gap(log: ControlLog) -> int:
    """How many cycles there are before the first gap."""
    return int(np.searchsorted(log.numbers, log.gaps[0].first)) if log.gaps else len(log)
