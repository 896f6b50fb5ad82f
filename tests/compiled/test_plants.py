"""Compiled plants with several model instances, a floating base, and forces."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PrismaticJoint, RevoluteJoint, SpatialInertia
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, MatrixGain, Sine, ZeroOrderHold

from vtbdrake.compiled import CompiledRollouts
from vtbdrake.compiled.check import TOLERANCE, compare
from vtbdrake.state.systems import collect

BOX = SpatialInertia.SolidBoxWithMass(1.5, 0.2, 0.3, 0.4)


def rollouts_of(diagram: Diagram, outputs: tuple[str, ...] = (), **values: float) -> CompiledRollouts:
    context = diagram.CreateDefaultContext()
    for name, value in values.items():
        plant = diagram.GetSubsystemByName("plant")
        plant.GetJointByName(name).set_translation(plant.GetMyContextFromRoot(context), value)
    return CompiledRollouts(
        diagram,
        collect(diagram),
        context,
        horizon=0.3,
        sample_period=0.05,
        outputs=outputs,
        compile=False,
    )


def two_carts(plant: MultibodyPlant, *, stop: float = np.inf) -> None:
    for name, axis in (("left", [1, 0, 0]), ("right", [0, 1, 0])):
        instance = plant.AddModelInstance(name)
        body = plant.AddRigidBody("cart", instance, BOX)
        joint = PrismaticJoint(f"{name}_slider", plant.world_frame(), body.body_frame(), axis, -stop, stop)
        plant.AddJointActuator(f"{name}_motor", plant.AddJoint(joint))
    plant.Finalize()


@pytest.mark.parametrize("sampled", [False, True])
def test_ports_of_model_instances(sampled: bool) -> None:
    builder = DiagramBuilder()
    plant = MultibodyPlant(0.01)
    plant.SetUseSampledOutputPorts(sampled)
    two_carts(plant)
    builder.AddNamedSystem("plant", plant)
    left, right = (plant.GetModelInstanceByName(name) for name in ("left", "right"))
    gain = builder.AddNamedSystem("gain", MatrixGain(np.array([[-30.0, -2.0]])))
    hold = builder.AddNamedSystem("hold", ZeroOrderHold(0.02, 1))
    sine = builder.AddNamedSystem("sine", Sine(3.0, 7.0, 0.1, 1))
    builder.Connect(plant.get_state_output_port(right), gain.get_input_port())
    builder.Connect(gain.get_output_port(), hold.get_input_port())
    builder.Connect(hold.get_output_port(), plant.get_actuation_input_port(left))
    builder.Connect(sine.get_output_port(0), plant.get_actuation_input_port(right))
    rollouts = rollouts_of(builder.Build(), ("plant.right_state", "hold.y"), left_slider=0.1, right_slider=-0.2)
    assert compare(rollouts, rollouts.walker.context) <= TOLERANCE
    moved = rollouts().outputs
    assert np.ptp(moved["plant.right_state"]) > 0.1
    assert np.ptp(moved["hold.y"]) > 0.1


def test_an_actuator_without_input_rests_and_generalized_forces_act() -> None:
    builder = DiagramBuilder()
    plant = MultibodyPlant(0.01)
    two_carts(plant)
    builder.AddNamedSystem("plant", plant)
    source = builder.AddNamedSystem("force", ConstantVectorSource([1.0, -2.0]))
    builder.Connect(source.get_output_port(), plant.get_applied_generalized_force_input_port())
    rollouts = rollouts_of(builder.Build(), ("plant.state",))
    assert compare(rollouts, rollouts.walker.context) <= TOLERANCE
    end = rollouts().outputs["plant.state"][0, -1]
    np.testing.assert_allclose(end[2:], 0.3 * np.array([1.0, -2.0]) / 1.5, rtol=1e-12)


def test_a_floating_base_tumbles() -> None:
    builder = DiagramBuilder()
    plant = MultibodyPlant(0.01)
    base = plant.AddRigidBody("base", BOX)
    arm = plant.AddRigidBody("arm", BOX)
    plant.AddJointActuator(
        "motor", plant.AddJoint(RevoluteJoint("hinge", base.body_frame(), arm.body_frame(), [0, 0, 1], 0.1))
    )
    plant.Finalize()
    builder.AddNamedSystem("plant", plant)
    torque = builder.AddNamedSystem("torque", Sine(1.0, 5.0, 0.0, 1))
    builder.Connect(torque.get_output_port(0), plant.get_actuation_input_port())
    rollouts = rollouts_of(builder.Build(), ("plant.state",))
    assert compare(rollouts, rollouts.walker.context) <= TOLERANCE
    assert np.ptp(rollouts().outputs["plant.state"][0], axis=0)[7] > 1e-3


def test_a_rollout_that_reaches_a_stop_is_not_valid() -> None:
    builder = DiagramBuilder()
    plant = MultibodyPlant(0.01)
    two_carts(plant, stop=0.05)
    builder.AddNamedSystem("plant", plant)
    source = builder.AddNamedSystem("force", ConstantVectorSource([5.0, 0.0]))
    builder.Connect(source.get_output_port(), plant.get_actuation_input_port())
    batch = rollouts_of(builder.Build())({"force.value": [[0.1, 0.0], [5.0, 0.0]]})
    assert batch.valid.tolist() == [True, False]
