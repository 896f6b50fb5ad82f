"""The beginning of a capture that the camera leads, with the satellite in a process of its own."""

from __future__ import annotations

import numpy as np
import pytest

from tests.diagrams.lock_step_loop import deployed, run_all
from vtbdrake.deployment import Deployment
from vtbdrake.state.systems import pose_from_array
from vtbdrake.testbed import DpsAlone
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.satellite.dps import PERIOD

CYCLES = 60
AHEAD = 7  # By how many cycles the clock of the DPS is ahead of the satellite's.
READ = [f"dps.env.target.{name}" for name in ("pose", "fused", "left_out")]


@pytest.mark.parametrize("perception", [pytest.param("camera", marks=pytest.mark.slow), "pose_sensor"])
def test_poses_from_a_satellite_are_dated_by_the_clock_of_the_dps(perception: str) -> None:
    pytest.importorskip("cv2")
    scenario = SatelliteScenario(seed=1, tumble_deg=2.0, perception=perception, image_width=240, image_height=180)
    testbed, dps = scenario.build(), DpsAlone(scenario)
    simulated, own = testbed.default_context(), dps.default_context()
    testbed.simulator(simulated).AdvanceTo((CYCLES - 1) * PERIOD)
    own.SetTime(AHEAD * PERIOD)
    with deployed(scenario, dps, own, paced_by="joint_position") as (runtime, _):
        run_all(runtime, CYCLES)
    ways = (testbed, simulated), (dps, own)
    (expected, fused, _), (pose, used, left_out) = ([system.read(c, a) for a in READ] for system, c in ways)
    assert used >= fused >= 6.0 and left_out == 0.0
    error = pose_from_array(pose).InvertAndCompose(pose_from_array(expected))
    assert np.linalg.norm(error.translation()) < 2e-3
    assert error.rotation().ToAngleAxis().angle() < 2e-3


@pytest.mark.parametrize("perception", ["camera+scanner", "pose_sensor"])
def test_every_satellite_can_be_deployed(perception: str) -> None:
    deployment = Deployment.of(SatelliteScenario(perception=perception, wheels=True))
    assert deployment.protocol is not None
    # In lock-step, the cycle ends with it.
    assert deployment.protocol.sense[-1].signals == ("joint_position",)
