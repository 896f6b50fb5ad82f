"""Maps between LCM channels and signals: which signals travel in which messages, and how they are coded."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from math import nan, prod
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from vtbdrake.lcm.messages import MalformedError, MessageDecoder, MessageEncoder
from vtbdrake.testbed import Signal

LONGEST_CHANNEL_NAME = 63
"""LCM_MAX_CHANNEL_NAME_LENGTH, in bytes: what the udpm protocol allows."""

Decoder = Callable[[bytes], tuple[float, Mapping[str, Any]]]
"""Returns the sender's time of a message in seconds (NaN if it has none) and its values by signal."""

Encoder = Callable[[Mapping[str, Any], int], bytes]
"""Returns the message with values by signal and the time in microseconds."""

_CODES = {
    "int8_t": "b",
    "int16_t": "h",
    "int32_t": "i",
    "int64_t": "q",
    "float": "f",
    "double": "d",
    "boolean": "?",
}  # LCM's types of numbers, as `struct` calls them


def decode(message_type: Any, data: bytes) -> Any:
    """Decode one message strictly: all of it, and nothing else.

    Args:
        message_type: a class made by lcm-gen.
        data: the bytes of the message.

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

    `vector_map` makes one for messages of numbers, `vtbdrake.lcm.drake_messages` some for Drake's message types. For
    everything else, give functions from and to message objects::

        LcmMap(channel="GOAL", type=pose_t, signals=("goal",), decode=lambda message: {"goal": to_pose(message)})

    Attributes:
        channel: name of the channel.
        type: class made by lcm-gen.
        signals: names of the signals that travel in the messages.
        decode: returns the values by signal from a message; required for receiving. A value is an array of the
            signal's size, or an object of an abstract signal's type. Raises `MalformedError` to reject the message.
        encode: returns a message from values by signal and the time in microseconds; required for sending. Raises
            LookupError if the message makes no sense without a signal that is missing.
        sent: returns the sender's time in a message, in seconds; NaN if it has none.
    """

    channel: str
    type: Any
    signals: Sequence[str]
    decode: Callable[[Any], Mapping[str, Any]] | None = None
    encode: Callable[[Mapping[str, Any], int], Any] | None = None
    sent: Callable[[Any], float] = no_time

    def __post_init__(self) -> None:
        object.__setattr__(self, "signals", tuple(self.signals))
        size = len(self.channel.encode())
        if not 0 < size <= LONGEST_CHANNEL_NAME:
            raise ValueError(
                f"an LCM channel's name has 1 to {LONGEST_CHANNEL_NAME} bytes, not {size}: {self.channel!r}"
            )
        if not callable(getattr(self.type, "_get_packed_fingerprint", None)):
            raise ValueError(f"channel {self.channel}: {self.type!r} is no class made by lcm-gen")
        if not self.signals or len(set(self.signals)) < len(self.signals):
            raise ValueError(f"channel {self.channel} carries at least one signal, each once, not {self.signals}")

    def decoder(self, signals: Sequence[Signal]) -> Decoder:
        """Return the decoder of this channel's messages.

        Args:
            signals: the signals of this map, in its order.

        Raises:
            ValueError: the message type cannot carry them.
        """
        to_values = self.decode
        if to_values is None:
            raise ValueError(f"the map of channel {self.channel} has no decode=: it cannot receive")

        def decode_message(data: bytes) -> tuple[float, Mapping[str, Any]]:
            message = decode(self.type, data)
            return self.sent(message), to_values(message)

        return decode_message

    def encoder(self, signals: Sequence[Signal]) -> Encoder:
        """Return the encoder of this channel's messages.

        Args:
            signals: the signals of this map, in its order.

        Raises:
            ValueError: the message type cannot carry them.
        """
        to_message = self.encode
        if to_message is None:
            raise ValueError(f"the map of channel {self.channel} has no encode=: it cannot send")
        return lambda values, utime: bytes(to_message(values, utime).encode())


class Field(NamedTuple):
    """A field of a message type.

    Attributes:
        path: its name; dotted if it lies in a message within the message.
        typename: its type in LCM.
        dimensions: its shape; the path of another field where that field holds the size. Empty for a scalar.
    """

    path: str
    typename: str
    dimensions: tuple[int | str, ...]

    @property
    def code(self) -> str:
        """The type as `struct` calls it: a byte is an integer, ``s`` a string; empty for other messages."""
        return {"byte": "b", "string": "s"}.get(self.typename) or _CODES.get(self.typename, "")

    @property
    def length(self) -> str:
        """The path of the field that holds a size of this one; empty if its dimensions are fixed."""
        return next((size for size in self.dimensions if isinstance(size, str)), "")

    @property
    def shape(self) -> tuple[int, ...]:
        """The fixed dimensions."""
        return tuple(size for size in self.dimensions if isinstance(size, int))


def _fields(message: Any, prefix: str = "") -> list[Field]:
    """Return all fields of a message and of the messages within it, in the order of encoding."""
    found = []
    kind = type(message)
    for name, typename, dimensions in zip(kind.__slots__, kind.__typenames__, kind.__dimensions__, strict=True):
        sizes = tuple(prefix + size if isinstance(size, str) else size for size in dimensions or ())
        found.append(Field(prefix + name, typename, sizes))
        if hasattr(getattr(message, name), "__typenames__"):
            found += _fields(getattr(message, name), f"{prefix}{name}.")
    return found


def _owner(message: Any, path: str) -> tuple[Any, str]:
    """Return the message within ``message`` that has the field at ``path``, and the field's name there."""
    parents, _, name = path.rpartition(".")
    return (attrgetter(parents)(message) if parents else message), name


@dataclass(frozen=True, kw_only=True)
class VectorMap(LcmMap):
    """An `LcmMap` of vector signals; `vector_map` makes one.

    Attributes:
        fields: by signal, the fields that hold its entries, one after the other.
        stamp: path of the field with the sender's time in microseconds; empty if there is none.
    """

    fields: Mapping[str, Sequence[Field]]
    stamp: str = ""

    def decoder(self, signals: Sequence[Signal]) -> Decoder:
        self._check(signals)
        layout = self._layout(self.signals)
        return super().decoder(signals) if layout is None else MessageDecoder(*layout).decode

    def encoder(self, signals: Sequence[Signal]) -> Encoder:
        self._check(signals)
        general = super().encoder(signals)
        if self._layout(()) is None:
            return general
        sizes = {signal.name: signal.size or 0 for signal in signals}
        encoders: dict[tuple[str, ...], MessageEncoder] = {}  # by the signals in the message

        def encode(values: Mapping[str, Any], utime: int) -> bytes:
            names = tuple(values)
            if names not in encoders:
                example = general({name: np.zeros(sizes[name]) for name in names}, 0)
                encoders[names] = MessageEncoder(*(self._layout(names) or ()), example=example)
            return encoders[names].encode(values, utime)

        return encode

    def _check(self, signals: Sequence[Signal]) -> None:
        """Raise ValueError if a signal is abstract, or not of the size of its fields."""
        lengths: dict[str, Signal] = {}
        for signal in signals:
            if signal.size is None:
                raise ValueError(f"signal {signal.name} is abstract; channel {self.channel} carries vectors")
            fields = self.fields[signal.name]
            if length := fields[0].length:
                other = lengths.setdefault(length, signal)
                if other.size != signal.size:
                    raise ValueError(
                        f"signals {other.name} and {signal.name} have {other.size} and {signal.size} entries, but "
                        f"field {length} of {self.type.__name__} is the length of both"
                    )
            elif signal.size != (size := sum(prod(field.shape) for field in fields)):
                paths = ", ".join(field.path for field in fields)
                raise ValueError(
                    f"signal {signal.name} has {signal.size} entries, but {paths} of {self.type.__name__} on channel "
                    f"{self.channel} has {size}"
                )

    def _layout(self, names: Sequence[str]) -> tuple[Any, ...] | None:
        """Return the arguments of `MessageDecoder` and `MessageEncoder` for a message with the signals ``names``.

        None if messages of this type can hold arrays of strings or of messages: lcm-gen's code handles those.
        """
        fields = []
        for field in _fields(self.type()):
            if field.code and not (field.code == "s" and field.dimensions):
                fields.append((field.path, field.code, field.dimensions))
            elif field.dimensions:
                return None
        signals = {name: [field.path for field in self.fields[name]] for name in names}
        return self.type._get_packed_fingerprint(), fields, signals, self.stamp


def vector_map(
    channel: str, message_type: Any, fields: Mapping[str, str | Sequence[str]], *, stamp: str = "utime"
) -> VectorMap:
    """Return a map for messages whose signals are fields of numbers.

    Args:
        channel: name of the channel.
        message_type: class made by lcm-gen.
        fields: by signal, the field that holds it: a number or an array. Several fields, if its entries are spread
            over them. Dotted names reach into messages within the message.
        stamp: field with the sender's time in microseconds; empty if there is none: late and repeated messages then
            count as new ones.

    Raises:
        ValueError: there is no such field, or it does not hold numbers.
    """
    known = {field.path: field for field in _fields(message_type())}
    found: dict[str, list[Field]] = {}
    for name, paths in fields.items():
        found[name] = [
            _number_field(message_type, known, path) for path in ([paths] if isinstance(paths, str) else paths)
        ]
        if len(found[name]) > 1 and any(field.length for field in found[name]):
            raise ValueError(
                f"signal {name} on channel {channel} cannot be spread over {', '.join(paths)}: an array of variable "
                "length carries a signal alone"
            )
    if stamp and _number_field(message_type, known, stamp).dimensions:
        raise ValueError(f"field {stamp} of {message_type.__name__} is no time; give stamp='' if there is none")

    def to_values(message: Any) -> dict[str, np.ndarray]:
        return {
            name: np.concatenate([np.ravel(np.asarray(attrgetter(field.path)(message), float)) for field in parts])
            for name, parts in found.items()
        }

    return VectorMap(
        channel=channel,
        type=message_type,
        signals=tuple(found),
        decode=to_values,
        encode=lambda values, utime: _compose(message_type(), found, values, stamp, utime),
        sent=(lambda message: attrgetter(stamp)(message) * 1e-6) if stamp else no_time,
        fields=found,
        stamp=stamp,
    )


def _number_field(message_type: Any, known: Mapping[str, Field], path: str) -> Field:
    if path not in known:
        fields = ", ".join(message_type.__slots__)
        raise ValueError(f"{message_type.__name__} has no field {path!r}; it has {fields}")
    field = known[path]
    if field.typename not in _CODES or (field.length and len(field.dimensions) > 1):
        shape = "".join(f"[{dimension}]" for dimension in field.dimensions)
        raise ValueError(
            f"field {path} of {message_type.__name__} is a {field.typename}{shape}: a vector signal travels in "
            "numbers, in arrays of fixed dimensions, or in an array of one dimension; write an LcmMap for it"
        )
    return field


def _compose(
    message: Any, fields: Mapping[str, Sequence[Field]], values: Mapping[str, Any], stamp: str, utime: int
) -> Any:
    """Set values, by signal, and the time in a new message: fields of missing signals stay zero or empty.

    Raises:
        LookupError: the message cannot leave out a signal that is missing.
    """
    if stamp:
        owner, name = _owner(message, stamp)
        setattr(owner, name, utime)
    for signal, value in values.items():
        numbers = np.asarray(value, dtype=float)
        for field in fields[signal]:
            owner, name = _owner(message, field.path)
            shape = numbers.shape if field.length else field.shape
            part, numbers = numbers[: prod(shape)].reshape(shape), numbers[prod(shape) :]
            if field.length:
                _set_length(message, field.length, part.size)
            setattr(owner, name, (part if field.code in "df" else np.vectorize(round, otypes="O")(part)).tolist())
    for signal in fields.keys() - values.keys():
        for field in fields[signal]:
            if not field.length or attrgetter(field.length)(message):
                raise LookupError(signal)
    return message


def _set_length(message: Any, length: str, size: int) -> None:
    """Set a length, and fill all arrays of that length with zeros unless they have it already."""
    owner, name = _owner(message, length)
    setattr(owner, name, size)
    for field in _fields(message):
        if field.dimensions == (length,) and field.typename in _CODES:
            owner, name = _owner(message, field.path)
            if len(getattr(owner, name)) != size:
                setattr(owner, name, [0] * size)
