"""Tests of courses that are saved as tests: pytest runs them, and they notice a changed model."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.testbeds import PendulumScenario
from vtbdrake.rollout import Quality, RolloutTask
from vtbdrake.rollout.course import Course, DrivenRollout, task_without_problem
from vtbdrake.state import Snapshot
from vtbdrake.testbed.scenario_text import scenario_text
from vtbdrake.testing.saved_course import SavedCourseError, drive_again, save_course
from vtbdrake_diagrams.cube_toss import CubeTossScenario

pytestmark = pytest.mark.one_python

ROOT = Path(__file__).resolve().parents[2]
MODEL = '''
"""A pendulum with friction in its joint, held by a spring."""

from dataclasses import dataclass

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlantConfig

from tests.testbeds import PENDULUM, PendulumScenario


def tilt(angle: float) -> float:
    return abs(angle)


@dataclass
class Swinging(PendulumScenario):
    stiffness: float = 20.0
    damping: float = 2.0

    def add_world(self, builder) -> None:
        plant, _ = builder.add_plant(MultibodyPlantConfig(time_step=0.0))
        Parser(plant).AddModelsFromUrl(PENDULUM)
        plant.GetJointByName("theta").set_default_damping(0.1)
        plant.Finalize()
        builder.sim_sensor("joint_state", plant.get_state_output_port())
        builder.sim_actuator("torque", plant.get_actuation_input_port())
'''
ANGLE, MASS = "sim.sys.Pendulum.theta.position", "sim.sys.Pendulum.arm_com.mass"
POSITION, VELOCITY = "sim.sys.cube.position", "sim.sys.cube.velocity"
STEP = 0.03125


@pytest.fixture
def model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    (tmp_path / "swinging.py").write_text(MODEL)
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("swinging")
    del sys.modules["swinging"]


def course(model: Any) -> Course:
    """A course of a second, with another mass from before its beginning on, and two commands in it."""
    testbed = model.Swinging().build()
    context = testbed.default_context()
    testbed.write(context, {MASS: 0.7, ANGLE: 0.2})
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(0.5)
    return Course(testbed.fork(simulator), STEP, ((0, {"u.angle": 0.4}), (9, {"u.angle": -0.1})), 32)


def task(model: Any) -> RolloutTask:
    return RolloutTask(model.Swinging(), horizon=1.0, quality=Quality(model.tilt, of=ANGLE), sample_period=0.1)


def run(folder: Path) -> subprocess.CompletedProcess[str]:
    arguments = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", folder, folder]
    environment = {"PYTHONPATH": f"{folder}:{ROOT}", "PATH": "/usr/bin:/bin", "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.slow
def test_saved_tests_pass_and_notice_a_changed_model(model: Any, tmp_path: Path) -> None:
    testbed = model.Swinging().build()
    save_course(tmp_path / "test_tilt.py", course(model), testbed, task=task(model))
    save_course(tmp_path / "test_state.py", course(model), testbed)
    files = ["swinging.py", "test_state.py", "test_state.vtb", "test_tilt.py", "test_tilt.vtb"]
    assert sorted(file.name for file in tmp_path.glob("*.*")) == files
    code = (tmp_path / "test_tilt.py").read_text()
    assert "TOLERANCE = 1e-06" in code and MASS in code and ".damping" not in code
    untouched = run(tmp_path)
    assert untouched.returncode == 0 and "2 passed" in untouched.stdout, untouched.stdout
    # The friction is a parameter, which the snapshot holds, too.
    (tmp_path / "swinging.py").write_text(MODEL.replace("set_default_damping(0.1)", "set_default_damping(0.11)"))
    changed = run(tmp_path)
    assert changed.returncode == 1 and "2 failed" in changed.stdout, changed.stdout
    assert changed.stdout.count("comparison failed") == 2, changed.stdout


def test_friction_of_a_geometry_is_that_of_today_too(tmp_path: Path) -> None:
    def start(scenario: CubeTossScenario) -> Snapshot:
        testbed = scenario.build()
        context = testbed.default_context()
        height = 0.5 * scenario.edge
        testbed.write(
            context, {POSITION: [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, height], VELOCITY: [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]}
        )
        return testbed.snapshot(context)

    def place(driven: DrivenRollout) -> float:
        return float(driven.read([POSITION])[POSITION][4])

    once, today = CubeTossScenario(friction=0.1), CubeTossScenario(friction=0.4)
    # As if the friction stood in the code of the scenario.
    saved = start(once)
    Snapshot(saved.time, saved.values, saved.groups, today.record()).save(tmp_path / "start.vtb")
    driven = drive_again(
        today.name(), scenario_text(today), start=tmp_path / "start.vtb", step=STEP, parameters={}, writes=(), steps=8
    )
    expected, other = (place(Course(start(s), STEP, (), 8).driven(task_without_problem(s))) for s in (today, once))
    assert place(driven) == expected and other - expected > 0.05


def test_expected_quality_is_that_of_the_course(model: Any, tmp_path: Path) -> None:
    save_course(tmp_path / "test_tilt.py", course(model), model.Swinging().build(), task=task(model), tolerance=1e-3)
    result = course(model).rollout(task(model))
    code = (tmp_path / "test_tilt.py").read_text()
    assert f"result.value == pytest.approx({result.value!r}, rel=TOLERANCE" in code and "TOLERANCE = 0.001" in code


def test_what_cannot_be_a_test_is_refused(model: Any, tmp_path: Path) -> None:
    testbed, driven = model.Swinging().build(), course(model)
    for name in ("tilt.py", "test_tilt.txt", "test_Tilt.py", "test_a-b.py"):
        with pytest.raises(SavedCourseError, match=r"pytest finds a test in test_NAME.py"):
            save_course(tmp_path / name, driven, testbed)
    with pytest.raises(SavedCourseError, match="lies in a folder that does not exist"):
        save_course(tmp_path / "none" / "test_tilt.py", driven, testbed)
    with pytest.raises(SavedCourseError, match="the tolerance is a relative difference between 0 and 1, not 0"):
        save_course(tmp_path / "test_tilt.py", driven, testbed, tolerance=0.0)
    lambdas = RolloutTask(model.Swinging(), horizon=1.0, quality=Quality(lambda angle: abs(angle), of=ANGLE))
    with pytest.raises(SavedCourseError, match="is a function of a script, a notebook or a lambda"):
        save_course(tmp_path / "test_tilt.py", driven, testbed, task=lambdas)
    (tmp_path / "test_tilt.vtb").touch()
    with pytest.raises(SavedCourseError, match=r"test_tilt.vtb exists, and is not overwritten"):
        save_course(tmp_path / "test_tilt.py", driven, testbed)
    fails = Course(driven.start, STEP, ((0, {"sim.sys.Pendulum.theta.velocity": 1e200}),), 32)
    with pytest.raises(SavedCourseError, match="the course fails, so that no test can expect anything of it"):
        save_course(tmp_path / "test_fails.py", fails, testbed)
    with pytest.raises(ValueError, match="another scenario"):
        save_course(tmp_path / "test_other.py", driven, PendulumScenario().build())
    assert not list(tmp_path.glob("test_*.py"))
