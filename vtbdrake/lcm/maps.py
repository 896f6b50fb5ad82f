"""Which signals travel in which messages: maps between LCM channels and the signals of a DPS."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import nan
from typing import Any, NamedTuple

from vtbdrake.control.kernels import ReceivedSignal
from vtbdrake.control.ranges import Range
from vtbdrake.lcm.messages import MessageDecoder, MessageEncoder
from vtbdrake.lcm.wire import decode
from vtbdrake.testbed import Signal

LONGEST_CHANNEL_NAME = 63
"""LCM_MAX_CHANNEL_NAME_LENGTH: what the udpm protocol allows."""


class Sample(NamedTuple):
    """What one message says.

    Attributes:
        sent: the sender's time, in seconds; NaN if the message does not tell.
        values: the value of each signal in it, by name.
    """

    sent: float
    values: Mapping[str, Any]


Reader = Callable[[bytes], Sample]
Writer = Callable[[Mapping[str, Any], int], bytes]


def never_sent(message: Any) -> float:
    """The time in a message that has none."""
    return nan


@dataclass(frozen=True, kw_only=True)
class LcmMap:
    """One channel, the type of its messages, and how they become values of signals and the reverse.

    `vector_map` makes one for messages of numbers, `iiwa_status` and others for known types; this one is for all else::

        LcmMap(channel="GOAL", type=pose_t, signals=("goal",), decode=lambda message: {"goal": to_pose(message)})

    Attributes:
        channel: its name.
        type: a class made by lcm-gen.
        signals: the names of the signals that travel in it.
        decode: the values of the signals, by name, from a message; needed to receive. An array of the signal's size, or
            an object of an abstract signal's type. It raises `MalformedError` to reject a message for a reason.
        encode: a message from the values that are to be sent and the time in microseconds; needed to send. It raises
            LookupError if the message makes no sense without a signal that is missing.
        sent: the sender's time in a message, in seconds; NaN if it has none.
    """

    channel: str
    type: Any
    signals: Sequence[str]
    decode: Callable[[Any], Mapping[str, Any]] | None = None
    encode: Callable[[Mapping[str, Any], int], Any] | None = None
    sent: Callable[[Any], float] = never_sent

    def __post_init__(self) -> None:
        object.__setattr__(self, "signals", tuple(self.signals))
        if not 0 < len(self.channel.encode()) <= LONGEST_CHANNEL_NAME:
            raise ValueError(
                f"an LCM channel's name has 1 to {LONGEST_CHANNEL_NAME} bytes, not {len(self.channel.encode())}: "
                f"{self.channel!r}"
            )
        if not callable(getattr(self.type, "_get_packed_fingerprint", None)):
            raise ValueError(f"channel {self.channel}: {self.type!r} is no class made by lcm-gen")
        if not self.signals or len(set(self.signals)) < len(self.signals):
            raise ValueError(f"channel {self.channel} carries at least one signal, each once, not {self.signals}")

    def reader(self, signals: Sequence[Signal]) -> Reader:
        """What makes a `Sample` of a message's bytes; ``signals`` are those of this map, in its order.

        Raises:
            ValueError: the message type cannot carry them.
        """
        to_values = self.decode
        if to_values is None:
            raise ValueError(f"the map of channel {self.channel} has no decode=: it cannot receive")

        def read(data: bytes) -> Sample:
            message = decode(self.type, data)
            return Sample(self.sent(message), to_values(message))

        return read

    def intake(
        self, signals: Sequence[Signal], receptions: Sequence[ReceivedSignal], example: bytes
    ) -> MessageDecoder | None:
        """What takes in messages that are laid out like an accepted one, quickly; None if there is no such way.

        Args:
            signals: those of this map, in its order.
            receptions: theirs.
            example: a message that `reader` could read.
        """
        return None

    def form(self, signals: Sequence[Signal], ranges: Mapping[str, Range] | None = None) -> MessageEncoder | None:
        """What writes messages with all of ``signals``, quickly; None if there is no such way.

        Args:
            signals: some of this map, in its order.
            ranges: theirs, if what is not within them is not to be written.
        """
        return None

    def writer(self, signals: Sequence[Signal]) -> Writer:
        """What makes a message's bytes of values, by name, and the time in microseconds.

        Raises:
            ValueError: the message type cannot carry the signals.
        """
        to_message = self.encode
        if to_message is None:
            raise ValueError(f"the map of channel {self.channel} has no encode=: it cannot send")
        return lambda values, utime: bytes(to_message(values, utime).encode())
