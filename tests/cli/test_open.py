"""Tests of ``vtbdrake open``: which scenario a snapshot gets, what it looks like, and from where."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.cli.program import ACROBOT, PENDULUM, error_of, run
from tests.testbeds import PendulumScenario
from tests.visualization.meshcat_page import messages
from vtbdrake.state import Snapshot
from vtbdrake.testbed import Scenario, ScenarioError
from vtbdrake.testbed.scenario_file import scenario_of
from vtbdrake_diagrams.cart_pole import CartPoleScenario

ANGLE = "sim.sys.cart_pole.pole_pin.position"


def saved(scenario: Scenario, path: Path, *, angle: float = 0.0, camera: tuple[Any, Any] = (None, None)) -> Snapshot:
    testbed = scenario.build()
    context = testbed.default_context()
    if angle:
        testbed.write(context, {ANGLE: angle})
    notes = {key: place for key, place in zip(("camera.position", "camera.target"), camera, strict=True) if place}
    snapshot = replace(testbed.snapshot(context), notes=notes)
    snapshot.save(path)
    return snapshot


def test_picture_is_taken_from_the_noted_camera(tmp_path: Path) -> None:
    # The pole turns about -y, and its mass is 0.5 m from the pin: seen along y it is at the right if the angle is pi/2.
    camera = ([0.0, -1.0, 0.0], [0.0, 0.0, 0.0])
    places = []
    for angle in (np.pi / 2, -np.pi / 2):
        saved(CartPoleScenario(), tmp_path / "pole.vtb", angle=angle, camera=camera)
        program = run("open", tmp_path / "pole.vtb", "-o", tmp_path / "pole.png", "--json")
        assert program.exit_code == 0, program.stderr
        assert json.loads(program.stdout)["scenario"].endswith(":CartPoleScenario")
        image = np.asarray(Image.open(tmp_path / "pole.png").convert("RGB")).astype(int)
        rows, columns = np.nonzero((image[..., 0] > 40) & (image[..., 0] > 2 * image[..., 2]))
        places.append((rows.mean(), columns.mean()))
    # A pinhole: the focal length in pixels is half the height by the tangent of half the field of view.
    focal = 200.0 / np.tan(np.deg2rad(75.0) / 2)
    for (row, column), side in zip(places, (1.0, -1.0), strict=True):
        assert row == pytest.approx(200.0, abs=4.0)
        assert column == pytest.approx(320.0 + side * focal * 0.5, abs=4.0)


def test_page_begins_at_the_noted_camera(tmp_path: Path) -> None:
    saved(CartPoleScenario(), tmp_path / "pole.vtb", camera=([1.0, -2.0, 3.0], [0.5, 0.0, 0.25]))
    program = run("open", tmp_path / "pole.vtb", "-o", tmp_path / "pole.html")
    assert program.exit_code == 0 and program.stdout == f"Wrote {tmp_path / 'pole.html'}.\n"
    commands = messages((tmp_path / "pole.html").read_text())
    (target,) = [m["value"] for m in commands if m["type"] == "set_target"]
    (position,) = [m["value"] for m in commands if m["type"] == "set_property" and m["property"] == "position"]
    assert (target, position) == ([0.5, 0.25, 0.0], [1.0, 3.0, 2.0])  # in the axes of three.js


def test_scenario_of_another_module_is_named_by_the_user(tmp_path: Path) -> None:
    file = tmp_path / "a.vtb"
    snapshot = saved(PendulumScenario(), file)
    stranger = {**snapshot.scenario, "scenario": "antigravity:Scenario"}
    replace(snapshot, scenario=stranger).save(tmp_path / "stranger.vtb")
    refused = error_of("open", tmp_path / "stranger.vtb", "-o", tmp_path / "a.html")
    assert "importing a module runs its code: name the scenario" in refused
    assert "antigravity" not in sys.modules
    assert run("open", file, "--scenario", PENDULUM, "-o", tmp_path / "a.html").exit_code == 0
    assert "does not belong to" in error_of("open", file, "--scenario", ACROBOT, "-o", tmp_path / "a.html")


def test_fields_of_the_scenario_are_those_of_the_snapshot() -> None:
    changed = CartPoleScenario().with_fields({"simulator_config.accuracy": 1e-5})
    assert changed != CartPoleScenario()
    assert scenario_of(changed.record()) == changed
    with pytest.raises(ScenarioError, match="no field 'colour'"):
        scenario_of({**CartPoleScenario().record(), "colour": 1.0})
    with pytest.raises(ScenarioError, match="does not fit"):
        scenario_of({k: v for k, v in CartPoleScenario().record().items() if k != "simulator.accuracy"})


def test_notes_travel_with_a_snapshot_and_are_no_state(tmp_path: Path) -> None:
    noted = saved(CartPoleScenario(), tmp_path / "a.vtb", camera=([1, 2, 3], [0, 0, 0]))
    loaded = Snapshot.load(tmp_path / "a.vtb")
    assert loaded.notes == noted.notes
    assert loaded == replace(noted, notes={})
    program = run("open", tmp_path / "none.vtb")
    assert program.exit_code == 2 and "none.vtb" in program.stderr


def test_note_that_is_no_camera_is_refused(tmp_path: Path) -> None:
    for camera in (([0, 0, 1], [0, 0, 0]), ([1], [0, 0, 0]), (7, 8), ("abc", "abc"), ([1, 2, 3], None)):
        saved(CartPoleScenario(), tmp_path / "a.vtb", camera=camera)
        program = run("open", tmp_path / "a.vtb", "-o", tmp_path / "a.html")
        assert program.exit_code == 2 and "the snapshot notes a camera" in program.stderr
