"""The servicer's belief, and the mental copy of its testbed."""

from __future__ import annotations

import numpy as np
import pytest

from vtbdrake.reasoning import Belief
from vtbdrake.rollout import RolloutRunner, RolloutTask
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.satellite.supervisor import Mode

MODE = "dps.impl.supervisor.mode"
WORLD = {
    "sim.sys.target.body.pose": 0.02,
    "sim.sys.target.body.velocity": 0.01,
    "sim.sys.servicer.base.pose": 0.005,
    "sim.sys.servicer.base.velocity": 0.005,
    "sim.sys.servicer.joint_2.position": 0.003,
    "sim.sys.servicer.joint_2.velocity": 0.05,
}


@pytest.mark.slow
def test_mental_capture_begins_with_the_estimates() -> None:
    scenario = SatelliteScenario(seed=1, tumble_deg=3.0, perception="pose_sensor")
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(5.01)
    mental = scenario.mental()
    start = Belief.of(testbed, context).start(mental.build())
    record = RolloutRunner(RolloutTask(mental, 18.0, record=[MODE, *WORLD])).run({}, start=start).record
    for address, tolerance in WORLD.items():
        believed, true = record[address][0], testbed.read(context, address)
        assert np.abs(believed - true).max() < tolerance, address
        assert np.abs(believed - true).max() > 0.0, f"{address} is known exactly"
    # The arm has moved since it was measured.
    name = "sim.sys.servicer.joint_2.position"
    measured, true = testbed.read(context, "dps.impl.controller.measured_position")[1], testbed.read(context, name)
    assert abs(record[name][0] - true) < 0.2 * abs(measured - true)
    assert record[MODE][0] == testbed.read(context, MODE)
    assert record[MODE][-1] == Mode.HOLD


def test_seeing_servicer_continues_in_its_mental_copy() -> None:
    seeing = SatelliteScenario(perception="camera+scanner", image_width=64, image_height=48)
    testbed, mental = seeing.build(), seeing.mental()
    start = Belief.of(testbed, testbed.default_context()).start(mental.build())
    record = ["dps.env.target.fused", "dps.env.markers.count"]
    found = RolloutRunner(RolloutTask(mental, 0.5, record=record)).run({}, start=start).record
    # The copy sees nothing. Its tracker follows the pose sensor, whose samples of 0 to 0.3 s have arrived.
    assert [found[address][-1] for address in record] == [4.0, 0.0]
