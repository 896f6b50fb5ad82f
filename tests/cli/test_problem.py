"""``vtbdrake sweep`` and ``boundary`` show what the library computes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.cli.program import ACROBOT, ANGLE, DAMPING, PENDULUM, RATE, run
from tests.testbeds import PendulumScenario
from vtbdrake import Parameter, Problem, Quality
from vtbdrake.optimization import Sweep
from vtbdrake.rollout.named_function import largest, magnitude, smallest


def stated(**more: Any) -> Problem:
    """Return the problem that the command lines below state."""
    parameters, quality = [Parameter(ANGLE, 0.0, 3.0)], Quality(magnitude, of=RATE)
    return Problem(
        scenario=PendulumScenario(), parameters=parameters, quality=quality, horizon=2.0, threshold=4.0, **more
    )


def test_sweep_prints_and_saves_what_the_library_computes(tmp_path: Path) -> None:
    expected = stated().sweep(4, progress=False)

    vary = ("--vary", f"{ANGLE}=0:3:4", "--quality", RATE, "--threshold", 4, "--horizon", 2)
    files = [tmp_path / name for name in ("s.csv", "s.sweep", "s.png")]
    program = run("sweep", PENDULUM, *vary, "--csv", files[0], "--save", files[1], "--plot", files[2])

    assert (program.exit_code, program.stderr) == (0, "")
    lines = program.stdout.splitlines()
    assert [line.split() for line in lines[2:6]] == [
        [f"{p:.6g}", f"{r.h:.6g}", f"{r.t_star:.6g}", r.end]
        for p, r in zip(expected.points[:, 0], expected.rollouts, strict=True)
    ]
    point, h = expected.best.parameters, expected.best.value
    assert lines[-2:] == [
        f"best: h = {h:.6g} at {ANGLE} = {point[ANGLE]:.6g} rad (the upper end of its range)",
        f"boundary: {expected.boundary()}",
    ]
    np.testing.assert_array_equal(Sweep.load(files[1]).h, expected.h)
    assert files[0].read_text().splitlines()[0] == f"{ANGLE},condition,h,t_star,end,message,wall_time"
    assert files[2].read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
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


@pytest.mark.slow
def test_boundary_for_all_and_for_each_condition() -> None:
    problem = stated(conditions=[{DAMPING: 0.1}, {DAMPING: 0.5}])
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


def test_qualities_of_an_array_are_those_of_an_entry():
    for value in (np.array([2.0, -3.0, 1.0]), np.array([[2.0, -3.0], [1.0, 0.0]])):
        assert [f(value) for f in (magnitude, largest, smallest)] == [3.0, 2.0, -3.0]
    assert [f(-0.5) for f in (magnitude, largest, smallest)] == [0.5, -0.5, -0.5]
