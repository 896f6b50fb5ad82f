"""The campaign of captures, and its criteria."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant

import vtbdrake_diagrams.satellite.studies
from vtbdrake.campaigns.campaign import Campaign
from vtbdrake.campaigns.results import CampaignResult
from vtbdrake.state.systems import pose_to_array
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, Target
from vtbdrake_diagrams.satellite.studies.captures import (
    FIRST_SEED,
    GRIP,
    LARGEST_TUMBLE,
    across,
    along,
    bar_in_gripper,
    creep,
    deep,
    joint_creep,
    start,
    turned,
)

FILE = Path(vtbdrake_diagrams.satellite.studies.__path__[0]) / "captures.yaml"
POSTURE = [0.1, 0.9, -0.2, 1.8, 0.3, 0.9, -0.1]
BASE = RigidTransform(RollPitchYaw(0.2, -0.1, 0.3), [0.1, -0.2, 0.3])


@pytest.fixture(scope="module")
def campaign() -> Campaign:
    """Return the campaign with the pose sensor, which stands for camera and scanner, of a single capture."""
    text = FILE.read_text()
    with_sensor = Campaign.load(FILE)
    assert with_sensor.seeds.count == 40 and "perception" not in text
    with_sensor = replace(with_sensor, values={"scenario.perception": "pose_sensor"})
    with_sensor.seeds = replace(with_sensor.seeds, count=1)
    return with_sensor


@pytest.fixture(scope="module")
def result(campaign: Campaign) -> CampaignResult:
    return campaign.run(executor="serial", progress=False)


@pytest.mark.slow
@pytest.mark.one_python
def test_campaign_judges_the_true_motion(campaign: Campaign, result: CampaignResult) -> None:
    """Criteria equal what the plant's own kinematics and two samples in a row say."""
    assert result.is_met and result.passed == 1
    (rollout,) = result.rollouts
    rerun = campaign.run_again(rollout.condition, rollout.seed)
    assert rerun.rollout == rollout
    plant = campaign.problem.testbed.plant
    context = plant.CreateDefaultContext()
    hand, bar = plant.GetFrameByName("gripper"), plant.GetFrameByName("grapple")
    places = []
    for state in rerun.motion.states[-2:]:
        plant.SetPositionsAndVelocities(context, state)
        places.append(bar.CalcPose(context, hand).translation())
    values = [rollout.values[name] for name in ("across", "along", "deep")]
    np.testing.assert_allclose(values, np.abs(places[-1]), atol=1e-9)
    assert max(values) < 0.015
    # From the sample before to the last one the bar has moved about as much as it would in the next half second.
    assert abs(rollout.values["bar creeps"] - np.linalg.norm(places[1] - places[0])) < 2e-4
    assert rollout.values["duration"] == pytest.approx(rerun.result.times[-1])


def test_starts_differ_within_the_limits() -> None:
    rates = [float(np.linalg.norm(start(seed)["sim.env.release.velocity"][:3])) for seed in range(1000, 1050)]
    assert max(rates) < LARGEST_TUMBLE
    assert max(rates) > 0.9 * LARGEST_TUMBLE
    np.testing.assert_allclose(rates, LARGEST_TUMBLE * np.random.default_rng(FIRST_SEED).uniform(size=50))
    directions = np.array([start(seed)["sim.env.release.velocity"][:3] for seed in range(1000, 1050)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert np.linalg.norm(directions.mean(axis=0)) < 0.4


@cache
def plant() -> MultibodyPlant:
    return SatelliteScenario(perception="pose_sensor").build().plant


def gripped(offset: list[float]) -> list[np.ndarray]:
    """Return the arguments of the criteria if the bar is at an offset in the gripper."""
    context = plant().CreateDefaultContext()
    for k, position in enumerate(POSTURE, 1):
        plant().GetJointByName(f"joint_{k}").set_angle(context, position)
    plant().SetFreeBodyPose(context, plant().GetBodyByName("base"), BASE)
    X_WG = plant().GetFrameByName("gripper").CalcPoseInWorld(context)
    X_WT = X_WG @ RigidTransform(offset) @ Target().X_TH.inverse()
    return [pose_to_array(BASE), pose_to_array(X_WT), *map(np.float64, POSTURE)]


def test_offsets_are_those_of_the_bar() -> None:
    grip = gripped([0.004, -0.05, 0.015])
    assert len(grip) == len(GRIP)
    np.testing.assert_allclose(bar_in_gripper(*grip), [0.004, -0.05, 0.015], atol=1e-9)
    np.testing.assert_allclose([across(*grip), along(*grip), deep(*grip)], [0.004, 0.05, 0.015], atol=1e-9)
    assert turned(grip[0]) == pytest.approx(np.degrees(BASE.rotation().ToAngleAxis().angle()))


def test_a_common_motion_is_no_creep_and_a_relative_one_is() -> None:
    base, target, *joints = gripped([0.0, 0.0, 0.0])
    still, drift = np.zeros(6), np.array([0.0, 0.0, 0.0, 0.01, -0.02, 0.03])
    rates = [0.0] * ARM_JOINTS
    assert creep(base, target, still, still, *joints, *rates) == pytest.approx(0.0, abs=1e-12)
    assert creep(base, target, drift, drift, *joints, *rates) == pytest.approx(0.0, abs=1e-12)
    assert creep(base, target, still, drift, *joints, *rates) == pytest.approx(0.5 * np.linalg.norm(drift))
    assert creep(base, target, still, still, *joints, 0.01, *rates[1:]) > 1e-3
    assert joint_creep(0.001, -0.004, 0.0) == 0.002
