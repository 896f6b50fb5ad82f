"""Small testbeds whose best decision is known."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass, field

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, EventStatus, LeafSystem
from pydrake.systems.primitives import LinearSystem

from tests.testbeds import PENDULUM
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

PERIOD = 0.01

# Switching times at which a treacherous DPS kills its process, or hangs.
KILL, HANG = 2.25, 2.5


class BangBang(AddressedSystem):
    """Pushes with all its force until the switching time, then pulls with it, until twice that time.

    .. pydrake_system::

        name: BangBang
        input_ports:
        - state
        - switch
        output_ports:
        - force
    """

    def __init__(self, strength: float, *, ends: bool = True, treacherous: bool = False) -> None:
        super().__init__()
        self._strength, self._ends, self._treacherous = strength, ends, treacherous
        self._command = self.declare_discrete_state(force=Quantity(unit="N"))
        self._position_and_velocity = self.declare_discrete_state(estimate=Quantity([0.0, 0.0], "m, m/s"))
        self._sensor = self.DeclareVectorInputPort("state", BasicVector(2))
        self._switch = self.DeclareVectorInputPort("switch", BasicVector(1))
        self.DeclareStateOutputPort("force", self._command.index)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        (switch,) = self._switch.Eval(context)
        while self._treacherous and switch == HANG:
            time.sleep(1.0)
        if self._treacherous and switch == KILL:
            os.kill(os.getpid(), signal.SIGKILL)
        t = context.get_time() + 1e-9
        force = self._strength * (1.0 if t < switch else -1.0 if t < 2.0 * switch or not self._ends else 0.0)
        self._command.mutable(discrete).force = force
        self._position_and_velocity.mutable(discrete).estimate = self._sensor.Eval(context)


@dataclass
class MassScenario(Scenario):
    """A mass of 1 kg that a force of 1 N moves from rest: after t it is t^2 / 2 further.

    Its DPS believes what it has sensed last. Sampled every 10 ms; the force acts a period after it was decided. When
    twice the switching time has passed, the mass rests switch^2 further.
    """

    simulator_config: SimulatorConfig = field(default_factory=SimulatorConfig)
    mass: float = 1.0
    treacherous: bool = False

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("state", size=2, unit="m, m/s")],
            act=[Signal("force", size=1, unit="N", idle=0.0)],
            commands=[Signal("switch", size=1, unit="s", lower=0.0)],
        )

    def make_dps(self) -> LeafSystem:
        return BangBang(1.0, treacherous=self.treacherous)

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        h = PERIOD
        A, B = np.array([[1.0, h], [0.0, 1.0]]), np.array([[h * h / 2.0], [h]]) / self.mass
        mass = builder.add("sys", "mass", LinearSystem(A, B, np.eye(2), np.zeros((2, 1)), h))
        builder.sim_sensor("state", mass.get_output_port())
        builder.sim_actuator("force", mass.get_input_port())
        builder.believe("sim.sys.mass.discrete_state_0", of=["dps.estimate"], age=PERIOD)


class Fence(AddressedSystem):
    """Ends the simulation when the mass is past a position, in m."""

    def __init__(self, position: float) -> None:
        super().__init__()
        self._position = position
        self._state = self.DeclareVectorInputPort("state", BasicVector(2))
        self.DeclarePeriodicUnrestrictedUpdateEvent(10 * PERIOD, 0.0, self._check)

    def _check(self, context: Context, _: object) -> EventStatus:
        if self._state.Eval(context)[0] > self._position:
            return EventStatus.ReachedTermination(self, "the mass has left its track")
        return EventStatus.Succeeded()


@dataclass
class FencedMassScenario(MassScenario):
    """The mass on a track that ends."""

    track: float = 1.0

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        super().add_world(builder)
        fence = builder.add("env", "fence", Fence(self.track))
        builder.connect(builder.sensors["state"], fence.get_input_port())


@dataclass
class SwingUpScenario(Scenario):
    """Drake's pendulum (1 kg at 0.5 m, damping 0.1 N m s), swung up by one torque that changes its sign once."""

    simulator_config: SimulatorConfig = field(
        default_factory=lambda: SimulatorConfig(accuracy=1e-6, max_step_size=0.05)
    )
    torque: float = 2.5

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("state", size=2, unit="rad, rad/s")],
            act=[Signal("force", size=1, unit="N m", idle=0.0)],
            commands=[Signal("switch", size=1, unit="s", lower=0.0)],
        )

    def make_dps(self) -> LeafSystem:
        return BangBang(self.torque, ends=False)

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(MultibodyPlantConfig(time_step=0.0))
        Parser(plant).AddModelsFromUrl(PENDULUM)
        plant.Finalize()
        builder.sim_sensor("state", plant.get_state_output_port())
        builder.sim_actuator("force", plant.get_actuation_input_port())
