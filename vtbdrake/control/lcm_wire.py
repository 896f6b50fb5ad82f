"""LCM messages as bytes: decoded strictly, and a quick way for messages that are numbers only."""

from __future__ import annotations

import struct
from io import BytesIO
from operator import itemgetter
from typing import Any

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


class MalformedError(ValueError):
    """A message that is not what its channel carries; ``reason`` is one of those that `Reception` counts."""

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


class Layout:
    """Where each number lies in messages of a type whose arrays are as long as an example's.

    Such messages are read and written by one call of `struct`, five times as fast as field by field.

    Attributes:
        size: bytes of such a message.
        at: by field, which entries of `unpack` and `pack` are its numbers; entry 0 is the fingerprint.
    """

    def __init__(self, message: Any) -> None:
        """
        Raises:
            TypeError: the type holds more than numbers and one-dimensional arrays of numbers.
        """
        kind = type(message)
        code = ">8s"
        template: list[Any] = [kind._get_packed_fingerprint()]
        self.at: dict[str, slice] = {}
        lengths: set[str] = set()
        for name, typename, dimensions in zip(kind.__slots__, kind.__typenames__, kind.__dimensions__, strict=True):
            value = getattr(message, name)
            if typename not in FORMATS or len(dimensions or ()) > 1:
                raise TypeError(f"field {name} of {kind.__name__} is a {typename} with dimensions {dimensions}")
            numbers = [value] if dimensions is None else list(value)
            lengths.update(dimension for dimension in dimensions or () if isinstance(dimension, str))
            self.at[name] = slice(len(template), len(template) + len(numbers))
            code += f"{len(numbers)}{FORMATS[typename]}"
            template += numbers
        self._struct = struct.Struct(code)
        self.size = self._struct.size
        self._fixed = itemgetter(0, *(self.at[name].start for name in kind.__slots__ if name in lengths))
        self.template = template
        self._expected = self._fixed(template)

    def unpack(self, data: bytes) -> tuple[Any, ...] | None:
        """All numbers of the message, or None if it is not laid out like this."""
        if len(data) != self.size:
            return None
        numbers = self._struct.unpack(data)
        return numbers if self._fixed(numbers) == self._expected else None

    def pack(self, numbers: list[Any]) -> bytes:
        """The message of these numbers: `template` with some of them replaced."""
        return self._struct.pack(*numbers)
