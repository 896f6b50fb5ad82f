"""Maps between LCM channels and signals: which messages carry which signals, and how they are coded."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from io import BytesIO
from math import isfinite, nan, prod
from operator import attrgetter
from typing import Any, NamedTuple

from vtbdrake.lcm.messages import MalformedError, MessageDecoder, MessageEncoder
from vtbdrake.testbed import Signal

LONGEST_CHANNEL_NAME = 63
"""LCM_MAX_CHANNEL_NAME_LENGTH, in bytes: what the udpm protocol allows."""

Decoder = Callable[[bytes], tuple[float, Mapping[str, Any]]]
"""Returns the sender's time of a message in seconds (NaN if it has none) and its values by signal."""

Encoder = Callable[[Mapping[str, Any], int], bytes]
"""Returns the message with values by signal and the time in microseconds."""

_NUMBERS = {
    "int8_t": "b",
    "int16_t": "h",
    "int32_t": "i",
    "int64_t": "q",
    "float": "f",
    "double": "d",
    "boolean": "?",
}  # LCM's types of numbers, as `struct` calls them
_CODES = _NUMBERS | {"byte": "b", "string": "s"}


def decode(message_type: Any, data: bytes) -> Any:
    """Decode one message strictly: all of it, and nothing else.

    Args:
        message_type: The class of the message, as lcm-gen made it.
        data: The bytes of the message.

    Raises:
        MalformedError: ``fingerprint``: the message is of another type; ``truncated``: its end is missing;
            ``trailing``: bytes follow it; ``size``: an array has an impossible length.
    """
    fingerprint = message_type._get_packed_fingerprint()
    if len(data) < len(fingerprint):
        raise MalformedError("truncated")
    if not data.startswith(fingerprint):
        raise MalformedError("fingerprint")
    stream = _StrictStream(data)
    message = message_type.decode(stream)
    if stream.tell() != len(data):
        raise MalformedError("trailing")
    return message


class _StrictStream(BytesIO):
    """A stream that raises where the decoders of lcm-gen accept strings and byte arrays that are cut off.

    It also limits the number of empty reads: a message can announce an array of 2**31 empty rows.
    """

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self._empty_reads = len(data)

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or size < 0:
            raise MalformedError("size")
        chunk = super().read(size)
        if len(chunk) != size:
            raise MalformedError("truncated")
        if not size:
            self._empty_reads -= 1
            if self._empty_reads < 0:
                raise MalformedError("size")
        return chunk


def no_time(message: Any) -> float:
    """Return the time of a message that has none: NaN."""
    return nan


@dataclass(frozen=True, kw_only=True)
class LcmMap:
    """One channel, the type of its messages, and how they become values of signals and the reverse.

    `vector_map` makes one for messages of numbers, `vtbdrake.lcm.iiwa_messages` and its neighbours some
    for Drake's message types. For everything else, give functions from and to message objects::

        LcmMap(channel="GOAL", type=pose_t, signals=("goal",), decode=lambda message: {"goal": to_pose(message)})

    Attributes:
        channel: Name of the channel.
        type: Class made by lcm-gen.
        signals: Names of the signals that the messages carry.
        decode: Returns the values by signal from a message; required for receiving. A value is an array of the
            signal's size, or an object of an abstract signal's type. Raises `MalformedError` to reject the message.
        encode: Returns a message from values by signal and the time in microseconds; required for sending. Raises
            LookupError if the message makes no sense without a signal that is missing.
        sent: Returns the sender's time in a message, in seconds; NaN if it has none.
        sender: Returns the name of a message's sender, an empty one if it has none; None if no message names it. It
            matters for commands u, which several may send, see `LcmBridge`.
    """

    channel: str
    type: Any
    signals: Sequence[str]
    decode: Callable[[Any], Mapping[str, Any]] | None = dataclasses.field(default=None, repr=False)
    encode: Callable[[Mapping[str, Any], int], Any] | None = dataclasses.field(default=None, repr=False)
    sent: Callable[[Any], float] = dataclasses.field(default=no_time, repr=False)
    sender: Callable[[Any], str] | None = dataclasses.field(default=None, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "signals", tuple(self.signals))
        size = len(self.channel.encode())
        if not 0 < size <= LONGEST_CHANNEL_NAME:
            raise ValueError(
                f"an LCM channel's name has 1 to {LONGEST_CHANNEL_NAME} bytes, not {size}: {self.channel!r}"
            )
        _check_type(self.channel, self.type)
        if not self.signals or len(set(self.signals)) < len(self.signals):
            raise ValueError(f"channel {self.channel} carries at least one signal, each once, not {self.signals}")

    def decoder(self, signals: Sequence[Signal]) -> Decoder:
        """Return the decoder of this channel's messages.

        Args:
            signals: The signals of this map, in its order.

        Raises:
            ValueError: The message type cannot carry them.
        """
        to_values = self.decode
        if to_values is None:
            raise ValueError(f"the map of channel {self.channel} has no decode=: it cannot receive")

        def decode_message(data: bytes) -> tuple[float, Mapping[str, Any]]:
            message = decode(self.type, data)
            return self.sent(message), to_values(message)

        return decode_message

    def sender_of(self, data: bytes) -> str:
        """Return the name of a message's sender; empty if it names none.

        Raises:
            MalformedError: The message is not of this channel's type.
        """
        return "" if self.sender is None else self.sender(decode(self.type, data))

    def encoder(self, signals: Sequence[Signal]) -> Encoder:
        """Return the encoder of this channel's messages; see `decoder`."""
        to_message = self.encode
        if to_message is None:
            raise ValueError(f"the map of channel {self.channel} has no encode=: it cannot send")
        return lambda values, utime: bytes(to_message(values, utime).encode())

    def age(self, values: Mapping[str, Any], time: float) -> float:
        """Return the age of values in seconds, by which the time stamp of their message precedes the sending.

        It is 0 by default: most values have no time of their own.

        Args:
            values: The values by signal, which are about to be sent by a simulated machine.
            time: Time in that machine's world in seconds.
        """
        return 0.0


class Field(NamedTuple):
    """A field of a message type.

    Attributes:
        path: Its name; dotted if it lies in a message within the message.
        typename: Its type in LCM.
        dimensions: Its shape; the path of another field where that field holds the size. Empty for a scalar.
        members: The fields of a message within the message.
    """

    path: str
    typename: str
    dimensions: tuple[int | str, ...] = ()
    members: tuple[Field, ...] = ()

    @property
    def code(self) -> str:
        """Return the type as `struct` calls it; ``s`` for a string, ``{`` for a message."""
        return _CODES.get(self.typename, "{")

    @property
    def length(self) -> str:
        """Return the path of the field that holds a size of this one; empty if its dimensions are fixed."""
        return next((size for size in self.dimensions if isinstance(size, str)), "")

    @property
    def size(self) -> int:
        """Return the count of numbers in the field if its dimensions are fixed."""
        return prod(size for size in self.dimensions if isinstance(size, int))


def _check_type(channel: str, message_type: Any) -> None:
    if not callable(getattr(message_type, "_get_packed_fingerprint", None)):
        raise ValueError(f"channel {channel}: {message_type!r} is no class made by lcm-gen")


def _fields(message_type: Any, prefix: str = "") -> tuple[Field, ...]:
    fields = []
    for name, typename, dimensions in zip(
        message_type.__slots__, message_type.__typenames__, message_type.__dimensions__, strict=True
    ):
        sizes = tuple(prefix + size if isinstance(size, str) else size for size in dimensions or ())
        members: tuple[Field, ...] = ()
        if typename not in _CODES:
            package, _, own_name = typename.rpartition(".")
            members = _fields(getattr(import_module(package or own_name), own_name), f"{prefix}{name}.")
        fields.append(Field(prefix + name, typename, sizes, members))
    return tuple(fields)


def _by_path(fields: Sequence[Field]) -> dict[str, Field]:
    """Return all fields that occur exactly once in every message."""
    by_path = {}
    for field in fields:
        by_path[field.path] = field
        if not field.dimensions:
            by_path |= _by_path(field.members)
    return by_path


@dataclass(frozen=True, kw_only=True)
class VectorMap(LcmMap):
    """An `LcmMap` of vector signals; `vector_map` makes one.

    Attributes:
        parts: By signal, the fields that hold its entries, one after the other.
        fields: All fields of the message type.
        stamp: Path of the field with the sender's time in microseconds; empty if there is none.
        scale: By signal, the factor from the numbers in the message to the values; 1 for the others.
        constants: Numbers that are the same in every message, by path.
    """

    parts: Mapping[str, Sequence[Field]] = dataclasses.field(repr=False)
    fields: Sequence[Field] = dataclasses.field(repr=False)
    stamp: str = ""
    scale: Mapping[str, float] = dataclasses.field(default_factory=dict, repr=False)
    constants: Mapping[str, float] = dataclasses.field(default_factory=dict, repr=False)

    def decoder(self, signals: Sequence[Signal]) -> Decoder:
        self._check(signals)
        return MessageDecoder(*self._layout(self.signals)).decode

    def encoder(self, signals: Sequence[Signal]) -> Encoder:
        self._check(signals)
        sizes = {signal.name: signal.size or 0 for signal in signals}

        def encoder_of(names: tuple[str, ...]) -> MessageEncoder:
            example = self._example({name: sizes[name] for name in names})
            return MessageEncoder(*self._layout(names), example=example)

        encoders = {tuple(sizes): encoder_of(tuple(sizes))}  # by the signals in the message

        def encode(values: Mapping[str, Any], utime: int) -> bytes:
            names = tuple(values)
            if names not in encoders:
                encoders[names] = encoder_of(names)
            return encoders[names].encode(values, utime)

        return encode

    def _layout(
        self, names: Sequence[str]
    ) -> tuple[bytes, Sequence[Field], dict[str, list[str]], str, Mapping[str, float]]:
        """Return the arguments of `MessageDecoder` and `MessageEncoder` for messages with these signals."""
        signals = {name: [field.path for field in self.parts[name]] for name in names}
        return self.type._get_packed_fingerprint(), self.fields, signals, self.stamp, self.scale

    def _example(self, sizes: Mapping[str, int]) -> bytes:
        """Return a message with signals of these sizes, in which all but constants and lengths of arrays is zero."""
        lengths = {self.parts[name][0].length: size for name, size in sizes.items()}
        for name in self.parts.keys() - sizes.keys():
            length = self.parts[name][0].length
            if not length or lengths.get(length):
                raise LookupError(name)
        return bytes(self.type._get_packed_fingerprint() + _zeros(self.fields, {**self.constants, **lengths}))

    def _check(self, signals: Sequence[Signal]) -> None:
        """Raise ValueError if a signal is abstract, or not of the size of its fields."""
        lengths: dict[str, Signal] = {}
        for signal in signals:
            if signal.size is None:
                raise ValueError(f"signal {signal.name} is abstract; channel {self.channel} carries vectors")
            parts = self.parts[signal.name]
            if length := parts[0].length:
                other = lengths.setdefault(length, signal)
                if other.size != signal.size:
                    raise ValueError(
                        f"signals {other.name} and {signal.name} have {other.size} and {signal.size} entries, but "
                        f"field {length} of {self.type.__name__} is the length of both"
                    )
            elif signal.size != (size := sum(field.size for field in parts)):
                paths = ", ".join(field.path for field in parts)
                raise ValueError(
                    f"signal {signal.name} has {signal.size} entries, but {paths} of {self.type.__name__} on channel "
                    f"{self.channel} has {size}"
                )


def _zeros(fields: Sequence[Field], numbers: Mapping[str, float]) -> bytes:
    """Return the bytes of these fields, in which all numbers but these (lengths and constants, by path) are zero."""
    data = b""
    for field in fields:
        count = prod(int(numbers.get(size, 0)) if isinstance(size, str) else size for size in field.dimensions)
        if field.code == "{":
            data += count * _zeros(field.members, numbers if not field.dimensions else {})
        elif field.code == "s":
            data += count * b"\0\0\0\1\0"
        else:
            data += struct.pack(f">{count}{field.code}", *[numbers.get(field.path, 0)] * count)
    return data


def vector_map(
    channel: str,
    message_type: Any,
    fields: Mapping[str, str | Sequence[str]],
    *,
    stamp: str = "utime",
    sender: str = "",
    scale: Mapping[str, float] | None = None,
    constants: Mapping[str, float] | None = None,
) -> VectorMap:
    """Return a map for messages whose signals are fields of numbers.

    Args:
        channel: Name of the channel.
        message_type: Class made by lcm-gen.
        fields: By signal, the field that holds it: a number or an array. Several fields, if its entries are spread
            over them. Dotted names reach into messages within the message.
        stamp: Field with the sender's time in microseconds; empty if there is none: late and repeated messages then
            count as new ones.
        sender: Field with the sender's name, a string; empty if there is none. For commands u that several may send.
        scale: By signal, the factor from the numbers in the message to the values of the signal: 1e-3 for a field in
            mm, -1 for a machine with the opposite sign. 1 for the others.
        constants: By field, a number that it holds in every message that is sent; other fields without a signal are
            zero.

    Raises:
        ValueError: There is no such field, it does not hold numbers or cannot hold a constant, or a factor is zero or
            not finite.
    """
    _check_type(channel, message_type)
    try:
        known_fields = _fields(message_type)
    except RecursionError:
        raise ValueError(f"{message_type.__name__} contains itself: write an LcmMap for it") from None
    fields_by_path = _by_path(known_fields)
    parts: dict[str, list[Field]] = {}
    for name, spec in fields.items():
        paths = [spec] if isinstance(spec, str) else spec
        parts[name] = [_number_field(message_type, fields_by_path, path) for path in paths]
        if len(paths) > 1 and any(field.length for field in parts[name]):
            raise ValueError(
                f"signal {name} on channel {channel} cannot be spread over {', '.join(paths)}: an array of variable "
                "length carries a signal alone"
            )
    if stamp and _number_field(message_type, fields_by_path, stamp).dimensions:
        raise ValueError(f"field {stamp} of {message_type.__name__} is no time; give stamp='' if there is none")
    if sender and (sender not in fields_by_path or fields_by_path[sender][1:3] != ("string", ())):
        raise ValueError(f"field {sender} of {message_type.__name__} is no string: it holds no sender's name")
    scale = dict(scale or {})
    for name, factor in scale.items():
        if name not in parts or not (isfinite(factor) and factor != 0.0):
            raise ValueError(
                f"scale maps signals of channel {channel} ({', '.join(parts)}) to finite factors other than zero, not "
                f"{name!r} to {factor!r}"
            )
    return VectorMap(
        channel=channel,
        type=message_type,
        signals=tuple(parts),
        parts=parts,
        fields=known_fields,
        stamp=stamp,
        sender=attrgetter(sender) if sender else None,
        scale=scale,
        constants=_constants(message_type, fields_by_path, constants or {}),
    )


def _constants(
    message_type: Any, fields_by_path: Mapping[str, Field], constants: Mapping[str, float]
) -> dict[str, float]:
    numbers: dict[str, float] = {}
    for path, number in constants.items():
        field = _number_field(message_type, fields_by_path, path)
        if field.dimensions or (field.typename not in ("float", "double") and number != int(number)):
            raise ValueError(f"field {path} of {message_type.__name__}, a {field.typename}, cannot hold {number!r}")
        numbers[path] = number if field.typename in ("float", "double") else int(number)
    return numbers


def _number_field(message_type: Any, fields_by_path: Mapping[str, Field], path: str) -> Field:
    if path not in fields_by_path:
        fields = ", ".join(message_type.__slots__)
        raise ValueError(f"{message_type.__name__} has no field {path!r}; it has {fields}")
    field = fields_by_path[path]
    if field.typename not in _NUMBERS or (field.length and len(field.dimensions) > 1):
        shape = "".join(f"[{dimension}]" for dimension in field.dimensions)
        raise ValueError(
            f"field {path} of {message_type.__name__} is a {field.typename}{shape}: fields of a vector signal are "
            "numbers, arrays of fixed dimensions, or an array of one dimension; write an LcmMap for it"
        )
    return field
