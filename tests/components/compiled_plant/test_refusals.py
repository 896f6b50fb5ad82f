"""Plants that cannot be compiled are refused by name."""

from __future__ import annotations

import re

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.geometry import CollisionFilterDeclaration, GeometrySet, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    ExternallyAppliedSpatialForce,
    MultibodyPlant,
)
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    LinearBushingRollPitchYaw,
    LinearSpringDamper,
    PdControllerGains,
    PrismaticJoint,
    RevoluteJoint,
    RevoluteSpring,
    UniversalJoint,
)
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from tests.components.compiled_plant.plants import cart_pole, inertia
from vtbdrake.components.compiled_plant import (
    UnsupportedPlantError,
    plant_dynamics,
    plant_step,
)


def two_bodies(time_step: float = 0.01) -> MultibodyPlant:
    plant = MultibodyPlant(time_step)
    for name in ("a", "b"):
        body = plant.AddRigidBody(name, inertia(1.0))
        joint = plant.AddJoint(RevoluteJoint(f"joint_{name}", plant.world_frame(), body.body_frame(), [0, 0, 1]))
        plant.AddJointActuator(f"motor_{name}", joint)
    return plant


def _other_joint(plant):
    body = plant.AddRigidBody("c", inertia(1.0))
    plant.AddJoint(UniversalJoint("wrist", plant.world_frame(), body.body_frame()))


def _coupler(plant):
    plant.AddCouplerConstraint(plant.GetJointByName("joint_a"), plant.GetJointByName("joint_b"), 2.0)


def _spring(plant):
    a, b = plant.GetBodyByName("a"), plant.GetBodyByName("b")
    plant.AddForceElement(LinearSpringDamper(a, np.zeros(3), b, np.ones(3), 1.0, 10.0, 0.0))


def _controller(plant):
    plant.GetJointActuatorByName("motor_b").set_controller_gains(PdControllerGains(p=1.0, d=0.1))


def _second_motor(plant):
    plant.AddJointActuator("helper", plant.GetJointByName("joint_b"))


def _bushing(plant):
    frames = [plant.GetBodyByName(name).body_frame() for name in ("a", "b")]
    plant.AddForceElement(LinearBushingRollPitchYaw(*frames, *[np.ones(3)] * 4))


def _revolute_spring(plant):
    plant.AddForceElement(RevoluteSpring(plant.GetJointByName("joint_a"), 0.0, 5.0))


def _weightless(plant):
    plant.set_gravity_enabled(plant.GetBodyByName("a").model_instance(), False)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_other_joint, "the joint wrist is of type universal"),
        (_coupler, "there are 1 constraints"),
        (_spring, "a force element of type LinearSpringDamper"),
        (_bushing, "a force element of type LinearBushingRollPitchYaw"),
        (_revolute_spring, "a force element of type RevoluteSpring"),
        (_second_motor, r"the joint joint_b has 2 actuators \(motor_b, helper\): give it one"),
        (_controller, "the actuator motor_b has a PD controller"),
        (_weightless, "gravity is disabled for the model instances DefaultModelInstance"),
    ],
)
def test_part_is_refused_by_name(change, reason):
    plant = two_bodies()
    change(plant)
    plant.Finalize()
    with pytest.raises(UnsupportedPlantError, match=reason):
        plant_dynamics(plant, plant.CreateDefaultContext())


@pytest.mark.parametrize("time_step", [0.0, 0.01])
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("applied_generalized_force", [0.0, 1.0]),
        ("applied_spatial_force", AbstractValue.Make([ExternallyAppliedSpatialForce()])),
        ("DefaultModelInstance_actuation", [0.0, 1.0]),
        ("DefaultModelInstance_desired_state", np.zeros(4)),
    ],
)
def test_other_input_is_refused_by_name(name, value, time_step):
    plant = two_bodies(time_step)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    plant.get_actuation_input_port().FixValue(context, [1.0, 2.0])
    assert plant_dynamics(plant, context).size1_in("u") == 2
    plant.GetInputPort(name).FixValue(context, value)
    with pytest.raises(UnsupportedPlantError, match=f"the input port {name} is connected or has a fixed value"):
        plant_dynamics(plant, context)


def test_connected_force_is_refused_by_name():
    builder = DiagramBuilder()
    plant = builder.AddSystem(two_bodies())
    plant.Finalize()
    force = builder.AddSystem(ConstantVectorSource([0.0, 1.0]))
    builder.Connect(force.get_output_port(), plant.get_applied_generalized_force_input_port())
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    with pytest.raises(UnsupportedPlantError, match="the input port applied_generalized_force"):
        plant_dynamics(plant, plant.GetMyContextFromRoot(root))


@pytest.mark.parametrize("time_step", [0.0, 0.01])
def test_locked_joint_is_refused_by_name(time_step):
    plant = cart_pole(time_step)
    context = plant.CreateDefaultContext()
    plant.GetJointByName("hinge").Lock(context)
    with pytest.raises(UnsupportedPlantError, match="the joint hinge is locked"):
        plant_dynamics(plant, context)


def _spheres(filtered: bool):
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    for name in ("left", "right"):
        body = plant.AddRigidBody(name, inertia(1.0))
        plant.AddJoint(PrismaticJoint(f"rail_{name}", plant.world_frame(), body.body_frame(), [1, 0, 0]))
        plant.RegisterCollisionGeometry(body, RigidTransform(), Sphere(0.1), "ball", CoulombFriction(1.0, 1.0))
    plant.Finalize()
    if filtered:
        shapes = GeometrySet(scene_graph.model_inspector().GetAllGeometryIds())
        scene_graph.collision_filter_manager().Apply(CollisionFilterDeclaration().ExcludeWithin(shapes))
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    return diagram, plant, plant.GetMyContextFromRoot(root), root


def test_bodies_that_can_collide_are_refused_by_name():
    _diagram, plant, context, _root = _spheres(filtered=False)
    with pytest.raises(UnsupportedPlantError, match="left and right can collide"):
        plant_dynamics(plant, context)


def test_bodies_that_a_filter_keeps_apart_are_accepted():
    _diagram, plant, context, _root = _spheres(filtered=True)
    assert plant_step(plant, context).size1_in("x") == 4


def test_continuous_plant_has_no_step():
    plant = cart_pole(0.0)
    with pytest.raises(UnsupportedPlantError, match="time_step"):
        plant_step(plant, plant.CreateDefaultContext())


def test_tamsi_has_another_step():
    plant = MultibodyPlant(0.01)
    plant.AddRigidBody("stone", inertia(1.0))
    plant.set_discrete_contact_approximation(_tamsi())
    plant.Finalize()
    with pytest.raises(UnsupportedPlantError, match="TAMSI"):
        plant_step(plant, plant.CreateDefaultContext())


def _tamsi():
    plant_module = pytest.importorskip("pydrake.multibody.plant")
    if not hasattr(plant_module.DiscreteContactApproximation, "kTamsi"):
        pytest.skip("this Drake has no TAMSI")
    return plant_module.DiscreteContactApproximation.kTamsi


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        (["pole.maas"], "did you mean 'pole.mass'"),
        (["slider.position"], "cannot be an input"),
        (["pole.mass", "pole.mass"], "more than once"),
    ],
)
def test_unknown_input_is_an_error(inputs, message):
    plant = cart_pole(0.0)
    with pytest.raises(ValueError, match=re.escape(message)):
        plant_dynamics(plant, plant.CreateDefaultContext(), inputs=inputs)


def test_pose_that_carries_other_frames_is_no_input():
    plant = two_bodies()
    stand = plant.AddFrame(FixedOffsetFrame("stand", plant.GetBodyByName("a").body_frame(), RigidTransform()))
    top = plant.AddFrame(FixedOffsetFrame("top", stand, RigidTransform([0, 0, 1.0])))
    for name, frame in (("c", stand), ("d", top)):
        body = plant.AddRigidBody(name, inertia(1.0))
        plant.AddJoint(RevoluteJoint(f"joint_{name}", frame, body.body_frame(), [0, 0, 1]))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    with pytest.raises(ValueError, match="the frame top is attached to it"):
        plant_dynamics(plant, context, inputs=["stand.pose"])
    assert plant_dynamics(plant, context, inputs=["top.pose"]).name_in() == ["x", "u", "top_pose"]
