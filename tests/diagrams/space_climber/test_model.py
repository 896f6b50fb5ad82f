"""The shipped models against the generator and against Drake; oracles are sums over the XML and hand formulas."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JointActuatorIndex

from vtbdrake_diagrams.space_climber.kinematics import LegKinematics
from vtbdrake_diagrams.space_climber.model import CLIMBER_SDF, PAYLOAD_SDF, climber_sdf, payload_sdf
from vtbdrake_diagrams.space_climber.morphology import JOINT_NAMES, LEGS, Morphology
from vtbdrake_diagrams.space_climber.plant import add_climber, add_payload


@pytest.fixture(scope="module")
def plant() -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    add_payload(plant, add_climber(plant))
    plant.Finalize()
    return plant


def test_shipped_files_are_what_the_generator_writes() -> None:
    assert CLIMBER_SDF.read_text() == climber_sdf()
    assert PAYLOAD_SDF.read_text() == payload_sdf()


def xml_mass_and_com() -> tuple[float, np.ndarray]:
    """Total mass, and centre of mass in B at zero joint angles, from the XML alone."""
    model = ET.parse(CLIMBER_SDF).getroot().find("model")
    assert model is not None
    pose_in_base: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    mass, moment = 0.0, np.zeros(3)
    for link in model.findall("link"):
        pose = link.find("pose")
        if pose is None:
            R, p = np.eye(3), np.zeros(3)
        else:
            R_parent, p_parent = pose_in_base[pose.attrib["relative_to"]]
            x, y, z, _, _, yaw = map(float, pose.text.split())
            R = R_parent @ [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
            p = p_parent + R_parent @ [x, y, z]
        pose_in_base[link.attrib["name"]] = R, p
        link_mass = float(link.findtext("inertial/mass"))
        com = np.array(list(map(float, link.findtext("inertial/pose").split()[:3])))
        mass += link_mass
        moment += link_mass * (p + R @ com)
    return mass, moment / mass


def test_mass_and_centre_of_mass() -> None:
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(CLIMBER_SDF))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    mass, com = xml_mass_and_com()
    assert mass == pytest.approx(27.0, abs=1e-9)  # CREX
    assert plant.CalcTotalMass(context) == pytest.approx(mass, abs=1e-9)
    X_WB = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("base"))
    np.testing.assert_allclose(X_WB.inverse() @ plant.CalcCenterOfMassPositionInWorld(context), com, atol=1e-12)
    assert Morphology().total_mass == pytest.approx(27.0, abs=1e-12)


def test_inertia_of_the_torso(plant: MultibodyPlant) -> None:
    m = Morphology()
    I_BBo = plant.GetBodyByName("base").default_rotational_inertia().CopyToFullMatrix3()
    plate_x = m.torso_length / 2 + m.plate_thickness / 2
    I_yy = m.torso_mass / 12 * (m.torso_length**2 + m.torso_height**2)
    I_yy += m.plate_mass / 12 * (m.plate_thickness**2 + m.plate_height**2) + m.plate_mass * plate_x**2
    assert I_BBo[1, 1] == pytest.approx(I_yy, rel=1e-9)


def test_actuators_are_in_the_order_of_the_joint_names(plant: MultibodyPlant) -> None:
    names = [plant.get_joint_actuator(JointActuatorIndex(k)).name() for k in range(plant.num_actuators())]
    assert tuple(names) == JOINT_NAMES
    assert {plant.GetJointActuatorByName(name).effort_limit() for name in names} == {Morphology().joint_torque}


def test_stance_stands_on_the_plane(plant: MultibodyPlant) -> None:
    context = plant.CreateDefaultContext()
    for leg in LEGS:
        p_WF = plant.GetFrameByName(f"{leg}_foot").CalcPoseInWorld(context).translation()
        assert p_WF[2] == pytest.approx(Morphology().foot_radius, abs=1e-12)
    front = plant.GetFrameByName("front_left_foot").CalcPoseInWorld(context).translation()
    np.testing.assert_allclose(front[:2], [0.40, 0.40], atol=1e-12)


def test_stance_is_within_the_joint_ranges() -> None:
    m = Morphology()
    q = LegKinematics(m).inverse(m.stance).ravel()
    assert np.all(q > m.joint_lower)
    assert np.all(q < m.joint_upper)


def test_attachment_is_half_a_cube_ahead_of_the_front_plate(plant: MultibodyPlant) -> None:
    context = plant.CreateDefaultContext()
    X_WB = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("base"))
    X_WP = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("payload"))
    np.testing.assert_allclose((X_WB.inverse() @ X_WP).translation(), [0.40 + 0.01 + 0.10, 0, 0], atol=1e-12)


def test_payload_mass_scales_its_inertia(plant: MultibodyPlant) -> None:
    context = plant.CreateDefaultContext()
    payload = plant.GetBodyByName("payload")
    before = plant.CalcTotalMass(context)
    payload.SetMass(context, 30.0)
    assert plant.CalcTotalMass(context) == pytest.approx(before + 29.0)
    inertia = payload.CalcSpatialInertiaInBodyFrame(context).CalcRotationalInertia().CopyToFullMatrix3()
    np.testing.assert_allclose(inertia, 30.0 / 6 * 0.2**2 * np.eye(3), atol=1e-12)
    assert payload.get_mass(plant.CreateDefaultContext()) == 1.0
