"""The program as its users run it."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

PENDULUM = "tests.testbeds:PendulumScenario"
ACROBOT = "tests.testbeds:AcrobotScenario"
ANGLE = "sim.sys.Pendulum.theta.position"
RATE = "sim.sys.Pendulum.theta.velocity"
DAMPING = "sim.sys.Pendulum.theta.damping"


def run(*arguments: object, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Runs ``vtbdrake`` in a process of its own."""
    command = [sys.executable, "-m", "vtbdrake.cli", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=120)
