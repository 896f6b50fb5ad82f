"""Two axes that are a machine: they speak the iiwa messages, and say how their DPS is run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

from drake import lcmt_scope

from tests.control.scripted import PERIOD, ServoScenario
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.iiwa_messages import iiwa_command, iiwa_status
from vtbdrake.lcm.maps import vector_map
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.testbed import Interface

COMMAND = "IIWA_COMMAND"
PATIENCE = 60.0  # s for whatever has to happen


@dataclass
class ServoMachineScenario(ServoScenario):
    """Sensor signals stay fresh on a computer that is busy, and the machine, which is slow there, keeps no pace."""

    max_age: float = PATIENCE
    lock_step: bool = False
    leave_time: float = 0.0

    def interface(self) -> Interface:
        interface = super().interface()
        return replace(interface, sense=[replace(signal, max_age=self.max_age) for signal in interface.sense])

    def deployment(self) -> Deployment:
        protocol = Protocol(
            sense=[iiwa_status({"position": "joint_position_measured", "speed": "joint_velocity_estimated"})],
            act=[iiwa_command({"velocity": "joint_torque"})],
            commands=[vector_map("TARGET", lcmt_scope, {"target": "value"})],
        )
        deployment = Deployment(
            protocol=protocol,
            period=PERIOD,
            guards={"max_missed": inf, "pace_tolerance": inf, "leave_time": self.leave_time},
            continuity={"velocity": ("speed", 5.0)},
            pace="position",
            patience=PATIENCE / PERIOD,
        )
        return deployment.in_lock_step("position", wait=PATIENCE) if self.lock_step else deployment
