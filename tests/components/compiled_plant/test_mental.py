"""A compiled plant as the world in which a robot reasons."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake.components.compiled_plant import compiled_world
from vtbdrake.components.sensors import JointEncoders, JointTachometers
from vtbdrake.rollout import Quality
from vtbdrake.testbed import VirtualTestbedBuilder
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cart_pole.decision import cost
from vtbdrake_diagrams.cart_pole.model import CART_POLE_SDF, JOINT_NAMES
from vtbdrake_diagrams.cart_pole.swing_up import make_reasoner

STATE = [f"sim.sys.cart_pole.{joint}.{value}" for value in ("position", "velocity") for joint in JOINT_NAMES]


@dataclass
class CompiledCartPole(CartPoleScenario):
    """The cart-pole, whose mental copy has a compiled world."""

    compiled: bool = False

    def mental(self) -> CompiledCartPole:
        return replace(super().mental(), compiled=True)

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        if not self.compiled:
            super().add_world(builder)
            return
        plant = MultibodyPlant(self.plant_config.time_step)
        Parser(plant).AddModels(str(CART_POLE_SDF))
        plant.Finalize()
        joints = [plant.GetJointByName(name) for name in JOINT_NAMES]
        world = builder.add("sys", "cart_pole", compiled_world(plant, plant.CreateDefaultContext(), compile=False))
        sensors = {"joint_position": JointEncoders, "joint_velocity": JointTachometers}
        for signal, kind in sensors.items():
            sensor = builder.add("sense", signal, kind(plant, joints, period=self.period))
            builder.connect(world.GetOutputPort("state"), sensor.GetInputPort("state"))
            builder.sim_sensor(signal, sensor.get_output_port())
        builder.sim_actuator("force", world.GetInputPort("actuation"))
        self.add_beliefs(builder)


def _cost(*state: float) -> float:
    return cost(np.array(state))


def decide(scenario: CartPoleScenario):
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {STATE[1]: 0.4, STATE[2]: -0.5})
    testbed.simulator(context).AdvanceTo(0.31)
    quality = Quality(_cost, of=STATE, reading="integral", minimize=True)
    with make_reasoner(scenario, rollouts=8, quality=quality, executor="serial") as reasoner:
        return reasoner.decide(testbed, context)


def test_decision_in_the_compiled_world_is_that_in_the_plants():
    ours, theirs = decide(CompiledCartPole()), decide(CartPoleScenario())
    qualities = [[candidate.quality for candidate in decision.candidates] for decision in (ours, theirs)]
    np.testing.assert_allclose(*qualities, rtol=1e-9)
    assert np.ptp(qualities[0]) > 0.01
    assert ours.chosen == theirs.chosen
    np.testing.assert_array_equal(ours.values["u.plan"], theirs.values["u.plan"])
