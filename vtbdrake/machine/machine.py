"""The machine: a simulated world in place of the physical robot, cycle by cycle, without a clock or a bus."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.control.bridge import Reports
from vtbdrake.control.fallback import is_position
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.robot_mode import RobotMode
from vtbdrake.control.sensor_monitor import LatencyMonitor
from vtbdrake.lcm.lcm_bridge import ChannelReader
from vtbdrake.lcm.protocol import Protocol, protocol_of
from vtbdrake.machine.config import HOLD, IDLE, LOCK, MachineConfig
from vtbdrake.machine.injected_faults import (
    ACT,
    SENSE,
    DelayLine,
    InjectedFault,
    InjectedFaultError,
    NoBrake,
    OwnStop,
    Packet,
    whole_cycles,
)
from vtbdrake.state.variables import A
from vtbdrake.testbed import Scenario, WorldAlone

PERTURBED = ("mass", "damping", "friction", "rotor_inertia")
"""The variables that are perturbed, by the last part of their addresses. An inertia changes with its mass."""

_REORDER_WINDOW = 0.1  # s, see `LcmBridge`
_MICROSECONDS = 1e6


@dataclass
class MachineStatus:
    """The status of a machine.

    Attributes:
        cycle: The number of cycles it has done.
        time: The time of its world, in seconds.
        braking: True if it braked in its last cycle.
        silent: The command channels on which no command was accepted for longer than its timeout.
        accepted: The number of accepted commands, by actuator signal.
        rejected: The number of rejected commands, by actuator signal and reason; see `ReceivedSignal`, and
            `Machine.reject_late` for the reason ``late``.
        faults: The injected faults that have begun, as `InjectedFault.to_dict` gives them.
    """

    cycle: int
    time: float
    braking: bool
    silent: list[str]
    accepted: dict[str, int]
    rejected: dict[str, dict[str, int]]
    faults: list[dict[str, Any]]


class Machine:
    """The world of a scenario as a machine, with perturbed parameters, noise, latencies, a brake and injected faults.

    Cycle k takes it from k periods to k + 1, under the newest of the commands that were received before. If the answer
    to the state of k periods is among them, a controller commands it as a testbed's DPS commands the simulated world.
    Nothing in it depends on a clock: equal commands in equal cycles, and equal requests, give equal messages. Only
    after `reject_late`, commands must come in time.

    Args:
        scenario: The scenario of the world. Its deployment has the protocol of the machine (see `Protocol`).
        config: The differences from the simulated world.
        epoch: The time of cycle 0 in its messages, in microseconds.
        world: The world of the scenario, if it has been built already; the machine simulates a new context of it.

    Attributes:
        protocol: Its LCM protocol.
        period: The period of a cycle, in seconds.
        cycle: The number of cycles it has done.
        perturbed: The values of variables that differ from the scenario's, by address.

    Raises:
        ProtocolError: The scenario has no protocol, or one that does not fit its signals.
        ValueError: The config does not fit the scenario.
    """

    def __init__(
        self,
        scenario: Scenario,
        config: MachineConfig | None = None,
        *,
        epoch: int = 0,
        world: WorldAlone | None = None,
    ) -> None:
        self.config = config = config or MachineConfig()
        self.protocol = protocol_of(scenario)
        self.period = period = config.period or scenario.deployment().period
        self.world = world = world or WorldAlone(scenario)
        self.cycle = 0
        self._epoch = epoch
        seeds = np.random.SeedSequence(config.seed).spawn(5)
        perturbation, noise, sense, act, disturbance = (np.random.default_rng(seed) for seed in seeds)
        self._context = world.default_context()
        self.perturbed = perturbed_values(world, self._context, config.perturb, perturbation) if config.perturb else {}
        self.perturbed.update(config.values)
        world.write(self._context, self.perturbed)
        self._simulator = world.simulator(self._context)
        self._simulator.Initialize()

        self._lines = {
            side: DelayLine(delay=whole_cycles(latency, period), period=period, random=random)
            for side, latency, random in ((SENSE, config.sense_latency, sense), (ACT, config.act_latency, act))
        }
        self._brake = HoldingBrake(world, config.brake)
        self._feed = world.feed(self._context)
        self._actuation = dict(self._brake.idle)  # What acts, by actuator signal.
        self._sensors = _Sensors(
            world, self.protocol, period, config.noise, noise, actuation=self._actuation, mode=self._mode
        )
        self._disturbances = _Disturbances(world, period, config, disturbance)
        signals = {signal.name: signal for signal in world.interface.act}
        self._received = {name: ReceivedSignal() for name in signals}
        self._readers = {
            map.channel: ChannelReader(map, [signals[name] for name in map.signals], self._received, _REORDER_WINDOW)
            for map in self.protocol.act
        }
        self._types = {map.channel: map.type for map in self.protocol.act}
        self._counts = dict.fromkeys(signals, 0)
        self._accepted = dict.fromkeys(signals, -inf)  # The cycle of the last accepted command.
        self._commands: dict[str, Any] = dict.fromkeys(signals)
        self.reject_late(False)
        self._patience = whole_cycles(config.timeout, period)
        self._silent: list[str] = []
        self._stopped = False

    @property
    def time(self) -> float:
        """Return the time of its world, in seconds."""
        return self.cycle * self.period

    @property
    def channels(self) -> list[str]:
        """Return the LCM channels of actuator commands."""
        return list(self._readers)

    @property
    def braking(self) -> bool:
        """Return True if the machine braked in its last cycle."""
        return self._brake.engaged

    @property
    def stopped(self) -> bool:
        """Return True if its own stop was pressed in its last cycle, by the fault `OwnStop`."""
        return self._stopped

    def _mode(self, mode: RobotMode) -> int:
        """Return the number that it reports as its mode."""
        if self._stopped:
            return mode.stopped
        return mode.braking if self._brake.ends_commands else mode.active

    def read(self, address: str) -> Any:
        """Return the value of a variable or output port of its world."""
        return self.world.read(self._context, address)

    def write(self, values: Mapping[str, Any]) -> None:
        """Set variables of its world between two cycles, by address, as if a tool was changed.

        Raises:
            ValueError: An address is unknown, or a value impossible; nothing has changed.
        """
        self.world.write(self._context, values)
        self.perturbed.update(values)

    def reject_late(self, reject: bool) -> None:
        """Reject, or accept, commands whose latency exceeds the quickest one's by more than ``max_latency``.

        Such commands have waited somewhere, in a hub that was stopped for example. Commands that are far ahead of this
        computer's clock are rejected likewise, see `MachineOrder`. Both need a sender whose clock runs as fast as this
        computer's, so not in lock-step. A sender that does not tell the time is never late.
        """
        for reader in self._readers.values():
            reader.limit_lead(reject)
        is_limited = reject and self.config.max_latency < inf
        self._latencies: dict[str, LatencyMonitor] = (
            {n: LatencyMonitor(self.config.max_latency) for n in self._received} if is_limited else {}
        )

    # -- cycles

    def receive(self, channel: str, data: bytes) -> None:
        """Take a message of the controller. It passes the latency and the injected faults before it is decoded.

        Args:
            channel: Channel of the message.
            data: The encoded message.
        """
        self._lines[ACT].send(Packet(channel, self._types[channel], data, self.cycle))

    def advance(self) -> None:
        """Do one cycle.

        Raises:
            RuntimeError: The simulation failed.
        """
        for packet in self._lines[ACT].arrivals(self.cycle):
            self._readers[packet.channel].receive(packet.channel, packet.data)
        self._stopped = OwnStop.name in self._lines[SENSE].faults
        for name, received in self._received.items():
            if received.count > self._counts[name]:
                self._counts[name] = received.count
                self._accept(name, received)
        if self._stopped:  # The next command releases the brake, none that came before or meanwhile.
            self._accepted = dict.fromkeys(self._accepted, -inf)
        coasting = NoBrake.name in self._lines[SENSE].faults
        oldest = self.cycle - self._patience
        self._silent = [
            map.channel for map in self.protocol.act if max(self._accepted[name] for name in map.signals) < oldest
        ]
        self._brake.set(self._context, self._stopped or (bool(self._silent) and not coasting))
        for name, command in self._commands.items():
            # A signal may be missing in the messages that arrive; its last command becomes stale.
            stale = self._accepted[name] < oldest and not coasting
            self._apply(name, self._brake.actuation(name, command, stale, stopped=self._stopped))
        self._simulator.AdvanceTo((self.cycle + 1) * self.period)
        self.cycle += 1

    def _accept(self, name: str, received: ReceivedSignal) -> None:
        if self._stopped:
            return
        latency = self._latencies.get(name)
        if latency is not None and latency.excess(received) > latency.limit:
            received.reject("late")
        else:
            self._accepted[name], self._commands[name] = self.cycle, received.value

    def _apply(self, name: str, value: Any) -> None:
        # Every message makes a new object: the same object has not changed.
        changed = self._actuation[name] is not value
        self._actuation[name] = value
        if name in self._disturbances:
            self._feed(name, value + self._disturbances.following(name))
        elif changed:
            self._feed(name, value)

    def messages(self) -> list[tuple[str, bytes]]:
        """Measure the present state; return channel and bytes of the messages that arrive at the controller now."""
        line = self._lines[SENSE]
        for packet in self._sensors.packets(self._context, self.cycle, self._message_time):
            line.send(packet)
        return [(packet.channel, packet.data) for packet in line.arrivals(self.cycle)]

    def _message_time(self, channel: str) -> int:
        error = self._lines[SENSE].clock_error(channel)
        return self._epoch + round(self.time * _MICROSECONDS) + round(error * _MICROSECONDS)

    # -- faults

    def begin(self, fault: InjectedFault) -> None:
        """Begin a fault, from the next message on, in place of one of the same name and side.

        Raises:
            InjectedFaultError: The machine has no such channel.
        """
        channels = self._sensors.channels if fault.side == SENSE else self.channels
        for channel in fault.channels:
            if channel not in channels:
                raise InjectedFaultError(
                    f"the machine has no {fault.side} channel {channel!r}; it has: {', '.join(channels)}"
                )
        self._lines[fault.side].begin(fault)

    def end_faults(self) -> None:
        """End all injected faults."""
        for line in self._lines.values():
            line.end_faults()

    def status(self) -> MachineStatus:
        """Return the present status."""
        return MachineStatus(
            cycle=self.cycle,
            time=self.time,
            braking=self._brake.engaged,
            silent=list(self._silent),
            accepted={name: received.count for name, received in self._received.items()},
            rejected={name: dict(received.rejected) for name, received in self._received.items()},
            faults=[fault.to_dict() for line in self._lines.values() for fault in line.faults.values()],
        )


class HoldingBrake:
    """The brake of the machine itself, which engages when no commands arrive.

    ``lock``: the joints that have actuators stop at once, as if brakes engaged, and the actuators get their idle
    commands; it needs a discrete plant. ``idle``: the actuators get their idle commands. ``hold``: they keep the last
    ones, unless the machine's own stop is pressed: that applies the idle ones. Position commands (in rad or m) are
    always kept: another one would move the machine.

    Args:
        world: The world of the machine.
        kind: One of `BRAKES`; empty for ``lock`` if the plant is discrete, else ``idle``.

    Attributes:
        engaged: True while it brakes.
        idle: The idle commands by actuator signal; arrays for vector signals.

    Raises:
        ValueError: Joints of a continuous plant cannot be locked.
    """

    def __init__(self, world: WorldAlone, kind: str) -> None:
        plant = world.plant
        lockable = plant is not None and plant.time_step() > 0.0
        if kind == LOCK and not lockable:
            raise ValueError("only the joints of a discrete plant can be locked: choose the brake idle or hold")
        self._kind = kind or (LOCK if lockable else IDLE)
        self.engaged = False
        self.idle = {s.name: s.vector(s.idle) if s.is_vector else s.idle for s in world.interface.act}
        self._positions = {s.name for s in world.interface.act if is_position(s)}
        self._plant = plant
        self._joints = []
        if plant is not None and self._kind == LOCK:
            self._joints = [plant.get_joint_actuator(index).joint() for index in plant.GetJointActuatorIndices()]

    @property
    def ends_commands(self) -> bool:
        """Return whether the machine does without commands: a brake that holds the last ones does not."""
        return self.engaged and self._kind != HOLD

    def actuation(self, name: str, command: Any, stale: bool, *, stopped: bool = False) -> Any:
        """Return the command that acts on an actuator.

        Args:
            name: Name of the actuator signal.
            command: The newest command that the machine has accepted; None if there is none yet.
            stale: Whether that command is too old to be obeyed.
            stopped: Whether the machine's own stop is pressed.
        """
        idle = (stopped or (self._kind != HOLD if self.engaged else stale)) and name not in self._positions
        return self.idle[name] if idle or command is None else command

    def set(self, context: Context, engaged: bool) -> None:
        """Engage or release the brake in a context of the world.

        Args:
            context: The context, in which joints are locked or unlocked if the kind is ``lock``.
            engaged: Whether the brake engages; if it does not, it is released.
        """
        if engaged == self.engaged:
            return
        self.engaged = engaged
        if self._plant is not None:
            plant_context = self._plant.GetMyMutableContextFromRoot(context)
            for joint in self._joints:
                if engaged:
                    joint.Lock(plant_context)
                else:
                    joint.Unlock(plant_context)


class _Disturbances:
    r"""First-order Gauss-Markov processes that are added to what acts, one for each entry of an actuator signal.

    d_k = r d_{k-1} + sqrt(1 - r^2) sigma n_k with r = exp(-period / disturbance_time) and n of N(0, 1).
    """

    def __init__(self, world: WorldAlone, period: float, config: MachineConfig, random: np.random.Generator) -> None:
        sizes = {signal.name: signal.size for signal in world.interface.act if signal.size is not None}
        for name in config.disturbance:
            if name not in sizes:
                raise ValueError(f"a disturbance acts on vector actuator signals ({', '.join(sizes)}), not on {name!r}")
        self._random, self._decay = random, float(np.exp(-period / config.disturbance_time))
        self._deviations = config.disturbance
        self._values = {name: std * random.standard_normal(sizes[name]) for name, std in config.disturbance.items()}

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def following(self, name: str) -> np.ndarray:
        """Return the disturbance of a signal in the next cycle."""
        value = self._values[name]
        drive = self._deviations[name] * np.sqrt(1.0 - self._decay**2)
        self._values[name] = self._decay * value + drive * self._random.standard_normal(value.shape)
        return self._values[name]


class _Sensors:
    """Makes messages of the simulated sensor signals, with noise, and of what the machine reports of itself."""

    def __init__(
        self,
        world: WorldAlone,
        protocol: Protocol,
        period: float,
        deviations: Mapping[str, float],
        random: np.random.Generator,
        *,
        actuation: Mapping[str, Any],
        mode: Callable[[RobotMode], int],
    ) -> None:
        signals = {signal.name: signal for signal in world.interface.sense}
        vectors = [signal.name for signal in signals.values() if signal.is_vector]
        for name in deviations:
            if name not in vectors:
                raise ValueError(f"noise is added to vector sensor signals ({', '.join(vectors)}), not to {name!r}")
        self._noise = deviations
        self._random = random
        self._actuation = actuation  # Kept up to date by the machine.
        reports = Reports(world.interface, protocol.reported, protocol.robot_mode)
        signals_by_name = signals | {signal.name: signal for signal in reports.signals}
        self._reported = {signal.name: name for name, signal in reports.carriers.items()}
        self._robot_mode, self._mode = protocol.robot_mode, mode
        self._maps = [(map, map.encoder([signals_by_name[name] for name in map.signals])) for map in protocol.sense]
        self._cycles = {
            map.channel: max(1, round(protocol.periods.get(map.channel, period) / period)) for map in protocol.sense
        }
        self._due = dict.fromkeys(self._cycles, 0)  # The cycle of the next message: it may be skipped, and sent later.
        self._ports = {name: world.diagram.GetOutputPort(f"sense.{name}") for name in vectors}
        self._readers = {name: world.reader(f"sense.{name}") for name in signals if name not in vectors}
        self.channels = list(self._cycles)

    def packets(self, context: Context, cycle: int, time: Callable[[str], int]) -> list[Packet]:
        """Return the messages of this cycle.

        Args:
            context: The context of the world.
            cycle: The number of the cycle.
            time: The time of a message in microseconds, as a function of its channel.
        """
        packets = []
        for map, encode in self._maps:
            if cycle >= self._due[map.channel]:
                period = self._cycles[map.channel]
                self._due[map.channel] = cycle + period - (cycle - 1) % period
                values = {name: self._measure(name, context) for name in map.signals}
                age = round(map.age(values, context.get_time()) * _MICROSECONDS)
                packets.append(Packet(map.channel, map.type, encode(values, time(map.channel) - age), cycle))
        return packets

    def _measure(self, name: str, context: Context) -> Any:
        if name in self._reported:
            return self._actuation[self._reported[name]]
        if self._robot_mode is not None and name == self._robot_mode.carrier:
            return np.array([float(self._mode(self._robot_mode))])
        if name not in self._ports:
            return self._readers[name](context)
        # Not a copy: it becomes a message before anything changes.
        value = self._ports[name].Eval(context)
        deviation = self._noise.get(name)
        return value if deviation is None else value + deviation * self._random.standard_normal(value.shape)


def perturbed_values(
    world: WorldAlone, context: Context, relative: float, random: np.random.Generator
) -> dict[str, Any]:
    """Return new values, by address, of all variables of the world that `PERTURBED` names.

    Every entry is multiplied by its own factor, uniform in [1 - relative, 1 + relative], drawn in the order of the
    addresses. Values beyond the bounds of a variable are set to the bound.

    Args:
        world: The simulated world of the machine.
        context: Its root context, with the values before.
        relative: Half width of the factors' range: 0.05 is 5 %.
        random: The generator that draws the factors.
    """
    changed = {}
    for address, variable in world.variables().items():
        if variable.kind != A or variable.derived or address.rpartition(".")[2] not in PERTURBED:
            continue
        factor = 1.0 + relative * random.uniform(-1.0, 1.0, variable.shape)
        value = np.clip(variable.get(context) * factor, *variable.bounds)
        changed[address] = value if variable.shape else float(value)
    return changed
