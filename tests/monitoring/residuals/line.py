"""A machine in the same process, in lock-step with the loop that commands it, and loops that only listen."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping
from math import inf
from typing import Any

from vtbdrake.control.bridge import Bridge, Reports
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.guards import Guards
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.runtime import Runtime
from vtbdrake.lcm.lcm_bridge import ChannelReader, ChannelWriter, SentSignal
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.machine.machine import Machine
from vtbdrake.testbed import DpsAlone, Scenario, VirtualTestbed

Falsify = Callable[[str, bytes], bytes]


class Ear(Bridge):
    """A bridge that takes messages from ``heard``, as an `LcmBridge` does from the bus."""

    def __init__(self, scenario: Scenario) -> None:
        protocol, self.interface = protocol_of(scenario), scenario.interface()
        reports = Reports(self.interface, protocol.reported, protocol.robot_mode)
        self.sensed = {signal.name: ReceivedSignal() for signal in self.interface.sense}
        self.reported = reports.acting
        self.commands = {}
        self.heard: deque[tuple[str, bytes]] = deque()
        signals = {signal.name: signal for signal in [*self.interface.sense, *reports.signals]}
        received = self.sensed | reports.received
        self._readers = {
            map.channel: ChannelReader(map, [signals[name] for name in map.signals], received, 0.1)
            for map in protocol.sense
        }

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass

    @property
    def connected(self) -> bool:
        return True

    def poll(self, timeout: float = 0.0) -> int:
        count = len(self.heard)
        while self.heard:
            channel, data = self.heard.popleft()
            self._readers[channel].receive(channel, data)
        return count

    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        raise AssertionError("who only listens actuation nothing")


class Line(Ear):
    """A bridge to a machine: every poll but the first advances it by one cycle and takes its state.

    Attributes:
        falsify: changes messages of the machine on their way to all who listen.
        ears: others that hear the machine.
    """

    def __init__(self, scenario: Scenario, machine: Machine) -> None:
        super().__init__(scenario)
        self.machine = machine
        self.falsify: Falsify = lambda channel, data: data
        self.ears: list[Ear] = []
        signals = {signal.name: signal for signal in self.interface.act}
        sent = {name: SentSignal() for name in signals}
        self._writers = [
            ChannelWriter(map, [signals[n] for n in map.signals], sent) for map in protocol_of(scenario).act
        ]
        self._begun = False
        self._utime = 0

    def poll(self, timeout: float = 0.0) -> int:
        if self._begun:
            self.machine.advance()
        self._begun = True
        for channel, data in self.machine.messages():
            told = channel, self.falsify(channel, data)
            for ear in (self, *self.ears):
                ear.heard.append(told)
        return super().poll()

    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        self._utime += 1
        for writer in self._writers:
            message = writer.message(actuation, self._utime)
            assert message is not None
            self.machine.receive(writer.channel, message[1])
        return ()


def loop(
    target: VirtualTestbed | DpsAlone, bridge: Bridge, period: float, *, begin: bool = True, **values: Any
) -> Runtime:
    """Return a runtime with a simulated clock, whose sensors are never stale; ``values`` are by address."""
    context = target.default_context()
    target.write(context, values)
    guards = Guards(target.interface, period, max_missed=inf)
    runtime = Runtime(target, bridge, period=period, context=context, clock=SimulatedClock(), guards=guards)
    if not begin:
        return runtime
    if isinstance(target, DpsAlone):
        runtime.start_dps()
    for signal in target.interface.act:
        if guards.limiters[signal.name].needs_start:
            guards.start(signal.name, runtime.actuator_command(signal.name))
    return runtime


class Together:
    """A machine, the loop that drives it, and one that shadows it."""

    def __init__(
        self,
        scenario: Scenario,
        machine: Machine,
        *,
        shadowing: Scenario | None = None,
        values: Mapping[str, Any] | None = None,
    ) -> None:
        self.line = Line(scenario, machine)
        period = machine.period
        self.driver = loop(DpsAlone(scenario), self.line, period, **(values or {}))
        self.shadow: Runtime | None = None
        if shadowing is not None:
            ear = Ear(shadowing)
            self.line.ears.append(ear)
            self.shadow = loop(shadowing.build(mode="shadow"), ear, period, **(values or {}))

    def run(self, cycles: int) -> None:
        for _ in range(cycles):
            for runtime in (self.driver, self.shadow):
                if runtime is not None:
                    # Commands are limited by the time that has passed.
                    runtime.clock.wait_until(runtime.clock.now() + runtime.period)
                    runtime.cycle()
