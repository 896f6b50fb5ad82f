"""Values that are written to a plant are those that Drake computes with."""

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    PlanarJoint,
    PrismaticJoint,
    QuaternionFloatingJoint,
    RevoluteJoint,
    RpyFloatingJoint,
    SpatialInertia,
    UniversalJoint,
)
from pydrake.systems.framework import DiagramBuilder

from tests.testbeds import ACROBOT
from vtbdrake.state import collect
from vtbdrake.state.multibody import multibody_variables

INERTIA = [0.2, 0.3, 0.4, 0.01, -0.02, 0.03]


@pytest.fixture
def world():
    """Drake's acrobot, and a box that floats."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    plant.set_name("plant")
    Parser(plant).AddModelsFromUrl(ACROBOT)
    plant.AddRigidBody("box", plant.AddModelInstance("box"), SpatialInertia.SolidBoxWithMass(2.0, 0.3, 0.4, 0.1))
    plant.Finalize()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    return plant, collect(diagram), context, plant.GetMyContextFromRoot(context)


def test_products_of_inertia_are_written_and_read(world):
    plant, variables, context, plant_context = world
    variables["plant.box.inertia"].set(context, INERTIA)
    I_BBo_B = plant.GetBodyByName("box").CalcSpatialInertiaInBodyFrame(plant_context).CalcRotationalInertia()
    np.testing.assert_allclose(I_BBo_B.get_moments(), INERTIA[:3], rtol=1e-12)
    np.testing.assert_allclose(I_BBo_B.get_products(), INERTIA[3:], rtol=1e-12)
    np.testing.assert_allclose(variables["plant.box.inertia"].get(context), INERTIA, rtol=1e-12)


def test_entries_of_a_floating_body_have_the_names_of_drake(world):
    plant, variables, _, _ = world
    joint = plant.GetJointByName("box")
    q = plant.GetPositionNames(joint.model_instance(), add_model_instance_prefix=False)
    v = plant.GetVelocityNames(joint.model_instance(), add_model_instance_prefix=False)
    assert variables["plant.box.position"].entry_names == tuple(name.rsplit("_", 1)[-1] for name in q)
    assert variables["plant.box.velocity"].entry_names == tuple(name.rsplit("_", 1)[-1] for name in v)
    assert variables["plant.box.pose"].entry_names == ("x", "y", "z", "roll", "pitch", "yaw")
    assert variables["plant.Acrobot.shoulder.position"].entry_names == ()


def test_products_of_inertia_are_about_the_center_of_mass(world):
    plant, variables, context, plant_context = world
    m, (x, y, z) = 2.0, (0.1, 0.2, -0.3)
    variables.write(context, {"plant.box.center_of_mass": [x, y, z], "plant.box.inertia": INERTIA})
    I_BBo_B = plant.GetBodyByName("box").CalcSpatialInertiaInBodyFrame(plant_context).CalcRotationalInertia()
    # Parallel axes: the products about the origin are less by m x y, m x z and m y z.
    expected = np.array(INERTIA[3:]) - m * np.array([x * y, x * z, y * z])
    np.testing.assert_allclose(I_BBo_B.get_products(), expected, rtol=1e-12)
    np.testing.assert_allclose(variables["plant.box.inertia"].get(context), INERTIA, rtol=1e-12)


@pytest.mark.parametrize("index", range(6))
def test_an_entry_of_the_inertia_is_written_alone(world, index):
    _, variables, context, _ = world
    variables["plant.box.inertia"].set(context, INERTIA)
    variables[f"plant.box.inertia[{index}]"].set(context, INERTIA[index] + 0.005)
    expected = np.array(INERTIA)
    expected[index] += 0.005
    np.testing.assert_allclose(variables["plant.box.inertia"].get(context), expected, rtol=1e-12)


def test_products_of_inertia_couple_the_axes(world):
    plant, variables, context, plant_context = world
    variables["plant.box.inertia"].set(context, INERTIA)
    box = plant.GetBodyByName("box")
    start = box.floating_velocities_start_in_v()
    angular = plant.CalcMassMatrix(plant_context)[start : start + 3, start : start + 3]
    xx, yy, zz, xy, xz, yz = INERTIA
    np.testing.assert_allclose(angular, [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], rtol=1e-12)


def test_rotor_inertia_is_that_of_drakes_actuator(world):
    plant, variables, context, plant_context = world
    (address,) = (address for address in variables if address.endswith(".rotor_inertia"))
    actuator = plant.get_joint_actuator(plant.GetJointActuatorIndices()[0])
    before = plant.CalcMassMatrix(plant_context)
    assert variables[address].get(context) == actuator.rotor_inertia(plant_context)
    variables[address].set(context, 0.25)
    assert actuator.rotor_inertia(plant_context) == 0.25
    assert variables[address].get(context) == 0.25
    # It turns with the elbow, by the gear ratio (1): its reflected inertia is added there and nowhere else.
    v = actuator.joint().velocity_start()
    difference = plant.CalcMassMatrix(plant_context) - before
    assert difference[v, v] == pytest.approx(0.25 * actuator.default_gear_ratio() ** 2)
    difference[v, v] = 0.0
    np.testing.assert_allclose(difference, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("joint", "axis", "position", "velocity"),
    [
        (RevoluteJoint, [[0, 0, 1]], "rad", "rad/s"),
        (PrismaticJoint, [[0, 0, 1]], "m", "m/s"),
        (UniversalJoint, [], "rad", "rad/s"),
        (BallRpyJoint, [], "rad", "rad/s"),
        (PlanarJoint, [[0, 0, 0]], "m, m, rad", "m/s, m/s, rad/s"),
        (RpyFloatingJoint, [], "rad, m", "rad/s, m/s"),
        (QuaternionFloatingJoint, [], "1, 1, 1, 1, m, m, m", "rad/s, m/s"),  # a quaternion has no unit
    ],
)
def test_positions_and_velocities_have_the_units_of_their_joint(joint, axis, position, velocity):
    plant = MultibodyPlant(0.01)
    body = plant.AddRigidBody("body", SpatialInertia.SolidBoxWithMass(2.0, 0.3, 0.4, 0.1))
    plant.AddJoint(joint("joint", plant.world_frame(), body.body_frame(), *axis))
    plant.Finalize()
    units = {variable.address: variable.unit for variable in multibody_variables(plant)}
    assert (units["joint.position"], units["joint.velocity"]) == (position, velocity)


def test_a_name_that_model_and_body_share_stands_once():
    plant = MultibodyPlant(0.01)
    M_BBo_B = SpatialInertia.SolidBoxWithMass(2.0, 0.3, 0.4, 0.1)
    plant.AddRigidBody("frame", plant.AddModelInstance("quad"), M_BBo_B)
    plant.AddRigidBody("box", plant.AddModelInstance("box"), M_BBo_B)
    plant.Finalize()
    poses = {variable.address for variable in multibody_variables(plant) if variable.address.endswith(".pose")}
    assert poses == {"quad.frame.pose", "box.pose"}
