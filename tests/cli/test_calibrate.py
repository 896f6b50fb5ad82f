"""``vtbdrake calibrate`` fits what the library fits, and says what is not accepted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.calibration.pendulum import COULOMB, DRIVES, MASS, PendulumScenario, recorded
from tests.cli.program import error_of, run
from vtbdrake import Parameter, load_scenario
from vtbdrake.calibration import calibrate
from vtbdrake_diagrams.manipulator.arm import Arm

VISCOUS = f"{DRIVES}.viscous[0]"
SCENARIO = "tests.calibration.pendulum:PendulumScenario"
SIGNALS = ("--position", "position", "--torque", "torque")
COLUMNS = ("--position-columns", "q", "--torque-columns", "u")
VARY = ("--vary", f"{MASS}=0.3:3", "--vary", f"{COULOMB}=0:1")


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    log = recorded({MASS: 1.4, COULOMB: 0.2}, 0)
    q, u = log.sense["position"], log.act["torque"]
    path = tmp_path_factory.mktemp("logs") / "swing.npz"
    np.savez(path, time=q.times, q=q.values[:, 0], u=u.values[:, 0])
    return path


@pytest.mark.slow
def test_numbers_are_those_of_the_library(table: Path, tmp_path: Path) -> None:
    saved = tmp_path / "pendulum.yaml"
    program = run("calibrate", SCENARIO, table, *SIGNALS, *COLUMNS, *VARY, "--save", saved, "--json")
    assert (program.exit_code, program.stderr) == (0, "")
    parameters = [Parameter(MASS, 0.3, 3.0), Parameter(COULOMB, 0.0, 1.0)]
    expected = calibrate(
        PendulumScenario(), recorded({MASS: 1.4, COULOMB: 0.2}, 0), parameters, position="position", torque="torque"
    )
    printed = {each["address"]: each for each in json.loads(program.stdout)["parameters"]}
    for address, truth in ((MASS, 1.4), (COULOMB, 0.2)):
        assert printed[address]["value"] == pytest.approx(expected.parameters[address].value, rel=1e-9)
        assert printed[address]["value"] == pytest.approx(truth, rel=0.02)
        assert printed[address]["verdict"] == "accepted"
    assert load_scenario(f"{SCENARIO}@{saved}").pedigree.numbers[MASS].source == "calibrated"


@pytest.mark.slow
def test_friction_of_all_drives_is_one_option(table: Path) -> None:
    program = run(
        "calibrate", SCENARIO, table, *SIGNALS, *COLUMNS, "--vary", f"{MASS}=0.3:3", "--vary", "drives", "--json"
    )
    printed = {each["address"]: each["value"] for each in json.loads(program.stdout)["parameters"]}
    assert printed == pytest.approx({MASS: 1.4, COULOMB: 0.2, VISCOUS: 0.01}, rel=0.05)


def test_what_is_not_accepted_is_told_by_the_exit_code(table: Path) -> None:
    program = run("calibrate", SCENARIO, table, *SIGNALS, *COLUMNS, "--vary", f"{MASS}=0.3:1.1")
    assert program.exit_code == 1
    assert "at a bound" in program.stdout
    assert program.stderr == f"Error: not accepted: {MASS}\n"


def test_bad_input_is_one_line(table: Path, tmp_path: Path) -> None:
    fit = ("calibrate", SCENARIO, table, *SIGNALS)
    assert "name its columns by --position-columns" in error_of(*fit, *VARY)
    assert "no column 'w'" in error_of(*fit, "--position-columns", "w", "--torque-columns", "u", *VARY)
    assert "LOGS or --self-test" in error_of("calibrate", SCENARIO, *SIGNALS, *VARY)
    assert "LOGS or --self-test" in error_of(*fit, *VARY, "--self-test")
    assert "expected NAME=UNIT" in error_of(*fit, *COLUMNS, *VARY, "--unit", "position")
    assert "--set is for the DPS" in error_of(*fit, *COLUMNS, *VARY, "--set", "dps.impl.value=0")
    assert error_of(*fit, *COLUMNS)  # Nothing is varied.


@pytest.mark.slow
@pytest.mark.one_python
def test_self_test_prints_errors_and_coverage() -> None:
    knots = np.tile(Arm().home, (11, 1))
    knots[3:-3] += 0.15 * np.array([[1.0], [-1.0], [0.5], [1.0], [-1.0]])
    program = run(
        *("calibrate", "vtbdrake_diagrams.manipulator.studies.excited:ExcitedArmScenario", "--self-test", "--json"),
        *("--field", "knots=11", "--field", "duration=1.0", "--set", f"u.plan={[0.001, *knots.ravel().tolist()]}"),
        *("--position", "joint_position", "--torque", "joint_torque", "--vary", "sim.sys.arm.tool.mass=0.2:1.5"),
        *("--trials", 2, "--seconds", 1.5, "--disturbance", 0.02, "--seed", 3),
    )
    assert program.exit_code == 0, program.stderr
    result = json.loads(program.stdout)
    (mass,) = result["parameters"]
    assert result["trials"] == 2 and len(set(mass["truths"])) == 2
    assert np.abs(mass["errors"]).max() < 0.02 and mass["intervals"] <= 2
