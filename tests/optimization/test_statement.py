"""Problems that are stated again from the file of their study."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.optimization.studies import DAMPING, RATE, THETA, gap, pendulum_problem
from vtbdrake.optimization import Choice, CVaR, Parameter, Problem, Study
from vtbdrake.optimization.identity import code_changes, describe, differences
from vtbdrake.optimization.statement import StatementError, restated
from vtbdrake.rollout import Constraint, Quality
from vtbdrake.rollout.named_function import largest, magnitude
from vtbdrake_diagrams.cart_pole import CartPoleScenario

ROOT = Path(__file__).resolve().parents[2]
MORE: dict[str, Any] = {
    "parameters": [Parameter(THETA, 0.1, 1.5, log=True), Choice("scenario.stiffness", [0.0, 2.0])],
    "quality": [Quality(gap, THETA, minimize=True, reading="end"), Quality(magnitude, RATE, upper=9.0)],
    "conditions": [{DAMPING: 0.0}, {DAMPING: 0.1}],
    "constraints": [Constraint(largest, THETA, at_most=2.0)],
    "risk": CVaR(0.5),
}


@pytest.mark.parametrize("more", [{}, MORE, {"threshold": 0.2, "quality": Quality(gap, THETA)}])
def test_restated_problem_is_the_same(tmp_path: Path, more: dict[str, Any]) -> None:
    stated = pendulum_problem(**more)
    stated.study(tmp_path / "study.db").close()
    with Study.open(tmp_path / "study.db") as opened:
        again = restated(opened.record)
    assert differences(describe(stated), describe(again)) == [] == code_changes(describe(stated), describe(again))
    point = [parameter.ends[0] for parameter in stated.parameters]
    assert again.rollout(point).identical(stated.rollout(point))


def local() -> Problem:
    return pendulum_problem(quality=Quality(lambda theta: abs(theta), THETA))


def from_snapshot() -> Problem:
    testbed = pendulum_problem().testbed
    return pendulum_problem(start=testbed.snapshot(testbed.default_context()))


@pytest.mark.one_python
@pytest.mark.parametrize(
    ("make", "message"), [(local, "the function f is one of a script"), (from_snapshot, "begin from a snapshot")]
)
def test_what_no_file_holds_is_told(make: Any, message: str) -> None:
    with pytest.raises(StatementError, match=message):
        restated(make().study().record)


@pytest.mark.one_python
def test_file_of_an_earlier_version_is_told() -> None:
    record = pendulum_problem().study().record
    del record["statement"]
    with pytest.raises(StatementError, match="earlier vtbdrake"):
        restated(record)


@pytest.mark.one_python
def test_module_of_a_file_is_imported_only_if_it_is_trusted(tmp_path: Path) -> None:
    pendulum_problem().study(tmp_path / "study.db").close()
    code = """
import sys
from vtbdrake.optimization import Study
from vtbdrake.optimization.statement import StatementError, restated
record = Study.open(sys.argv[1]).record
try:
    restated(record)
except StatementError as error:
    print(error)
assert not any(name.startswith("tests") for name in sys.modules)
print(restated(record, trusted=["tests"]))
"""
    call = [sys.executable, "-c", code, str(tmp_path / "study.db")]
    output = subprocess.run(call, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert "the file names tests.testbeds:PendulumScenario, and importing its module runs its code" in output
    assert "Problem(PendulumScenario: gap" in output


def test_scenario_of_the_package_needs_no_trust(tmp_path: Path) -> None:
    angle = "sim.sys.cart_pole.pole_pin.position"
    stated = Problem(
        scenario=CartPoleScenario(),
        parameters=[Parameter(angle, 2.0, 3.0)],
        quality=Quality(magnitude, angle),
        horizon=0.1,
    )
    again = restated(stated.study(tmp_path / "study.db").record)
    assert again.scenario == stated.scenario


@pytest.mark.one_python
def test_scenario_that_cannot_be_built_any_more_is_told() -> None:
    record = pendulum_problem().study().record
    record["problem"] = {**record["problem"], "horizon": -1.0}
    with pytest.raises(StatementError, match="cannot be stated with today's code: .*horizon"):
        restated(record)
