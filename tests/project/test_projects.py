"""Projects of ``vtbdrake new``: they pass ruff and their own tests, for robots of every kind of file."""

import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pydrake
import pytest
from pydrake.multibody.plant import MultibodyPlant

import vtbdrake as vtb
from tests.cli.program import ROOT, error_of, run
from vtbdrake.project import SMALL_ARM, read_robot, read_station, write_project
from vtbdrake.testing.checks import CHECKS
from vtbdrake.testing.lock_step import LockStep
from vtbdrake.testing.subject import Subject
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
    "finger": MODELS / "finger.urdf",
    "fourbar": MODELS / "fourbar.sdf",
    "torso": MODELS / "torso.urdf",
    "acrobot": EXAMPLES / "acrobot" / "Acrobot.urdf",
    "acrobot_no_collision": EXAMPLES / "acrobot" / "Acrobot_no_collision.urdf",
    "pendulum": EXAMPLES / "pendulum" / "Pendulum.urdf",
    "cart_pole": EXAMPLES / "multibody" / "cart_pole" / "cart_pole.sdf",
    "planar_gripper": EXAMPLES / "planar_gripper" / "planar_gripper.sdf",
    "planar_brick": EXAMPLES / "planar_gripper" / "planar_brick.sdf",
    "desk": EXAMPLES / "kuka_iiwa_arm" / "models" / "desk" / "transcendesk55inch.sdf",
}
# Robots with free bases: on feet that are spheres, and on soles.
LEGGED = {"quadruped": MODELS / "quadruped.urdf", "biped": MODELS / "biped.xml"}
FLYING = {"x2": MODELS / "x2.xml"}

STATIONS = {"torque_station": "Torque", "position_station": "Position", "mixed_station": "PositionAndTorque"}
# A robot whose joints are all driven, and a station pass all of their tests, as a user runs them. How rollouts, forks
# and the fallback work depends on the code, which is the same for all.
CHECKED = ("small_arm", "torque_station")
# What depends on the robot, for all others, in this process.
OF_ROBOTS = ("test_robot_holds_its_posture", "test_robot_moves_to_a_posture", "test_measurements_are_believed")
OF_STATIONS = ("test_arms_hold_their_postures", "test_arms_move_to_postures", "test_measurements_are_believed")
OF_THE_ROBOT = {
    "check_builds_alike_twice",
    "check_yaml_round_trip",
    "check_pickle_round_trip",
    "check_signals_have_units",
    "check_signals_have_limits",
    "check_parameters_have_bounds",
    "check_values_fit_their_signals",
    "check_sim_and_real_alike",
    "check_deployment_is_safe",
    "check_loop_commands_its_machine",
}
# The parsers of Drake beside the parser of URDF; with couplings, and actuators that are replaced.
OFTEN = ("mujoco_arm", "hand")


class Projects:
    """A folder with a project for each robot and station, written when it is first asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __getitem__(self, name: str) -> Path:
        project = self.folder / f"my_{name}"
        if not project.exists():
            robots = ROBOTS | LEGGED | FLYING
            model = read_robot(robots[name]) if name in robots else read_station(f"{FILE}#{STATIONS[name]}")
            write_project(self.folder, project.name, model)
        return project


@pytest.fixture(scope="module")
def projects(tmp_path_factory: pytest.TempPathFactory) -> Projects:
    return Projects(tmp_path_factory.mktemp("projects"))


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
@pytest.mark.parametrize(
    "names",
    [
        (*CHECKED, "fourbar", "acrobot", "biped", "x2"),
        pytest.param((*ROBOTS, *LEGGED, *FLYING, *STATIONS), marks=pytest.mark.slow),
    ],
)
def test_projects_pass_ruff(projects: Projects, names: tuple[str, ...]) -> None:
    folders = [projects[name] for name in names]
    for command in (("check",), ("format", "--check", "--diff")):
        done = python("-m", "ruff", *command, "--no-cache", *map(str, folders), cwd=projects.folder)
        assert done.returncode == 0, done.stdout + done.stderr


def test_a_project_passes_its_quickest_tests(projects: Projects) -> None:
    check_tests_pass(projects["small_arm"], "-k", "hold or believed or stopped")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name == "small_arm" else [pytest.mark.one_python]) for name in CHECKED],
)
def test_projects_pass_their_tests(projects: Projects, name: str) -> None:
    check_tests_pass(projects[name])


def module_of_tests(projects: Projects, name: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return what is in the module of a project's tests, run in this process."""
    project = projects[name]
    monkeypatch.syspath_prepend(project)
    return runpy.run_path(str(project / "tests" / f"test_my_{name}.py"))


def scenario_of(tests: dict[str, Any]) -> vtb.Scenario:
    """Return the scenario of a project, from the module of its tests."""
    return next(v for v in tests.values() if isinstance(v, type) and issubclass(v, vtb.Scenario))()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in OFTEN else [pytest.mark.one_python])
        for name in sorted({*ROBOTS, *STATIONS} - {*CHECKED})
    ],
)
def test_other_robots_hold_move_and_drive_a_machine(
    projects: Projects, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    tests = module_of_tests(projects, name, monkeypatch)
    scenario = scenario_of(tests)
    testbed = scenario.build()
    for test in OF_STATIONS if name in STATIONS else OF_ROBOTS:
        tests[test](testbed)
    subject = Subject(tests.get("CHECKED", scenario))
    for check in CHECKS:
        if check.__name__ in OF_THE_ROBOT and (error := subject.outcome(check)):
            raise error
    with LockStep(scenario) as loop:
        runtime = loop.runtime
        runtime.take_over(timeout=1.0)
        runtime.run(cycles=1)  # The first command continues what is measured.
        runtime.write(tests.get("COMMANDS") or {"u.posture": np.squeeze(tests["AWAY"])})
        runtime.run(cycles=round(tests["SECONDS"] / runtime.period), until=lambda: bool(runtime.guards.latched))
        assert not runtime.guards.latched
        if name in STATIONS:
            for arm, away in tests["AWAY"].items():
                assert np.abs(runtime.read(f"real.sense.{arm}_position_measured") - away).max() < tests["TOLERANCE"]
        else:
            assert tests["distance"](runtime.read("real.sense.position"), np.array(tests["AWAY"])) < tests["TOLERANCE"]


@pytest.mark.slow
@pytest.mark.one_python
def test_a_robot_with_legs_stands_on_them(projects: Projects, monkeypatch: pytest.MonkeyPatch) -> None:
    tests = module_of_tests(projects, "quadruped", monkeypatch)
    tests["test_robot_stands"](scenario_of(tests).build())


@pytest.mark.one_python
def test_a_finger_moves_in_spite_of_its_damping(projects: Projects, monkeypatch: pytest.MonkeyPatch) -> None:
    tests = module_of_tests(projects, "finger", monkeypatch)
    tests["test_robot_moves_to_a_posture"](scenario_of(tests).build())


@pytest.mark.one_python
def test_a_weak_waist_bears_what_a_strong_arm_does(projects: Projects, monkeypatch: pytest.MonkeyPatch) -> None:
    tests = module_of_tests(projects, "torso", monkeypatch)
    tests["test_robot_moves_to_a_posture"](scenario_of(tests).build())


@pytest.mark.one_python
def test_long_names_have_channels_that_lcm_takes(tmp_path: Path) -> None:
    names = [f"my_{'long_' * 12}{side}_arm" for side in ("left", "right")]
    robot, channels = read_robot(SMALL_ARM), []
    for name in names:
        text = (write_project(tmp_path, name, robot) / name / "scenario.py").read_text()
        channels.append({channel for channel in re.findall(r'"([A-Z_0-9]+)"', text) if "LONG" in channel})
    assert len(channels[0]) == len(channels[1]) == 6
    assert max(map(len, channels[0] | channels[1])) == 63  # with _EFFORT_MEASURED
    assert not channels[0] & channels[1]


@pytest.mark.one_python
def test_joints_that_fall_are_not_guarded(projects: Projects, monkeypatch: pytest.MonkeyPatch) -> None:
    tests = module_of_tests(projects, "acrobot", monkeypatch)
    signals = {signal.name: signal for signal in tests["MyAcrobotScenario"]().interface().sense}
    shoulder, elbow = range(2)
    assert list(tests["JOINTS"]) == ["shoulder", "elbow"]
    assert signals["velocity"].upper[shoulder] == 500.0 and signals["velocity"].upper[elbow] < 500.0
    assert signals["position"].upper[shoulder] > 100.0 and signals["position"].upper[elbow] < 20.0


@pytest.mark.one_python
def test_a_drone_hovers(projects: Projects, monkeypatch: pytest.MonkeyPatch) -> None:
    tests = module_of_tests(projects, "x2", monkeypatch)
    tests["test_robot_takes_off_and_hovers"](scenario_of(tests).build())


@pytest.mark.slow
@pytest.mark.one_python
@pytest.mark.parametrize("name", ["biped", "x2"])
def test_projects_of_robots_with_a_free_base_pass_their_tests(projects: Projects, name: str) -> None:
    check_tests_pass(projects[name])


@pytest.mark.slow
@pytest.mark.one_python
def test_robot_on_four_feet_shifts_its_weight_and_drives_a_machine(projects: Projects) -> None:
    check_tests_pass(projects["quadruped"], "-k", "weight or check_loop_commands_its_machine")


@pytest.mark.slow
@pytest.mark.one_python
def test_the_program_of_a_project_drives_a_machine(projects: Projects) -> None:
    done = python("-m", "my_small_arm.drive", cwd=projects["small_arm"])
    assert "the log repeats, bit for bit: True" in done.stdout, done.stdout + done.stderr
    assert "stopped by the guards" not in done.stdout


@pytest.mark.slow
@pytest.mark.one_python
def test_optimization_of_a_project_finds_feasible_gains(projects: Projects) -> None:
    program = projects["small_arm"] / "my_small_arm" / "optimize.py"
    assert program.read_text().count("rollouts=30") == 1
    program.write_text(program.read_text().replace("rollouts=30", "rollouts=8"))
    done = python("-m", "my_small_arm.optimize", cwd=projects["small_arm"])
    assert "dps.frequency" in done.stdout, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.one_python
@pytest.mark.parametrize("name", ["pendulum", "torque_station"])
def test_notebook_of_a_project_runs(projects: Projects, name: str) -> None:
    import nbformat
    from nbclient import NotebookClient

    project = projects[name]
    notebook = nbformat.read(project / f"my_{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    for cell in notebook.cells:
        cell.source = cell.source.replace("rollouts=8", "rollouts=3")
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(project)}}).execute()


@pytest.mark.one_python
def test_new_writes_a_project_and_says_first_what_is_assumed(tmp_path: Path) -> None:
    result = run("new", "head", "--urdf", MODELS / "bare.urdf", cwd=tmp_path)
    assert result.exit_code == 0
    lines = result.stderr.splitlines()
    kinds = [line.partition(": ")[0] for line in lines]
    assert kinds == ["assumed"] * 3 + ["note"] * (len(lines) - 3)
    assert "no limit of the effort, assumed is pan " in lines[0] and " N m, tilt " in lines[0]
    assert "assumed: effort, range, speed" in (tmp_path / "head" / "head" / "robot.py").read_text()
    assert lines[0].removeprefix("assumed: ") in (tmp_path / "head" / "README.md").read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["head"]  # nothing else is left
    assert json.loads((tmp_path / "head" / "head.ipynb").read_text())["nbformat"] == 4


@pytest.mark.one_python
def test_drives_get_the_limits_of_a_file_without_transmissions(tmp_path: Path) -> None:
    """The commanded torques and the machine's guards take them from the project's robot.py."""
    text = re.sub(r"<transmission.*?</transmission>", "", SMALL_ARM.read_text(), flags=re.DOTALL)
    stated = {"turn": 40.0, "shoulder": 60.0, "elbow": 20.0}
    (tmp_path / "bare_arm.urdf").write_text(text)
    result = run("new", "arm", "--urdf", "bare_arm.urdf", cwd=tmp_path)
    assert result.exit_code == 0 and "assumed" not in result.stderr
    module = runpy.run_path(str(tmp_path / "arm" / "arm" / "robot.py"), run_name="robot")
    plant = MultibodyPlant(0.001)
    module["add_robot"](plant)
    plant.Finalize()
    drives = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    assert {drive.joint().name(): drive.effort_limit() for drive in drives} == stated
    assert module["limits"]("effort").tolist() == list(stated.values())


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
