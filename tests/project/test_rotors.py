"""Robots that fly: rotors from thrust sites, names of bodies or the name of a drone, with what is assumed."""

from pathlib import Path

import numpy as np
import pytest

from vtbdrake.project import RobotFileError, read_robot

pytestmark = pytest.mark.one_python

MODELS = Path(__file__).parent / "models"
# A body of 0.775 kg, with moments of inertia as Drake's quadrotor has them.
BODY = (
    '<link name="{base}"><inertial><mass value="0.775"/><inertia ixx="0.0015" iyy="0.0025" izz="0.0035" ixy="0" '
    'ixz="0" iyz="0"/></inertial><collision><geometry><box size="0.36 0.4 0.06"/></geometry></collision></link>'
)
PLACES = {"rotor_0": (0.13, -0.22), "rotor_1": (-0.13, 0.2), "rotor_2": (0.13, 0.22), "rotor_3": (-0.13, -0.2)}
ROTOR = (
    '<link name="{name}"><inertial><mass value="0.005"/><inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" '
    'iyz="0"/></inertial></link><joint name="{name}_joint" type="{kind}"><parent link="base"/><child link="{name}"/>'
    '<origin xyz="{x} {y} 0.023"/><axis xyz="0 0 1"/><limit lower="-1e16" upper="1e16"/></joint>'
)


def written(folder: Path, name: str, *, base: str = "base", rotors: str = "") -> Path:
    path = folder / f"{name}.urdf"
    path.write_text(f'<robot name="{name}">{BODY.format(base=base)}{rotors}</robot>')
    return path


def test_thrust_sites_are_rotors() -> None:
    flying = read_robot(MODELS / "x2.xml").flying
    assert flying is not None and flying.base == "drone" and flying.assumptions == ()
    assert [rotor.name for rotor in flying.rotors] == ["thrust1", "thrust2", "thrust3", "thrust4"]
    assert [rotor.moment for rotor in flying.rotors] == [-0.02, 0.02, -0.02, 0.02]
    assert {rotor.most for rotor in flying.rotors} == {13.0}  # of the class
    np.testing.assert_allclose(flying.rotors[2].position, [0.14, 0.18, 0.08])
    assert flying.height == pytest.approx(0.03)


@pytest.mark.parametrize("kind", ["fixed", "revolute"])
def test_bodies_called_rotors_are_rotors(tmp_path: Path, kind: str) -> None:
    rotors = "".join(ROTOR.format(name=name, kind=kind, x=x, y=y) for name, (x, y) in PLACES.items())
    robot = read_robot(written(tmp_path, "iris", rotors=rotors))
    assert robot.flying is not None and robot.joints == ()
    moments = {}
    for rotor in robot.flying.rotors:
        assert rotor.position[:2] == pytest.approx(PLACES[rotor.name])
        moments[rotor.name] = np.sign(rotor.moment)
    # Neighbours turn in opposite directions.
    assert moments["rotor_0"] == moments["rotor_1"] == -moments["rotor_2"] == -moments["rotor_3"]
    weight = (0.775 + 4 * 0.005) * 9.81
    assert sum(rotor.most for rotor in robot.flying.rotors) == pytest.approx(2.0 * weight, rel=0.01)
    assert "says of the rotors where they are only" in robot.assumptions[0]


def test_a_drone_without_rotors_gets_four(tmp_path: Path) -> None:
    robot = read_robot(written(tmp_path, "quadrotor"))
    assert robot.flying is not None and str(robot) == "quadrotor.urdf, which flies with 4 rotors"
    places = np.array([rotor.position for rotor in robot.flying.rotors])
    np.testing.assert_allclose(places.mean(axis=0), 0.0, atol=1e-12)
    # Drake's example has its rotors 0.15 m from the middle.
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), 0.168, atol=0.002)
    assert "has no rotors: assumed are four, 0.168 m from the middle" in robot.assumptions[0]


def test_an_object_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(RobotFileError, match="crate.urdf has no joints to drive.*It is an object, not a robot"):
        read_robot(written(tmp_path, "crate"))
