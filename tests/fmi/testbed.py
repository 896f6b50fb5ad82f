"""Testbeds with an FMU: in the world, which a DPS holds at a goal, and in a DPS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import Adder, Gain, MatrixGain, PassThrough, ZeroOrderHold

from tests.control.scripted import PERIOD, ServoScenario
from vtbdrake.fmi import FmuSystem
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder


@dataclass(repr=False, eq=False)
class TankScenario(Scenario):
    """A tank with the level x, x' = k u, whose inflow u the DPS commands."""

    path: str = ""
    fork: bool = True

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("level", 1, unit="m", lower=-10.0, upper=10.0)],
            act=[Signal("inflow", 1, unit="m^3/s", lower=-50.0, upper=50.0, idle=0.0)],
            commands=[Signal("goal", 1, unit="m", lower=-2.0, upper=2.0, default=1.0)],
        )

    def make_dps(self) -> System:
        builder = DiagramBuilder()
        hold = builder.AddNamedSystem("sense", ZeroOrderHold(0.02, 1))
        error = builder.AddNamedSystem("error", Adder(2, 1))
        minus = builder.AddNamedSystem("minus", Gain(-1.0, 1))
        gain = builder.AddNamedSystem("impl", Gain(3.0, 1))
        builder.Connect(hold.get_output_port(), minus.get_input_port())
        builder.Connect(minus.get_output_port(), error.get_input_port(0))
        builder.Connect(error.get_output_port(), gain.get_input_port())
        builder.ExportInput(hold.get_input_port(), "level")
        builder.ExportInput(error.get_input_port(1), "goal")
        builder.ExportOutput(gain.get_output_port(), "inflow")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        tank = FmuSystem(self.path, inputs={"inflow": "u"}, outputs=["x"], parameters={"k": 2.0}, fork=self.fork)
        builder.add("sys", "tank", tank)
        builder.sim_sensor("level", tank.GetOutputPort("x"))
        builder.sim_actuator("inflow", tank.GetInputPort("inflow"))


@dataclass(repr=False, eq=False)
class FilteringScenario(ServoScenario):
    """A DPS whose filter is an FMU: it commands velocities that follow the integral of the first position."""

    path: str = ""

    def make_dps(self) -> System:
        builder = DiagramBuilder()
        first = builder.AddNamedSystem("first", MatrixGain(np.array([[1.0, 0.0]])))
        fmu = builder.AddNamedSystem("fmu", FmuSystem(self.path, period=PERIOD))
        share = builder.AddNamedSystem("share", MatrixGain(np.array([[0.3], [0.2]])))
        builder.Connect(first.get_output_port(), fmu.get_input_port())
        builder.Connect(fmu.get_output_port(), share.get_input_port())
        builder.ExportInput(first.get_input_port(), "position")
        for name in ("speed", "target"):
            builder.ExportInput(builder.AddNamedSystem(name, PassThrough(2)).get_input_port(), name)
        builder.ExportOutput(share.get_output_port(), "velocity")
        return builder.Build()
