"""A testbed whose world is an FMU: x' = k u, and a DPS that holds x at a goal."""

from __future__ import annotations

from dataclasses import dataclass

from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import Adder, Gain, ZeroOrderHold

from vtbdrake.fmi import FmuSystem
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder


@dataclass(repr=False, eq=False)
class TankScenario(Scenario):
    """A tank, whose inflow the DPS commands."""

    path: str = ""
    fork: bool = True

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("level", 1)], act=[Signal("inflow", 1, idle=[0.0])], commands=[Signal("goal", 1, default=1.0)]
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
