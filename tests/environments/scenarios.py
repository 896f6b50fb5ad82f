"""Testbeds as environments, small and quick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia
from pydrake.symbolic import Variable, exp, max
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import MatrixGain, SymbolicVectorSystem, ZeroOrderHold

import vtbdrake as vtb
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cart_pole.policy import cost

POLE = "sim.sys.cart_pole.pole_pin.position"
START = vtb.Parameter(POLE, 2.9, 3.3)
"""The angle of the pole at the start, in rad: it stands at pi."""
COST = vtb.Quality(cost, of="plant.state", reading="integral", minimize=True)
SIGNALS: dict[str, Any] = {"action": ["force"], "observation": ["joint_position", "joint_velocity"]}
BALANCING: dict[str, Any] = {**SIGNALS, "reward": COST, "period": 0.02, "horizon": 1.0, "parameters": [START]}


def tilt(angle: float) -> float:
    """Return how far the pole leans, in rad."""
    return abs(angle - np.pi)


def falling(**changes: Any) -> vtb.Problem:
    """Return the problem to keep the pole within 0.5 rad, over half a second, sampled twice in each step of 20 ms."""
    statement: dict[str, Any] = {
        "scenario": CartPoleScenario(),
        "parameters": [START],
        "quality": COST,
        "constraints": [vtb.Constraint(tilt, of=POLE, at_most=0.5)],
        "horizon": 0.5,
        "sample_period": 0.01,
    }
    return vtb.Problem(**{**statement, **changes})


@dataclass
class SliderScenario(Scenario):
    """A mass of 1 kg on a rail, between stops at 5 cm. A drive that bursts makes infinity of more than 4 N."""

    bursts: bool = False

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("state", size=2, unit="m, m/s", lower=-10.0, upper=10.0)],
            act=[Signal("force", size=1, unit="N", lower=-5.0, upper=5.0, idle=0.0)],
        )

    def make_dps(self) -> Diagram:
        builder = DiagramBuilder()
        law = builder.AddNamedSystem("law", MatrixGain(np.zeros((1, 2))))
        builder.ExportInput(law.get_input_port(), "state")
        builder.ExportOutput(law.get_output_port(), "force")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(MultibodyPlantConfig(time_step=0.01, use_sampled_output_ports=False))
        body = plant.AddRigidBody("cart", SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.1, 0.1))
        slider = PrismaticJoint("slider", plant.world_frame(), body.body_frame(), [1.0, 0.0, 0.0], -0.05, 0.05)
        plant.AddJointActuator("motor", plant.AddJoint(slider))
        plant.Finalize()
        sensor = builder.add("sense", "state", ZeroOrderHold(0.01, 2))
        builder.connect(plant.get_state_output_port(), sensor.get_input_port())
        builder.sim_sensor("state", sensor.get_output_port())
        force = plant.get_actuation_input_port()
        if self.bursts:
            u = Variable("u")
            burst = SymbolicVectorSystem(input=[u], output=[u + exp(1e4 * max(u - 4.0, 0.0)) - 1.0])
            drive = builder.add("act", "drive", burst)
            builder.connect(drive.get_output_port(), force)
            force = drive.get_input_port()
        builder.sim_actuator("force", force)
