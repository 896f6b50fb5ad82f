"""Captures with the pose sensor, and the modes of the supervisor."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from vtbdrake.components.environment import LightConfig
from vtbdrake.state import Snapshot
from vtbdrake.testbed import ScenarioError, VirtualTestbed, load_scenario
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.satellite.bodies import ARM_JOINT_NAMES, Servicer
from vtbdrake_diagrams.satellite.supervisor import Mode, Reason


@cache
def built() -> VirtualTestbed:
    return SatelliteScenario(seed=1, tumble_deg=3.0, perception="pose_sensor").build()


def mode(context: Context) -> str:
    return Mode(int(built().read(context, "dps.impl.supervisor.mode"))).label


def reason(context: Context) -> str:
    return Reason(int(built().read(context, "dps.impl.supervisor.reason"))).label


def fixture_in_gripper(context: Context) -> RigidTransform:
    plant = built().plant
    own = plant.GetMyContextFromRoot(context)
    X_WG, X_WH = (plant.GetFrameByName(name).CalcPoseInWorld(own) for name in ("gripper", "grapple"))
    return X_WG.InvertAndCompose(X_WH)


@dataclass(frozen=True)
class Course:
    """A whole capture, which several tests begin from: the modes in their order, and states by time in s."""

    modes: list[str]
    states: dict[float, Snapshot]

    def at(self, time: float) -> Context:
        """Return a new context in the state of a time."""
        context = built().default_context()
        built().restore(context, self.states[time])
        return context


@pytest.fixture(scope="module")
def course() -> Course:
    context = built().default_context()
    simulator = built().simulator(context)
    course = Course([], {})
    for k in range(100):
        time = round(0.2 * (k + 1), 1)
        simulator.AdvanceTo(time)
        if mode(context) not in course.modes:
            course.modes.append(mode(context))
        if time in (2.0, 13.0, 20.0):
            course.states[time] = built().fork(simulator)
    return course


def test_bar_is_held_at_the_end(course: Course) -> None:
    assert course.modes == ["wait", "approach", "track", "grip", "retreat", "hold"]
    context = course.at(20.0)
    before = fixture_in_gripper(context)
    assert np.abs(before.translation()).max() < 0.015
    built().simulator(context, restored=True).AdvanceTo(25.0)
    moved = before.InvertAndCompose(fixture_in_gripper(context))
    # Held still: less than a millimetre and a quarter of a degree in five seconds.
    assert np.linalg.norm(moved.translation()) < 1e-3
    assert moved.rotation().ToAngleAxis().angle() < np.radians(0.25)


def test_tracker_knows_the_inertia_of_the_target() -> None:
    body = built().plant.GetBodyByName("body", built().plant.GetModelInstanceByName("target"))
    inertia = body.default_spatial_inertia().CalcRotationalInertia()
    expected = [*inertia.get_moments(), *inertia.get_products()]
    assert built().read(built().default_context(), "dps.env.target.inertia") == pytest.approx(expected)


def advanced(time: float, **values: object) -> Context:
    """A context in the course of a capture."""
    context = built().default_context()
    built().write(context, {address.replace("__", "."): value for address, value in values.items()})
    built().simulator(context).AdvanceTo(time)
    return context


def test_nothing_moves_without_go() -> None:
    context = advanced(3.0, u__capture=0.0)
    assert mode(context) == "wait"
    command = built().read(context, "dps.impl.controller.joint_position")
    np.testing.assert_array_equal(
        command, built().read(built().default_context(), "dps.impl.controller.joint_position")
    )


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"u__capture": -1.0}, "abort commanded"),
        ({"sim__sense__target_pose__dropout": 1.0}, "the target is lost"),
        ({"dps__impl__supervisor__reach": 0.5}, "the target is out of reach"),
        ({"dps__impl__supervisor__largest_speed": 0.01}, "the target moves too fast"),
        ({"dps__impl__supervisor__time_limit": 2.0}, "out of time"),
    ],
)
def test_abort_says_why(course: Course, values: dict[str, float], expected: str) -> None:
    context = course.at(2.0)
    assert mode(context) == "approach"
    built().write(context, {address.replace("__", "."): value for address, value in values.items()})
    simulator = built().simulator(context, restored=True)
    while context.get_time() < 6.0 and mode(context) != "abort":
        simulator.AdvanceTo(context.get_time() + 0.1)
    assert (mode(context), reason(context)) == ("abort", expected)


@pytest.mark.slow
def test_abort_releases_the_bar_and_backs_off(course: Course) -> None:
    context = course.at(13.0)
    assert mode(context) == "retreat"
    built().write(context, {"u.capture": -1.0})
    simulator = built().simulator(context, restored=True)
    before = built().read(context, "sim.sys.target.body.velocity")
    simulator.AdvanceTo(19.0)
    assert mode(context) == "abort"
    # The arm, which is still braking, no longer drags the target.
    np.testing.assert_allclose(built().read(context, "sim.sys.target.body.velocity"), before, atol=0.01)
    assert fixture_in_gripper(context).translation()[2] > 0.15
    simulator.AdvanceTo(30.0)
    stowed = [built().read(context, f"sim.sys.servicer.{name}.position") for name in ARM_JOINT_NAMES]
    assert np.abs(np.array(stowed) - Servicer().stowed).max() < 0.05


def test_lost_target_is_no_start() -> None:
    context = advanced(3.0, sim__sense__target_pose__dropout=1.0)
    assert mode(context) == "wait"


@pytest.mark.parametrize(("field", "value"), [("tumble_deg", -1.0), ("distance", 1.0), ("perception", "eyes")])
def test_bad_fields_are_refused(field: str, value: object) -> None:
    with pytest.raises(ScenarioError, match=field):
        SatelliteScenario(**{field: value}).build()


def test_scenario_survives_a_file(tmp_path: Path) -> None:
    scenario = SatelliteScenario(seed=3, light=LightConfig(direction=[1.0, 0.0, 0.2]))
    scenario.save(tmp_path / "satellite.yaml")
    assert load_scenario(tmp_path / "satellite.yaml") == scenario
