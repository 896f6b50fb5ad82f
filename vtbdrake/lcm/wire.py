"""LCM messages as bytes: decoded strictly, and a quick way for messages that are numbers only."""

from __future__ import annotations

import struct
from io import BytesIO
from typing import Any, NamedTuple

FORMATS = {
    "int8_t": "b",
    "int16_t": "h",
    "int32_t": "i",
    "int64_t": "q",
    "float": "f",
    "double": "d",
    "boolean": "?",
}
"""Number types of LCM, and what `struct` calls them."""

_FINGERPRINT = 8  # bytes, with which every message begins


class MalformedError(ValueError):
    """A message that is not what its channel carries; ``reason`` is one of those that `ReceivedSignal` counts."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class _StrictReader(BytesIO):
    """Refuses what the decoders of lcm-gen let pass: byte arrays and strings that are cut off.

    A length is never believed before the bytes are there: an array of thousands of millions of empty rows would
    otherwise be read row by row.
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


def decode(message_type: Any, data: bytes) -> Any:
    """The message of ``message_type`` (a class made by lcm-gen) that ``data`` is, all of it and nothing else.

    Raises:
        MalformedError: ``fingerprint``: it is of another type; ``truncated``: its end is missing; ``trailing``: bytes
            follow it; ``size``: it names a length that it cannot have.
    """
    fingerprint = message_type._get_packed_fingerprint()
    if len(data) < len(fingerprint):
        raise MalformedError("truncated")
    if not data.startswith(fingerprint):
        raise MalformedError("fingerprint")
    reader = _StrictReader(data)
    message = message_type.decode(reader)
    if reader.tell() != len(data):
        raise MalformedError("trailing")
    return message


class Place(NamedTuple):
    """Where the numbers of a field lie in a message.

    Attributes:
        offset: of the first, in bytes.
        size: how many there are.
        code: their type, as `struct` calls it.
    """

    offset: int
    size: int
    code: str

    @property
    def end(self) -> int:
        return self.offset + self.size * struct.calcsize(f">{self.code}")


class Layout:
    """Where each number lies in messages of a type whose arrays are as long as an example's.

    Such messages are read and written many times as fast as field by field.

    Attributes:
        example: the example's bytes.
        at: by field, where its numbers are.
        fixed: offsets and sizes of the bytes by which one tells that a message of the example's length is laid out so:
            its fingerprint, and the lengths of its arrays.
    """

    def __init__(self, message: Any) -> None:
        """
        Raises:
            TypeError: the type holds more than numbers and one-dimensional arrays of numbers.
        """
        kind = type(message)
        self.at: dict[str, Place] = {}
        end = _FINGERPRINT
        lengths: set[str] = set()
        for name, typename, dimensions in zip(kind.__slots__, kind.__typenames__, kind.__dimensions__, strict=True):
            if typename not in FORMATS or len(dimensions or ()) > 1:
                raise TypeError(f"field {name} of {kind.__name__} is a {typename} with dimensions {dimensions}")
            count = 1 if dimensions is None else len(getattr(message, name))
            lengths.update(dimension for dimension in dimensions or () if isinstance(dimension, str))
            self.at[name] = Place(end, count, FORMATS[typename])
            end = self.at[name].end
        places = [self.at[name] for name in kind.__slots__ if name in lengths]
        self.fixed = [(0, _FINGERPRINT), *((place.offset, place.end - place.offset) for place in places)]
        self.example: bytes = message.encode()
