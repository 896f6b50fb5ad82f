"""Ready-made maps for the messages of a Schunk WSG gripper: lengths in mm, and a force whose sign means nothing."""

from __future__ import annotations

from drake import lcmt_schunk_wsg_command, lcmt_schunk_wsg_status

from vtbdrake.lcm.driver_conventions import Fields, by_signal, same_names
from vtbdrake.lcm.maps import LcmMap, vector_map

_UNITS = {"actual_position_mm": 1e-3, "actual_speed_mm_per_s": 1e-3, "target_position_mm": 1e-3}


def wsg_status(fields: Fields, *, channel: str = "SCHUNK_WSG_STATUS") -> LcmMap:
    """Return a map for the state of a Schunk WSG gripper.

    The signals are in m and m/s, the message is in mm. Its force has no reliable sign: take the absolute value.

    Args:
        fields: By signal, the field of `lcmt_schunk_wsg_status` that holds it: ``actual_position_mm`` and
            ``actual_speed_mm_per_s`` of the fingers' distance, ``actual_force`` in N. A sequence, if signals and fields
            have the same names.
        channel: Name of the channel.

    Raises:
        ValueError: There is no such field.
    """
    fields = same_names(fields)
    return vector_map(channel, lcmt_schunk_wsg_status, fields, scale=by_signal(_UNITS, fields))


def wsg_command(
    fields: Fields = ("target_position_mm",), *, force: float | None = None, channel: str = "SCHUNK_WSG_COMMAND"
) -> LcmMap:
    """Return a map for the actuator commands to a Schunk WSG gripper.

    Args:
        fields: By signal, the field of `lcmt_schunk_wsg_command` that holds it: ``target_position_mm``, the distance of
            the fingers (the signal is in m), and ``force``, its largest force in N. A sequence, if signals and fields
            have the same names.
        force: The largest force in N where no signal holds it.
        channel: Name of the channel.

    Raises:
        ValueError: There is no such field, or the force is given twice or never.
    """
    fields = same_names(fields)
    if ("force" in fields.values()) == (force is not None):
        raise ValueError("a gripper is commanded with one largest force: by a signal of the field force, or by force=")
    constants = {} if force is None else {"force": force}
    return vector_map(channel, lcmt_schunk_wsg_command, fields, scale=by_signal(_UNITS, fields), constants=constants)
