"""A testbed controls Drake's own driver of a KUKA iiwa: it takes over and hands back without a kick."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import lcm
import numpy as np
import pytest
from drake import lcmt_iiwa_command, lcmt_iiwa_status

import vtbdrake as vtb
from tests.lcm.drake_iiwa import STEP, DrakeIiwa
from tests.lcm.iiwa import HOME, JOINTS, PERIOD, POSITION, TORQUE, TORQUE_RATE, IiwaScenario, arm_plant
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.maps import vector_map
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.machine import Machine, MachineConfig
from vtbdrake.testbed import DpsAlone, VirtualTestbed

JUMP = TORQUE_RATE * PERIOD
"""The allowed jump of the torque on a joint from one step of the plant to the next, in N m (2.5)."""


class Session:
    """A deployed testbed and Drake's arm, cycle by cycle."""

    def __init__(self, runtime: vtb.Runtime, arm: DrakeIiwa) -> None:
        self.runtime, self.arm = runtime, arm

    def run(self, cycles: int) -> None:
        (sent,) = self.runtime.bridge.sent.values()  # type: ignore[attr-defined]
        for _ in range(cycles):
            self.arm.advance(sent.count)
            self.runtime.run(cycles=1)

    def largest_jump(self) -> float:
        return float(np.abs(np.diff(self.arm.actuation, axis=0)).max())


@cache
def target(mode: str, *, alone: bool) -> DpsAlone | VirtualTestbed:
    scenario = IiwaScenario(mode=mode)
    return DpsAlone(scenario) if alone else scenario.build()


@contextmanager
def session(
    mode: str,
    *,
    alone: bool = False,
    offset: float = 0.0,
    record: Path | None = None,
    deployment: Deployment | None = None,
) -> Iterator[Session]:
    scenario = IiwaScenario(mode=mode)
    with (
        vtb.Hub(port=0, protect=["IIWA_COMMAND"]) as hub,
        scenario.deploy(hub.url, target=target(mode, alone=alone), record=record, deployment=deployment) as runtime,
        DrakeIiwa(hub.url, mode, offset=offset) as arm,
    ):
        yield Session(runtime, arm)


def test_model_has_the_kinematics_of_an_iiwa() -> None:
    plant = arm_plant()
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, np.radians([60.0, 30.0, 60.0, 30.0, 60.0, 30.0, 60.0]))
    flange = plant.GetFrameByName("iiwa_link_7").CalcPoseInWorld(context).translation()
    # By MotionGenesis, in Drake's tests of its iiwa.
    np.testing.assert_allclose(flange, [0.2970356451892219, 0.1727696964662288, 1.154681973689345], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "offset"), [(TORQUE, 0.004), pytest.param(POSITION, 0.0005, marks=pytest.mark.slow)])
def test_arm_is_taken_over_and_handed_back_without_a_kick(mode: str, offset: float, tmp_path: Path) -> None:
    with session(mode, offset=offset, record=tmp_path / "log") as s:
        for position in ("sim", "shadow", "real", "twin", "real", "shadow", "sim", "shadow", "real"):
            s.runtime.switch(position)
            s.run(16)
            assert s.runtime.guards.latched == ()
        assert s.largest_jump() < JUMP
        s.runtime.write({"u.target": HOME + 0.02})
        s.run(60)
        assert s.runtime.guards.latched == ()
    np.testing.assert_allclose(s.arm.positions[-1], HOME + 0.02, atol=0.005)
    assert vtb.replay(vtb.read_log(tmp_path / "log")).identical


def test_arm_that_is_elsewhere_is_not_taken_over() -> None:
    with session(TORQUE, offset=0.05) as s:
        s.run(2)
        s.runtime.switch("shadow")
        s.run(2)
        with pytest.raises(SwitchRefusedError, match=r"joint_torque\[.\] is 15 away from joint_torque_added\[.\]; 2.5"):
            s.runtime.switch("real")
        s.runtime.write({"u.target": HOME + 0.05})
        s.run(60)
        s.runtime.switch("real")
        s.run(20)
        assert s.runtime.guards.latched == ()
    assert s.largest_jump() < JUMP


def raw(limit: Any) -> Deployment:
    """Return a deployment that takes the torques as they are in the messages."""
    names = [
        "joint_torque_measured",
        "joint_torque_commanded",
        "joint_torque_external",
        "joint_position_commanded",
    ]
    fields = {
        "joint_position": "joint_position_measured",
        "joint_velocity": "joint_velocity_estimated",
        "joint_torque_added": "joint_torque_measured",
        **{name: name for name in names},
    }
    deployment = IiwaScenario().deployment()
    assert deployment.protocol is not None
    sense = [vector_map("IIWA_STATUS", lcmt_iiwa_status, fields)]
    protocol = Protocol(sense=sense, act=deployment.protocol.act)
    return replace(deployment, protocol=protocol, continuity={"joint_torque": limit})


@pytest.mark.slow
def test_torques_as_in_the_messages_are_refused() -> None:
    with session(TORQUE, deployment=raw("joint_torque_added")) as s:
        s.run(2)
        s.runtime.switch("shadow")
        s.run(2)
        with pytest.raises(SwitchRefusedError, match=r"joint_torque\[1\] is 60.8 away from joint_torque_added\[1\]"):
            s.runtime.switch("real")


@pytest.mark.slow
def test_a_wide_limit_lets_them_kick_the_arm() -> None:
    with session(TORQUE, deployment=raw(("joint_torque_added", 100.0))) as s:
        s.run(2)
        s.runtime.switch("real")
        s.run(2)
    assert s.largest_jump() == pytest.approx(60.8 - JUMP, abs=0.1)


def test_dps_alone_takes_over_without_a_kick() -> None:
    with session(TORQUE, alone=True, offset=0.004) as s:
        s.run(2)
        s.runtime.switch("real")
        s.run(20)
        assert s.runtime.guards.latched == ()
    assert 0.0 < s.largest_jump() < JUMP


@pytest.mark.slow
def test_dps_alone_sends_nothing_if_its_first_command_is_discontinuous() -> None:
    with session(TORQUE, alone=True, deployment=raw("joint_torque_added")) as s:
        s.run(2)
        s.runtime.switch("real")
        s.run(20)
        (fault,) = s.runtime.guards.latched
        assert "joint_torque[1] is 60.8 away from joint_torque_added[1]; 2.5 is allowed" in fault.reason
        with pytest.raises(SwitchRefusedError, match=r"joint_torque\[1\] is 60.8 away"):
            s.runtime.reset()
    assert s.runtime.bridge.sent["joint_torque"].count == 0  # type: ignore[attr-defined]
    assert s.largest_jump() < 1e-9


@pytest.mark.slow
def test_dps_alone_takes_over_by_a_reset_when_it_continues() -> None:
    with session(TORQUE, alone=True, offset=0.05) as s:
        s.run(2)
        s.runtime.switch("real")
        s.run(10)
        assert "is 15 away" in s.runtime.guards.latched[0].reason
        s.runtime.write({"u.target": HOME + 0.05})
        s.run(60)
        s.runtime.reset()
        s.run(20)
        assert s.runtime.guards.latched == ()
        assert s.runtime.bridge.sent["joint_torque"].count == 20  # type: ignore[attr-defined]
    assert s.largest_jump() < JUMP


class Ear:
    """A client of the bus that keeps the states of an arm, and commands it."""

    def __init__(self, url: str) -> None:
        self._lcm, self.heard = lcm.LCM(url), list[bytes]()
        self._lcm.subscribe("IIWA_STATUS", lambda _, data: self.heard.append(data))

    def state(self, number: int) -> lcmt_iiwa_status:
        while len(self.heard) <= number:
            assert self._lcm.handle_timeout(60_000), "no message within 60 s"
        return lcmt_iiwa_status.decode(self.heard[number])

    def command(self, data: bytes) -> None:
        self._lcm.publish("IIWA_COMMAND", data)


@pytest.mark.slow_cases
@pytest.mark.parametrize("mode", [TORQUE, POSITION])
def test_simulated_machine_sends_what_drakes_driver_sends(mode: str) -> None:
    # In Drake's diagram, a message that arrives between two steps of the plant acts from the second one on.
    config = MachineConfig(period=STEP, act_latency=STEP, brake="idle")
    machine = Machine(IiwaScenario(mode=mode), config)
    with vtb.Hub(port=0) as hub:
        ear = Ear(hub.url)
        with DrakeIiwa(hub.url, mode) as arm:
            for k in range(40):
                ((_, data),) = machine.messages()
                ours, drakes = lcmt_iiwa_status.decode(data), ear.state(k)
                assert abs(ours.utime - drakes.utime) <= 1
                for name in lcmt_iiwa_status.__slots__[2:]:
                    # The driver of positions has a continuous integral, which error control integrates.
                    tolerance = 1e-9 if mode == TORQUE else 1e-3
                    np.testing.assert_allclose(getattr(ours, name), getattr(drakes, name), atol=tolerance, err_msg=name)
                command = lcmt_iiwa_command()
                command.utime = k + 1
                swing = np.sin(0.2 * k + np.arange(JOINTS))
                if mode == TORQUE:
                    command.num_torques, command.joint_torque = JOINTS, (5.0 * swing).tolist()
                else:
                    command.num_joints, command.joint_position = JOINTS, (HOME + 0.001 * k * swing).tolist()
                machine.receive("IIWA_COMMAND", command.encode())
                for _ in range(round(PERIOD / STEP)):
                    machine.advance()
                ear.command(command.encode())
                arm.advance(k + 1)
    assert np.abs(drakes.joint_torque_measured).max() > 30.0
    assert np.ptp(arm.positions, axis=0).max() > 0.01


def test_small_step_of_the_position_is_a_large_one_of_the_torque() -> None:
    machine = Machine(IiwaScenario(mode=POSITION), MachineConfig(period=STEP, brake="idle"))
    torques = []
    for k in range(40):
        command = lcmt_iiwa_command()
        command.utime, command.num_joints = k + 1, JOINTS
        command.joint_position = (HOME + (0.001 if k >= 20 else 0.0)).tolist()
        machine.receive("IIWA_COMMAND", command.encode())
        machine.advance()
        torques.append(machine.read("sim.act.iiwa.torque_measured"))
    assert np.abs(np.diff(torques, axis=0)).max() == pytest.approx(91.4, abs=0.5)
