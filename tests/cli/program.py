"""The program, run in the process of the tests."""

import contextlib
import sys
from pathlib import Path

from click.testing import CliRunner, Result

from vtbdrake.cli import main

ROOT = Path(__file__).resolve().parents[2]

PENDULUM = "tests.testbeds:PendulumScenario"
ACROBOT = "tests.testbeds:AcrobotScenario"
ANGLE = "sim.sys.Pendulum.theta.position"
RATE = "sim.sys.Pendulum.theta.velocity"
DAMPING = "sim.sys.Pendulum.theta.damping"


def run(*arguments: object, cwd: Path = ROOT) -> Result:
    """Run ``vtbdrake`` in the folder ``cwd``."""
    path = sys.path[:]
    with contextlib.chdir(cwd):
        try:
            return CliRunner().invoke(main, [str(argument) for argument in arguments], prog_name="vtbdrake")
        finally:
            sys.path[:] = path  # The program adds the current directory.


def error_of(*arguments: object, code: int = 2, cwd: Path = ROOT) -> str:
    """Run ``vtbdrake`` with bad input, and return the one line that it prints."""
    result = run(*arguments, cwd=cwd)
    assert result.exit_code == code, result.output
    assert result.stderr.startswith("Error: ") and result.stderr.count("\n") == 1
    return result.stderr
