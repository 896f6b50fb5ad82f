"""Ready-made maps for the messages of a KUKA iiwa, with the conventions of its driver.

Measured and commanded torque are negated in the messages, and include the arm's gravity compensation. The external
torque is not negated. A torque command is added to the gravity compensation.
"""

from __future__ import annotations

from collections.abc import Mapping

from drake import lcmt_iiwa_command, lcmt_iiwa_status

from vtbdrake.lcm.driver_conventions import Fields, Gravity, arm_status, same_names
from vtbdrake.lcm.maps import LcmMap, vector_map

_SIGNS = {"joint_torque_measured": -1.0, "joint_torque_commanded": -1.0}


def iiwa_status(
    fields: Fields,
    *,
    on_top: Mapping[str, str] | None = None,
    gravity: Gravity | None = None,
    channel: str = "IIWA_STATUS",
) -> LcmMap:
    """Return a map for the state of a KUKA iiwa, as drake-iiwa-driver and Drake's `IiwaDriver` send it.

    In the message, ``joint_torque_measured`` and ``joint_torque_commanded`` have the opposite sign; both include
    the arm's gravity compensation. The signals have the sign of a plant.

    Args:
        fields: By signal, the field of `lcmt_iiwa_status` that holds it: ``joint_position_measured``,
            ``joint_velocity_estimated`` (filtered: 40 Hz in drake-iiwa-driver), ``joint_position_commanded``,
            ``joint_position_ipo`` in rad and rad/s; ``joint_torque_measured``, ``joint_torque_commanded`` and
            ``joint_torque_external`` in N m. A sequence, if signals and fields have the same names.
        on_top: By signal, the field of the measured or the commanded torque, whose part on top of the gravity
            compensation is the signal: what the torque commands of `iiwa_command` add, and what they have to continue.
        gravity: The gravity compensation of the arm with its tool; `vtbdrake.control.gravity_compensation` makes it
            from a plant with the arm's joints alone. Required for ``on_top``.
        channel: Name of the channel.

    Raises:
        ValueError: There is no such field, or ``on_top`` has no ``gravity``.
    """
    return arm_status(
        channel,
        lcmt_iiwa_status,
        same_names(fields),
        signs=_SIGNS,
        position="joint_position_measured",
        torques=("joint_torque_measured", "joint_torque_commanded"),
        on_top=on_top,
        gravity=gravity,
    )


def iiwa_command(fields: Fields = ("joint_position",), *, channel: str = "IIWA_COMMAND") -> LcmMap:
    """Return a map for the actuator commands to a KUKA iiwa.

    The arm needs positions in position mode, torques in torque-only mode, and both in impedance mode. It adds the
    torques to its gravity compensation: an arm at rest needs a torque of 0, not one against its weight.

    Args:
        fields: By signal, the field of `lcmt_iiwa_command` that holds it: ``joint_position`` in rad, ``joint_torque``
            in N m. A field without a command is empty in the message. A sequence, if signals and fields have the same
            names.
        channel: Name of the channel.

    Raises:
        ValueError: There is no such field.
    """
    return vector_map(channel, lcmt_iiwa_command, same_names(fields))
