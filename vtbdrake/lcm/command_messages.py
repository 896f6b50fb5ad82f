"""Messages by which planners and operators command a DPS: they name their sender."""

from __future__ import annotations

import time

from numpy.typing import ArrayLike

from vtbdrake.common.argument_checks import as_array
from vtbdrake.control.message_order import LONGEST_SENDER
from vtbdrake.lcm.lcm_types.lcmt_vtb_command import lcmt_vtb_command
from vtbdrake.lcm.maps import VectorMap, vector_map

# The time of day minus the time of the monotonic clock, in microseconds: a clock that is set does not change the order.
_EPOCH = (time.time_ns() - time.monotonic_ns()) // 1000


def command_map(channel: str, command: str) -> VectorMap:
    """Return a map for a command u in messages that name their sender, for `Protocol.commands`.

    Several senders may command the same: the newest message counts, and the order of each sender is kept (see
    `LcmBridge`). `command_message` makes the messages; in other languages, ``lcm-gen`` makes their type from
    ``vtbdrake/lcm/lcm_types/vtb_command.lcm``.

    Args:
        channel: Name of the channel.
        command: Name of the command u.
    """
    return vector_map(channel, lcmt_vtb_command, {command: "value"}, sender="sender")


def command_message(value: ArrayLike, *, sender: str, utime: int | None = None) -> bytes:
    """Return a message for `command_map`, to be published on its channel.

    Args:
        value: The value of the command u, shape (size,).
        sender: Who commands, such as ``"planner"``: one name per process that publishes on the channel.
        utime: The time on the sender's clock in microseconds; by default now, on a clock that never goes back.

    Raises:
        ValueError: The value is no vector of numbers, or the sender's name is empty or longer than 64 characters.
    """
    vector = as_array("the value of a command", value)
    if vector.ndim != 1:
        raise ValueError(f"the value of a command is a vector, not of shape {vector.shape}")
    if not 0 < len(sender) <= LONGEST_SENDER:
        raise ValueError(f"a sender's name has 1 to {LONGEST_SENDER} characters, not {len(sender)}: {sender[:80]!r}")
    message = lcmt_vtb_command()
    message.utime = _EPOCH + time.monotonic_ns() // 1000 if utime is None else utime
    message.sender, message.size, message.value = sender, len(vector), vector.tolist()
    return bytes(message.encode())
