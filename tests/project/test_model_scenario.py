"""A model file is shown as it is: a command moves each of its joints, as its kinematics say."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from tests.cli.program import error_of
from tests.project.foreign_robots import CACHE, EXAMPLE_ROBOT_DATA, ROBOTS, fetch
from vtbdrake.project import SMALL_ARM, ModelFileScenario
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.web.live.watching import describe, opening_addresses
from vtbdrake_diagrams.station import FILE

pytestmark = pytest.mark.one_python

MODELS = Path(__file__).parent / "models"


def pose_of(testbed: VirtualTestbed, context, frame: str):
    scene_graph = testbed.scene_graph
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    inspector = query.inspector()
    frames = {inspector.GetName(frame_id): frame_id for frame_id in inspector.GetAllFrameIds()}
    return query.GetPoseInWorld(frames[frame])


def test_a_command_moves_its_joint() -> None:
    """The forearm hangs 0.4 m in front of the shoulder, which is 0.3 m high; a half turn brings it behind."""
    testbed = ModelFileScenario.of(str(SMALL_ARM)).build()
    context = testbed.default_context()
    np.testing.assert_allclose(pose_of(testbed, context, "arm::forearm").translation(), [0.4, 0.0, 0.3], atol=1e-12)
    testbed.write(context, {"u.turn": 0.5 * np.pi, "u.elbow": 0.25})
    X_WF = pose_of(testbed, context, "arm::forearm")
    np.testing.assert_allclose(X_WF.translation(), [0.0, 0.4, 0.3], atol=1e-12)
    assert X_WF.rotation().ToAngleAxis().angle() > 0.25


def test_sliders_have_the_ranges_of_the_joints() -> None:
    commands = {signal.name: signal for signal in ModelFileScenario.of(str(MODELS / "scara.urdf")).interface().commands}
    lift = commands["lift"]
    assert (lift.lower, lift.upper, lift.unit) == (0.02, 0.2, "m")


def opening_of(scenario: ModelFileScenario) -> list[str]:
    """Return what the page of a scenario watches at once."""
    return opening_addresses({address: describe(v) for address, v in scenario.build().variables().items()})


def test_page_opens_with_a_slider_for_every_joint() -> None:
    """The arm of the station has 7 joints, its gripper 2."""
    fingers = ["u.left_finger_sliding_joint", "u.right_finger_sliding_joint"]
    assert opening_of(ModelFileScenario.of(f"{FILE}#Torque")) == [*(f"u.iiwa_joint_{k}" for k in range(1, 8)), *fingers]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["tiago_description/robots/tiago.urdf", "romeo_small.urdf", "ur_description/urdf/ur5_gripper.urdf"]
)
def test_page_of_a_foreign_robot_opens_with_its_joints(name: str) -> None:
    """The page shows the joints that the text of the robot's file lets move."""
    try:
        fetch(CACHE, [EXAMPLE_ROBOT_DATA])
    except ConnectionError as error:
        pytest.skip(str(error))
    file = next(robot.file(CACHE) for robot in ROBOTS if robot.path.endswith(name))
    joints = [joint for joint in ElementTree.parse(file).iterfind("joint") if joint.get("type") != "fixed"]
    assert len(joints) >= 6
    assert sorted(opening_of(ModelFileScenario.of(str(file)))) == sorted(f"u.{joint.get('name')}" for joint in joints)


@pytest.mark.parametrize("kind", ["mujoco", "directives", "station"])
def test_files_of_every_kind_are_shown(tmp_path: Path, kind: str) -> None:
    directives = tmp_path / "lab.dmd.yaml"
    directives.write_text(f"directives:\n- add_model: {{name: robot, file: 'file://{SMALL_ARM}'}}\n")
    file = {"mujoco": str(MODELS / "arm.xml"), "directives": str(directives), "station": f"{FILE}#Torque"}[kind]
    scenario = ModelFileScenario.of(file)
    joint = {"mujoco": "shoulder", "directives": "elbow", "station": "iiwa_joint_1"}[kind]
    assert joint in [signal.name for signal in scenario.interface().commands]
    assert scenario.build().scene_graph is not None


def test_a_file_that_is_none_is_refused() -> None:
    assert "there is no file missing.urdf" in error_of("view", "missing.urdf")
    assert "--package goes with a model file" in error_of("view", "cart_pole", "--package", "a=.")
