"""The whole robot in its testbed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from pydrake.math import RollPitchYaw

from vtbdrake_diagrams.space_climber import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.gait import GAITS
from vtbdrake_diagrams.space_climber.morphology import LEGS, LUNAR_GRAVITY, Morphology


@dataclass
class Track:
    """Time (n,), base position (n, 3), roll-pitch-yaw (n, 3), lowest foot centre (n,), estimate (6,) at the end."""

    time: np.ndarray
    position: np.ndarray
    rpy: np.ndarray
    lowest_foot: np.ndarray
    estimate: np.ndarray


def simulate(*, duration: float = 8.0, heading: float = 0.0, walk: float = 1.0, **fields: Any) -> Track:
    testbed = SpaceClimberScenario(payload=False, **fields).build()
    plant = testbed.plant
    root = testbed.default_context()
    testbed.write(root, {"u.heading": heading, "u.walk": walk})
    simulator = testbed.simulator(root)
    context = plant.GetMyContextFromRoot(root)
    feet = [plant.GetFrameByName(f"{leg}_foot") for leg in LEGS]
    rows = []
    for k in range(1, round(duration * 10) + 1):
        simulator.AdvanceTo(k * 0.1)
        X_WB = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("base"))
        lowest = min(foot.CalcPoseInWorld(context).translation()[2] for foot in feet)
        rows.append([k * 0.1, *X_WB.translation(), *RollPitchYaw(X_WB.rotation()).vector(), lowest])
    believed = testbed.variables().read(root, [f"dps.env.{name}" for name in ("roll", "pitch", "yaw", "position")])
    table = np.array(rows)
    return Track(table[:, 0], table[:, 1:4], table[:, 4:7], table[:, 7], np.hstack(list(believed.values())))


def test_contact_forces_carry_the_weight() -> None:
    testbed = SpaceClimberScenario(payload=False).build()
    root = testbed.default_context()
    testbed.write(root, {"u.walk": 0.0})
    testbed.simulator(root).AdvanceTo(2.0)
    results = testbed.read(root, "plant.contact_results")
    forces = [results.point_pair_contact_info(k).contact_force() for k in range(results.num_point_pair_contacts())]
    assert len(forces) == 6
    np.testing.assert_allclose(np.abs(np.sum(forces, axis=0)), [0.0, 0.0, 27.0 * LUNAR_GRAVITY], atol=0.02 * 27 * 1.62)
    np.testing.assert_array_equal(testbed.read(root, "sim.sense.foot_contact.foot_contact"), np.ones(6))


WALKS = [(gait, gravity) for gait in GAITS for gravity in (LUNAR_GRAVITY, 9.81)]


@pytest.mark.parametrize(
    ("gait", "gravity"), [WALKS[0], *(pytest.param(*walk, marks=pytest.mark.slow) for walk in WALKS[1:])]
)
def test_walks_straight_and_level_at_one_stroke_per_stance(gait: str, gravity: float) -> None:
    track = simulate(gait=gait, gravity=gravity)
    start, end = np.searchsorted(track.time, [1.99, 7.99])  # three periods, after the smooth start
    way = track.position[end] - track.position[start]
    assert way[0] / 6.0 == pytest.approx(0.2 / (GAITS[gait].duty * 2.0), rel=0.05)
    assert abs(way[1]) < 0.02 * way[0]
    assert np.abs(track.rpy).max() < np.radians(2.0)
    m = Morphology()
    np.testing.assert_allclose(track.position[:, 2], m.torso_clearance, atol=0.01)
    assert track.lowest_foot.min() > m.foot_radius - 0.005
    assert track.lowest_foot.max() < m.foot_radius + 0.002  # always a foot on the ground


def test_walks_backwards_as_fast_as_forwards() -> None:
    track = simulate(walk=-1.0)
    start, end = np.searchsorted(track.time, [1.99, 7.99])
    way = track.position[end] - track.position[start]
    assert way[0] / 6.0 == pytest.approx(-0.2, rel=0.05)
    assert abs(way[1]) < 0.02 * abs(way[0])
    assert np.abs(track.rpy).max() < np.radians(2.0)


def test_perceived_pose_follows_the_true_one() -> None:
    track = simulate(heading=0.3)
    roll, pitch, yaw, x, y, height = track.estimate
    np.testing.assert_allclose([roll, pitch, yaw], track.rpy[-1], atol=np.radians(1.5))
    np.testing.assert_allclose([x, y, height], track.position[-1], atol=0.08)


@pytest.mark.slow
def test_turns_to_the_commanded_heading() -> None:
    heading = np.radians(30.0)
    track = simulate(duration=16.0, heading=heading)
    way = track.position[-1] - track.position[-61]
    assert np.arctan2(way[1], way[0]) == pytest.approx(heading, abs=np.radians(2.0))
    assert np.linalg.norm(way) / 6.0 == pytest.approx(0.2, rel=0.05)


def test_levels_its_torso_on_a_slope() -> None:
    track = simulate(duration=10.0, slope_deg=6.0, walk=0.0)
    assert track.rpy[0, 1] > np.radians(3.0)
    np.testing.assert_allclose(track.rpy[-1], 0.0, atol=np.radians(0.2))


def test_walk_command_of_zero_stands() -> None:
    track = simulate(duration=3.0, walk=0.0)
    np.testing.assert_allclose(track.position[-1, :2], 0.0, atol=1e-3)


def test_an_imu_that_is_mounted_askew_feels_gravity_askew() -> None:
    testbed = SpaceClimberScenario(payload=False).build()
    root = testbed.default_context()
    askew = {"sim.sense.imu.mount[3]": np.pi / 2, "u.walk": 0.0, "dps.impl.gait.posture_gain": 0.0}
    testbed.write(root, askew)
    testbed.simulator(root).AdvanceTo(2.0)
    # Rolled by 90 deg, its y axis points up.
    np.testing.assert_allclose(testbed.read(root, "sim.sense.imu.imu")[3:], [0.0, LUNAR_GRAVITY, 0.0], atol=0.03)
