"""The copy of a model file: what Drake refuses is mended without moving a line, and meshes are converted."""

import struct
from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake.project import RobotFileError, add_model, read_robot, write_project
from vtbdrake.project.meshes import convert
from vtbdrake.project.model_faults import faults
from vtbdrake.project.model_scenario import ModelFileScenario
from vtbdrake.project.xml_text import XmlText

pytestmark = pytest.mark.one_python

INERTIA = '<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
HINGE = (
    '<joint name="hinge" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>'
    '<limit lower="-1" upper="1" effort="5" velocity="1"/></joint>'
)
# A tetrahedron, with outward triangles.
POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
TRIANGLES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]


def urdf(folder: Path, *, arm: str = "", further: str = "", name: str = "robot.urdf") -> Path:
    """Write a URDF whose arm is in line 3, and what is further in line 5."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(
        f'<robot name="robot">\n<link name="base">{INERTIA}</link>\n<link name="arm">{INERTIA}{arm}</link>\n{HINGE}\n'
        f"{further}\n</robot>\n"
    )
    return path


def shape(reference: str, kind: str = "visual", material: str = "") -> str:
    return f'<{kind}><geometry><mesh filename="{reference}"/></geometry>{material}</{kind}>'


def write_stl(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    facets = [struct.pack("<12fH", 0, 0, 0, *POINTS[list(corners)].ravel(), 0) for corners in TRIANGLES]
    path.write_bytes(bytes(80) + struct.pack("<I", len(facets)) + b"".join(facets))


def write_dae(path: Path, *, meter: float = 1.0) -> None:
    points = " ".join(map(str, POINTS.ravel()))
    indices = " ".join(str(k) for corners in TRIANGLES for k in corners)
    path.write_text(f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="unit" meter="{meter}"/><up_axis>Z_UP</up_axis></asset>
<library_effects><effect id="e"><profile_COMMON><technique sid="c"><lambert>
<diffuse><color>0 1 0 1</color></diffuse></lambert></technique></profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">{points}</float_array><technique_common>
<accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles material="s" count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>{indices}</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="w"><node><instance_geometry url="#g"><bind_material><technique_common>
<instance_material symbol="s" target="#m"/></technique_common></bind_material></instance_geometry></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#w"/></scene></COLLADA>
""")


def volume(obj: bytes) -> float:
    """Return the volume that the triangles of an OBJ file enclose, by the divergence theorem."""
    lines = [line.split() for line in obj.decode().splitlines()]
    vertices = np.array([line[1:] for line in lines if line[:1] == ["v"]], float)
    faces = np.array([[corner.split("/")[0] for corner in line[1:]] for line in lines if line[:1] == ["f"]], int) - 1
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def test_changes_leave_every_line_where_it_is() -> None:
    text = b'<a>\n  <b\n    x="1"\n    y="&lt;>"/>\n  <c>\n  </c>\n  <drake:d/>text\n</a>\n'
    xml = XmlText(text)
    b, c, d = xml.root.children
    assert (b.line, c.line, d.line, d.tag, b.get("y")) == (2, 5, 7, "drake:d", "<>")
    xml.set(b, x=None, z="2")
    xml.remove(c)
    changed = XmlText(xml.encode()).root
    assert [(e.tag, e.line) for e in changed.children] == [("b", 2), ("drake:d", 7)]
    assert changed.children[0].attributes == {"y": "<>", "z": "2"} and "text" in changed.text


def test_a_mesh_in_stl_becomes_a_mesh_that_drake_reads(tmp_path: Path) -> None:
    write_stl(tmp_path / "meshes" / "arm.STL")
    arm = shape("../meshes/arm.STL") + shape("../meshes/arm.STL", "collision")
    robot = read_robot(urdf(tmp_path / "urdf", arm=arm))
    assert {path.as_posix() for path in robot.files} == {
        "urdf/robot.urdf",
        "meshes/arm.STL.obj",
        "meshes/arm.STL.hull.obj",
    }
    for name in ("arm.STL.obj", "arm.STL.hull.obj"):
        assert volume(robot.files[Path("meshes") / name]) == pytest.approx(1.0 / 6.0)
    project = write_project(tmp_path, "my_robot", robot)
    plant = MultibodyPlant(0.001)
    add_model(plant, project / "my_robot" / "models" / "urdf" / "robot.urdf")
    assert plant.HasBodyNamed("arm")


def test_a_mesh_in_collada_keeps_material_and_unit(tmp_path: Path) -> None:
    write_dae(tmp_path / "arm.dae", meter=0.1)
    files = convert(tmp_path / "arm.dae", "arm")
    assert list(files) == ["arm.obj", "arm.mtl"]
    assert volume(files["arm.obj"]) == pytest.approx(1e-3 / 6.0)
    assert "Kd 0 1 0" in files["arm.mtl"].decode() and "usemtl m0" in files["arm.obj"].decode()


def test_a_mesh_of_mujoco_keeps_its_name(tmp_path: Path) -> None:
    write_stl(tmp_path / "meshes" / "arm.stl")
    (tmp_path / "parts.xml").write_text('<mujocoinclude><asset><mesh file="arm.stl"/></asset></mujocoinclude>')
    path = tmp_path / "robot.xml"
    path.write_text(
        '<mujoco><compiler meshdir="meshes"/><include file="parts.xml"/><worldbody><body name="arm">'
        '<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/><joint name="hinge" axis="0 1 0" range="-1 1"/>'
        '<geom type="mesh" mesh="arm"/><body name="tool"><inertial mass="0" pos="0 0 0" diaginertia="0 0 0"/></body>'
        "</body></worldbody></mujoco>"
    )
    robot = read_robot(path)  # without a name, and with a body without mass
    assert {path.as_posix() for path in robot.files} == {"robot.xml", "parts.xml", "meshes/arm.stl.obj"}
    assert b'model="robot"' in robot.files[Path("robot.xml")]


def test_without_trimesh_a_mesh_is_left_out_and_that_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vtbdrake.project.model_copy.can_convert", lambda path: False)
    write_stl(tmp_path / "arm.stl")
    robot = read_robot(urdf(tmp_path, arm=shape("arm.stl")))
    assert [path.as_posix() for path in robot.files] == ["robot.urdf"]
    assert any("robot.urdf:3: left out: meshes in STL" in n and "vtbdrake[meshes]" in n for n in robot.notes)


PACKAGE_XML = "<package><name>{}</name></package>"


@pytest.mark.parametrize("how", ["own_name", "package_xml", "beside", "given", "ros_package_path"])
def test_packages_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    folder = {"own_name": "pkg", "package_xml": "any", "beside": "other"}.get(how, "models")
    path = urdf(tmp_path / folder / "urdf", arm=shape("package://pkg/meshes/arm.obj"))
    root = tmp_path / {"beside": "pkg", "given": "far/a", "ros_package_path": "far/pkg"}.get(how, folder)
    (root / "meshes").mkdir(parents=True)
    (root / "meshes" / "arm.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n")
    if how == "package_xml":
        (root / "package.xml").write_text(PACKAGE_XML.format("pkg"))
    if how == "ros_package_path":
        monkeypatch.setenv("ROS_PACKAGE_PATH", f"{tmp_path / 'none'}:{tmp_path / 'far'}")
    robot = read_robot(path, {"pkg": root} if how == "given" else {})
    assert robot.packages == {"pkg": Path(root.name)}
    assert Path(root.name) / "meshes" / "arm.obj" in robot.files


def test_an_unknown_package_is_told_with_the_name_that_was_found(tmp_path: Path) -> None:
    path = urdf(tmp_path / "urdf", arm=shape("package://pkg/arm.obj"))
    (tmp_path / "package.xml").write_text(PACKAGE_XML.format("pkg_description"))
    with pytest.raises(
        RobotFileError, match=r"robot\.urdf:3: .*package\.xml has the <name> pkg_description.*--package"
    ):
        read_robot(path)


BLUE, RED = (f'<material name="paint"><color rgba="{rgb} 1"/></material>' for rgb in ("0 0 1", "1 0 0"))
BOX = '<visual><geometry><box size="1 1 1"/></geometry>{}</visual>'
FIXED = '<link name="tip"/><joint name="weld" type="fixed"><parent link="arm"/><child link="tip"/>{}</joint>'
TRANSMISSION = (
    '<transmission name="t"><type>SimpleTransmission</type><joint name="{0}"/><actuator name="a"/></transmission>'
)
NOTHING = INERTIA.replace("0.01", "0")


@pytest.mark.parametrize(
    ("arm", "further", "note"),
    [
        (BOX.format(BLUE) + BOX.format(RED), "", "robot.urdf:3: the material paint is defined again"),
        (BOX.format('<material name="paint"/>'), "", "robot.urdf:3: the material paint is not defined"),
        ("", FIXED.format('<mimic joint="hinge"/>'), "robot.urdf:5: weld does not move: its <mimic> is left out"),
        ("", TRANSMISSION.format("nowhere"), "robot.urdf:5: there is no joint nowhere"),
    ],
)
def test_what_drake_refuses_is_mended_with_a_note(tmp_path: Path, arm: str, further: str, note: str) -> None:
    robot = read_robot(urdf(tmp_path, arm=arm, further=further))
    assert any(text.partition("robot.urdf")[1:] and note in text for text in robot.notes)


@pytest.mark.parametrize("axis", ["0, 0.6, 0.8", "0.,.6,.8", "0.0, .6, 8e-1", "0, 6, 8", "0,6,8"])
def test_commas_between_numbers_are_blanks(tmp_path: Path, axis: str) -> None:
    path = urdf(tmp_path)
    path.write_text(path.read_text().replace('axis xyz="0 1 0"', f'axis xyz="{axis}"'))
    robot = read_robot(path)
    assert any("robot.urdf:4: commas between numbers count as blanks" in note for note in robot.notes)
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(bytes(robot.files[robot.model]).decode(), "urdf")
    plant.Finalize()
    assert plant.GetJointByName("hinge").revolute_axis() == pytest.approx([0.0, 0.6, 0.8])


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('mass value="1"', 'mass value="1,5"', "robot.urdf:2: the value '1,5' has a comma, at which Drake stops"),
        ('izz="0.01"', 'izz="0,02"', "robot.urdf:2: the izz '0,02' has a comma"),
        ('axis xyz="0 1 0"', 'axis xyz="0,0 1 0"', "robot.urdf:4: the xyz '0,0 1 0' has a comma"),
        ('upper="1"', 'upper="-,5e0"', "robot.urdf:4: the upper '-,5e0' has a comma"),
        ('mass value="1"', 'mass value="-1"', "robot.urdf:2: the mass of base is '-1': give a number that is not"),
        ('mass value="1"', 'mass value="nan"', "robot.urdf:2: the mass of base is 'nan'"),
        ('mass value="1"', 'mass value="1.5kg"', "robot.urdf:2: the mass of base is '1.5kg'"),
        ('mass value="1"', 'mass value="${m}"', "robot.urdf:2: ${m} is of xacro, which Drake does not know"),
        ("</robot>", '<xacro:include filename="hand.xacro"/></robot>', "robot.urdf:6: <xacro:include> is of xacro"),
        ('lower="-1"', 'lower="2"', "robot.urdf:4: the range of hinge is empty, 2 to 1: give it a lower"),
        ("</robot>", '<link name="arm"/></robot>', "robot.urdf:6: a second link arm, after the one in line 3"),
        ("</robot>", f"{HINGE}</robot>", "robot.urdf:6: a second joint hinge, after the one in line 4"),
    ],
)
def test_what_drake_would_read_wrongly_is_refused_with_its_line(tmp_path: Path, old: str, new: str, told: str) -> None:
    path = urdf(tmp_path)
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(RobotFileError) as error:
        read_robot(path)
    assert told in str(error.value)
    with pytest.raises(RobotFileError) as error:
        ModelFileScenario(file=str(path)).build()
    assert told in str(error.value)


SDF = """<sdf version="1.9"><model name="m"><link name="a"><inertial><mass>1</mass></inertial></link>
<joint name="j" type="revolute"><parent>world</parent><child>a</child><axis><xyz>0 0 1</xyz>
<limit><lower>-1</lower><upper>1</upper></limit></axis></joint></model></sdf>"""
MJCF = """<mujoco><worldbody><body name="a"><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
<joint range="-1 1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("text", "old", "new", "told"),
    [
        (SDF, "<mass>1<", "<mass>1,5<", "m.sdf:1: the mass '1,5' has a comma"),
        (SDF, "<mass>1<", "<mass><", "m.sdf:1: the mass of a is ''"),
        (SDF, "<lower>-1<", "<lower>3<", "m.sdf:2: the range of j is empty, 3 to 1"),
        (SDF, "<xyz>0 0 1<", "<xyz>0,0 0 1<", "m.sdf:2: the xyz '0,0 0 1' has a comma"),
        (MJCF, 'mass="1"', 'mass="1,5"', "m.xml:1: the mass '1,5' has a comma"),
        (MJCF, 'mass="1"', 'mass="-1"', "m.xml:1: the mass of a is '-1'"),
        (MJCF, 'range="-1 1"', 'range="1 -1"', "m.xml:2: the range of a joint is empty, 1 to -1"),
    ],
)
def test_faults_of_sdf_and_mjcf_are_told(tmp_path: Path, text: str, old: str, new: str, told: str) -> None:
    path = tmp_path / ("m.sdf" if text is SDF else "m.xml")
    read_faults = [text for _, text in faults(XmlText(text.encode()).root)]
    assert not read_faults
    path.write_text(text.replace(old, new))
    with pytest.raises(RobotFileError) as error:
        read_robot(path)
    assert told in str(error.value)


def test_commas_that_are_no_numbers_are_left_alone() -> None:
    text = (
        '<robot name="1,2"><link name="3,4"/><gazebo><update>1,5</update></gazebo><a note="1, 2 or so">x, y</a></robot>'
    )
    assert not list(faults(XmlText(text.encode()).root))


def test_names_of_numbers_keep_their_commas(tmp_path: Path) -> None:
    path = urdf(tmp_path)
    path.write_text(path.read_text().replace('"hinge"', '"1, 2"'))
    assert [joint.name for joint in read_robot(path).joints] == ["1, 2"]


def test_names_with_emoji_are_python(tmp_path: Path) -> None:
    path = urdf(tmp_path)
    path.write_text(path.read_text().replace('"hinge"', '"\U0001f9be"').replace('"arm"', '"\U0001f916 a"'), "utf-8")
    write_project(tmp_path, "hand", read_robot(path))
    text = (tmp_path / "hand" / "hand" / "robot.py").read_text("utf-8")
    namespace: dict[str, object] = {"__file__": str(tmp_path / "hand" / "hand" / "robot.py"), "__name__": "hand.robot"}
    exec(compile(text, "robot.py", "exec"), namespace)
    assert namespace["DRIVEN"] == ["\U0001f9be"]


def test_links_without_moments_of_inertia_get_those_of_a_sphere(tmp_path: Path) -> None:
    path = urdf(tmp_path)
    path.write_text(path.read_text().replace(f'arm">{INERTIA}', f'arm">{NOTHING}'))
    robot = read_robot(path)
    moment = 0.4 * (3.0 / (4.0 * np.pi * 1000.0)) ** (2.0 / 3.0)  # 2/5 m r^2 of 1 kg of water
    assert "robot.urdf:3 gives a mass without moments of inertia" in robot.assumptions[0]
    assert robot.assumptions[0].endswith(f"arm {moment:.3g}")


def test_alike_notes_are_one(tmp_path: Path) -> None:
    """Forty joints that have an attribute which Drake ignores."""
    path = tmp_path / "chain.xml"
    bodies = "".join(
        f'<body name="b{k}" pos="0.1 0 0">\n<joint name="j{k}" axis="0 1 0" range="-1 1" actuatorfrcrange="-{k} 5"/>\n'
        f'<geom type="sphere" size="0.02"/>'
        for k in range(40)
    )
    path.write_text(f'<mujoco model="chain"><worldbody>{bodies}{"</body>" * 40}</worldbody></mujoco>')
    notes = read_robot(path).notes
    assert sum("actuatorfrcrange" in note for note in notes) == 1
    assert any("chain.xml:2 and 39 more of the kind" in note for note in notes)


def test_a_project_is_silent_about_what_was_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "robot.xml"
    joint = '<joint name="j" axis="0 1 0" range="-1 1" actuatorfrcrange="-7 7"/>'
    body = f'<body name="a">{joint}<geom type="sphere" size="0.1"/></body>'
    path.write_text(f'<mujoco model="r"><worldbody>{body}</worldbody></mujoco>')
    robot = read_robot(path)
    assert any("actuatorfrcrange" in note for note in robot.notes)
    assert robot.joints[0].effort == 7.0  # although Drake ignores it
    add_model(MultibodyPlant(0.001), path)
    assert not caplog.records
