"""A driven pendulum that speaks the iiwa messages of an arm with one joint: cheap to simulate for an hour."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, System
from pydrake.systems.primitives import Demultiplexer, ZeroOrderHold

from tests.testbeds import PENDULUM
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.iiwa_messages import iiwa_command, iiwa_status
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.machine.config import MachineConfig
from vtbdrake.machine.machine import Machine
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

PERIOD = 0.1
PAYLOAD, MASS = "sim.sys.Pendulum.arm_com.mass", 0.5


class Rhythm(AddressedSystem):
    """A torque over time with damping; its state has the last sensor values.

    .. pydrake_system::

        name: Rhythm
        input_ports:
        - position
        - velocity
        output_ports:
        - torque
    """

    def __init__(self, period: float) -> None:
        super().__init__()
        self._position = self.DeclareVectorInputPort("position", 1)
        self._velocity = self.DeclareVectorInputPort("velocity", 1)
        self._command = self.declare_discrete_state(torque=Quantity())
        self._sensed = self.declare_discrete_state(seen=Quantity([0.0, 0.0]))
        self.DeclareStateOutputPort("torque", self._command.index)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, discrete: Any) -> None:
        q, v = self._position.Eval(context), self._velocity.Eval(context)
        self._command.mutable(discrete).torque = 2.0 * np.sin(1.5 * context.get_time()) - 0.5 * v.item()
        self._sensed.mutable(discrete).seen = np.concatenate((q, v))


@dataclass
class DrivenPendulum(Scenario):
    """Drake's pendulum. A ``time_step`` of 0 makes it continuous; ``sampled`` sensors are a period late."""

    simulator_config: SimulatorConfig = field(default_factory=SimulatorConfig)
    time_step: float = PERIOD
    sampled: bool = False
    believes: bool = True

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("position", size=1, unit="rad"), Signal("velocity", size=1, unit="rad/s")],
            act=[Signal("torque", size=1, unit="N m", lower=-10.0, upper=10.0, idle=0.0)],
        )

    def deployment(self) -> Deployment:
        sense = {
            "position": "joint_position_measured",
            "velocity": "joint_velocity_estimated",
            "torque_reported": "joint_torque_commanded",
        }
        protocol = Protocol(
            sense=[iiwa_status(sense)],
            act=[iiwa_command({"torque": "joint_torque"})],
            reported={"torque": "torque_reported"},
        )
        return Deployment(protocol=protocol, continuity={"torque": None})

    def make_dps(self) -> System:
        return Rhythm(PERIOD)

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(MultibodyPlantConfig(time_step=self.time_step, use_sampled_output_ports=False))
        Parser(plant).AddModelsFromUrl(PENDULUM)
        plant.Finalize()
        split = builder.add("sense", "joint", Demultiplexer([1, 1]))
        shown = plant.get_state_output_port()
        if self.sampled:
            hold = builder.add("sense", "hold", ZeroOrderHold(PERIOD, 2))
            builder.connect(shown, hold.get_input_port())
            shown = hold.get_output_port()
        builder.connect(shown, split.get_input_port())
        builder.sim_sensor("position", split.get_output_port(0))
        builder.sim_sensor("velocity", split.get_output_port(1))
        builder.sim_actuator("torque", plant.get_actuation_input_port())
        if self.believes:
            age = PERIOD if self.sampled else 0.0
            builder.believe("sim.sys.Pendulum.theta.position", of=["dps.seen[0]"], age=age)
            builder.believe("sim.sys.Pendulum.theta.velocity", of=["dps.seen"], by=lambda seen: seen[1], age=age)


def machine(scenario: Scenario, **options: Any) -> Machine:
    """Return a machine that is simulated by ``scenario``; ``options`` are fields of `MachineConfig`."""
    return Machine(scenario, MachineConfig(period=PERIOD, timeout=100.0, **options))
