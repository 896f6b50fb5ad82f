"""A study of the cart-pole, for the tests of its page."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

from vtbdrake.optimization import Parameter, Problem
from vtbdrake.optimization.records import DrivenTrial
from vtbdrake.rollout import Constraint, Quality
from vtbdrake.rollout.named_function import magnitude
from vtbdrake.web.live.simulation_session import SimulationSession
from vtbdrake_diagrams.cart_pole import CartPoleScenario

ROOT = Path(__file__).resolve().parents[3]
ANGLE = "sim.sys.cart_pole.pole_pin.position"
RATE = "sim.sys.cart_pole.pole_pin.velocity"
PLACE = "sim.sys.cart_pole.cart_slider.position"
FORCE = "T_act.force.idle"
HORIZON = 1.0


def cart_pole_problem(**more: Any) -> Problem:
    """From which angle and with which speed of the pole does the cart get farthest?"""
    settings: dict[str, Any] = {
        "scenario": CartPoleScenario(),
        "parameters": [Parameter(ANGLE, 0.5, 3.0), Parameter(RATE, -3.0, 3.0)],
        "quality": Quality(magnitude, PLACE, unit="m"),
        "constraints": [Constraint(magnitude, RATE, at_most=8.0)],
        "horizon": HORIZON,
    }
    return Problem(**{**settings, **more})


def drive_cart(path: Path) -> DrivenTrial:
    """Push the cart by hand for a quarter of a second, and store that in the study."""
    problem = cart_pole_problem()
    with SimulationSession(problem.scenario, problem=problem) as session:
        session.write({ANGLE: 1.5, RATE: 0.5})
        session.drive([FORCE])
        session.deflect({FORCE: 1.0})
        session.advance(32)
        session.end_drive()
        return session.store_trial(path, by="Ada")


def run_elsewhere(path: Path, *, rollouts: int, solver: str = "CMA-ES") -> subprocess.Popen[bytes]:
    """Begin the study, or go on with it, in a process of its own; return when its file is there and taken."""
    code = f"""
from pathlib import Path
from tests.web.study.studies import cart_pole_problem
with cart_pole_problem().study({str(path)!r}, solver={solver!r}) as study:
    study.run(rollouts={rollouts}, executor="serial", progress=False)
"""
    runner = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT)
    while not path.exists() or not path.with_name(f"{path.name}-lock").exists():
        assert runner.poll() is None
    return runner
