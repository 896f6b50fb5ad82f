"""A compiled plant in a testbed: the same ports, the same addresses, the same motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import PrismaticJoint, RevoluteJoint
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, MatrixGain

from tests.components.compiled_plant.plants import cart_pole, inertia
from vtbdrake.components.compiled_plant import compiled_world
from vtbdrake.components.sensors import JointEncoders
from vtbdrake.rollout import Quality, RolloutTask, SerialExecutor
from vtbdrake.rollout.executor import run_rollouts
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

PERIOD = 0.01


def add_cart_pole(plant: MultibodyPlant) -> None:
    instance = plant.AddModelInstance("robot")
    cart = plant.AddRigidBody("cart", instance, inertia(1.0, (0, 0, 0)))
    pole = plant.AddRigidBody("pole", instance, inertia(0.2, (0, 0, -0.5)))
    slider = plant.AddJoint(PrismaticJoint("slider", plant.world_frame(), cart.body_frame(), [1, 0, 0], -4.0, 4.0, 0.1))
    plant.AddJointActuator("motor", slider)
    plant.AddJoint(RevoluteJoint("hinge", cart.body_frame(), pole.body_frame(), [0, 1, 0]))


@dataclass
class CartPoleScenario(Scenario):
    """State feedback of a cart-pole; its world is a plant of Drake, or the compiled one."""

    compiled: bool = False

    def interface(self) -> Interface:
        return Interface(sense=[Signal("state", size=4)], act=[Signal("force", size=1, idle=0.0)])

    def make_dps(self):
        builder = DiagramBuilder()
        gain = builder.AddNamedSystem("gain", MatrixGain(np.array([[-1.0, 8.0, -2.0, 1.0]])))
        builder.ExportInput(gain.get_input_port(), "state")
        builder.ExportOutput(gain.get_output_port(), "force")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        if self.compiled:
            plant = MultibodyPlant(PERIOD)
            add_cart_pole(plant)
            plant.Finalize()
            world = compiled_world(plant, plant.CreateDefaultContext(), inputs=["robot.pole.mass"], compile=False)
            builder.add("sys", "robot", world)
            state, actuation = world.GetOutputPort("state"), world.GetInputPort("actuation")
        else:
            plant, _ = builder.add_plant(MultibodyPlantConfig(time_step=PERIOD))
            add_cart_pole(plant)
            plant.Finalize()
            state, actuation = plant.get_state_output_port(), plant.get_actuation_input_port()
        builder.sim_sensor("state", state)
        builder.sim_actuator("force", actuation)


START = {"sim.sys.robot.hinge.position": 0.5, "sim.sys.robot.slider.velocity": 0.3, "sim.sys.robot.pole.mass": 0.4}
RECORD = ("sim.sys.robot.slider.position", "sim.sys.robot.hinge.velocity")


def _angle(q):
    return abs(q)


def rollout(scenario: CartPoleScenario, start=START):
    task = RolloutTask(scenario, 1.0, Quality(_angle, "sim.sys.robot.hinge.position"), record=RECORD)
    return run_rollouts(SerialExecutor(), task, [start], progress=False)[0]


def test_testbed_of_the_compiled_world_moves_as_that_of_the_plant():
    ours, theirs = (rollout(CartPoleScenario(compiled=compiled)) for compiled in (True, False))
    for name in RECORD:
        np.testing.assert_allclose(ours.record[name], theirs.record[name], rtol=1e-9, atol=1e-12)
        assert np.ptp(theirs.record[name]) > 0.1


def test_variables_have_the_addresses_units_and_bounds_of_the_plant():
    ours, theirs = (CartPoleScenario(compiled=compiled).build() for compiled in (True, False))
    compiled, plant = ours.variables(), theirs.variables()
    joints = [f"sim.sys.robot.{joint}.{x}" for joint in ("slider", "hinge") for x in ("position", "velocity")]
    for address in [*joints, "sim.sys.robot.pole.mass"]:
        a, b = compiled[address], plant[address]
        assert (a.kind, a.shape, a.unit) == (b.kind, b.shape, b.unit)
        np.testing.assert_array_equal(a.bounds, b.bounds)
        assert a.get(ours.default_context()) == b.get(theirs.default_context())


def test_reached_stop_is_told():
    testbed = CartPoleScenario(compiled=True).build()
    context = testbed.default_context()
    overrun = testbed.variables()["sim.sys.robot.overrun"]
    assert overrun.get(context) < 0.0
    testbed.variables()["sim.sys.robot.slider.velocity"].set(context, 50.0)
    testbed.simulator(context).AdvanceTo(0.2)
    assert overrun.get(context) > 0.0


def test_sensors_measure_the_compiled_plant():
    plant = cart_pole(PERIOD)
    builder = DiagramBuilder()
    world = builder.AddSystem(compiled_world(plant, plant.CreateDefaultContext(), compile=False))
    force = builder.AddSystem(ConstantVectorSource([3.0]))
    joints = [plant.GetJointByName(name) for name in ("slider", "hinge")]
    encoders = builder.AddSystem(JointEncoders(plant, joints, period=PERIOD))
    builder.Connect(force.get_output_port(), world.GetInputPort("actuation"))
    builder.Connect(world.GetOutputPort("state"), encoders.GetInputPort("state"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(20 * PERIOD + PERIOD / 2)
    root = simulator.get_context()
    # A sampled sensor shows the sample of the last tick.
    x = world.GetOutputPort("state").Eval(world.GetMyContextFromRoot(root))
    measured = encoders.get_output_port().Eval(encoders.GetMyContextFromRoot(root))
    assert 0.0 < measured[0] < x[0]
    assert x[0] - measured[0] == pytest.approx(PERIOD * x[2], rel=1e-12)
