"""A loop and its machine in one process, in lock-step: deterministic, without a bus and without a clock that runs."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import AbstractContextManager
from math import floor
from typing import Any, Self

from vtbdrake.control.bridge import Bridge, Reports
from vtbdrake.control.clock import Clock, SimulatedClock
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.runtime import Runtime
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.lcm_bridge import ChannelReader, ChannelWriter, SentSignal
from vtbdrake.machine.config import MachineConfig
from vtbdrake.machine.machine import Machine
from vtbdrake.testbed import DpsAlone, Scenario, VirtualTestbed, WorldAlone

_REORDER_WINDOW = 0.1  # s, see `LcmBridge`
_ON_GRID = 1e-6  # of a cycle: a time that close to its beginning belongs to it


class MachineBridge(Bridge):
    """Connects a loop to a `Machine` in the same process, by the messages of its protocol.

    The machine does a cycle whenever the clock has advanced by its period, and sends its messages once per cycle.

    Args:
        machine: The machine, in its cycle 0.
        clock: The clock of the loop; cycle k of the machine begins k periods after its present time.

    Attributes:
        machine: The machine.
        cut: Whether the connection is cut: nothing arrives, and no command leaves.
        dead: Whether the machine is dead, until `restart`: nothing moves and nothing arrives.
    """

    real_time = False

    def __init__(self, machine: Machine, clock: Clock) -> None:
        protocol, interface = machine.protocol, machine.world.interface
        self.interface = interface
        self.machine = machine
        self.cut = self.dead = False
        self.channels = {name: map.channel for map in protocol.sense for name in map.signals}
        self.sensed = {signal.name: ReceivedSignal() for signal in interface.sense}
        reports = Reports(interface, protocol.reported, protocol.robot_mode)
        self.reported, self.robot_mode = reports.acting, reports.robot_mode
        # Those that come from outside would be published by an operator; here they are written by address.
        self.commands = {}
        self._clock = clock
        self._start = clock.now()
        self._sent_cycle = -1
        received = self.sensed | reports.received
        signals = {signal.name: signal for signal in (*interface.sense, *reports.signals)}
        self._readers = {
            map.channel: ChannelReader(
                map, [signals[name] for name in map.signals], received, _REORDER_WINDOW, clock=clock.now
            )
            for map in protocol.sense
        }
        actuators = {signal.name: signal for signal in interface.act}
        self.sent = {name: SentSignal() for name in actuators}
        self._writers = [
            ChannelWriter(map, [actuators[name] for name in map.signals], self.sent) for map in protocol.act
        ]
        self._utime = 0

    def restart(self, machine: Machine) -> None:
        """Continue with another machine of the same scenario, in its cycle 0."""
        self.machine, self.dead = machine, False
        self._start, self._sent_cycle = self._clock.now(), -1

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass

    @property
    def connected(self) -> bool:
        return not self.cut

    def poll(self, timeout: float = 0.0) -> int:
        if timeout:
            self._clock.wait_until(self._clock.now() + min(timeout, self.machine.period))
        cycle = floor((self._clock.now() - self._start) / self.machine.period + _ON_GRID)
        count = 0
        while not self.dead and self._sent_cycle < cycle:
            if self._sent_cycle >= 0:
                self.machine.advance()
            self._sent_cycle += 1
            for channel, data in self.machine.messages():
                if not self.cut:
                    self._readers[channel].receive(channel, data)
                    count += 1
        return count

    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        if self.cut:
            return tuple(actuation)
        self._utime = max(self._utime + 1, round(1e6 * self._clock.now()))
        left: set[str] = set()
        for writer in self._writers:
            message = writer.message(actuation, self._utime)
            if message is not None:
                names, data = message
                if not self.dead:
                    self.machine.receive(writer.channel, data)
                left.update(names)
        return tuple(name for name in actuation if name not in left)


class LockStep(AbstractContextManager["LockStep"]):
    """The DPS of a scenario, which commands the simulated machine of the same scenario, cycle by cycle.

    For example::

        with LockStep(ArmScenario()) as loop:
            loop.runtime.take_over(timeout=1.0)
            loop.machine.begin(Drop(channels=("ARM_STATUS",)))
            loop.runtime.run(cycles=100)

    Args:
        scenario: A scenario whose deployment has a protocol.
        target: The testbed or DPS alone to run; by default a new DPS alone.
        config: The configuration of the machine.
        values: Variables of the target to set before the first cycle, by address.
        world: The world of the scenario, if it has been built already, see `Machine`.

    Attributes:
        machine: The machine; `Machine.begin` injects faults.
        clock: The clock of the loop, which advances by a period per cycle.
        bridge: The connection of the two.
        deployment: How the DPS runs.
        runtime: The loop.

    Raises:
        ProtocolError: The deployment of the scenario has no protocol, or one that does not fit its signals.
        DeploymentError: The DPS cannot run safely.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        target: DpsAlone | VirtualTestbed | None = None,
        config: MachineConfig | None = None,
        values: Mapping[str, Any] | None = None,
        world: WorldAlone | None = None,
    ) -> None:
        self.machine = Machine(scenario, config, world=world)
        self.clock = SimulatedClock()
        self.bridge = MachineBridge(self.machine, self.clock)
        # By the clock: where messages began the cycles, those that fail to come would stop it.
        self.deployment = Deployment.of(scenario, pace="")
        target = target or DpsAlone(scenario)
        context = target.default_context()
        target.write(context, values or {})
        self.runtime: Runtime = self.deployment.runtime(target, self.bridge, context=context, clock=self.clock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.runtime.close()
