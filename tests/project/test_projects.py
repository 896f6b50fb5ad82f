"""Projects of ``vtbdrake new``: they pass ruff and their own tests, for robots of every kind of file."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pydrake
import pytest

from tests.cli.program import ROOT, error_of, run
from vtbdrake.project import SMALL_ARM, read_robot, read_station, write_project
from vtbdrake_diagrams.station import FILE

MODELS = Path(__file__).parent / "models"
EXAMPLES = Path(pydrake.getDrakePath()) / "examples"
ROBOTS = {
    "small_arm": SMALL_ARM,
    "iiwa": ROOT / "diagrams" / "station" / "models" / "iiwa14.urdf",
    "scara": MODELS / "scara.urdf",
    "mujoco_arm": MODELS / "arm.xml",
    "hand": MODELS / "hand.sdf",
    "head": MODELS / "bare.urdf",
    "fourbar": MODELS / "fourbar.sdf",
    "acrobot": EXAMPLES / "acrobot" / "Acrobot.urdf",
    "acrobot_sdf": EXAMPLES / "acrobot" / "Acrobot.sdf",
    "acrobot_no_collision": EXAMPLES / "acrobot" / "Acrobot_no_collision.urdf",
    "pendulum": EXAMPLES / "pendulum" / "Pendulum.urdf",
    "cart_pole": EXAMPLES / "multibody" / "cart_pole" / "cart_pole.sdf",
    "planar_gripper": EXAMPLES / "planar_gripper" / "planar_gripper.sdf",
    "planar_brick": EXAMPLES / "planar_gripper" / "planar_brick.sdf",
    "desk": EXAMPLES / "kuka_iiwa_arm" / "models" / "desk" / "transcendesk55inch.sdf",
}

STATIONS = {"torque_station": "Torque", "position_station": "Position", "mixed_station": "PositionAndTorque"}
# A robot for each parser of Drake, one with joints that no motor drives, and a station pass all of their tests.
CHECKED = ("small_arm", "mujoco_arm", "hand", "fourbar", "torque_station")
ON_BOTH_PYTHONS = ("small_arm", "mujoco_arm", "hand")
# What depends on the robot; how rollouts, forks and the fallback work depends on the code, which is the same for all.
OF_THE_ROBOT = "hold or move or believed or machine or signals or bounds or safe or round_trip or alike"


@pytest.fixture(scope="module")
def projects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a project for each robot."""
    folder = tmp_path_factory.mktemp("projects")
    for name, path in ROBOTS.items():
        write_project(folder, f"my_{name}", read_robot(path))
    for name, key in STATIONS.items():
        write_project(folder, f"my_{name}", read_station(f"{FILE}#{key}"))
    return folder


def python(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )


def check_tests_pass(project: Path, *options: str) -> None:
    done = python("-m", "pytest", "-q", "-p", "no:cacheprovider", *options, cwd=project)
    assert done.returncode == 0, done.stdout


@pytest.mark.one_python
def test_projects_pass_ruff(projects: Path) -> None:
    for command in (("check",), ("format", "--check", "--diff")):
        done = python("-m", "ruff", *command, "--no-cache", ".", cwd=projects)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name in ON_BOTH_PYTHONS else [pytest.mark.one_python]) for name in CHECKED],
)
def test_projects_pass_their_tests(projects: Path, name: str) -> None:
    check_tests_pass(projects / f"my_{name}")


@pytest.mark.one_python
@pytest.mark.parametrize("name", sorted({*ROBOTS, *STATIONS} - {*CHECKED}))
def test_other_robots_hold_move_and_drive_a_machine(projects: Path, name: str) -> None:
    check_tests_pass(projects / f"my_{name}", "-k", OF_THE_ROBOT)


@pytest.mark.slow
@pytest.mark.one_python
def test_the_program_of_a_project_drives_a_machine(projects: Path) -> None:
    done = python("-m", "my_small_arm.drive", cwd=projects / "my_small_arm")
    assert "the log repeats, bit for bit: True" in done.stdout, done.stdout + done.stderr
    assert "stopped by the guards" not in done.stdout


@pytest.mark.slow
@pytest.mark.one_python
def test_optimization_of_a_project_finds_feasible_gains(projects: Path) -> None:
    done = python("-m", "my_small_arm.optimize", cwd=projects / "my_small_arm")
    assert "dps.frequency" in done.stdout, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.one_python
@pytest.mark.parametrize("name", ["pendulum", "torque_station"])
def test_notebook_of_a_project_runs(projects: Path, name: str) -> None:
    import nbformat
    from nbclient import NotebookClient

    project = projects / f"my_{name}"
    notebook = nbformat.read(project / f"my_{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(project)}}).execute()


@pytest.mark.one_python
def test_new_writes_a_project_and_says_what_is_assumed(tmp_path: Path) -> None:
    result = run("new", "head", "--urdf", MODELS / "bare.urdf", cwd=tmp_path)
    assert result.exit_code == 0
    assert "no limit of the effort of pan, tilt" in result.stderr
    assert "assumed: effort, range, speed" in (tmp_path / "head" / "head" / "robot.py").read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["head"]  # nothing else is left
    assert json.loads((tmp_path / "head" / "head.ipynb").read_text())["nbformat"] == 4


@pytest.mark.one_python
def test_new_writes_a_project_for_a_station(tmp_path: Path) -> None:
    result = run("new", "lab", "--station", f"{FILE}#Torque", cwd=tmp_path)
    assert result.exit_code == 0 and "station.yaml#Torque with iiwa, wsg" in result.stdout
    models = tmp_path / "lab" / "lab" / "models"
    names = {path.relative_to(models).as_posix() for path in models.rglob("*") if path.is_file()}
    assert names == {
        "package.xml",
        "station.yaml",
        *(f"models/{m}" for m in ("iiwa14.urdf", "wsg.sdf", "table.sdf")),
    } | {"models/block.sdf"}


@pytest.mark.one_python
def test_stations_without_an_arm_are_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.yaml").write_text("model_drivers: {}\n")
    message = error_of("new", "lab", "--station", "empty.yaml", cwd=tmp_path)
    assert "empty.yaml has no !IiwaDriver" in message and "--urdf" in message
    assert [path.name for path in tmp_path.iterdir()] == ["empty.yaml"]


@pytest.mark.one_python
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("my-arm", "as in my_arm"),
        ("3arms", "as in my_robot"),
        ("class", "as in my_robot"),
        ("../arm", "as in arm"),
        ("numpy", "Python has a module numpy already"),
        ("tests", "call it my_tests"),
    ],
)
def test_bad_names_are_refused(tmp_path: Path, name: str, message: str) -> None:
    assert message in error_of("new", name, cwd=tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.one_python
def test_nothing_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "arm").mkdir()
    (tmp_path / "arm" / "thesis.txt").write_text("all of it")
    assert "exists, and is not overwritten" in error_of("new", "arm", cwd=tmp_path)
    assert [path.name for path in (tmp_path / "arm").iterdir()] == ["thesis.txt"]


@pytest.mark.one_python
def test_a_bad_file_leaves_nothing(tmp_path: Path) -> None:
    assert "there is no file arm.urdf" in error_of("new", "arm", "--urdf", "arm.urdf", cwd=tmp_path)
    assert not list(tmp_path.iterdir())
