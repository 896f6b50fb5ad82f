"""Ready-made maps for the messages of a Franka Panda, with the conventions of its driver.

The external torque is negated in the messages. The measured torque includes the arm's gravity compensation, the desired
one does not. A torque command is added to the gravity compensation.
"""

from __future__ import annotations

from collections.abc import Mapping

from drake import lcmt_panda_command, lcmt_panda_status

from vtbdrake.control.robot_mode import RobotMode
from vtbdrake.lcm.driver_conventions import Fields, Gravity, arm_status, same_names
from vtbdrake.lcm.maps import LcmMap, vector_map

PANDA_MODE = RobotMode(carrier="robot_mode", active=2, braking=1, stopped=5)
"""The ``robot_mode`` of `lcmt_panda_status`, as libfranka numbers it: 1 idle, 2 move, 5 user stopped.

For ``Protocol(robot_mode=PANDA_MODE)``, with a map ``panda_status({"robot_mode": "robot_mode", ...})``. The other modes
(3 guiding, 4 reflex, 6 automatic error recovery, 0 other) block commands, too.
"""

_SIGNS = {"joint_torque_external": -1.0}


def panda_status(
    fields: Fields,
    *,
    on_top: Mapping[str, str] | None = None,
    gravity: Gravity | None = None,
    channel: str = "PANDA_STATUS",
) -> LcmMap:
    """Return a map for the state of a Franka Panda, as drake-franka-driver sends it.

    In the message, ``joint_torque_external`` has the opposite sign; ``joint_torque`` includes the arm's gravity
    compensation, and ``joint_torque_desired`` does not. The signals have the sign of a plant.

    Args:
        fields: By signal, the field of `lcmt_panda_status` that holds it: ``joint_position``, ``joint_velocity``,
            ``joint_position_desired``, ... in rad, rad/s and rad/s^2; ``joint_torque`` (measured),
            ``joint_torque_desired`` and ``joint_torque_external`` in N m. A sequence, if signals and fields have the
            same names.
        on_top: By signal, ``joint_torque``, whose part on top of the gravity compensation is the signal: what the
            torque commands of `panda_command` add, and what they have to continue.
        gravity: The arm's gravity compensation, see `vtbdrake.lcm.iiwa_status`. Required for ``on_top``.
        channel: Name of the channel.

    Raises:
        ValueError: There is no such field, or ``on_top`` has no ``gravity``.
    """
    return arm_status(
        channel,
        lcmt_panda_status,
        same_names(fields),
        signs=_SIGNS,
        position="joint_position",
        torques=("joint_torque",),
        on_top=on_top,
        gravity=gravity,
    )


def panda_command(fields: Fields = ("joint_position",), *, channel: str = "PANDA_COMMAND") -> LcmMap:
    """Return a map for the actuator commands to a Franka Panda.

    The message says which control mode it is for: the one of its fields. The arm adds the torques to its gravity
    compensation (drake-franka-driver without ``--remove_gravity_compensation``).

    Args:
        fields: By signal, the field of `lcmt_panda_command` that holds it: ``joint_position`` in rad,
            ``joint_velocity`` in rad/s, ``joint_torque`` in N m. A sequence, if signals and fields have the same names.
        channel: Name of the channel.

    Raises:
        ValueError: There is no such field.
    """
    fields = same_names(fields)
    modes = {
        "joint_position": lcmt_panda_status.CONTROL_MODE_POSITION,
        "joint_velocity": lcmt_panda_status.CONTROL_MODE_VELOCITY,
        "joint_torque": lcmt_panda_status.CONTROL_MODE_TORQUE,
    }
    mode = sum(modes.get(name, 0) for name in set(fields.values()))
    return vector_map(channel, lcmt_panda_command, fields, constants={"control_mode_expected": mode})
