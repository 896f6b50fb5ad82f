"""The arm on the machine, recorded and replayed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.machine import MachineProcess
from vtbdrake.recording.log_reader import read_log
from vtbdrake.recording.recorder import Recorder
from vtbdrake.recording.replay import replay
from vtbdrake.testbed import DpsAlone
from vtbdrake_diagrams.manipulator.laws import LAWS
from vtbdrake_diagrams.manipulator.motions import Motion
from vtbdrake_diagrams.manipulator.scenario import ManipulatorScenario

PATIENCE = 60.0  # s
FIRST_LAW, *FURTHER_LAWS = LAWS
CYCLES = 120


@pytest.fixture(scope="module")
def hub() -> Iterator[Hub]:
    with Hub(port=0) as running:
        yield running


@pytest.mark.slow
@pytest.mark.parametrize("law", [FIRST_LAW, *(pytest.param(law, marks=pytest.mark.one_python) for law in FURTHER_LAWS)])
def test_every_control_law_is_replayed_to_the_last_bit(hub: Hub, tmp_path: Path, law: str) -> None:
    """By the DPS alone, as it was recorded, and in the whole testbed; against a machine with other parameters."""
    scenario = ManipulatorScenario(law=law)
    bridge = protocol_of(scenario).bridge(scenario.interface(), hub.url)
    runtime = scenario.deployment().in_lock_step("wrench", wait=PATIENCE).runtime(DpsAlone(scenario), bridge)
    path = tmp_path / "run.lcm"
    with (
        Recorder(runtime, path, digest_period=0.02),
        MachineProcess(scenario, hub.url, lock_step=True, perturb=0.05, seed=3, noise={"joint_velocity": 1e-3}),
    ):
        bridge.open()
        for _ in range(round(PATIENCE)):
            if all(received.count for received in bridge.sensed.values()):
                break
            bridge.poll(1.0)
        runtime.switch("real")
        runtime.write({"u.motion": float(Motion.SWING)})
        runtime.cycle()
        runtime.run(cycles=CYCLES // 2 - 1)
        runtime.write({"u.motion": float(Motion.CIRCLE)})
        runtime.run(cycles=CYCLES // 2)
        bridge.close()
    assert not runtime.guards.latched
    log = read_log(path)
    assert len(log) == CYCLES and len(np.unique(log.actuation["joint_torque"], axis=0)) > 0.9 * CYCLES

    for target in (None, scenario.build()):
        report = replay(log, target, record=["dps.impl.motion", "u.motion"])
        assert report.identical and report.cycles == CYCLES and report.digests == 6, report
        assert np.array_equal(report.actuation["joint_torque"], log.actuation["joint_torque"])
        assert Motion.SWING in report.record["dps.impl.motion"]
        assert set(report.record["u.motion"].ravel()) == {Motion.SWING, Motion.CIRCLE}
