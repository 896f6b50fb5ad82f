"""The main paths of the program, each as a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.cli.program import ACROBOT, ANGLE, DAMPING, PENDULUM, RATE, ROOT, run
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake import Parameter, Problem, Quality, Snapshot, Sweep
from vtbdrake.cli.quality import magnitude
from vtbdrake.rollout import RolloutRunner, RolloutTask


def test_variables_are_those_of_the_testbed() -> None:
    testbed = PendulumScenario().build()
    expected = testbed.variables().table(testbed.default_context(), pattern="theta")
    assert run("variables", PENDULUM, "--match", "theta").stdout == expected + "\n"


def test_variables_as_json() -> None:
    listed = {v["address"]: v for v in json.loads(run("variables", ACROBOT, "--json").stdout)}
    assert list(listed) == list(AcrobotScenario().build().variables())
    assert listed["dps.gain"] == {
        "address": "dps.gain",
        "kind": "a",
        "derived": False,
        "shape": [4],
        "unit": "N m/rad, N m s/rad",
        "bounds": [-1000.0, 1000.0],
        "value": [0.0, 0.0, -3.0, -1.0],
    }
    assert listed["sim.sys.Acrobot.elbow.damping"]["bounds"] == [0.0, None]


def test_rollout_from_a_file_prints_and_saves_what_the_library_computes(tmp_path: Path) -> None:
    scenario = PendulumScenario(stiffness=2.0)
    scenario.save(tmp_path / "stiff.yaml")
    result = RolloutRunner(RolloutTask(scenario, 1.0, record=(ANGLE, "plant.state"))).run({ANGLE: 0.5})

    command = ["--horizon", 1, "--set", f"{ANGLE}=0.5", "--record", ANGLE, "--record", "plant.state"]
    program = run("rollout", f"{PENDULUM}@{tmp_path}/stiff.yaml", *command, "--save", tmp_path / "a.csv")

    assert (program.returncode, program.stderr) == (0, "")
    assert "end               horizon" in program.stdout
    angles = result.record[ANGLE]
    row = next(line for line in program.stdout.splitlines() if line.startswith(ANGLE))
    assert row.split() == [ANGLE, "rad", f"{angles[-1]:.6g}", f"{angles.min():.6g}", f"{angles.max():.6g}"]
    assert (tmp_path / "a.csv").read_text().splitlines()[0] == f"t,{ANGLE},plant.state[0],plant.state[1]"
    saved = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(saved[:, 0], result.times)
    np.testing.assert_array_equal(saved[:, 1], angles)
    np.testing.assert_array_equal(saved[:, 2:], result.record["plant.state"])


def test_recording_as_numpy_archive(tmp_path: Path) -> None:
    program = run("rollout", ACROBOT, "--horizon", 0.2, "--record", "plant.state", "--save", tmp_path / "a.npz")
    assert program.returncode == 0
    saved = np.load(tmp_path / "a.npz", allow_pickle=False)
    assert saved["plant.state"].shape == (saved["t"].size, 4) == (5, 4)


def test_a_rollout_continues_from_the_snapshot_of_another(tmp_path: Path) -> None:
    push = ("--set", "sim.sys.Acrobot.elbow.position=0.3")
    assert run("rollout", ACROBOT, "--horizon", 0.5, *push, "--snapshot", tmp_path / "half").returncode == 0
    start = ("--start", tmp_path / "half", "--snapshot", tmp_path / "whole")
    assert run("rollout", ACROBOT, "--horizon", 0.5, *start).returncode == 0

    half, whole = Snapshot.load(tmp_path / "half"), Snapshot.load(tmp_path / "whole")
    runner = RolloutRunner(RolloutTask(AcrobotScenario(), 0.5, start=half))
    runner.run({})
    assert not whole.compare(runner.testbed.snapshot(runner.context))
    assert (half.time, whole.time) == (0.5, 1.0)
    assert half.compare(whole)


def test_failed_rollout_has_exit_code_1_and_its_reason() -> None:
    program = run("rollout", ACROBOT, "--horizon", 1, "--set", "sim.sys.Acrobot.lower_link.mass=0")
    assert program.returncode == 1
    assert "end               failed" in program.stdout
    assert program.stderr.startswith("Error: the rollout failed: RuntimeError: An internal mass matrix")
    assert program.stderr.count("\n") == 1


def test_sweep_prints_and_saves_what_the_library_computes(tmp_path: Path) -> None:
    problem = Problem(
        scenario=PendulumScenario(),
        parameters=[Parameter(ANGLE, 0.0, 3.0)],
        quality=Quality(magnitude, of=RATE),
        horizon=2.0,
        threshold=4.0,
    )
    expected = problem.sweep(4, progress=False)

    vary = ("--vary", f"{ANGLE}=0:3:4", "--quality", RATE, "--threshold", 4, "--horizon", 2)
    files = [tmp_path / name for name in ("s.csv", "s.sweep", "s.png")]
    program = run("sweep", PENDULUM, *vary, "--csv", files[0], "--save", files[1], "--plot", files[2])

    assert (program.returncode, program.stderr) == (0, "")
    lines = program.stdout.splitlines()
    assert [line.split() for line in lines[2:6]] == [
        [f"{p:.6g}", f"{r.h:.6g}", f"{r.t_star:.6g}", r.end]
        for p, r in zip(expected.points[:, 0], expected.rollouts, strict=True)
    ]
    (point, h) = expected.best()
    assert lines[-2:] == [f"best: h = {h:.6g} at {ANGLE} = {point[ANGLE]:.6g}", f"boundary: {expected.boundary()}"]
    np.testing.assert_array_equal(Sweep.load(files[1]).h, expected.h)
    assert files[0].read_text().splitlines()[0] == f"{ANGLE},condition,h,t_star,end,message,wall_time"
    assert files[2].read_bytes().startswith(b"\x89PNG")


def test_sweep_with_a_python_quality_in_processes() -> None:
    vary = ("--vary", "sim.sys.Acrobot.elbow.position=0.1:0.3:2", "--horizon", 0.2)
    quality = ("--quality", "math:hypot", "--of", "dps.torque", "--of", "sim.sys.Acrobot.elbow.velocity")
    rows = [
        run("sweep", ACROBOT, *vary, *quality, "--executor", executor).stdout.splitlines()[2:4]
        for executor in ("serial", "processes")
    ]
    assert len(rows[0]) == 2
    assert rows[0] == rows[1]


def test_sweep_over_two_parameters_has_a_row_per_pair_and_condition() -> None:
    vary = ("--vary", f"{ANGLE}=0:1:2", "--vary", f"{RATE}=0:1:3", "--quality", ANGLE, "--horizon", 0.1)
    conditions = ("--condition", f"{DAMPING}=0.1", "--condition", f"{DAMPING}=0.5")
    program = run("sweep", PENDULUM, *vary, *conditions)
    lines = program.stdout.splitlines()
    assert lines[0].split() == [ANGLE, "[rad]", RATE, "[rad/s]", "condition", "h", "t*", "[s]", "end"]
    assert len(lines[2 : lines.index("")]) == 12
    assert f"condition 1 ({DAMPING} = 0.5)" in lines


def test_boundary_for_all_and_for_each_condition() -> None:
    problem = Problem(
        scenario=PendulumScenario(),
        parameters=[Parameter(ANGLE, 0.0, 3.0)],
        quality=Quality(magnitude, of=RATE),
        horizon=2.0,
        threshold=4.0,
        conditions=[{DAMPING: 0.1}, {DAMPING: 0.5}],
    )
    expected = problem.boundary(resolution=0.1, coarse=0.5, repeats=2, progress=False)
    assert expected.lower < expected.by_condition[1, 0]

    vary = ("--vary", f"{ANGLE}=0:3", "--quality", RATE, "--threshold", 4, "--horizon", 2)
    conditions = ("--condition", f"{DAMPING}=0.1", "--condition", f"{DAMPING}=0.5")
    steps = ("--resolution", 0.1, "--coarse", 0.5, "--repeats", 2)
    program = run("boundary", PENDULUM, *vary, *conditions, *steps)

    lines = program.stdout.splitlines()
    assert lines[0] == str(expected)
    safe, unsafe = expected.worst_chances
    assert lines[3:5] == [
        f"  {safe.value:.6g} rad: unsafe in 0 of 3 rollouts (a chance of 0% to 71%) under condition 0",
        f"  {unsafe.value:.6g} rad: unsafe in 3 of 3 rollouts (a chance of 29% to 100%) under condition 0",
    ]
    lower, upper = expected.by_condition[1]
    assert lines[2] == f"  condition 1 ({DAMPING} = 0.5): safe up to {lower:.6g} rad, not at {upper:.6g} rad"


def test_diagram_shows_the_signals(tmp_path: Path) -> None:
    program = run("diagram", ACROBOT, "--mode", "shadow")
    assert (program.returncode, program.stderr) == (0, "")
    assert "joint_state" in program.stdout
    assert run("diagram", ACROBOT, "--mode", "shadow", "-o", tmp_path / "d").stdout == ""
    assert (tmp_path / "d").read_text() == program.stdout.removesuffix("\n")


def test_animation_is_one_html_file(tmp_path: Path) -> None:
    program = run("rollout", PENDULUM, "--horizon", 0.2, "--set", f"{ANGLE}=1", "--html", tmp_path / "a.html")
    assert (program.returncode, program.stderr) == (0, "")
    assert "plant.state" not in program.stdout
    text = (tmp_path / "a.html").read_text()
    assert "</html>" in text
    assert "http://localhost" not in text


def test_version_is_one_line() -> None:
    program = run("--version")
    assert (program.returncode, program.stderr) == (0, "")
    assert program.stdout.startswith("vtbdrake")


@pytest.mark.parametrize("command", ["variables", "rollout", "sweep", "boundary", "diagram"])
def test_help_shows_an_example(command: str) -> None:
    assert f"Example:\n    vtbdrake {command} " in run(command, "--help").stdout


def test_scenarios_are_found_from_the_current_directory(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("from tests.testbeds import PendulumScenario as Mine\n")
    program = f"import sys; sys.path.remove({str(tmp_path)!r}) if {str(tmp_path)!r} in sys.path else None; "
    program += "sys.path.remove('') if '' in sys.path else None; from vtbdrake.cli import main; main()"
    result = subprocess.run(
        [sys.executable, "-c", program, "variables", "mine:Mine", "--match", "theta.damping"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert DAMPING in result.stdout, result.stderr


def test_a_module_of_the_current_directory_does_not_take_the_place_of_another(tmp_path: Path) -> None:
    (tmp_path / "wave.py").write_text("print('has run')\nfrom tests.testbeds import PendulumScenario as Mine\n")
    for command in (["-m", "vtbdrake.cli"], ["-P", "-c", "from vtbdrake.cli import main; main()"]):
        result = subprocess.run(
            [sys.executable, *command, "variables", "wave:Mine"],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
        )
        assert (result.returncode, result.stdout) == (2, "")
        assert "wave has no scenario 'Mine'" in result.stderr
