"""An acrobot with a torque at its elbow, with the iiwa messages of an arm with two joints."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import lcm
import numpy as np
from drake import lcmt_iiwa_command, lcmt_iiwa_status
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import BasicVector, Context, System
from pydrake.systems.primitives import Demultiplexer

from tests.testbeds import ACROBOT
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.iiwa_messages import iiwa_command, iiwa_status
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.state import AddressedSystem
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

PERIOD = 0.001
ELBOW = "sim.sys.Acrobot.elbow.position"
STATUS, COMMAND = "IIWA_STATUS", "IIWA_COMMAND"
SENSE = {"position": "joint_position_measured", "velocity": "joint_velocity_estimated"}


class Swing(AddressedSystem):
    """Torque against the elbow's motion, and a rhythm; sampled.

    .. pydrake_system::

        name: Swing
        input_ports:
        - position
        - velocity
        output_ports:
        - torque
    """

    def __init__(self, period: float) -> None:
        super().__init__()
        self._velocity = self.DeclareVectorInputPort("velocity", 2)
        self._position = self.DeclareVectorInputPort("position", 2)
        self._torque = self.DeclareDiscreteState(BasicVector([0.0]))
        self.DeclareStateOutputPort("torque", self._torque)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, discrete: object) -> None:
        torque = np.sin(20.0 * context.get_time()) - self._velocity.Eval(context)[1] - self._position.Eval(context)[1]
        discrete.set_value(0, [torque])  # type: ignore[attr-defined]


@dataclass
class RobotScenario(Scenario):
    """The acrobot in steps of a millisecond."""

    simulator_config: SimulatorConfig = field(default_factory=SimulatorConfig)
    time_step: float = PERIOD

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("position", size=2, unit="rad"), Signal("velocity", size=2, unit="rad/s")],
            act=[Signal("torque", size=1, unit="N m", lower=-10.0, upper=10.0, idle=0.0)],
        )

    def make_dps(self) -> System:
        return Swing(PERIOD)

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(MultibodyPlantConfig(time_step=self.time_step))
        Parser(plant).AddModelsFromUrl(ACROBOT)
        plant.Finalize()
        split = builder.add("sense", "joints", Demultiplexer([2, 2]))
        builder.connect(plant.get_state_output_port(), split.get_input_port())
        builder.sim_sensor("position", split.get_output_port(0))
        builder.sim_sensor("velocity", split.get_output_port(1))
        builder.sim_actuator("torque", plant.get_actuation_input_port())

    def deployment(self) -> Deployment:
        protocol = Protocol(sense=[iiwa_status(SENSE)], act=[iiwa_command({"torque": "joint_torque"})])
        return Deployment(protocol=protocol, continuity={"torque": None})


def torque(value: float, utime: int) -> bytes:
    """Return a torque command."""
    message = lcmt_iiwa_command()
    message.utime, message.num_torques, message.joint_torque = utime, 1, [value]
    return message.encode()


def state(data: bytes) -> np.ndarray:
    """Return the positions and velocities in a state message."""
    message = lcmt_iiwa_status.decode(data)
    return np.array([*message.joint_position_measured, *message.joint_velocity_estimated])


class Listener:
    """A controller on the bus that uses liblcm: it records what the machine sends, and commands it.

    Attributes:
        heard: states of the machine, as bytes.
        statuses: the status messages of the machine.
    """

    def __init__(self, url: str) -> None:
        self._lcm = lcm.LCM(url)
        self.heard: list[bytes] = []
        self.statuses: list[dict[str, Any]] = []
        self._lcm.subscribe(STATUS, lambda _, data: self.heard.append(data))
        self._lcm.subscribe("VTB_MACHINE_STATUS", lambda _, data: self.statuses.append(json.loads(data)))

    def wait(self, condition: Callable[[list[bytes]], bool]) -> list[bytes]:
        """Wait until the condition is fulfilled, and return what was heard."""
        while not condition(self.heard):
            assert self._lcm.handle_timeout(60_000), "no message within 60 s"
        return self.heard

    def next(self) -> bytes:
        """Return the next state."""
        count = len(self.heard)
        return self.wait(lambda heard: len(heard) > count)[count]

    def until_cycle(self, cycle: int) -> list[bytes]:
        """Return what is heard until the machine has done this number of cycles; its status, which follows, says so."""
        self._lcm.publish("VTB_MACHINE", b'{"request": "status"}')
        self.wait(lambda heard: bool(self.statuses) and self.statuses[-1]["cycle"] == cycle)
        return list(self.heard)

    def command(self, value: float, utime: int) -> None:
        self._lcm.publish(COMMAND, torque(value, utime))

    def publish(self, channel: str, data: bytes) -> None:
        self._lcm.publish(channel, data)
