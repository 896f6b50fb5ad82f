"""A scenario with a limited rate of its actuator command, and no measurement to start from."""

from __future__ import annotations

from dataclasses import dataclass

from tests.control.servo_machine import ServoMachineScenario
from vtbdrake.deployment import Deployment


@dataclass
class CarelessScenario(ServoMachineScenario):
    """A servo machine whose deployment has no continuity."""

    def deployment(self) -> Deployment:
        return Deployment(protocol=super().deployment().protocol)
