"""The two axes of `tests.control.scripted`, with sensor values that change in every cycle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tests.control.scripted import PERIOD, ScriptedBridge, ServoScenario
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.guards import Guards
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import Cycle
from vtbdrake.testbed import DpsAlone


def wandering(t: float) -> Mapping[str, Any]:
    """Return values of both signals that differ at any time; the position comes in every other cycle only."""
    cycle = round(t / PERIOD)
    values = {"speed": np.cos([5.0 * t, 3.0 * t])}
    return values | ({"position": 0.3 * np.sin([37.0 * t + 1.0, 11.0 * t])} if cycle % 2 == 0 else {})


class Servo:
    """A loop in lock-step with a simulated clock, on real from its second cycle on.

    Args:
        alone: steps the DPS alone.
        begun: its first cycle is done, and its switches are thrown.
        scenario: another one than the servo's own.

    Attributes:
        cycles: all that there were.
    """

    def __init__(self, *, alone: bool = True, begun: bool = True, scenario: ServoScenario | None = None) -> None:
        self.scenario = scenario or ServoScenario(rate=0.0)
        target = DpsAlone(self.scenario) if alone else self.scenario.build()
        clock = SimulatedClock()
        self.bridge = ScriptedBridge(self.scenario.interface(), clock, wandering)
        self.cycles: list[Cycle] = []
        self.runtime = Runtime(
            target,
            self.bridge,
            period=PERIOD,
            clock=clock,
            guards=Guards(self.scenario.interface(), PERIOD),
            watchers=(self.cycles.append,),
        )
        if begun:
            self.runtime.cycle()
            self.runtime.switch("real")

    @property
    def commands(self) -> np.ndarray:
        """Return the actuator commands of the DPS, (n, 2); NaN where it had none."""
        return np.array([cycle.actuation.get("velocity", [np.nan, np.nan]) for cycle in self.cycles])
