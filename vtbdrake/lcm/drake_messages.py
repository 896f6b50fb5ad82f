"""Ready-made maps for Drake's message types."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from drake import lcmt_iiwa_command, lcmt_iiwa_status

from vtbdrake.lcm.vectors import VectorMap, vector_map


def iiwa_status(fields: Mapping[str, str] | Sequence[str], *, channel: str = "IIWA_STATUS") -> VectorMap:
    """The state of an arm that speaks the iiwa messages, as the arm sends it.

    Args:
        fields: by signal, the field of `lcmt_iiwa_status` that it is: ``joint_position_measured``,
            ``joint_velocity_estimated``, ``joint_position_commanded``, ``joint_position_ipo`` in rad and rad/s;
            ``joint_torque_measured``, ``joint_torque_commanded`` (with the sign of the arm's own software, opposite to
            Drake's) and ``joint_torque_external`` in N m. A sequence, if signals and fields have the same names.
        channel: the channel's name.

    Raises:
        ValueError: there is no such field.
    """
    return vector_map(channel, lcmt_iiwa_status, _same_names(fields))


def iiwa_command(
    fields: Mapping[str, str] | Sequence[str] = ("joint_position",), *, channel: str = "IIWA_COMMAND"
) -> VectorMap:
    """Commands to an arm that speaks the iiwa messages.

    Args:
        fields: by signal, the field of `lcmt_iiwa_command` that it is: ``joint_position`` in rad, ``joint_torque`` in
            N m. One that is not commanded is empty in the message. A sequence, if signals and fields have the same
            names.
        channel: the channel's name.

    Raises:
        ValueError: there is no such field.
    """
    return vector_map(channel, lcmt_iiwa_command, _same_names(fields))


def _same_names(fields: Mapping[str, str] | Sequence[str]) -> Mapping[str, str]:
    return fields if isinstance(fields, Mapping) else {name: name for name in fields}
