"""What the maps of arms and grippers share: fields by signal, and torques on top of an arm's gravity compensation.

The signals have the conventions of a plant: torques are positive where they accelerate a joint in its positive
direction, external torques act from the environment on the joints, lengths are in m. The messages have the conventions
of the drivers (``manipulation/README.md`` of Drake, whose simulated drivers follow them, too), see the modules
`iiwa_messages`, `panda_messages` and `wsg_messages` beside this one.

Both arms carry their weight themselves, and a torque command is what comes on top. What a command has to continue when
it takes over is the torque that acts then on top of the gravity compensation: the arguments ``on_top`` and ``gravity``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.failures import FAILURES
from vtbdrake.lcm.maps import Decoder, Encoder, LcmMap, vector_map
from vtbdrake.lcm.messages import MalformedError
from vtbdrake.testbed import Signal

Fields = Mapping[str, str] | Sequence[str]
"""Fields of a message by signal; a sequence, if signals and fields have the same names."""

Gravity = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""An arm's gravity compensation: torques in N m, as a function of the joint positions in rad."""


@dataclass(frozen=True, kw_only=True)
class OnTopOfGravityMap(LcmMap):
    """An `LcmMap` of an arm's state with torques on top of the arm's gravity compensation.

    From a message with the positions q and the torques tau, the signals get tau - g(q), where g is the gravity
    compensation.

    Attributes:
        whole: The map of the same messages with tau in place of tau - g(q), and with the positions.
        position: The name of q in ``whole``.
        on_top: By signal, the name in ``whole`` of the tau that it is a part of.
        gravity: g, as a function of q.
    """

    whole: LcmMap = field(repr=False)
    position: str
    on_top: Mapping[str, str]
    gravity: Gravity = field(repr=False)

    def decoder(self, signals: Sequence[Signal]) -> Decoder:
        size, whole = self._sizes(signals)
        decode_whole = self.whole.decoder(whole)

        def decode_on_top(data: bytes) -> tuple[float, Mapping[str, Any]]:
            sent, values = decode_whole(data)
            if len(values[self.position]) != size:
                raise MalformedError("size")
            weight = self.gravity(values[self.position])
            parts = {name: values[torque] - weight for name, torque in self.on_top.items()}
            return sent, {name: parts[name] if name in parts else values[name] for name in self.signals}

        return decode_on_top

    def encoder(self, signals: Sequence[Signal]) -> Encoder:
        _, whole = self._sizes(signals)
        if self.position not in self.signals:
            raise ValueError(
                f"channel {self.channel} sends {', '.join(self.on_top)} with the gravity compensation, which follows "
                "from the measured positions: let a signal hold them, too"
            )
        encode_whole = self.whole.encoder(whole)

        def encode_on_top(values: Mapping[str, Any], utime: int) -> bytes:
            weight = self.gravity(np.asarray(values[self.position], dtype=float))
            # Where a signal holds the whole torque, that is sent.
            sums = {torque: values[name] + weight for name, torque in self.on_top.items()}
            return encode_whole({**sums, **{name: values[name] for name in values if name not in self.on_top}}, utime)

        return encode_on_top

    def _sizes(self, signals: Sequence[Signal]) -> tuple[int, list[Signal]]:
        """Return the number of joints, and the signals of ``whole``; raise ValueError if the gravity does not fit."""
        by_name = {signal.name: signal for signal in signals}
        (size, *other_sizes) = {by_name[name].size for name in self.on_top}
        if other_sizes or size is None:
            raise ValueError(f"signals {', '.join(self.on_top)} on channel {self.channel} are vectors of one size")
        try:
            shape = np.shape(self.gravity(np.zeros(size)))
        except FAILURES as error:
            raise ValueError(f"the gravity of channel {self.channel} cannot take {size} positions: {error}") from error
        if shape != (size,):
            raise ValueError(f"the gravity of channel {self.channel} has the shape {shape}, not ({size},)")
        return size, [by_name.get(name) or Signal(name, size=size) for name in self.whole.signals]


def arm_status(
    channel: str,
    message_type: Any,
    fields: Mapping[str, str],
    *,
    signs: Mapping[str, float],
    position: str,
    torques: Sequence[str],
    on_top: Mapping[str, str] | None,
    gravity: Gravity | None,
) -> LcmMap:
    """Return the map of an arm's state.

    Args:
        channel: Name of the channel.
        message_type: Type of the messages.
        fields: Field by signal.
        signs: Factor from message to signal by field, where it is not 1.
        position: The field of the measured positions.
        torques: The fields of torques that include the gravity compensation.
        on_top: Field by signal, see `vtbdrake.lcm.iiwa_status`.
        gravity: See `vtbdrake.lcm.iiwa_status`.
    """
    if not on_top:
        return vector_map(channel, message_type, fields, scale=by_signal(signs, fields))
    if gravity is None:
        raise ValueError(f"channel {channel} needs gravity= for torques on top of it ({', '.join(on_top)})")
    for name, path in on_top.items():
        if path not in torques or name in fields:
            raise ValueError(
                f"signal {name} on channel {channel} is either in fields, or the part of {' or '.join(torques)} on top "
                f"of the gravity compensation, not of {path!r}"
            )
    by_field = {path: name for name, path in fields.items()}
    internal = {path: by_field.get(path, f"{path}@{channel}") for path in (position, *on_top.values())}
    whole_fields = {**fields, **{name: path for path, name in internal.items()}}
    whole = vector_map(channel, message_type, whole_fields, scale=by_signal(signs, whole_fields))
    return OnTopOfGravityMap(
        channel=channel,
        type=message_type,
        signals=(*fields, *on_top),
        whole=whole,
        position=internal[position],
        on_top={name: internal[path] for name, path in on_top.items()},
        gravity=gravity,
    )


def same_names(fields: Fields) -> Mapping[str, str]:
    """Return the fields by signal."""
    return fields if isinstance(fields, Mapping) else {name: name for name in fields}


def by_signal(factors: Mapping[str, float], fields: Mapping[str, str]) -> dict[str, float]:
    """Return the factors, which are given by field, by signal.

    Args:
        factors: Factors by field of the message; fields of no signal are left out.
        fields: The field of the message that carries each signal.
    """
    return {name: factors[path] for name, path in fields.items() if path in factors}
