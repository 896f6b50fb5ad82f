"""The mode that a machine reports: which numbers block its commands, and which confirm that it does without any."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vtbdrake.control.bridge import Reports
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.robot_mode import ReportedMode, RobotMode
from vtbdrake.lcm.lcm_bridge import ChannelReader, LcmBridge
from vtbdrake.lcm.panda_messages import PANDA_MODE, panda_command, panda_status
from vtbdrake.testbed import Interface, Signal

PANDA = Interface(sense=[Signal("joint_position", size=7)], act=[Signal("joint_torque", size=7, idle=0.0)])
STATUS = panda_status({"joint_position": "joint_position", "robot_mode": "robot_mode"})


@pytest.mark.parametrize(
    ("number", "blocked", "is_released"),
    [
        (1, None, True),
        (2, None, False),
        (5, "its own stop is pressed (it reports the robot_mode 5): release it", True),
        (4, "it reports the robot_mode 4, which is neither active (2) nor braking (1)", False),
    ],
)
def test_mode_of_a_panda_arrives_in_its_status(number: int, blocked: str | None, is_released: bool) -> None:
    reports = Reports(PANDA, {}, PANDA_MODE)
    assert reports.robot_mode is not None
    signals = [*PANDA.sense, *reports.signals]
    received = {"joint_position": ReceivedSignal(), **reports.received}
    reader = ChannelReader(STATUS, signals, received, 0.1)
    reader.receive("PANDA_STATUS", STATUS.encoder(signals)({"joint_position": np.zeros(7), "robot_mode": [number]}, 1))
    assert reports.robot_mode.blocked_reason == blocked
    assert reports.robot_mode.is_released == is_released


def test_bridge_receives_the_mode() -> None:
    options: dict[str, Any] = {"sense": [STATUS], "act": [panda_command({"joint_torque": "joint_torque"})]}
    bridge = LcmBridge(PANDA, "memq://", robot_mode=PANDA_MODE, **options)
    assert bridge.robot_mode is not None and bridge.robot_mode.mode is PANDA_MODE
    with pytest.raises(ValueError, match="carries robot_mode, which is no sensor signal"):
        LcmBridge(PANDA, "memq://", **options)
    options["sense"] = [panda_status({"joint_position": "joint_position"})]
    with pytest.raises(ValueError, match="sensor signal robot_mode needs a map to one LCM channel, it has none"):
        LcmBridge(PANDA, "memq://", robot_mode=PANDA_MODE, **options)


def test_machine_whose_mode_is_unknown_is_not_commanded() -> None:
    reported = ReportedMode(RobotMode(carrier="arm_mode", max_cycles=3))
    assert reported.blocked_reason == "it has never reported its mode arm_mode, and is to (Protocol.robot_mode)"
    assert not reported.is_released
    reported.received.accept(np.array([0.0]), 0.0, 0.0)
    for _ in range(4):  # The first cycle has the report, three have none.
        reported.note_cycle()
        assert reported.blocked_reason is None
    reported.note_cycle()
    assert reported.blocked_reason == "it has not reported its mode arm_mode in the last 4 cycles"
    reported.received.accept(np.array([0.0]), 0.0, 0.0)
    reported.note_cycle()
    assert reported.blocked_reason is None


def test_bad_modes_are_refused() -> None:
    with pytest.raises(ValueError, match="of the mode arm_mode are three different numbers, not 0, 1 and 1"):
        RobotMode(carrier="arm_mode", stopped=1)
    with pytest.raises(ValueError, match="max_cycles of the mode arm_mode is at least 1, not 0"):
        RobotMode(carrier="arm_mode", max_cycles=0)
    with pytest.raises(ValueError, match="needs a name of its own: 'joint_position' is taken"):
        Reports(PANDA, {}, RobotMode(carrier="joint_position"))
