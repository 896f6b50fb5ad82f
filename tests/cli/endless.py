"""A scenario whose DPS gets stuck in a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydrake.systems.framework import Context, System

from tests.control.scripted import Servo
from tests.control.servo_machine import ServoMachineScenario

STEPS = 20


class EndlessServo(Servo):
    """A servo whose step does not end from the twentieth on."""

    def _update(self, context: Context, discrete: Any) -> None:
        super()._update(context, discrete)
        while discrete.value(1) >= STEPS:
            pass


@dataclass
class EndlessScenario(ServoMachineScenario):
    """Without a limit of the rate."""

    rate: float = 0.0

    def make_dps(self) -> System:
        return EndlessServo()
