"""The target that a loop steps (a testbed or the DPS alone), its ports to the machine, and the record of each cycle."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from enum import StrEnum
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, Diagram

from vtbdrake.common.failures import FAILURES
from vtbdrake.control.bridge import Bridge
from vtbdrake.control.guards import GuardDecision
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.state.systems import leaves
from vtbdrake.testbed import ActuatorCommand, DpsAlone, VirtualTestbed
from vtbdrake.testbed.addressed import AddressedDiagram
from vtbdrake.testbed.signal import Feed
from vtbdrake.testbed.switch import COMMAND, T_ACT, T_SENSE, Position

_log = logging.getLogger(__name__)


_ON_GRID = 1e-6  # Share of a period: a start time this close to a multiple counts as one.


class ChangeKind(StrEnum):
    """The kinds of changes, as logs name them."""

    WRITE = "write"  # of variables
    SWITCH = "switch"
    RESET = "reset"  # of the guards
    RESULT = "result"  # of a slow part


class Change(NamedTuple):
    """A change of the stepped target before a cycle's step, other than by time and sensor values.

    Attributes:
        kind: A `ChangeKind`; in a log of a newer version it may be another one.
        values: For ``write``, the new values by address; for ``switch``, the positions by ``sense.<signal>`` and
            ``act.<signal>``; for ``result``, one entry: path of the slow part -> ``{"tick": number of the sample (int),
            name: array, ...}``, where the arrays (any dtype and shape; none if the result is declared missing) are
            what `SlowPart.deliver` takes besides the tick.
    """

    kind: str
    values: Mapping[str, Any]


class Cycle(NamedTuple):
    """The record of one cycle, as watchers (a recorder, a plot, residuals) receive it.

    Together with the state before the first cycle, ``changes`` and ``fed`` of every cycle determine all that the DPS
    does.

    Attributes:
        number: Number of the cycle, from 0.
        time: DPS time at the end of the cycle, in seconds; unchanged if the DPS raised or has not started.
        now: Time on the runtime's clock after the cycle's messages were received, in seconds.
        changes: Changes of the target before the step, in order.
        fed: Sensor values that are new to the DPS in this cycle, by signal.
        actuation: The DPS's actuator commands before the guards, by signal; empty if it raised.
        verdict: The guards' decision; `GuardDecision.actuation` was sent.
    """

    number: int
    time: float
    now: float
    changes: tuple[Change, ...]
    fed: Mapping[str, Any]
    actuation: Mapping[str, Any]
    verdict: GuardDecision


def time_after(steps: int, *, start: float, period: float) -> float:
    """Return the DPS's time after a number of steps, in seconds.

    If the DPS starts at a multiple of the period, every returned time is a multiple, too: samples are due at the
    multiples, and with an accumulated rounding error a step would now and then contain none or two of an update.

    Args:
        steps: Number of steps since the start.
        start: The DPS's time at the start, in seconds.
        period: Length of a step, in seconds.
    """
    first = round(start / period)
    if steps and abs(first * period - start) <= _ON_GRID * period:
        return (first + steps) * period
    return start + steps * period


def numeric_parameters(diagram: Diagram, context: Context) -> list[BasicVector]:
    """Return Python's wrappers of all numeric parameters below ``diagram``, to be kept alive while it is stepped.

    Otherwise pydrake makes and discards a wrapper (1 us) whenever a system in Python reads its parameters.

    Args:
        diagram: The Diagram that is stepped.
        context: Its root context, which owns the parameters.
    """
    contexts = [system.GetMyContextFromRoot(context) for _, system in leaves(diagram)]
    return [
        leaf_context.get_numeric_parameter(i)
        for leaf_context in contexts
        for i in range(leaf_context.num_numeric_parameter_groups())
    ]


class RealPorts:
    """The ports ``real.sense.*``, ``real.act.*`` and ``real.act.active`` in one context.

    Args:
        target: The testbed, or the DPS alone.
        context: The root context.

    Attributes:
        feed: Sets the value of a sensor signal's input port: ``feed(name, value)``.
    """

    def __init__(self, target: AddressedDiagram, context: Context) -> None:
        diagram, interface = target.diagram, target.interface
        self._context = context
        self.feed = Feed({s.name: (s, diagram.GetInputPort(f"real.sense.{s.name}")) for s in interface.sense}, context)
        self._outputs = {s.name: (s, diagram.GetOutputPort(f"real.act.{s.name}").Eval) for s in interface.act}
        self._active = diagram.GetOutputPort("real.act.active") if interface.act else None

    def active(self) -> tuple[str, ...]:
        """Return the actuator signals that are on real. Evaluates the switches only, not the DPS."""
        if self._active is None:
            return ()
        flags = self._active.Eval(self._context)
        return tuple(name for name, flag in zip(self._outputs, flags, strict=True) if flag)

    def actuation(self, names: Iterable[str]) -> dict[str, Any]:
        """Return the DPS's present commands of the named actuator signals."""
        actuation: dict[str, Any] = {}
        for name in names:
            signal, evaluate = self._outputs[name]
            value = evaluate(self._context)
            if signal.is_vector:
                value = np.array(value)
            elif isinstance(value, ActuatorCommand):
                value = value.value
            actuation[name] = value
        return actuation


class RejectionAlarm:
    """The alarm about rejected messages of a command u: each is told, together with others of the same second.

    Args:
        name: Name of the command.
    """

    _PERIOD = 1.0  # s

    def __init__(self, name: str) -> None:
        self._name = name
        self._counts: dict[str, int] = {}  # by reason, of the messages that were told
        self._alarm_at = -inf

    def due(self, now: float, rejected: Mapping[str, int]) -> str:
        """Return the alarm at the time ``now`` about counts of rejected messages by reason; empty if none is due.

        Args:
            now: The time on the loop's clock, in seconds.
            rejected: Counts of rejected messages since the start, by reason.
        """
        if now - self._alarm_at < self._PERIOD or rejected == self._counts:
            return ""
        new = {reason: count - self._counts.get(reason, 0) for reason, count in rejected.items()}
        self._counts, self._alarm_at = dict(rejected), now
        causes = ", ".join(f"{count} {reason}" for reason, count in new.items() if count > 0)
        return f"messages with the command {self._name} were rejected: {causes}"


class Stepped:
    """A testbed, or the DPS alone, with one context that advances by one period per step.

    Args:
        target: The testbed or the DPS alone.
        bridge: Source of sensor values and of commands u.
        period: Length of a step, in seconds.
        context: Where the target starts; its default context if None. It belongs to this object from then on.

    Attributes:
        steps: Number of steps that the DPS has done.
        time: The DPS's time, in seconds.
        start_time: The DPS's time before its first step, in seconds.
        idle: Whether the target is a DPS alone that has not been started yet.
        initialized: Whether the initialization events have happened. They happen in the first step, unless ``context``
            was given.
        active: Names of the actuator signals that are on real.
        watched: The received signal of each sensor signal that is on real, by name.

    Raises:
        ValueError: The bridge receives a command u that comes from inside the testbed.
    """

    def __init__(
        self, target: VirtualTestbed | DpsAlone, bridge: Bridge, *, period: float, context: Context | None = None
    ) -> None:
        for name in bridge.commands:
            if f"{COMMAND}{name}" not in target.variables():
                raise ValueError(f"the command {name} is connected inside the testbed: the bridge cannot provide it")
        self.target = target
        self.bridge = bridge
        self.period = period
        self.steps = 0
        self.initialized = context is not None
        self._simulator = target.simulator(context, restored=context is not None)
        self._simulator.set_target_realtime_rate(0.0)
        self._context = self._simulator.get_mutable_context()
        self.time = self.start_time = float(self._context.get_time())
        # Never read: keeps the wrappers alive.
        self._parameters = numeric_parameters(target.diagram, self._context)
        self._ports = RealPorts(target, self._context)
        self.idle = isinstance(target, DpsAlone)
        self.active: tuple[str, ...] = ()
        self.watched: Mapping[str, ReceivedSignal] = {}
        self._changes: list[Change] = []
        self._fed: dict[str, Any] = {}
        # For each signal, the count of the newest value that the target has got.
        self._sensed = dict.fromkeys(bridge.sensed, 0)
        self._commands = dict.fromkeys(bridge.commands, 0)
        # Commands whose value lapses when it is too old: the largest age and the default.
        self._lapses = {
            signal.name: (signal.max_age, signal.default_vector())
            for signal in target.interface.commands
            if signal.name in bridge.commands and signal.max_age < inf
        }
        self._lapsing: set[str] = set()
        self._rejection_alarms = {name: RejectionAlarm(name) for name in bridge.commands}
        self.read_switches()

    @property
    def context(self) -> Context:
        """Return the target's context. While cycles run, only their thread may touch it."""
        return self._context

    def step(self) -> tuple[BaseException | None, dict[str, Any]]:
        """Advance by one period; return the error raised inside (or None) and the actuation of the active signals."""
        if self.idle:
            return None, {}
        self.initialized = True
        try:
            end = time_after(self.steps + 1, start=self.start_time, period=self.period)
            self._simulator.AdvanceTo(end)
            self.time = end
            self.steps += 1
            return None, self._ports.actuation(self.active)
        except FAILURES as error:
            # The time stays where it was: the next cycle tries the step again.
            return error, {}

    def start_dps(self) -> None:
        """Start the DPS alone: from the next cycle on it is stepped, and commands."""
        self.idle = False
        self.read_switches()

    def read_switches(self) -> None:
        """Update `active` and `watched` from the positions of the switches.

        Call it after throwing a switch by other means than `perform`, unless `run` or a `request` follows.
        """
        sensed = self.bridge.sensed
        self.active = () if self.idle else self._ports.active()
        if isinstance(self.target, DpsAlone):
            self.watched = {} if self.idle else sensed
        else:
            positions = self.target.positions(self._context)["sense"]
            self.watched = {name: sensed[name] for name, position in positions.items() if position == Position.REAL}

    def feed(self) -> None:
        """Feed the samples that are new to the real ports."""
        for name, received in self.bridge.sensed.items():
            if received.count != self._sensed[name]:
                self._sensed[name] = received.count
                self._ports.feed(name, received.value)
                self._fed[name] = received.value

    def apply_commands(self, now: float) -> None:
        """Write the commands u that the bridge has received, and the default of one whose last value is too old.

        One that cannot be written is counted as rejected. `note_rejected` gets every rejection, once per second at most
        for each command.

        Args:
            now: Present time on the clock of `ReceivedSignal.arrived`, in seconds.
        """
        for name, received in self.bridge.commands.items():
            if received.count != self._commands[name]:
                self._commands[name] = received.count
                try:
                    self._write_command(name, received.value)
                except ValueError:
                    received.reject("refused")
                else:
                    self._note_lapsing(name, received.value)
            if name in self._lapsing and received.age(now) > (max_age := self._lapses[name][0]):
                self._lapsing.discard(name)
                self._write_command(name, self._lapses[name][1])
                _log.warning("no command %s for %g s: it returns to its default", name, max_age)
            if received.rejected and (alarm := self._rejection_alarms[name].due(now, received.rejected)):
                self.note_rejected(now, name, alarm)

    def note_rejected(self, now: float, name: str, alarm: str) -> None:
        """Raise the alarm that messages with the command ``name`` were rejected; ``alarm`` says how many and why.

        Args:
            now: The time on the loop's clock, in seconds.
            name: Name of the command u.
            alarm: The alarm, as a sentence.
        """
        _log.error("ALARM: %s", alarm)

    def _write_command(self, name: str, value: ArrayLike) -> None:
        address = f"{COMMAND}{name}"
        self.write({address: np.reshape(value, self.target.variables()[address].shape)})

    def _note_lapsing(self, name: str, value: ArrayLike) -> None:
        """Remember a command whose value is another than its default, and lapses."""
        self._lapsing.discard(name)
        if name in self._lapses and not np.array_equal(value, self._lapses[name][1]):
            self._lapsing.add(name)

    def read(self, address: str) -> Any:
        """Return the present value of a variable or a port of the target, for example ``real.sense.<signal>``.

        Call it in the thread that runs the cycles, or between them; see `AddressedDiagram.reader`.
        """
        return self.target.read(self._context, address)

    def write(self, values: Mapping[str, Any]) -> None:
        """Set variables by address.

        Call it in the thread that runs the cycles, or between them; from another thread by `request`.

        Raises:
            ValueError: An address is unknown or a value impossible (nothing has changed), or the address is the time or
                a switch.
        """
        for address in values:
            if address == "time" or address.startswith((T_SENSE, T_ACT)):
                raise ValueError(f"{address} is not written while the loop runs: switches are thrown by switch()")
        self.target.write(self._context, values)
        self.note_change(ChangeKind.WRITE, values)

    def note_change(self, kind: str, values: Mapping[str, Any]) -> None:
        """Record a change of the target for the watchers; see `Change`.

        Args:
            kind: A `ChangeKind`.
            values: The new values; their keys depend on the kind.
        """
        self._changes.append(Change(kind, dict(values)))

    def actuator_command(self, name: str) -> Any:
        """Return the DPS's present command of an actuator signal, on real or not; None if the DPS has not started."""
        if self.idle:
            return None
        port = self.target.dps.GetOutputPort(name)
        return port.Eval(self.target.dps.GetMyContextFromRoot(self._context))

    def pop_record(self) -> tuple[tuple[Change, ...], dict[str, Any]]:
        """Return the changes and fed values since the last call."""
        changes, fed = tuple(self._changes), self._fed
        self._changes.clear()
        self._fed = {}
        return changes, fed
