"""A DPS with a slow part, for the tests: it estimates where its target is, beside a fast law that goes there."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, DiscreteTimeIntegrator, Gain, ZeroOrderHold

from tests.control.scripted import PERIOD
from vtbdrake.testbed import Interface, Scenario, Signal, SlowPart, VirtualTestbedBuilder


def chaotic(position: np.ndarray, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Forgets no bit of what it was given, in whichever order."""
    mixed = 3.9 * memory * (1.0 - memory) + 1e-3 * np.sin(position)
    return np.cos(7.0 * mixed + position), mixed


def gated(position: np.ndarray, memory: np.ndarray, *, gate: str) -> tuple[np.ndarray, np.ndarray]:
    """As `chaotic`, after somebody has opened the gate, a named pipe, for writing."""
    with open(gate, "rb"):
        return chaotic(position, memory)


def processes(position: np.ndarray) -> np.ndarray:
    """Who computes, and who keeps it running."""
    return np.array([os.getpid(), os.getppid()], dtype=float)


def deadly(position: np.ndarray) -> np.ndarray:
    if position[0] < 0.0:
        os._exit(7)
    return position


def busy(position: np.ndarray) -> np.ndarray:
    """Takes 50 ms of a processor."""
    end = time.process_time() + 0.05
    while time.process_time() < end:
        position = np.sort(position)
    return position + 1.0


def picky(position: np.ndarray) -> np.ndarray:
    if position[0] < 0.0:
        raise ArithmeticError("where is that?")
    return 2.0 * position


@dataclass
class SlowScenario(Scenario):
    """Two axes whose velocity is estimate - position."""

    simulator_config: SimulatorConfig = field(default_factory=lambda: SimulatorConfig(max_step_size=0.1, accuracy=1e-6))
    period: float = 0.02
    latency: float = 0.01
    function: Callable[..., Any] = chaotic
    more: dict[str, Any] = field(default_factory=lambda: {"memory": np.array([0.3, 0.6])})

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("position", size=2, unit="m")],
            act=[Signal("velocity", size=2, unit="m/s", idle=0.0)],
        )

    def make_dps(self) -> Diagram:
        builder = DiagramBuilder()
        part = SlowPart(
            self.function,
            inputs={"position": 2},
            outputs={"estimate": 2},
            period=self.period,
            latency=self.latency,
            **self.more,
        )
        perception = builder.AddNamedSystem("perception", part)
        minus = builder.AddNamedSystem("minus", Gain(-1.0, 2))
        law = builder.AddNamedSystem("law", Adder(2, 2))
        hold = builder.AddNamedSystem("hold", ZeroOrderHold(PERIOD, 2))
        builder.ExportInput(perception.GetInputPort("position"), "position")
        builder.ConnectInput("position", minus.get_input_port())
        builder.Connect(perception.GetOutputPort("estimate"), law.get_input_port(0))
        builder.Connect(minus.get_output_port(), law.get_input_port(1))
        builder.Connect(law.get_output_port(), hold.get_input_port())
        builder.ExportOutput(hold.get_output_port(), "velocity")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        axes = builder.add("sys", "axes", DiscreteTimeIntegrator(2, PERIOD))
        builder.sim_sensor("position", axes.get_output_port())
        builder.sim_actuator("velocity", axes.get_input_port())


def moving(t: float) -> Mapping[str, Any]:
    """Return what the machine's sensor shows."""
    return {"position": [np.sin(30.0 * t), 0.5 * np.cos(17.0 * t)]}
