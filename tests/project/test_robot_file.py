"""A model file's robot is read as the file's own numbers say; a file without one is refused."""

from pathlib import Path

import numpy as np
import pydrake
import pytest

from vtbdrake.project import RobotFileError, read_robot, resolve

pytestmark = pytest.mark.one_python

MODELS = Path(__file__).parent / "models"
EXAMPLES = Path(pydrake.getDrakePath()) / "examples"

INERTIA = '<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
LIMIT = '<limit lower="-1" upper="1" effort="5" velocity="1"/>'


def urdf(folder: Path, *, link: str = INERTIA, kind: str = "revolute", joint: str = LIMIT, further: str = "") -> Path:
    """Write a URDF with two links and one joint, in lines 3 to 5."""
    path = folder / "robot.urdf"
    path.write_text(
        f'<?xml version="1.0"?>\n<robot name="robot">\n<link name="base">{INERTIA}</link>\n'
        f'<link name="arm">{link}</link>\n'
        f'<joint name="hinge" type="{kind}"><parent link="base"/><child link="arm"/>'
        f'<axis xyz="0 1 0"/>{joint}</joint>\n'
        f"{further}</robot>\n"
    )
    return path


def test_drives_follow_the_order_of_the_actuators() -> None:
    robot = read_robot(MODELS / "scara.urdf")
    assert [joint.name for joint in robot.joints] == ["shoulder", "elbow", "lift"]
    assert robot.driven == ("lift", "elbow", "shoulder")
    lift = robot.joints[2]
    assert (lift.lower, lift.upper, lift.speed, lift.effort, lift.assumed) == (0.02, 0.2, 0.8, 60.0, ())
    assert lift.home == pytest.approx(0.11)  # 0 is outside its range


def test_damping_takes_half_of_the_effort_at_most() -> None:
    """The file says 7 rad/s and 15 N m; at this speed, damping of 3 and 8 N m s/rad would take 21 and 56 N m."""
    robot = read_robot(MODELS / "finger.urdf")
    assert [joint.speed for joint in robot.joints] == [2.5, 0.94]
    assert any("the speeds (rad/s or m/s) are therefore base 2.5, tip 0.94" in note for note in robot.notes)


def test_a_joint_without_actuator_moves_freely() -> None:
    robot = read_robot(EXAMPLES / "acrobot" / "Acrobot.urdf")
    assert robot.driven == ("elbow",)
    assert any("Acrobot.urdf:66: no actuator of shoulder" in note for note in robot.notes)


def test_all_joints_are_driven_where_the_file_has_no_actuators() -> None:
    robot = read_robot(MODELS / "bare.urdf")
    assert robot.driven == robot.added_drives == ("pan", "tilt")
    for joint in robot.joints:
        assert joint.assumed == ("effort", "range", "speed")
        assert np.isfinite([joint.lower, joint.upper, joint.speed, joint.effort]).all() and joint.effort > 0.0


@pytest.mark.parametrize(
    "differential",
    [
        '<type>DifferentialTransmission</type><joint name="hinge"/><joint name="second"/><actuator name="a"/>',
        '<flexJoint name="hinge"/><rollJoint name="second"/><passive_joint name="third"/>',
    ],
)
def test_joints_of_a_differential_are_driven(tmp_path: Path, differential: str) -> None:
    """Drake takes the <transmission> of the third joint alone."""
    further = f'<transmission name="d" type="WristTransmission">{differential}</transmission>\n'
    further += DRIVE.replace('"hinge"', '"third"')
    for parent, child, name in (("arm", "hand", "second"), ("hand", "tip", "third")):
        further += (
            f'<link name="{child}">{INERTIA}</link><joint name="{name}" type="revolute"><parent link="{parent}"/>'
            f'<child link="{child}"/><axis xyz="1 0 0"/>{LIMIT}</joint>\n'
        )
    robot = read_robot(urdf(tmp_path, further=further))
    assert (robot.driven, robot.added_drives) == (("third", "hinge", "second"), ("hinge", "second"))
    assert [joint.effort for joint in robot.joints] == [5.0] * 3
    assert any("robot.urdf:5: Drake leaves out the <transmission> of hinge, second" in note for note in robot.notes)


DRIVE = '<transmission name="t"><type>SimpleTransmission</type><joint name="hinge"/><actuator name="a"/></transmission>'


@pytest.mark.parametrize(
    ("kind", "limit", "drive", "effort", "speed", "assumed"),
    [
        pytest.param("revolute", LIMIT, DRIVE, 5.0, 1.0, (), id="transmission"),
        pytest.param("revolute", LIMIT, "", 5.0, 1.0, (), id="no_transmission"),
        pytest.param("prismatic", LIMIT, "", 5.0, 1.0, (), id="prismatic"),
        pytest.param(
            "continuous", '<limit effort="87" velocity="2.175"/>', "", 87.0, 2.175, ("range",), id="continuous"
        ),
        pytest.param(
            "revolute",
            LIMIT,
            DRIVE.replace("Simple", "FourBarLinkage"),
            5.0,
            1.0,
            (),
            id="transmission_unknown_to_drake",
        ),
        pytest.param(
            "revolute",
            '<limit lower="0" upper="0" effort="5" velocity="1"/>',
            "",
            5.0,
            1.0,
            ("range",),
            id="zero_range",
        ),
        # M = 0.01 kg m^2 without weight: 3 rad/s within 20 ms need 1.5 N m.
        pytest.param("continuous", '<limit effort="0" velocity="3"/>', "", 1.5, 3.0, ("effort", "range"), id="zero"),
        pytest.param("continuous", "", "", 1.5, 3.0, ("effort", "range", "speed"), id="no_limit"),
        pytest.param("continuous", "", DRIVE, 1.5, 3.0, ("effort", "range", "speed"), id="no_limit_transmission"),
    ],
)
def test_limits_are_those_of_the_file(
    tmp_path: Path, kind: str, limit: str, drive: str, effort: float, speed: float, assumed: tuple[str, ...]
) -> None:
    robot = read_robot(urdf(tmp_path, kind=kind, joint=limit, further=drive))
    (joint,) = robot.joints
    assert (joint.effort, joint.speed, joint.assumed) == (effort, speed, assumed)
    named = {
        name for name in ("effort", "range", "speed") for text in robot.assumptions if f"the {name}, assumed" in text
    }
    assert named == {*assumed}


def test_assumptions_name_joint_value_and_unit(tmp_path: Path) -> None:
    robot = read_robot(urdf(tmp_path, kind="continuous", joint='<limit effort="0" velocity="3"/>'))
    assert robot.assumptions[0].endswith(
        "robot.urdf:5 gives no limit of the effort, assumed is hinge 1.5 N m: compare JOINTS in robot.py with the data "
        "sheet"
    )
    assert not any("assumed" in note for note in robot.notes)


def test_an_assumed_drive_carries_the_robot_in_every_posture() -> None:
    """The tilted head weighs at most m g r = 0.9 kg 9.81 m/s^2 |(0.05, 0.02) m| on its tilt."""
    tilt = read_robot(MODELS / "bare.urdf").joints[1]
    assert tilt.effort > 0.9 * 9.81 * np.hypot(0.05, 0.02)
    assert tilt.effort == float(f"{tilt.effort:.2g}")  # an assumption pretends no more digits


def test_a_free_base_is_welded_where_the_file_places_it() -> None:
    welded = read_robot(EXAMPLES / "planar_gripper" / "planar_gripper.sdf").welded
    assert list(welded) == ["finger1_base", "finger2_base", "finger3_base"]
    assert all(X_WB.IsExactlyIdentity() for X_WB in welded.values())
    desk = read_robot(EXAMPLES / "kuka_iiwa_arm" / "models" / "desk" / "transcendesk55inch.sdf").welded
    np.testing.assert_allclose(desk["table_upper"].translation(), [-0.2437, -0.6251, 0.48], atol=1e-3)


def test_a_joint_that_follows_another_has_no_drive_of_its_own() -> None:
    robot = read_robot(MODELS / "hand.sdf")
    assert robot.driven == ("left_finger",)
    assert [(c.joint, c.leader, c.multiplier) for c in robot.couplings] == [("right_finger", "left_finger", 1.0)]
    assert robot.without_drive == ("right_finger",)


def test_a_closed_loop_moves_as_its_geometry_says() -> None:
    """In a parallelogram crank and rocker turn alike, and the coupler stays level."""
    robot = read_robot(MODELS / "fourbar.sdf")
    assert [joint.name for joint in robot.joints] == ["crank_joint", "coupler_joint", "rocker_joint"]
    np.testing.assert_allclose(robot.motions, [[1.0], [-1.0], [1.0]], atol=1e-3)


def test_motors_of_mujoco_act_by_their_gear() -> None:
    robot = read_robot(MODELS / "arm.xml")
    efforts = {joint.name: joint.effort for joint in robot.joints}
    assert (efforts["shoulder"], efforts["elbow"]) == (50.0 * 1.0, 20.0)  # gear times ctrlrange, forcerange
    assert robot.servos == ("m3",)  # a <position>


def test_a_range_of_positions_is_no_limit_of_the_torque(tmp_path: Path) -> None:
    """Drake takes the larger end, 1.5 rad, for a limit of 1.5 N m."""
    path = tmp_path / "robot.xml"
    servo = '<position name="servo" joint="hinge" kp="9" ctrlrange="-1.5 0"{}/>'
    text = (
        '<mujoco model="r"><worldbody><body name="a"><joint name="hinge" axis="0 1 0" range="-1.5 0"/>'
        f'<geom type="sphere" size="0.1"/></body></worldbody><actuator>{servo}</actuator></mujoco>'
    )
    path.write_text(text.format(""))
    (joint,) = read_robot(path).joints
    assert joint.assumed == ("effort", "speed")
    path.write_text(text.format(' forcerange="-7 7"'))
    (joint,) = read_robot(path).joints
    assert (joint.effort, joint.assumed) == (7.0, ("speed",))
    begin, end = text.index("<actuator>"), text.index("</mujoco>")
    included = text[begin:end].format(' forcerange="-8 8"')
    (tmp_path / "drives.xml").write_text(f"<mujocoinclude>{included}</mujocoinclude>")
    path.write_text(f'{text[:begin]}<include file="drives.xml"/></mujoco>')
    (joint,) = read_robot(path).joints
    assert (joint.effort, joint.assumed) == (8.0, ("speed",))


def test_bodies_that_touch_at_home_are_listed() -> None:
    robot = read_robot(EXAMPLES / "planar_gripper" / "planar_gripper.sdf")
    assert set(robot.touching) == {f"finger{k}_{link}" for k in (1, 2, 3) for link in ("link2", "tip_link")}


def test_home_is_a_posture_that_the_drives_carry(tmp_path: Path) -> None:
    """A weight of 9.81 N, 1 m from the axis, above a drive of 5 N m: the arm has to hang."""
    heavy = INERTIA.replace("<mass", '<origin xyz="1 0 0"/><mass')
    path = urdf(tmp_path, link=heavy, joint=LIMIT.replace('"1"', '"2"', 1), further=DRIVE)
    robot = read_robot(path)
    (joint,) = robot.joints
    assert 0.5 * joint.effort < 9.81 * np.cos(joint.home) < joint.effort
    assert any("drives of hinge cannot carry the robot in the file's posture: its home is" in n for n in robot.notes)


@pytest.mark.parametrize(("joints", "held"), [("XZ", ("x", "z")), ("X", ())])
def test_planar_base_that_falls_is_held(tmp_path: Path, joints: str, held: tuple[str, ...]) -> None:
    """A base that slides on a level rail does not fall."""
    axes = {"X": '<joint name="x" type="slide" axis="1 0 0"/>', "Z": '<joint name="z" type="slide" axis="0 0 1"/>'}
    path = tmp_path / "walker.xml"
    path.write_text(
        f'<mujoco model="r"><worldbody><body name="trunk">{"".join(axes[joint] for joint in joints)}'
        '<geom type="sphere" size="0.1"/><body name="leg"><joint name="hip" axis="0 1 0" range="-1 1"/>'
        '<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02"/></body></body></worldbody>'
        '<actuator><motor joint="hip" ctrlrange="-9 9"/></actuator></mujoco>'
    )
    robot = read_robot(path)
    assert robot.held == held
    assert robot.driven == ("hip",)
    assert any("which would fall" in note for note in robot.notes) == bool(held)


def test_a_joint_that_damping_holds_is_fixed(tmp_path: Path) -> None:
    further = f'<link name="tip">{INERTIA}</link><joint name="second" type="revolute"><parent link="arm"/>'
    further += f'<child link="tip"/><axis xyz="1 0 0"/><dynamics damping="{{}}"/>{LIMIT}</joint>'
    path = urdf(tmp_path, further=further.format("1e11"))
    robot = read_robot(path)
    assert (robot.held, robot.driven) == (("second",), ("hinge",))
    assert any("robot.urdf:6: the damping of second holds them" in note for note in robot.notes)
    assert read_robot(urdf(tmp_path, further=further.format("1"))).held == ()
    drives = DRIVE + DRIVE.replace("hinge", "second").replace('"t"', '"u"').replace('"a"', '"b"')
    robot = read_robot(urdf(tmp_path, further=further.format("1e4") + drives))
    slow = {joint.name: joint.speed for joint in robot.joints}["second"]
    assert robot.held == () and abs(robot.away[1]) <= 5.0 * slow  # what its speed allows within 5 s


def test_a_weight_beyond_the_drive_is_noted(tmp_path: Path) -> None:
    """The range begins at home, so that the other posture is on one side."""
    heavy = INERTIA.replace("<mass", '<origin xyz="1 0 0"/><mass')
    robot = read_robot(urdf(tmp_path, link=heavy, joint=LIMIT.replace('"-1"', '"0"'), further=DRIVE))
    assert robot.joints[0].home == 0.0 < robot.away[0]
    assert any("nor in one near it: they sink" in note for note in robot.notes)


def test_files_of_a_package_come_along(tmp_path: Path) -> None:
    package = tmp_path / "my_robot"
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").mkdir()
    (package / "package.xml").write_text("<package><name>my_robot</name></package>")
    (package / "meshes" / "arm.obj").write_text(
        "mtllib arm.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"
    )
    (package / "meshes" / "arm.mtl").write_text("newmtl m\nKd 1 0 0\n")
    visual = '<visual><geometry><mesh filename="package://my_robot/meshes/arm.obj"/></geometry></visual>'
    robot = read_robot(urdf(package / "urdf", link=INERTIA + visual))
    names = ("package.xml", "urdf/robot.urdf", "meshes/arm.obj", "meshes/arm.mtl")
    assert {path.as_posix() for path in robot.files} == {f"my_robot/{name}" for name in names}
    assert robot.packages == {"my_robot": Path("my_robot")} and robot.model == Path("my_robot/urdf/robot.urdf")


def test_files_beside_the_model_keep_their_places(tmp_path: Path) -> None:
    (tmp_path / "urdf").mkdir()
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "arm.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n")
    visual = '<visual><geometry><mesh filename="../meshes/arm.obj"/></geometry></visual>'
    robot = read_robot(urdf(tmp_path / "urdf", link=INERTIA + visual))
    assert {path.as_posix() for path in robot.files} == {"urdf/robot.urdf", "meshes/arm.obj"}


@pytest.mark.parametrize(
    ("changes", "line", "message"),
    [
        ({"link": ""}, 4, "give the link arm an <inertial>"),
        ({"kind": "planar", "joint": ""}, 5, "hinge is planar.* replace it by several"),
        ({"kind": "revolut"}, 5, "unrecognized type"),
        ({"joint": '<limit lower="1" upper="1" effort="1" velocity="1"/>'}, 5, "range of hinge is empty, 1 to 1"),
        (
            {"link": f'{INERTIA}<visual><geometry><mesh filename="no.obj"/></geometry></visual>'},
            4,
            "does not exist.* Put the file there, or take",
        ),
        (
            {"link": f'{INERTIA}<visual><geometry><mesh filename="package://pkg/no.obj"/></geometry></visual>'},
            4,
            "unknown package 'pkg': no folder around the file is named pkg.* --package pkg=FOLDER",
        ),
    ],
)
def test_bad_files_get_file_line_and_remedy(tmp_path: Path, changes: dict[str, str], line: int, message: str) -> None:
    with pytest.raises(RobotFileError, match=rf"robot\.urdf:{line}: .*{message}"):
        read_robot(urdf(tmp_path, **changes))


@pytest.mark.parametrize(
    "path",
    sorted(p for p in EXAMPLES.rglob("*") if p.suffix in (".urdf", ".sdf") if "object" in str(p) or "quad" in str(p)),
    ids=lambda path: path.name,
)
def test_objects_have_no_joints_to_drive(path: Path) -> None:
    with pytest.raises(RobotFileError, match=rf"{path.name} has no joints to drive"):
        read_robot(path)


def test_loops_of_joints_are_refused_with_a_remedy(tmp_path: Path) -> None:
    """The ball constraint of the linkage as a joint."""
    text = (MODELS / "fourbar.sdf").read_text()
    begin, end = text.index("<drake:ball_constraint>"), text.index("</drake:ball_constraint>")
    loop = '<joint name="loop" type="revolute"><parent>coupler</parent><child>rocker</child>'
    loop += "<axis><xyz>0 1 0</xyz></axis></joint>"
    path = tmp_path / "loop.sdf"
    path.write_text(text[:begin] + loop + text[end + len("</drake:ball_constraint>") :])
    with pytest.raises(RobotFileError, match=r"loop\.sdf:\d+: .*loop closes.*open each loop at one joint"):
        read_robot(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("missing.urdf", "there is no file missing.urdf"),
        (str(MODELS / "robot.xacro"), "there is no file"),
        ("package://no_such_package/robot.urdf", "is not on this computer.* downloads package://drake_models"),
        (__file__, "is not named like a URDF"),
    ],
)
def test_files_that_are_none_are_refused(text: str, message: str) -> None:
    with pytest.raises(RobotFileError, match=message):
        resolve(text)
