"""The arm's DPS alone commands what the whole testbed does, and its motion is chosen over LCM."""

from __future__ import annotations

import time
from functools import partial
from math import inf
from typing import Any

import lcm
import numpy as np
import pytest
from drake import lcmt_force_torque, lcmt_iiwa_command, lcmt_iiwa_status, lcmt_scope

from tests.control.scripted import ScriptedBridge
from tests.diagrams.manipulator.test_safety import gravity
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.machine import MachineProcess
from vtbdrake.testbed import DpsAlone
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.arm import Arm
from vtbdrake_diagrams.manipulator.laws import LAWS
from vtbdrake_diagrams.manipulator.motions import Motion

PATIENCE = 60.0  # s
FIRST_LAW, *FURTHER_LAWS = LAWS


def test_refused_reset_is_accepted_after_its_remedy() -> None:
    """The arm was led away while it floated, and rests there."""
    scenario = ManipulatorScenario(law="joint_impedance")
    pose, clock = np.array(Arm().home), SimulatedClock()
    sensed = {"joint_velocity": np.zeros(7), "wrench": np.zeros(6), "joint_torque_measured": gravity(pose)}

    def sensors(t: float) -> dict[str, Any]:
        return {**sensed, "joint_position": pose.copy()}

    bridge = ScriptedBridge(scenario.interface(), clock, sensors)
    runtime: Runtime = Deployment.of(scenario, pace="").runtime(DpsAlone(scenario), bridge, clock=clock)
    runtime.take_over()
    runtime.run(cycles=20)
    assert runtime.guards.latched == ()
    runtime.guards.latch("told", clock.now(), bridge.sensed)
    for _ in range(60):
        pose[:4] += 1e-2
        runtime.run(cycles=1)
    sensed["joint_torque_measured"] = gravity(pose)
    runtime.run(cycles=50)
    with pytest.raises(SwitchRefusedError, match=r"joint_torque.* is .* set u\.motion to 0 \(follow\)"):
        runtime.reset()
    runtime.write({"u.motion": 0.0})
    runtime.run(cycles=200)  # The DPS limits the rate of its own torque.
    runtime.reset()
    runtime.run(cycles=50)
    assert runtime.guards.latched == ()


def test_the_motion_is_chosen_over_lcm() -> None:
    scenario = ManipulatorScenario()
    testbed = scenario.build()
    with Hub(port=0) as hub:
        bridge = protocol_of(scenario).bridge(scenario.interface(), hub.url)
        bridge.open()
        runtime = Runtime(testbed, bridge, clock=SimulatedClock())
        speaker, received = lcm.LCM(hub.url), bridge.commands["motion"]

        def say(utime: int, motion: float) -> None:
            message = lcmt_scope()
            message.utime, message.size, message.value = utime, 1, [motion]
            known, limit = (received.count, sum(received.rejected.values())), time.monotonic() + PATIENCE
            speaker.publish("ARM_MOTION", message.encode())
            while (received.count, sum(received.rejected.values())) == known:
                assert time.monotonic() < limit
                runtime.cycle()

        runtime.run(cycles=5)
        before = testbed.read(runtime.context, "dps.impl.motion")
        say(1, 99.0)
        refused = testbed.read(runtime.context, "u.motion")
        say(2, float(Motion.CIRCLE))
        obeyed = partial(testbed.reader("dps.impl.motion"), runtime.context)
        runtime.run(cycles=2500, until=lambda: bool(obeyed() == Motion.CIRCLE))
        bridge.close()
    assert (before, refused) == (Motion.HOME, Motion.HOME)
    assert received.rejected == {"limits": 1}
    assert testbed.read(runtime.context, "dps.impl.motion") == Motion.CIRCLE


class FakeArm:
    """An arm on the bus that does not move: it reports a torque, as an iiwa does, and keeps the commanded torques."""

    def __init__(self, url: str) -> None:
        self.commanded: list[np.ndarray] = []
        self._lcm = lcm.LCM(url)
        self._lcm.subscribe("IIWA_COMMAND", self._obey)
        self._ready = False
        self._lcm.subscribe("READY", self._get_ready)
        self._lcm.publish("READY", b"")
        while not self._ready:
            assert self._lcm.handle_timeout(round(1e3 * PATIENCE))

    def _get_ready(self, channel: str, data: bytes) -> None:
        self._ready = True

    def _obey(self, channel: str, data: bytes) -> None:
        self.commanded.append(np.array(lcmt_iiwa_command.decode(data).joint_torque))

    def tell(self, torque: np.ndarray) -> None:
        """Publishes its state."""
        status = lcmt_iiwa_status()
        status.utime, status.num_joints = time.time_ns() // 1000, 7
        for name in status.__slots__[2:]:
            setattr(status, name, [0.0] * 7)
        status.joint_position_measured, status.joint_torque_measured = list(Arm().home), (-torque).tolist()
        status.joint_torque_commanded = status.joint_torque_measured  # what it keeps
        wrench = lcmt_force_torque()
        wrench.timestamp = status.utime
        mode = lcmt_scope()  # 0: it takes commands
        mode.utime, mode.size, mode.value = status.utime, 1, [0.0]
        self._lcm.publish("ARM_MODE", mode.encode())
        self._lcm.publish("IIWA_STATUS", status.encode())
        self._lcm.publish("WRENCH", wrench.encode())

    def listen(self) -> None:
        while self._lcm.handle_timeout(0):
            pass


def test_first_command_after_hub_restart_continues_reported_torque() -> None:
    scenario = ManipulatorScenario(law="joint_impedance")
    carried, braked = np.array([0.0, -45.2, 0.0, 22.4, 0.0, -2.1, 0.0]), np.zeros(7)
    with Hub(port=0) as first:
        port = int(first.url.rpartition(":")[2])
        bridge = protocol_of(scenario).bridge(scenario.interface(), first.url)
        bridge.open()
        # The arm tells its state when the test does.
        guards = {**scenario.deployment().guards, "pace_tolerance": inf}
        runtime: Runtime = Deployment.of(scenario, guards=guards).runtime(DpsAlone(scenario), bridge)
        arm, limit = FakeArm(first.url), time.monotonic() + PATIENCE
        while runtime.prepare("real").reasons:
            arm.tell(carried)
            bridge.poll(0.01)
            assert time.monotonic() < limit
        runtime.switch("real")
        while len(arm.commanded) < 30:
            arm.tell(carried)
            runtime.cycle()
            arm.listen()
            assert time.monotonic() < limit
        assert np.abs(arm.commanded[-1] - carried).max() < 5.0
    while bridge.connected:
        runtime.cycle()
    for _ in range(50):
        runtime.cycle()
    with Hub(port=port) as second:
        arm = FakeArm(second.url)
        while not bridge.connected:
            bridge.poll(0.01)
        while not arm.commanded:
            arm.tell(braked)
            runtime.cycle()
            arm.listen()
            assert time.monotonic() < limit
        bridge.close()
    step = np.array(Arm().torque_rates) * scenario.period
    assert (np.abs(arm.commanded[0] - braked) <= step * (1 + 1e-9)).all()
    assert runtime.guards.latched


@pytest.mark.parametrize("law", [FIRST_LAW, *(pytest.param(law, marks=pytest.mark.slow) for law in FURTHER_LAWS)])
def test_first_command_continues_what_the_resting_arm_measures(law: str) -> None:
    scenario = ManipulatorScenario(law=law, compile=False)
    deployment = Deployment.of(scenario).in_lock_step("wrench", wait=PATIENCE)
    with (
        Hub(port=0) as hub,
        scenario.deploy(hub.url, deployment=deployment) as runtime,
        MachineProcess(scenario, hub.url, lock_step=True, perturb=0.05, seed=1),
    ):
        runtime.take_over()
        runtime.run(cycles=20)
        assert runtime.guards.latched == ()
