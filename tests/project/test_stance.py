"""Robots with legs stand on them: feet, posture and shift are found; a robot that would fall is welded."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.project import ProjectRobot, read_robot
from vtbdrake.project.stance import StanceFinder

pytestmark = pytest.mark.one_python

MODELS = Path(__file__).parent / "models"


@pytest.fixture(scope="module")
def quadruped() -> ProjectRobot:
    return read_robot(MODELS / "quadruped.urdf")


@pytest.fixture(scope="module")
def biped() -> ProjectRobot:
    return read_robot(MODELS / "biped.xml")


def at_rest(robot: ProjectRobot, file: str) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the contact points in the world by foot, and the centre of mass, as Drake has them in the stance."""
    plant = MultibodyPlant(0.001)
    Parser(plant).AddModels(str(MODELS / file))
    plant.Finalize()
    context, standing = plant.CreateDefaultContext(), robot.standing
    assert standing is not None
    for name, position in standing.posture.items():
        plant.GetJointByName(name).set_angle(context, position)
    plant.SetFreeBodyPose(context, plant.GetBodyByName(standing.base), standing.X_WB)
    poses = {name: plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(name)) for name in standing.feet}
    contacts = {name: poses[name].multiply(points.T).T for name, points in standing.feet.items()}
    return contacts, plant.CalcCenterOfMassPositionInWorld(context)


def test_stretched_knees_are_bent_alike(quadruped: ProjectRobot) -> None:
    contacts, centre = at_rest(quadruped, "quadruped.urdf")
    assert list(contacts) == [f"{x}_{y}_shank" for x in ("front", "hind") for y in ("left", "right")]
    points = np.vstack(list(contacts.values()))
    assert np.abs(points[:, 2]).max() < 1e-3
    assert np.abs(points.mean(axis=0) - centre)[:2].max() < 5e-3
    posture = {joint.name: joint.home for joint in quadruped.joints}
    knees = [position for name, position in posture.items() if "knee" in name]
    assert max(knees) < -0.5 and np.ptp(knees) < 0.01
    assert quadruped.welded == {} and str(quadruped).endswith("hind_right_shank")


def test_soles_stand_level_in_the_keyframe(biped: ProjectRobot) -> None:
    contacts, centre = at_rest(biped, "biped.xml")
    standing = biped.standing
    assert standing is not None and standing.source == "stand in biped.xml"
    assert list(standing.soles) == list(contacts) == ["left_foot", "right_foot"]
    for points in contacts.values():
        assert points.shape == (4, 3)
        assert np.abs(points[:, 2]).max() < 1e-3
        assert np.ptp(points[:, 0]) == pytest.approx(0.22, abs=1e-3)  # the box's length
    points = np.vstack(list(contacts.values()))
    assert (points.min(axis=0) < centre)[:2].all() and (centre < points.max(axis=0))[:2].all()


@pytest.mark.parametrize("name", ["quadruped", "biped"])
def test_weight_is_shifted_to_the_left(name: str, request: pytest.FixtureRequest) -> None:
    standing = request.getfixturevalue(name).standing
    assert standing.direction == (0.0, 1.0) and 0.7 < standing.reached < 1.1
    assert standing.shift == pytest.approx(0.25 * standing.widths[1], rel=0.05)


def changed(folder: Path, change: Callable[[str], str]) -> ProjectRobot:
    path = folder / "quadruped.urdf"
    path.write_text(change((MODELS / "quadruped.urdf").read_text()))
    return read_robot(path)


def test_soles_may_be_taken_for_points(tmp_path: Path) -> None:
    """Legs of three joints may not be able to keep soles level: with boxes for feet they stand on points."""
    text = (MODELS / "quadruped.urdf").read_text()
    file = tmp_path / "boxes.urdf"
    file.write_text(text.replace('<sphere radius="0.02"/>', '<box size="0.04 0.04 0.04"/>'))
    joints = read_robot(file).joints
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    Parser(plant).AddModels(str(file))
    plant.Finalize()
    context = plant.GetMyMutableContextFromRoot(builder.Build().CreateDefaultContext())
    inspector, base = scene_graph.model_inspector(), plant.GetBodyByName("trunk")
    shapes = {}
    for soles in (True, False):
        standing = StanceFinder(plant, context, inspector, base=base, joints=joints, soles=soles).stance([])
        assert standing is not None and bool(standing.soles) == soles
        shapes[soles] = {points.shape for points in standing.feet.values()}
    assert shapes == {True: {(4, 3)}, False: {(1, 3)}}


def without_hind_feet(text: str) -> str:
    links = text.split("<link ")
    return "<link ".join(
        re.sub(r"<collision>.*?</collision>", "", x) if x.startswith('name="hind') else x for x in links
    )


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            without_hind_feet,
            "what it stands on (2 contact points of front_left_shank, front_right_shank) lies on a line",
        ),
        (lambda text: text.replace('effort="40"', 'effort="0.5"'), "the effort limits of its drives are too low"),
    ],
)
def test_a_robot_that_would_fall_is_welded(tmp_path: Path, change: Callable[[str], str], reason: str) -> None:
    robot = changed(tmp_path, change)
    assert robot.standing is None and list(robot.welded) == ["trunk"]
    note = next(note for note in robot.notes if "welded" in note)
    assert "quadruped.urdf:4: trunk can move freely in the file: welded to the world" in note
    assert f"because it cannot stand on its legs: {reason}" in note


def test_a_hand_has_no_legs() -> None:
    """Its fingers do not end below its base."""
    assert read_robot(MODELS / "hand.sdf").standing is None


def test_the_trunk_is_placed_by_its_feet(quadruped: ProjectRobot) -> None:
    assert quadruped.standing is not None
    X_WB: RigidTransform = quadruped.standing.X_WB
    assert 0.33 < X_WB.translation()[2] < 0.42 * 0.95  # legs of 0.42 m, bent
