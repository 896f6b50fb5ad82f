"""An arm with seven joints that speaks the iiwa messages: its interface, its messages, and a bridge to it."""

from __future__ import annotations

from typing import Any

import numpy as np
from drake import lcmt_iiwa_command, lcmt_iiwa_status

from vtbdrake.lcm.iiwa_messages import iiwa_command, iiwa_status
from vtbdrake.lcm.lcm_bridge import LcmBridge
from vtbdrake.testbed import Interface, Signal

SENSE = {"position": "joint_position_measured", "torque": "joint_torque_external"}
ACT = {"position": "joint_position", "torque": "joint_torque"}
LIMIT = 3.0


def interface() -> Interface:
    return Interface(
        sense=[Signal("position", size=7, lower=-LIMIT, upper=LIMIT), Signal("torque", size=7)],
        act=[Signal(name, size=7, lower=-LIMIT, upper=LIMIT, idle=0.0) for name in ACT],
    )


def bridge(url: str, **options: Any) -> LcmBridge:
    return LcmBridge(interface(), url, sense=[iiwa_status(SENSE)], act=[iiwa_command(ACT)], **options)


def status(utime: int, *, position: float = 0.1, torque: float = 0.2, joints: int = 7) -> lcmt_iiwa_status:
    message = lcmt_iiwa_status()
    message.utime = utime
    message.num_joints = joints
    for name in message.__slots__[2:]:
        setattr(message, name, [0.0] * joints)
    message.joint_position_measured = [position] * joints
    message.joint_torque_external = [torque] * joints
    return message


def command(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Positions and torques in a command."""
    message = lcmt_iiwa_command.decode(data)
    return np.array(message.joint_position), np.array(message.joint_torque)
