"""What a loop steps, and all that changes it beside time: what is fed to it, set in it and switched."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.control.boundary import RealPorts
from vtbdrake.control.bridge import Bridge, ReceivedSignal
from vtbdrake.control.cycle import WRITE, Change, time_after
from vtbdrake.control.parameters import parameters_at_hand
from vtbdrake.testbed import DpsAlone, VirtualTestbed
from vtbdrake.testbed.switch import COMMAND, REAL, T_ACT, T_SENSE


class Stepped:
    """A testbed, or the DPS alone, in one context, which goes on by a period at a time.

    Args:
        target: what is stepped.
        bridge: where sensor values and commands u come from.
        period: of a step, in seconds.
        context: where it begins; by default its defaults. It is its own from here on.

    Attributes:
        steps: how many the DPS has done.
        time: of the DPS, in seconds.
        start_time: the same, before its first step.
        idle: whether the DPS alone has not begun yet.
        initialized: whether the events of initialization have happened; they do in the first step, unless ``context``
            was given.
        active: the actuator signals that are on real.
        watched: reception of the sensor signals that are on real.

    Raises:
        ValueError: the bridge gives a command u that comes from inside the testbed.
    """

    def __init__(
        self, target: VirtualTestbed | DpsAlone, bridge: Bridge, *, period: float, context: Context | None = None
    ) -> None:
        for name in bridge.commanded:
            if f"{COMMAND}{name}" not in target.variables():
                raise ValueError(f"the command {name} comes from inside the testbed, the bridge cannot give it as well")
        self.target = target
        self.bridge = bridge
        self.period = period
        self.steps = 0
        self.initialized = context is not None
        self._simulator = target.simulator(context, restored=context is not None)
        self._simulator.set_target_realtime_rate(0.0)
        self._context = self._simulator.get_mutable_context()
        self.time = self.start_time = float(self._context.get_time())
        # Nobody reads it: to be held is what it is for.
        self._at_hand = parameters_at_hand(target.diagram, self._context)
        self._ports = RealPorts(target, self._context)
        self.idle = isinstance(target, DpsAlone)
        self.active: tuple[str, ...] = ()
        self.watched: Mapping[str, ReceivedSignal] = {}
        self._changes: list[Change] = []
        self._fed: dict[str, Any] = {}
        # How many of each signal's values are known: what is counted beyond that is new.
        self._sensed = dict.fromkeys(bridge.sensed, 0)
        self._commanded = dict.fromkeys(bridge.commanded, 0)
        self.look()

    @property
    def context(self) -> Context:
        """The target's context; only the thread that runs the cycles may touch it while they run."""
        return self._context

    def step(self) -> tuple[BaseException | None, dict[str, Any]]:
        """Steps by one period; gives what was raised inside, if anything, and the commands of the signals on real."""
        if self.idle:
            return None, {}
        self.initialized = True
        try:
            end = time_after(self.steps + 1, start=self.start_time, period=self.period)
            self._simulator.AdvanceTo(end)
            self.time = end
            self.steps += 1
            return None, self._ports.commands(self.active)
        except (Exception, SystemExit) as error:  # A failed assertion inside Drake arrives as SystemExit.
            # The time stays where it was: the step is tried again in the next cycle.
            return error, {}

    def begin(self) -> None:
        """Lets the DPS alone be stepped, and command."""
        self.idle = False
        self.look()

    def look(self) -> None:
        """Looks which signals are on real: sensor signals are watched, actuator signals commanded.

        To be called after a switch was thrown by other means than `perform`, unless `run` or a `request` did.
        """
        sensed = self.bridge.sensed
        self.active = () if self.idle else self._ports.active()
        if isinstance(self.target, DpsAlone):
            self.watched = {} if self.idle else sensed
        else:
            positions = self.target.positions(self._context)["sense"]
            self.watched = {name: sensed[name] for name, position in positions.items() if position == REAL}

    def feed(self) -> None:
        """Gives samples that are new to the real ports."""
        for name, reception in self.bridge.sensed.items():
            if reception.count != self._sensed[name]:
                self._sensed[name] = reception.count
                self._ports.feed(name, reception.value)
                self._fed[name] = reception.value

    def take_commands(self) -> None:
        """Sets the commands u that have come by the bridge; one that is refused is counted there."""
        for name, reception in self.bridge.commanded.items():
            if reception.count != self._commanded[name]:
                self._commanded[name] = reception.count
                address = f"{COMMAND}{name}"
                try:
                    self.write({address: np.reshape(reception.value, self.target.variables()[address].shape)})
                except ValueError:
                    reception.reject("refused")

    def write(self, values: Mapping[str, Any]) -> None:
        """Sets variables by address, in the thread that runs the cycles, or between them; from another one by
        `request`.

        Raises:
            ValueError: an address is unknown or a value impossible (nothing has changed), or it is the time or a
                switch.
        """
        for address in values:
            if address == "time" or address.startswith((T_SENSE, T_ACT)):
                raise ValueError(f"{address} is not written while the loop runs: switches are thrown by switch()")
        self.target.write(self._context, values)
        self.changed(WRITE, values)

    def changed(self, kind: str, values: Mapping[str, Any]) -> None:
        """Notes for those who watch what has changed the target; see `Change`."""
        self._changes.append(Change(kind, dict(values)))

    def command(self, name: str) -> Any:
        """What the DPS would command now, wherever the signal's switch stands; None if the DPS has not begun."""
        if self.idle:
            return None
        port = self.target.dps.GetOutputPort(name)
        return port.Eval(self.target.dps.GetMyContextFromRoot(self._context))

    def news(self) -> tuple[tuple[Change, ...], dict[str, Any]]:
        """What has changed, and what was fed, since it was asked last."""
        changes, fed = tuple(self._changes), self._fed
        self._changes.clear()
        self._fed = {}
        return changes, fed
