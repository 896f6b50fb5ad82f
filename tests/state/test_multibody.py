"""Values that are written to a plant are those that Drake computes with."""

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    DistanceConstraintParams,
    MultibodyPlant,
)
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
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from tests.testbeds import ACROBOT, add_deformable_ball
from vtbdrake.state import Snapshot, VariableError, collect, snapshot
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


def test_rotor_inertia_and_gear_ratio_are_those_of_drakes_actuator(world):
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
    gear = address.replace("rotor_inertia", "gear_ratio")
    variables[gear].set(context, 3.0)
    assert variables[gear].get(context) == actuator.gear_ratio(plant_context) == 3.0
    assert plant.CalcMassMatrix(plant_context)[v, v] - before[v, v] == pytest.approx(9.0 * 0.25)


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


def linked():
    """Two masses on slides with a rod and a coupler between them, and a deformable ball."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.001)
    plant.set_name("plant")
    slides = []
    for name in ("a", "b"):
        body = plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        slides.append(
            plant.AddJoint(PrismaticJoint(f"slide_{name}", plant.world_frame(), body.body_frame(), [1, 0, 0]))
        )
    slides[1].set_default_translation(0.5)
    a, b = plant.GetBodyByName("a"), plant.GetBodyByName("b")
    rod = plant.AddDistanceConstraint(a, [0, 0, 0], b, [0, 0, 0], 0.5)
    coupler = plant.AddCouplerConstraint(slides[0], slides[1], 2.0, -1.0)
    add_deformable_ball(plant)
    plant.Finalize()
    diagram = builder.Build()
    return plant, diagram, collect(diagram), (rod, coupler)


def open_rod(plant, context, constraints):
    plant.SetConstraintActiveStatus(context, constraints[0], False)


def open_coupler(plant, context, constraints):
    plant.SetConstraintActiveStatus(context, constraints[1], False)


def lengthen_rod(plant, context, constraints):
    was = plant.GetDistanceConstraintParams(context, constraints[0])
    rod = DistanceConstraintParams(was.bodyA(), [0, 0.1, 0], was.bodyB(), [0, -0.1, 0.2], 0.7, 300.0, 2.0)
    plant.SetDistanceConstraintParams(context, constraints[0], rod)


def disable_ball(plant, context, constraints):
    model = plant.deformable_model()
    model.GetBodyByName("ball").Disable(context)


@pytest.mark.parametrize("change", [open_rod, open_coupler, lengthen_rod, disable_ball])
def test_what_drake_keeps_in_abstract_parameters_is_part_of_snapshots_and_copies(change):
    plant, diagram, variables, constraints = linked()
    context, changed = diagram.CreateDefaultContext(), diagram.CreateDefaultContext()
    plant_context = plant.GetMyMutableContextFromRoot(changed)
    plant.SetVelocities(plant_context, plant.GetVelocities(plant_context) + 0.1)
    copy = context.Clone()
    plant.SetVelocities(plant.GetMyMutableContextFromRoot(copy), plant.GetVelocities(plant_context))
    change(plant, plant_context, constraints)

    other_plant, other, other_variables, _ = linked()
    restored, copied = other.CreateDefaultContext(), other.CreateDefaultContext()
    taken = snapshot.take(diagram, changed, variables)
    snapshot.apply(Snapshot.load(taken.to_bytes()), other, restored, other_variables)
    snapshot.StateCopier(diagram, variables, other, other_variables).copy(changed, copied)

    def moved(diagram, plant, context):
        Simulator(diagram, context).AdvanceTo(0.05)
        return plant.get_state_output_port().Eval(
            plant.GetMyContextFromRoot(context)
        ), plant.deformable_model().GetPositions(
            plant.GetMyContextFromRoot(context), plant.deformable_model().GetBodyByName("ball").body_id()
        )

    truth, without = moved(diagram, plant, changed), moved(diagram, plant, copy)
    assert any(not np.array_equal(*pair) for pair in zip(truth, without, strict=True))  # It makes a difference.
    for found in (restored, copied):
        for expected, pair in zip(truth, moved(other, other_plant, found), strict=True):
            np.testing.assert_array_equal(pair, expected)


def test_rod_is_changed_by_its_variables():
    plant, diagram, variables, (rod, _) = linked()
    context = diagram.CreateDefaultContext()
    assert variables["plant.constraint_0.stiffness"].get(context) == 0.0  # rigid
    variables["plant.constraint_0.distance"].set(context, 0.8)
    variables["plant.constraint_0.points[4]"].set(context, 0.3)
    params = plant.GetDistanceConstraintParams(plant.GetMyContextFromRoot(context), rod)
    assert (params.distance(), params.stiffness(), params.p_BQ().tolist()) == (0.8, np.inf, [0.0, 0.3, 0.0])
    variables["plant.constraint_0.stiffness"].set(context, 70.0)
    assert plant.GetDistanceConstraintParams(plant.GetMyContextFromRoot(context), rod).stiffness() == 70.0
    for address, value in {"distance": 0.0, "stiffness": -1.0, "active": 0.5}.items():
        with pytest.raises(VariableError, match=f"plant.constraint_0.{address}"):
            variables[f"plant.constraint_0.{address}"].set(context, value)
