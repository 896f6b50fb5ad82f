"""The physical robot, played: a simulated world that speaks the machine's protocol, cycle by cycle, without a clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import inf
from typing import Any

import numpy as np

from vtbdrake.control.bridge import ReceivedSignal
from vtbdrake.control.sensor_monitor import LatencyMonitor
from vtbdrake.lcm.bridge import ChannelReader
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.machine.brake import HoldingBrake
from vtbdrake.machine.config import MachineConfig
from vtbdrake.machine.faults import ACT, SENSE, InjectedFault, InjectedFaultError, NoBrake, Packet, whole_cycles
from vtbdrake.machine.line import Line
from vtbdrake.machine.perturbation import perturbed_values
from vtbdrake.machine.sensors import Sensors
from vtbdrake.testbed import Scenario, WorldAlone

_REORDER_WINDOW = 0.1  # s, see `LcmBridge`
_MICROSECONDS = 1e6


@dataclass
class MachineStatus:
    """How a machine is.

    Attributes:
        cycle: how many it has done.
        time: of its world, in seconds.
        braking: whether it braked in its last cycle.
        silent: command channels on which, by then, none had been accepted for longer than its timeout.
        accepted: by actuator signal, how many commands it took.
        rejected: by actuator signal, how many it did not, by the reason; see `ReceivedSignal`, and
            `Machine.refuse_late` for those that are ``late``.
        faults: those that have begun, as `InjectedFault.to_dict` gives them.
    """

    cycle: int
    time: float
    braking: bool
    silent: list[str]
    accepted: dict[str, int]
    rejected: dict[str, dict[str, int]]
    faults: list[dict[str, Any]]

    def to_dict(self) -> dict[str, Any]:
        """Plain data, fit for JSON."""
        return asdict(self)


class Machine:
    """A scenario's world as a machine, with perturbed parameters, noise, delays, a brake and faults.

    Cycle k takes it from k periods to k + 1, under the newest of the commands that were received before. If the answer
    to the state of k periods is among them, a controller commands it as a testbed's DPS commands the simulated world.
    Nothing in it depends on a clock: equal commands in equal cycles, and equal requests, give equal messages. Only
    where it is told to `refuse_late`, commands have to come in time.

    Args:
        scenario: whose world it is, and whose deployment has the protocol that it speaks (see `Protocol`).
        config: see there.
        epoch: what its messages tell as the time of cycle 0, in microseconds.

    Attributes:
        protocol: what it speaks.
        cycle: how many it has done.
        perturbed: values of variables that are not the scenario's own, by address.

    Raises:
        ProtocolError: the scenario does not say what its machine speaks, or not of all signals.
        ValueError: the config does not fit the scenario.
    """

    def __init__(self, scenario: Scenario, config: MachineConfig | None = None, *, epoch: int = 0) -> None:
        self.config = config = config or MachineConfig()
        self.protocol = protocol_of(scenario)
        self.world = world = WorldAlone(scenario)
        self.cycle = 0
        self._epoch = epoch
        seeds = np.random.SeedSequence(config.seed).spawn(4)
        perturbation, noise, sense, act = (np.random.default_rng(seed) for seed in seeds)
        self._context = world.default_context()
        self.perturbed = perturbed_values(world, self._context, config.perturb, perturbation) if config.perturb else {}
        self.perturbed.update(config.values)
        world.write(self._context, self.perturbed)
        self._simulator = world.simulator(self._context)
        self._simulator.set_target_realtime_rate(0.0)
        self._simulator.Initialize()

        self._lines = {
            side: Line(side, delay=whole_cycles(delay, config.period), period=config.period, random=random)
            for side, delay, random in ((SENSE, config.sense_delay, sense), (ACT, config.act_delay, act))
        }
        self._brake = HoldingBrake(world, config.brake)
        self._given = dict(self._brake.idle())
        self._feed = world.feed(self._context)
        self._sensors = Sensors(world, self.protocol, config, noise, given=self._given)
        signals = {signal.name: signal for signal in world.interface.act}
        self._receptions = {name: ReceivedSignal() for name in signals}
        self._inlets = {
            map.channel: ChannelReader(map, [signals[name] for name in map.signals], self._receptions, _REORDER_WINDOW)
            for map in self.protocol.act
        }
        self._types = {map.channel: map.type for map in self.protocol.act}
        self._accepted: dict[str, float] = dict.fromkeys(self._receptions, -inf)
        self._counts = dict.fromkeys(self._receptions, 0)
        self._commands: dict[str, Any] = dict.fromkeys(self._receptions)
        self._delays: dict[str, LatencyMonitor] = {}
        self._patience = whole_cycles(config.timeout, config.period)
        self._silent: list[str] = []

    @property
    def time(self) -> float:
        """Of its world, in seconds."""
        return self.cycle * self.config.period

    @property
    def channels(self) -> list[str]:
        """On which it is commanded."""
        return list(self._inlets)

    @property
    def braking(self) -> bool:
        """Whether it braked in its last cycle."""
        return self._brake.engaged

    def read(self, address: str) -> Any:
        """The value of a variable or output port of its world."""
        return self.world.read(self._context, address)

    def write(self, values: Mapping[str, Any]) -> None:
        """Sets variables of its world between two cycles, by address: a tool that was changed, say.

        Raises:
            ValueError: an address is unknown, or a value impossible; nothing has changed.
        """
        self.world.write(self._context, values)
        self.perturbed.update(values)

    def refuse_late(self, refuse: bool) -> None:
        """Whether commands are refused that took longer than the quickest one by more than the config's ``max_delay``.

        They have waited somewhere: in a hub that stood still, say. Only for senders whose clock runs as this computer's
        does, so not in lock-step; a sender that does not tell the time is not late.
        """
        wanted = refuse and self.config.max_delay < inf
        self._delays = {name: LatencyMonitor(self.config.max_delay) for name in self._receptions} if wanted else {}

    # -- cycles

    def receive(self, channel: str, data: bytes) -> None:
        """Takes a message of the controller, which may go through delays and faults before it is looked at."""
        self._lines[ACT].send(Packet(channel, self._types[channel], data, self.cycle))

    def advance(self) -> None:
        """Does one cycle.

        Raises:
            RuntimeError: the simulation failed.
        """
        for packet in self._lines[ACT].arrivals(self.cycle):
            self._inlets[packet.channel].take(packet.channel, packet.data)
        for name, reception in self._receptions.items():
            if reception.count > self._counts[name]:
                self._counts[name] = reception.count
                self._accept(name, reception)
        coasting = NoBrake.name in self._lines[SENSE].faults
        self._silent = self._find_silent()
        self._brake.set(self._context, bool(self._silent) and not coasting)
        for name in self._receptions:
            self._give(name, self._command(name, self._commands[name], coasting))
        self._simulator.AdvanceTo((self.cycle + 1) * self.config.period)
        self.cycle += 1

    def _accept(self, name: str, reception: ReceivedSignal) -> None:
        delay = self._delays.get(name)
        if delay is not None and delay.excess(reception) > delay.limit:
            reception.reject("late")
        else:
            self._accepted[name], self._commands[name] = self.cycle, reception.value

    def _find_silent(self) -> list[str]:
        since = self.cycle - self._patience
        return [map.channel for map in self.protocol.act if max(self._accepted[name] for name in map.signals) < since]

    def _command(self, name: str, last: Any, coasting: bool) -> Any:
        if self._brake.engaged:
            return self._brake.command(name, last)
        # A signal may be missing in messages that come; what was said of it long ago is not a command any more.
        stale = self._accepted[name] < self.cycle - self._patience and not coasting
        return self._brake.idle()[name] if stale or last is None else last

    def _give(self, name: str, value: Any) -> None:
        # Receptions hold a new object for every message: what is the same object has not changed.
        if self._given[name] is not value:
            self._given[name] = value
            self._feed(name, value)

    def messages(self) -> list[tuple[str, bytes]]:
        """Tells the present state: channel and bytes of what arrives at the controller now, in order."""
        line = self._lines[SENSE]
        utime = self._epoch + round(self.time * _MICROSECONDS)
        errors = {channel: round(line.clock_error(channel) * _MICROSECONDS) for channel in self._sensors.channels}
        for packet in self._sensors.packets(self._context, self.cycle, utime, errors):
            line.send(packet)
        return [(packet.channel, packet.data) for packet in line.arrivals(self.cycle)]

    # -- faults

    def begin(self, fault: InjectedFault) -> None:
        """Begins a fault, from the next message on; it takes the place of one of the same name and side.

        Raises:
            InjectedFaultError: it names a channel that there is not.
        """
        line = self._lines[fault.side]
        known = self._sensors.channels if fault.side == SENSE else self.channels
        for channel in fault.channels:
            if channel not in known:
                raise InjectedFaultError(
                    f"the machine has no {fault.side} channel {channel!r}; it has: {', '.join(known)}"
                )
        line.begin(fault)

    def normal(self) -> None:
        """Ends all faults."""
        for line in self._lines.values():
            line.end()

    def status(self) -> MachineStatus:
        """How it is now."""
        return MachineStatus(
            cycle=self.cycle,
            time=self.time,
            braking=self._brake.engaged,
            silent=list(self._silent),
            accepted={name: reception.count for name, reception in self._receptions.items()},
            rejected={name: dict(reception.rejected) for name, reception in self._receptions.items()},
            faults=[fault.to_dict() for line in self._lines.values() for fault in line.faults.values()],
        )
