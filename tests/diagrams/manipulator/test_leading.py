"""The arm that a hand leads: where it goes, how fast, what it does when the hand lets go."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.arm import Arm
from vtbdrake_diagrams.manipulator.laws import LAWS
from vtbdrake_diagrams.manipulator.leading import REST
from vtbdrake_diagrams.manipulator.motions import Motion

ARM = Arm()
SMOOTH = {"sim.act.drives.coulomb": np.zeros(7)}


def hand(pose: RigidTransform) -> np.ndarray:
    return np.array([1.0, *pose.rotation().ToQuaternion().wxyz(), *pose.translation()])


class Led:
    """One simulation of an arm that is led."""

    def __init__(self, testbed: VirtualTestbed) -> None:
        self.testbed, self.context = testbed, testbed.default_context()
        testbed.write(self.context, {"u.motion": float(Motion.LED), **SMOOTH})
        self.simulator = testbed.simulator(self.context)
        plant = testbed.plant
        assert plant is not None
        self._plant, self._plant_context = plant, plant.GetMyContextFromRoot(self.context)
        self._reference = plant.CreateDefaultContext()

    @property
    def tip(self) -> RigidTransform:
        return self._plant.GetFrameByName("tip").CalcPoseInWorld(self._plant_context)

    @property
    def reference(self) -> RigidTransform:
        """Drake's pose of the tip at the joint reference."""
        self._plant.SetPositions(self._reference, np.array(self.read("dps.impl.reference")))
        return self._plant.GetFrameByName("tip").CalcPoseInWorld(self._reference)

    def read(self, address: str) -> np.ndarray:
        return np.array(self.testbed.read(self.context, address))

    def lead(self, value: object) -> None:
        self.testbed.write(self.context, {"u.hand": np.array(value)})

    def advance(self, seconds: float) -> None:
        self.simulator.AdvanceTo(self.context.get_time() + seconds)


@cache
def built(law: str) -> VirtualTestbed:
    return ManipulatorScenario(law=law, led_by_hand=True).build()


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_tip_goes_where_the_hand_leads_it_and_home_again(law: str) -> None:
    run = Led(built(law))
    start = run.tip
    goal = RigidTransform(RollPitchYaw(0.2, 0.1, 0.3).ToRotationMatrix() @ start.rotation(), [0.55, 0.12, 0.72])
    run.lead(hand(goal))
    run.advance(4.0)
    assert np.linalg.norm(run.tip.translation() - goal.translation()) < 5e-4
    assert run.tip.rotation().InvertAndCompose(goal.rotation()).ToAngleAxis().angle() < 2e-3
    np.testing.assert_allclose(run.read("dps.impl.tip_pose").reshape(3, 4), goal.GetAsMatrix34(), atol=1e-3)
    np.testing.assert_allclose(run.read("dps.impl.tip_pose").reshape(3, 4), run.reference.GetAsMatrix34(), atol=1e-5)
    run.testbed.write(run.context, {"u.motion": float(Motion.HOME)})
    run.advance(3.5)
    assert run.read("dps.impl.motion") == Motion.HOME
    assert np.linalg.norm(run.tip.translation() - start.translation()) < 5e-4


def test_reference_is_smooth_and_stops_when_the_hand_lets_go() -> None:
    run = Led(built("joint_impedance"))
    run.advance(0.01)
    goal = RigidTransform(run.tip.rotation(), [0.4, 0.3, 0.4])
    dt, positions = 0.004, []
    for k in range(200):
        if k == 10:
            run.lead(hand(goal))
        if k == 120:
            run.lead(REST)
        run.advance(dt)
        positions.append(run.reference.translation())
    speed = np.linalg.norm(np.diff(positions, axis=0), axis=1) / dt
    assert speed[:9].max() == 0.0 and 0.2 < speed.max() < 0.31  # lead_speed is 0.3 m/s.
    assert np.abs(np.diff(speed) / dt).max() < 3.5  # lead_acceleration is 3 m/s^2.
    assert speed[118] > 0.2 and speed[-50:].max() == 0.0
    assert np.linalg.norm(positions[-1] - positions[119]) < 0.3**2 / (2 * 3.0) + 1e-3
    assert np.linalg.norm(goal.translation() - positions[-1]) > 0.05
    assert np.linalg.norm(run.tip.translation() - positions[-1]) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    "goal",
    [
        [1.6, 0.0, 1.6],
        pytest.param([-0.4, 0.0, 0.2], marks=pytest.mark.slow),
        pytest.param([0.0, 0.0, 0.3], marks=pytest.mark.slow),
    ],
)
def test_arm_stays_within_its_ranges_where_the_hand_is_out_of_reach(goal: list[float]) -> None:
    run = Led(built("cartesian_impedance"))
    run.lead(hand(RigidTransform(RollPitchYaw(0.0, 2.5, 1.0), goal)))
    for _ in range(60):
        run.advance(0.05)
        q, v = run.read("dps.impl.reference"), run.read("dps.impl.lead_velocity")
        assert np.all((q > ARM.lower) & (q < ARM.upper))
        assert np.all(np.abs(v) <= 0.5 * ARM.speeds + 1e-12)
    run.lead(REST)
    run.advance(0.3)
    assert not run.read("dps.impl.lead_velocity").any()


@pytest.mark.parametrize("value", [(0.4, *REST[1:]), (1.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.1, 0.5)])
def test_what_is_no_pose_leads_nowhere(value: tuple[float, ...]) -> None:
    run = Led(built("cartesian_impedance"))
    before = run.reference.translation()
    run.lead(value)
    run.advance(0.2)
    np.testing.assert_array_equal(run.reference.translation(), before)


def test_hand_does_not_lead_other_motions() -> None:
    run = Led(built("cartesian_impedance"))
    run.testbed.write(run.context, {"u.motion": float(Motion.HOME)})
    run.lead(hand(RigidTransform(run.tip.rotation(), [0.4, 0.3, 0.4])))
    run.advance(0.2)
    np.testing.assert_allclose(run.read("dps.impl.reference"), ARM.home, atol=1e-12)


def test_scenario_declares_what_the_hand_commands() -> None:
    scenario = ManipulatorScenario(led_by_hand=True)
    declared = scenario.hand_command()
    assert declared is not None and ManipulatorScenario().hand_command() is None
    declared.check_interface(scenario.interface())
    assert [map.channel for map in protocol_of(scenario).commands] == ["ARM_MOTION", "ARM_HAND"]
    tip = Led(built("cartesian_impedance")).tip.translation()
    assert np.all((tip > declared.lower) & (tip < declared.upper))
