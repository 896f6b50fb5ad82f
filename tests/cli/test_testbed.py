"""``vtbdrake variables``, ``diagram`` and ``rollout`` show what the library computes."""

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from jsonschema import Draft202012Validator

from tests.cli.program import ACROBOT, ANGLE, PENDULUM, run
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake import Snapshot
from vtbdrake.rollout import RolloutRunner, RolloutTask
from vtbdrake.testbed import ScenarioError, load_scenario
from vtbdrake_diagrams.satellite import SatelliteScenario

SATELLITE = "vtbdrake_diagrams.satellite:SatelliteScenario"


def test_variables_are_those_of_the_testbed() -> None:
    testbed = PendulumScenario().build()
    expected = testbed.variables().table(testbed.default_context(), pattern="theta")
    assert run("variables", PENDULUM, "--match", "theta").stdout == expected + "\n"


@pytest.mark.parametrize(
    ("changes", "is_valid"),
    [
        ({}, True),
        ({"tumble_deg": 30.0, "image_width": 1, "perception": "camera", "scanner": {"rows": 16}}, True),
        ({"tumble_deg": 30.1}, False),
        ({"distance": "far"}, False),
        ({"image_width": 0}, False),
        ({"perception": "sonar"}, False),
        ({"wheels": 1}, False),
        ({"tumble": 1.0}, False),
        ({"camera_errors": {"dropout": 1.5}}, False),
        ({"light": {"color": [1.0, 1.0, 2.0]}}, False),
        ({"scanner": {"divergence": 0.5}}, False),
    ],
)
def test_schema_accepts_the_files_that_load(tmp_path: Path, changes: dict[str, Any], is_valid: bool) -> None:
    """The schema is judged by the reference implementation of JSON Schema, beside the loader of scenario files."""
    described = json.loads(run("variables", SATELLITE, "--schema").stdout)
    Draft202012Validator.check_schema(described)
    assert Draft202012Validator(described).is_valid(changes) == is_valid
    file = tmp_path / "scenario.yaml"
    file.write_text(yaml.safe_dump({SATELLITE: changes}))
    with nullcontext() if is_valid else pytest.raises(ScenarioError):
        load_scenario(f"{SATELLITE}@{file}")


def test_schema_has_units_and_defaults() -> None:
    fields = json.loads(run("variables", SATELLITE, "--schema").stdout)["properties"]
    assert {key: fields["tumble_deg"][key] for key in ("type", "unit", "minimum", "maximum", "default")} == {
        "type": "number",
        "unit": "deg/s",
        "minimum": 0.0,
        "maximum": 30.0,
        "default": SatelliteScenario().tumble_deg,
    }
    assert fields["scanner"]["properties"]["frequency"]["unit"] == "Hz"
    assert fields["scanner"]["properties"]["frequency"]["default"] == SatelliteScenario().scanner.frequency


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

    assert (program.exit_code, program.stderr) == (0, "")
    assert "end               horizon" in program.stdout
    angles = result.record[ANGLE]
    row = next(line for line in program.stdout.splitlines() if line.startswith(ANGLE))
    assert row.split() == [ANGLE, "rad", f"{angles[-1]:.6g}", f"{angles.min():.6g}", f"{angles.max():.6g}"]
    assert (tmp_path / "a.csv").read_text().splitlines()[0] == f"t,{ANGLE},plant.state[0],plant.state[1]"
    saved = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(saved[:, 0], result.times)
    np.testing.assert_array_equal(saved[:, 1], angles)
    np.testing.assert_array_equal(saved[:, 2:], result.record["plant.state"])


def test_fields_may_be_given_one_by_one(tmp_path: Path) -> None:
    PendulumScenario(stiffness=2.0).save(tmp_path / "stiff.yaml")
    options = ("--horizon", 0.2, "--set", f"{ANGLE}=0.5", "--record", ANGLE)
    run("rollout", f"{PENDULUM}@{tmp_path}/stiff.yaml", *options, "--save", tmp_path / "a.csv")
    run("rollout", PENDULUM, "--field", "stiffness=2", *options, "--save", tmp_path / "b.csv")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_recording_as_numpy_archive(tmp_path: Path) -> None:
    program = run("rollout", ACROBOT, "--horizon", 0.2, "--record", "plant.state", "--save", tmp_path / "a.npz")
    assert program.exit_code == 0
    saved = np.load(tmp_path / "a.npz", allow_pickle=False)
    assert saved["plant.state"].shape == (saved["t"].size, 4) == (5, 4)


def test_a_rollout_continues_from_the_snapshot_of_another(tmp_path: Path) -> None:
    push = ("--set", "sim.sys.Acrobot.elbow.position=0.3")
    assert run("rollout", ACROBOT, "--horizon", 0.5, *push, "--snapshot", tmp_path / "half").exit_code == 0
    start = ("--start", tmp_path / "half", "--snapshot", tmp_path / "whole")
    assert run("rollout", ACROBOT, "--horizon", 0.5, *start).exit_code == 0

    half, whole = Snapshot.load(tmp_path / "half"), Snapshot.load(tmp_path / "whole")
    runner = RolloutRunner(RolloutTask(AcrobotScenario(), 0.5, start=half))
    runner.run({})
    assert not whole.compare(runner.testbed.snapshot(runner.context))
    assert (half.time, whole.time) == (0.5, 1.0)
    assert half.compare(whole)


def test_failed_rollout_has_exit_code_1_and_its_reason() -> None:
    program = run("rollout", ACROBOT, "--horizon", 1, "--set", "sim.sys.Acrobot.lower_link.mass=0")
    assert program.exit_code == 1
    assert "end               failed" in program.stdout
    assert program.stderr.startswith("Error: the rollout failed: RuntimeError: An internal mass matrix")
    assert program.stderr.count("\n") == 1


def test_diagram_shows_the_signals(tmp_path: Path) -> None:
    program = run("diagram", ACROBOT, "--mode", "shadow")
    assert (program.exit_code, program.stderr) == (0, "")
    assert "joint_state" in program.stdout
    assert run("diagram", ACROBOT, "--mode", "shadow", "-o", tmp_path / "d.svg").stdout == ""
    assert (tmp_path / "d.svg").read_text() == program.stdout.removesuffix("\n")


def test_animation_is_one_html_file(tmp_path: Path) -> None:
    program = run("rollout", PENDULUM, "--horizon", 0.2, "--set", f"{ANGLE}=1", "--html", tmp_path / "a.html")
    assert (program.exit_code, program.stderr) == (0, "")
    assert "plant.state" not in program.stdout
    text = (tmp_path / "a.html").read_text()
    assert "</html>" in text
    assert "http://localhost" not in text
