"""A scenario whose command has a limit of its rate, and that does not say from where it departs."""

from __future__ import annotations

from dataclasses import dataclass

from tests.control.servo_machine import ServoMachineScenario
from vtbdrake.control.operation import Operation


@dataclass
class CarelessScenario(ServoMachineScenario):
    """As it says."""

    def operation(self) -> Operation:
        return Operation()
