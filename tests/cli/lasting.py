"""Scenarios that last in one state: they say so, and compute in one call of C that no signal interrupts."""

from __future__ import annotations

from dataclasses import dataclass

from pydrake.systems.framework import Context, LeafSystem

from tests.control.servo_machine import ServoMachineScenario
from tests.testbeds import PendulumScenario
from vtbdrake.testbed import VirtualTestbedBuilder

BUILDING = "it is building"
STEPPING = "it is stepping"
JUDGING = "it is judging"


def last(state: str) -> None:
    """Print the state, and compute for many minutes, without a look at signals, with the interpreter's lock held."""
    print(state, flush=True)
    sum(range(10**12))


@dataclass
class BuildScenario(PendulumScenario):
    """It is built for ever."""

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        last(BUILDING)


class _Lasting(LeafSystem):
    def __init__(self) -> None:
        super().__init__()
        self.DeclarePeriodicPublishEvent(0.05, 0.05, self._last)

    def _last(self, context: Context) -> None:
        last(STEPPING)


@dataclass
class StepScenario(PendulumScenario):
    """Its first step is computed for ever."""

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        super().add_world(builder)
        builder.add("sys", "lasting", _Lasting())


@dataclass
class StepMachineScenario(ServoMachineScenario):
    """The first step of its machine is computed for ever."""

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        super().add_world(builder)
        builder.add("sys", "lasting", _Lasting())


def judge(angle: float) -> float:
    """Return a quality that is computed for ever."""
    last(JUDGING)
    return angle
