"""A machine in the same process, in lock-step with the runtime's own clock: for what has to be exact."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, System
from pydrake.systems.primitives import DiscreteTimeIntegrator, ZeroOrderHold

from vtbdrake.control.bridge import Bridge
from vtbdrake.control.clock import Clock
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

PERIOD = 0.001


class ScriptedBridge(Bridge):
    """Delivers what ``sensors(t)`` says at every poll, and keeps what is published, with the time."""

    real_time = False

    def __init__(self, interface: Interface, clock: Clock, sensors: Callable[[float], Mapping[str, Any]]) -> None:
        self.interface = interface
        self.sensed = {signal.name: ReceivedSignal() for signal in interface.sense}
        self.commands = {}
        self.sent: list[tuple[float, dict[str, Any]]] = []
        self.sensors = sensors
        self.up = True
        self._clock = clock

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass

    @property
    def connected(self) -> bool:
        return self.up

    def poll(self, timeout: float = 0.0) -> int:
        if timeout:
            self._clock.wait_until(self._clock.now() + min(timeout, PERIOD))
        now = self._clock.now()
        values = self.sensors(now)
        for name, value in values.items():
            received = self.sensed[name]
            received.value, received.arrived, received.count = np.asarray(value), now, received.count + 1
        return len(values)

    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        if not self.up:
            return tuple(actuation)
        self.sent.append((self._clock.now(), {name: np.array(value) for name, value in actuation.items()}))
        return ()


class Servo(AddressedSystem):
    """A DPS: velocity = gain (target - position), sampled; it raises or commands NaN when it is told to.

    .. pydrake_system::

        name: Servo
        input_ports:
        - position
        - speed
        - target
        output_ports:
        - velocity
    """

    def __init__(self) -> None:
        super().__init__()
        self._position = self.DeclareVectorInputPort("position", 2)
        self.DeclareVectorInputPort("speed", 2)
        self._target = self.DeclareVectorInputPort("target", 2)
        self._gain = self.declare_parameters(gain=Quantity(5.0, "1/s", (0.0, 1e3)))
        self._faults = self.declare_parameters(trouble=Quantity(bounds=(0.0, 2.0)))
        self._command = self.declare_discrete_state(velocity=Quantity([0.0, 0.0], "m/s"))
        self._counter = self.declare_discrete_state(ticks=Quantity())
        self._sensed = self.declare_discrete_state(seen=Quantity([0.0, 0.0], "m"))
        self.DeclareStateOutputPort("velocity", self._command.index)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    @staticmethod
    def law(gain: float, error: np.ndarray) -> np.ndarray:
        """Return the velocity that is commanded in a distance from the target."""
        return gain * error

    def _update(self, context: Context, discrete: Any) -> None:
        trouble = self._faults.view(context).trouble
        if trouble == 1.0:
            raise RuntimeError("out of ideas")
        position = self._position.Eval(context)
        velocity = self.law(self._gain.view(context).gain, self._target.Eval(context) - position)
        self._command.mutable(discrete).velocity = velocity if trouble == 0.0 else [np.nan, 0.0]
        self._counter.mutable(discrete).ticks += 1.0
        self._sensed.mutable(discrete).seen = position


@dataclass
class ServoScenario(Scenario):
    """Two axes without mass that are commanded by their velocity; a rate of 0 is no limit."""

    simulator_config: SimulatorConfig = field(default_factory=lambda: SimulatorConfig(max_step_size=0.1, accuracy=1e-6))
    rate: float = 2.0

    def interface(self) -> Interface:
        return Interface(
            sense=[
                Signal("position", size=2, unit="m", lower=-2.0, upper=2.0, max_age=0.0105),
                Signal("speed", size=2, unit="m/s", max_age=0.0105),
            ],
            act=[Signal("velocity", size=2, unit="m/s", lower=-1.0, upper=1.0, rate=self.rate or np.inf, idle=0.0)],
            commands=[Signal("target", size=2, unit="m")],
        )

    def make_dps(self) -> System:
        return Servo()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        axes = builder.add("sys", "axes", DiscreteTimeIntegrator(2, PERIOD))
        drives = builder.add("act", "drives", ZeroOrderHold(PERIOD, 2))
        builder.connect(drives.get_output_port(), axes.get_input_port())
        builder.sim_sensor("position", axes.get_output_port())
        builder.sim_sensor("speed", drives.get_output_port())
        builder.sim_actuator("velocity", drives.get_input_port())
        builder.believe("sim.sys.axes.discrete_state_0", of=["dps.seen"])
