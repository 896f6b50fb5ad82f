"""The whole robot, in plain Drake, with CENIC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.math import RollPitchYaw

from benchmarks.plain_climber import build_plain_climber
from diagrams.space_climber.gait import GAITS
from diagrams.space_climber.morphology import LEGS, LUNAR_GRAVITY, Morphology


@dataclass
class Track:
    """Time (n,), base position (n, 3), roll-pitch-yaw (n, 3), lowest foot centre (n,), estimate (6,) at the end."""

    time: np.ndarray
    position: np.ndarray
    rpy: np.ndarray
    lowest_foot: np.ndarray
    estimate: np.ndarray


def simulate(gait: str = "tripod", *, duration: float = 8.0, **options: float) -> Track:
    climber = build_plain_climber(gait, **options)
    plant = climber.plant
    simulator = climber.simulator()
    root = simulator.get_mutable_context()
    context = plant.GetMyContextFromRoot(root)
    feet = [plant.GetFrameByName(f"{leg}_foot") for leg in LEGS]
    rows = []
    for k in range(1, round(duration / 0.1) + 1):
        simulator.AdvanceTo(k * 0.1)
        X_WB = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("base"))
        lowest = min(foot.CalcPoseInWorld(context).translation()[2] for foot in feet)
        rows.append([k * 0.1, *X_WB.translation(), *RollPitchYaw(X_WB.rotation()).vector(), lowest])
    env = climber.diagram.GetSubsystemByName("dps").GetSubsystemByName("env")
    estimate = env.GetMyContextFromRoot(root).get_discrete_state(0).value().copy()
    table = np.array(rows)
    return Track(table[:, 0], table[:, 1:4], table[:, 4:7], table[:, 7], estimate)


def test_contact_forces_carry_the_weight() -> None:
    climber = build_plain_climber(walk=0.0)
    simulator = climber.simulator()
    simulator.AdvanceTo(2.0)
    plant = climber.plant
    context = plant.GetMyContextFromRoot(simulator.get_context())
    results = plant.get_contact_results_output_port().Eval(context)
    forces = [results.point_pair_contact_info(k).contact_force() for k in range(results.num_point_pair_contacts())]
    assert len(forces) == 6
    np.testing.assert_allclose(np.abs(np.sum(forces, axis=0)), [0.0, 0.0, 27.0 * LUNAR_GRAVITY], atol=0.02 * 27 * 1.62)
    contact = climber.diagram.GetSubsystemByName("foot_contact")
    readings = contact.get_output_port().Eval(contact.GetMyContextFromRoot(simulator.get_context()))
    np.testing.assert_array_equal(readings, np.ones(6))


@pytest.mark.parametrize("gravity", [LUNAR_GRAVITY, 9.81])
@pytest.mark.parametrize("gait", GAITS)
def test_walks_straight_and_level_at_one_stroke_per_stance(gait: str, gravity: float) -> None:
    track = simulate(gait, gravity=gravity)
    start, end = np.searchsorted(track.time, [1.99, 7.99])  # three periods, after the smooth start
    way = track.position[end] - track.position[start]
    assert way[0] / 6.0 == pytest.approx(0.2 / (GAITS[gait].duty * 2.0), rel=0.05)
    assert abs(way[1]) < 0.02 * way[0]
    assert np.abs(track.rpy).max() < np.radians(2.0)
    m = Morphology()
    np.testing.assert_allclose(track.position[:, 2], m.torso_clearance, atol=0.01)
    assert track.lowest_foot.min() > m.foot_radius - 0.005
    assert track.lowest_foot.max() < m.foot_radius + 0.002  # always a foot on the ground


def test_perceived_pose_follows_the_true_one() -> None:
    track = simulate(heading=0.3)
    roll, pitch, yaw, x, y, height = track.estimate
    np.testing.assert_allclose([roll, pitch, yaw], track.rpy[-1], atol=np.radians(1.5))
    np.testing.assert_allclose([x, y, height], track.position[-1], atol=0.08)


def test_turns_to_the_commanded_heading() -> None:
    heading = np.radians(30.0)
    track = simulate(duration=16.0, heading=heading)
    way = track.position[-1] - track.position[-61]
    assert np.arctan2(way[1], way[0]) == pytest.approx(heading, abs=np.radians(2.0))
    assert np.linalg.norm(way) / 6.0 == pytest.approx(0.2, rel=0.05)


def test_levels_its_torso_on_a_slope() -> None:
    slope = np.radians(6.0)
    track = simulate(duration=10.0, slope=slope, walk=0.0)
    # Level with respect to gravity is nose down by the slope's angle with respect to the ground.
    np.testing.assert_allclose(track.rpy[-1], [0.0, slope, 0.0], atol=np.radians(0.2))


def test_walk_command_of_zero_stands() -> None:
    track = simulate(duration=3.0, walk=0.0)
    np.testing.assert_allclose(track.position[-1, :2], 0.0, atol=1e-3)


def test_repeats_bit_for_bit() -> None:
    first, second = (simulate(duration=2.0, gravity=3.71) for _ in range(2))
    np.testing.assert_array_equal(first.position, second.position)
