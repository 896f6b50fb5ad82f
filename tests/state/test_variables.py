"""Addresses reach what they name, and refuse what makes no sense."""

import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    RenderCameraCore,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import FixedOffsetFrame, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, DiagramBuilder, LeafSystem
from pydrake.systems.sensors import CameraInfo, RgbdSensor

from tests.testbeds import ACROBOT
from vtbdrake.state import (
    AddressError,
    Variable,
    VariableError,
    Variables,
    collect,
    snapshot,
)
from vtbdrake.state.declarations import CONTINUOUS, PARAMETER, Element
from vtbdrake.state.variables import entry_units


@pytest.fixture
def world():
    """Drake's acrobot, and a box on the ground."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    plant.set_name("plant")
    Parser(plant).AddModelsFromUrl(ACROBOT)
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform([0, 0, -5.5]), Box(40, 40, 1), "ground", CoulombFriction(0.8, 0.8)
    )
    box = plant.AddRigidBody("box", plant.AddModelInstance("box"), SpatialInertia.SolidBoxWithMass(2.0, 0.3, 0.4, 0.1))
    for i, (x, y) in enumerate([(0.15, 0.2), (0.15, -0.2), (-0.15, 0.2), (-0.15, -0.2)]):
        plant.RegisterCollisionGeometry(
            box, RigidTransform([x, y, -0.04]), Sphere(0.01), f"foot{i}", CoulombFriction(0.8, 0.8)
        )
    plant.AddFrame(FixedOffsetFrame("mount", box.body_frame(), RigidTransform([0.1, 0.0, 0.05])))
    plant.Finalize()
    diagram = builder.Build()
    return diagram, plant, collect(diagram), diagram.CreateDefaultContext()


def test_joint_variables_agree_with_drake(world):
    diagram, plant, variables, context = world
    variables.write(context, {"plant.Acrobot.elbow.position": 0.7, "plant.Acrobot.elbow.velocity": -0.2})
    elbow = plant.GetJointByName("elbow")
    plant_context = plant.GetMyContextFromRoot(context)
    assert elbow.get_angle(plant_context) == 0.7
    assert elbow.get_angular_rate(plant_context) == -0.2
    variables["plant.Acrobot.elbow.damping"].set(context, 0.33)
    assert elbow.GetDampingVector(plant_context) == [0.33]


def test_mass_counts_in_the_total_and_in_the_gravity_torque(world):
    diagram, plant, variables, context = world
    plant_context = plant.GetMyContextFromRoot(context)
    before = plant.CalcTotalMass(plant_context)
    variables["plant.Acrobot.lower_link.mass"].set(context, 3.5)
    assert plant.CalcTotalMass(plant_context) - before == pytest.approx(2.5)
    # Elbow horizontal: the torque is m g l, l the distance of the link's centre of mass from the elbow.
    variables["plant.Acrobot.elbow.position"].set(context, np.pi / 2)
    torque = plant.CalcGravityGeneralizedForces(plant_context)[plant.GetJointByName("elbow").velocity_start()]
    arm = abs(variables["plant.Acrobot.lower_link.center_of_mass"].get(context)[2])
    assert abs(torque) == pytest.approx(3.5 * 9.81 * arm)


def test_center_of_mass_moves_without_changing_the_inertia_about_it(world):
    _, plant, variables, context = world
    before = variables["plant.box.inertia"].get(context)
    variables["plant.box.center_of_mass"].set(context, [0.1, -0.2, 0.3])
    np.testing.assert_allclose(variables["plant.box.inertia"].get(context), before, atol=1e-12)
    p_WCm = plant.CalcCenterOfMassPositionInWorld(
        plant.GetMyContextFromRoot(context), [plant.GetModelInstanceByName("box")]
    )
    np.testing.assert_allclose(p_WCm, [0.1, -0.2, 0.3])


def test_inertia_is_about_the_center_of_mass(world):
    _, plant, variables, context = world
    m, (x, y, z) = 2.0, (0.3, 0.4, 0.1)
    expected = m / 12 * np.array([y**2 + z**2, x**2 + z**2, x**2 + y**2, 0, 0, 0])
    np.testing.assert_allclose(variables["plant.box.inertia"].get(context), expected, atol=1e-12)
    variables["plant.box.center_of_mass"].set(context, [0.1, 0.0, 0.0])
    variables["plant.box.inertia"].set(context, [0.2, 0.3, 0.4, 0.01, 0.0, 0.0])
    body = plant.GetBodyByName("box")
    M_BBo_B = body.CalcSpatialInertiaInBodyFrame(plant.GetMyContextFromRoot(context))
    # Parallel axes: I_o = I_cm + m (|p|^2 1 - p p').
    assert M_BBo_B.CalcRotationalInertia().get_moments() == pytest.approx([0.2, 0.3 + 0.02, 0.4 + 0.02])


def test_friction_decides_how_far_a_box_slides(world):
    diagram, plant, variables, _ = world
    for mu in (0.3, 0.6):
        context = diagram.CreateDefaultContext()
        variables.write(context, {"plant.ground.friction": mu, "plant.box.friction": mu})
        variables["plant.box.pose"].set(context, [5.0, 5.0, -4.95, 0.0, 0.0, 0.0])
        variables["plant.box.velocity"].set(context, [0, 0, 0, 2.0, 0, 0])
        plant.GetInputPort("actuation").FixValue(plant.GetMyMutableContextFromRoot(context), [0.0])
        simulator = Simulator(diagram, context)
        simulator.AdvanceTo(2.0)
        assert variables["plant.box.x"].get(context) - 5.0 == pytest.approx(2.0**2 / (2 * mu * 9.81), rel=0.02)


def test_lock_holds_a_joint(world):
    diagram, plant, variables, context = world
    variables.write(context, {"plant.Acrobot.elbow.position": 1.0, "plant.Acrobot.elbow.locked": 1.0})
    plant.GetInputPort("actuation").FixValue(plant.GetMyMutableContextFromRoot(context), [0.0])
    Simulator(diagram, context).AdvanceTo(0.2)
    assert variables["plant.Acrobot.elbow.position"].get(context) == pytest.approx(1.0, abs=1e-9)
    assert variables["plant.Acrobot.shoulder.position"].get(context) != pytest.approx(0.0, abs=1e-3)


def test_pose_entries_are_those_of_the_body(world):
    _, plant, variables, context = world
    variables["plant.box.pose"].set(context, [1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    X_WB = plant.GetBodyByName("box").EvalPoseInWorld(plant.GetMyContextFromRoot(context))
    np.testing.assert_allclose(X_WB.translation(), [1, 2, 3])
    np.testing.assert_allclose(X_WB.rotation().matrix(), RollPitchYaw(0.1, 0.2, 0.3).ToRotationMatrix().matrix())
    read = variables.read(context, [f"plant.box.{name}" for name in ("x", "y", "height", "roll", "pitch", "yaw")])
    assert list(read.values()) == pytest.approx([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])


def test_height_of_any_body_can_be_asked_for(world):
    _, plant, variables, context = world
    assert "plant.Acrobot.lower_link.height" in variables
    assert "plant.Acrobot.lower_link.height" not in list(variables)
    X_WB = plant.GetBodyByName("lower_link").EvalPoseInWorld(plant.GetMyContextFromRoot(context))
    assert variables["plant.Acrobot.lower_link.height"].get(context) == X_WB.translation()[2]


def test_frame_offset_moves_the_frame(world):
    _, plant, variables, context = world
    variables["plant.box.mount.pose"].set(context, [0.2, 0.0, 0.0, 0.0, 0.0, np.pi / 2])
    X_WM = plant.GetFrameByName("mount").CalcPoseInWorld(plant.GetMyContextFromRoot(context))
    np.testing.assert_allclose(X_WM.translation(), [0.2, 0.0, 0.0])
    np.testing.assert_allclose(X_WM.rotation().matrix() @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_an_entry_of_an_array_is_a_variable(world):
    _, _, variables, context = world
    variables["plant.box.center_of_mass[2]"].set(context, 0.04)
    np.testing.assert_allclose(variables["plant.box.center_of_mass"].get(context), [0.0, 0.0, 0.04])
    assert variables["plant.box.center_of_mass[2]"].shape == ()
    with pytest.raises(AddressError, match="has 3 entries"):
        variables["plant.box.center_of_mass[3]"]
    assert "plant.box.center_of_mass[3]" not in variables
    with pytest.raises(AddressError, match="is a scalar"):
        variables["plant.box.mass[0]"]


@pytest.mark.parametrize(
    ("address", "value", "message"),
    [
        ("plant.box.mass", -1.0, r"must lie in \[0, inf\] kg, but the value given is -1"),
        ("plant.box.mass", np.nan, "must be finite"),
        ("plant.box.mass", [1.0, 2.0], r"has shape \(\), but the value given has \(2,\)"),
        ("plant.box.mass", "heavy", "takes numbers"),
        ("plant.box.mass", "5", r"takes numbers of shape \(\), not '5'"),
        ("plant.box.mass", None, "takes numbers .* not None"),
        ("plant.box.mass", np.array(2.0 + 1.0j), "takes numbers"),
        ("plant.box.mass", np.ma.array(3.0, mask=True), "takes numbers"),
        ("plant.box.center_of_mass", np.ma.array(np.ones(3), mask=[0, 1, 0]), "takes numbers"),
        ("plant.box.friction", -0.1, r"must lie in \[0, inf\], but"),
        ("plant.box.pitch", 0.1, "is derived"),
        ("plant.box.inertia", [1.0, 1.0, 3.0, 0.0, 0.0, 0.0], "belongs to no rigid body"),
        ("plant.box.locked", 0.5, "is 0 .free. or 1 .locked."),
    ],
)
def test_nonsense_is_refused_and_changes_nothing(world, address, value, message):
    _, _, variables, context = world
    before = variables[address].get(context)
    with pytest.raises(VariableError, match=message):
        variables[address].set(context, value)
    np.testing.assert_array_equal(variables[address].get(context), before)


@pytest.mark.parametrize(
    ("address", "value"),
    [
        ("plant.box.inertia", [1.0, 1.0, 3.0, 0.0, 0.0, 0.0]),
        ("plant.box.inertia[2]", 1e3),
        ("plant.box.locked", 0.5),
        ("plant.box.friction_by_geometry", np.full((4, 2), [0.1, 0.9])),
    ],
)
def test_of_several_values_all_are_set_or_none(world, address, value):
    diagram, _, variables, context = world
    before = snapshot.take(diagram, context, variables)
    with pytest.raises(VariableError, match=address.partition("[")[0]):
        variables.write(context, {"plant.box.mass": 7.0, "plant.box.pose": np.full(6, 0.3), address: value})
    assert not before.compare(snapshot.take(diagram, context, variables))


def test_inertia_of_nothing_is_refused(world):
    _, _, variables, context = world
    variables["plant.box.mass"].set(context, 0.0)
    with pytest.raises(VariableError, match="set the mass first"):
        variables["plant.box.inertia"].set(context, [1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


def test_one_string_is_no_sequence_of_addresses(world):
    _, _, variables, context = world
    with pytest.raises(ValueError, match="addresses are a sequence"):
        variables.read(context, "plant.box.mass")


def test_an_unknown_address_suggests_the_nearest(world):
    _, _, variables, _ = world
    with pytest.raises(AddressError, match=r"'plant.box.maas'; did you mean plant.box.mass"):
        variables["plant.box.maas"]
    for address in (None, 3, {}, ["plant.box.mass"]):
        with pytest.raises(AddressError, match="an address is a text, .* not "):
            variables[address]
    with pytest.raises(AddressError, match="addresses begin with plant.Acrobot, plant.box"):
        variables["nothing like it at all"]


def test_two_systems_of_one_address_are_refused():
    variable = Variable("a.b", "x", (), "1", lambda context: 0.0)
    with pytest.raises(AddressError, match="two variables have the address a.b"):
        Variables([variable, variable])


def test_selection_and_complement_are_all_that_can_be_set(world):
    _, _, variables, _ = world
    chosen = ["plant.box.mass", "plant.Acrobot.elbow.position"]
    rest = variables.complement(chosen)
    assert not set(chosen) & set(rest)
    assert set(chosen) | set(rest) == {v.address for v in variables.values() if not v.derived}


def test_table_shows_address_kind_unit_bounds_and_value(world):
    _, _, variables, context = world
    line = next(line for line in variables.table(context).splitlines() if line.startswith("plant.box.mass "))
    assert line.split() == ["plant.box.mass", "a", "scalar", "kg", "[0,", "inf]", "2"]
    assert "Acrobot" not in variables.table(context, pattern="box.mass")


class Filter(LeafSystem):
    def __init__(self, size=2):
        super().__init__()
        gain = self.DeclareNumericParameter(BasicVector([1.0, 2.0, 3.0]))
        state = self.DeclareContinuousState(2)
        self.variables = (
            Element("gain", PARAMETER, int(gain), (size,), start=1, unit="1/s", bounds=(0.0, 10.0)),
            Element("estimate", CONTINUOUS, int(state), start=1, unit="m"),
        )


def test_declared_variables_reach_their_entries_only():
    builder = DiagramBuilder()
    system = builder.AddNamedSystem("filter", Filter())
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    variables = collect(diagram)
    assert list(variables) == ["filter.gain", "filter.estimate"]
    variables.write(context, {"filter.gain": [5.0, 6.0], "filter.estimate": 7.0})
    own = system.GetMyContextFromRoot(context)
    np.testing.assert_array_equal(own.get_numeric_parameter(0).value(), [1.0, 5.0, 6.0])
    np.testing.assert_array_equal(own.get_continuous_state_vector().CopyToVector(), [0.0, 7.0])
    with pytest.raises(VariableError, match=r"must lie in \[0, 10\] 1/s"):
        variables["filter.gain"].set(context, [5.0, 11.0])


@pytest.mark.parametrize(
    ("unit", "units"),
    [("rad, m", ["rad", "m"]), ("m", ["m", "m"]), ("m, m, rad", ["m, m, rad"] * 2), ("(rad, m)/s", ["(rad, m)/s"] * 2)],
)
def test_an_entry_has_the_unit_and_the_bounds_of_its_place(unit, units):
    builder = DiagramBuilder()
    reference = builder.AddNamedSystem("arm", Filter())
    bounds = (np.array([-2.5, 0.0]), np.array([2.5, 0.6]))
    reference.variables = (Element("goal", PARAMETER, 0, (2,), start=1, unit=unit, bounds=bounds),)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    variables = collect(diagram)
    assert [variables[f"arm.goal[{k}]"].unit for k in range(2)] == units
    with pytest.raises(VariableError) as refused:
        variables.write(context, {"arm.goal": [0.5, 0.7]})
    assert str(refused.value) == f"arm.goal[1] must lie in [0, 0.6] {units[1]}, but the value given is 0.7"


@pytest.mark.parametrize(
    ("unit", "shape", "units"),
    [
        ("1, 1, 1, 1, m, m, m", (7,), ["1"] * 4 + ["m"] * 3),  # a quaternion and a position
        ("rad/s, m/s", (6,), ["rad/s"] * 3 + ["m/s"] * 3),
        ("1, 1, 1, m", (3, 4), ["1", "1", "1", "m"] * 3),  # [R | p]
        ("1, m", (7,), ["1, m"] * 7),
        ("s, N, ...", (5,), ["s", "N", "N", "N", "N"]),  # when a curve begins, and its knots
        ("s, N, ...", (2,), ["s", "N"]),
        ("s, N, ...", (1,), ["s, N, ..."]),
        ("m", (), ["m"]),
        ("m", (0,), []),
    ],
)
def test_entries_have_the_units_of_their_groups(unit, shape, units):
    assert list(entry_units(unit, shape)) == units


def test_a_declaration_beyond_the_group_is_refused():
    builder = DiagramBuilder()
    builder.AddNamedSystem("filter", Filter(size=3))
    with pytest.raises(ValueError, match="entries 1 to 3 of parameter group 0 of filter, which has 3 entries"):
        collect(builder.Build())


def test_a_vector_that_is_declared_as_one_number_is_refused():
    builder = DiagramBuilder()
    system = builder.AddNamedSystem("filter", Filter())
    system.variables = (Element("gain", PARAMETER, 0),)
    with pytest.raises(ValueError, match=r"filter.gain is declared as one number, .* give shape=\(3,\)"):
        collect(builder.Build())


def test_single_system_is_refused():
    with pytest.raises(ValueError, match="collect takes a Diagram; Filter is one system"):
        collect(Filter())


def test_camera_pose_is_written_to_the_camera():
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    plant.Finalize()
    core = RenderCameraCore("none", CameraInfo(64, 48, 1.0), ClippingRange(0.01, 10.0), RigidTransform())
    camera = builder.AddNamedSystem(
        "camera",
        RgbdSensor(
            scene_graph.world_frame_id(),
            RigidTransform([0.0, 0.0, 1.0]),
            ColorRenderCamera(core),
            DepthRenderCamera(core, DepthRange(0.1, 5.0)),
        ),
    )
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    pose = collect(diagram)["camera.pose"]
    np.testing.assert_allclose(pose.get(context), [0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    pose.set(context, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    X_PB = camera.GetX_PB(camera.GetMyContextFromRoot(context))
    expected = RigidTransform(RollPitchYaw(0.4, 0.5, 0.6), [0.1, 0.2, 0.3])
    np.testing.assert_allclose(X_PB.GetAsMatrix34(), expected.GetAsMatrix34(), atol=1e-12)
