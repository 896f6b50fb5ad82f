"""The arm's DPS alone commands what the whole testbed does, and its motion is chosen over LCM."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import lcm
import numpy as np
import pytest
from drake import lcmt_scope

from diagrams.manipulator import ManipulatorScenario
from diagrams.manipulator.laws import LAWS
from diagrams.manipulator.motions import CIRCLE, HOME
from tests.control.scripted import ScriptedBridge
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.hub import Hub
from vtbdrake.control.operation import operation_of
from vtbdrake.control.protocol import protocol_of
from vtbdrake.control.runtime import Runtime
from vtbdrake.state import Snapshot
from vtbdrake.testbed import DpsAlone

PATIENCE = 30.0  # s


def commands(scenario: ManipulatorScenario, snapshot: Snapshot, *, alone: bool, cycles: int) -> np.ndarray:
    """Torques, while the sensors tell of a motion about the arm's pose in the snapshot."""
    at_rest = {signal.name: np.zeros(signal.size or 0) for signal in scenario.interface().sense}
    pose = snapshot["dps.env.joint_position"]
    torque = snapshot["dps.impl.torque"]

    def sensors(t: float) -> dict[str, Any]:
        swing = 0.01 * np.sin(20.0 * t + np.arange(7))
        measured = {"joint_position": pose + swing, "joint_velocity": 5.0 * swing, "joint_torque_measured": torque}
        return {**at_rest, **measured, "wrench": np.array([0.0, 0.0, 0.0, 1.0, 2.0, np.sin(9.0 * t)])}

    clock = SimulatedClock()
    bridge = ScriptedBridge(scenario.interface(), clock, sensors)
    target = DpsAlone(scenario) if alone else scenario.build()
    context = target.default_context()
    target.restore(context, snapshot)
    runtime: Runtime = operation_of(scenario).runtime(target, bridge, context=context, clock=clock)
    bridge.poll()
    runtime.switch("real")
    runtime.run(cycles=cycles)
    assert runtime.guards.latched == ()
    return np.array([sent["joint_torque"] for _, sent in bridge.sent])


@pytest.mark.parametrize("law", LAWS)
def test_alone_from_a_snapshot_it_commands_what_the_whole_testbed_does(law: str, tmp_path: Path) -> None:
    scenario = ManipulatorScenario(law=law)
    testbed = scenario.build()
    simulator = testbed.simulator()
    testbed.write(simulator.get_mutable_context(), {"u.motion": float(CIRCLE)})
    simulator.AdvanceTo(0.1)
    testbed.snapshot(simulator.get_context()).save(tmp_path / "s")
    snapshot = Snapshot.load(tmp_path / "s")
    alone = commands(scenario, snapshot, alone=True, cycles=60)
    whole = commands(scenario, snapshot, alone=False, cycles=60)
    assert np.array_equal(alone, whole)
    assert np.ptp(alone, axis=0).max() > 0.1


def test_the_motion_is_chosen_over_lcm() -> None:
    scenario = ManipulatorScenario()
    testbed = scenario.build()
    with Hub(port=0) as hub:
        bridge = protocol_of(scenario).bridge(scenario.interface(), hub.url)
        bridge.open()
        runtime = Runtime(testbed, bridge, clock=SimulatedClock())
        speaker, reception = lcm.LCM(hub.url), bridge.commanded["motion"]

        def say(utime: int, motion: float) -> None:
            message = lcmt_scope()
            message.utime, message.size, message.value = utime, 1, [motion]
            known, limit = (reception.count, sum(reception.rejected.values())), time.monotonic() + PATIENCE
            speaker.publish("ARM_MOTION", message.encode())
            while (reception.count, sum(reception.rejected.values())) == known:
                assert time.monotonic() < limit
                runtime.cycle()

        runtime.run(cycles=5)
        before = testbed.read(runtime.context, "dps.impl.motion")
        say(1, 99.0)
        refused = testbed.read(runtime.context, "u.motion")
        say(2, float(CIRCLE))
        runtime.run(cycles=2500)
        bridge.close()
    assert (before, refused) == (HOME, HOME)
    assert reception.rejected == {"limits": 1}
    assert testbed.read(runtime.context, "dps.impl.motion") == CIRCLE
