"""The fields of a message type that hold numbers: found by name, checked, and written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from operator import attrgetter
from typing import Any

import numpy as np

from vtbdrake.lcm.wire import FORMATS


@dataclass(frozen=True)
class Field:
    """A field of numbers in a message: a scalar, an array of fixed dimensions, or one as long as another field says.

    Attributes:
        path: its name; dotted if it lies in a message within the message.
        dimensions: of a fixed array; empty for a scalar.
        length: the field that tells its length, beside it; empty if its dimensions are fixed.
        integer: whether it takes integers only.
    """

    path: str
    dimensions: tuple[int, ...]
    length: str
    integer: bool

    @property
    def count(self) -> int | None:
        """How many numbers it has; None if the message tells."""
        return None if self.length else prod(self.dimensions)

    def write(self, message: Any, numbers: list[float]) -> None:
        owner, name = owner_of(message, self.path)
        values: Any = [round(number) for number in numbers] if self.integer else numbers
        if self.length:
            setattr(owner, self.length, len(values))
            setattr(owner, name, values)
        elif self.dimensions:
            setattr(owner, name, np.reshape(np.array(values), self.dimensions).tolist())
        else:
            setattr(owner, name, values[0])


def owner_of(message: Any, path: str) -> tuple[Any, str]:
    """The message within ``message`` that has the field, and the field's own name."""
    parents, _, name = path.rpartition(".")
    return (attrgetter(parents)(message) if parents else message), name


def find_field(message_type: Any, path: str) -> Field:
    """
    Raises:
        ValueError: the type has no such field, or it is not one of numbers that a signal can be.
    """
    try:
        owner, name = owner_of(message_type(), path)
        kind = type(owner)
        index = kind.__slots__.index(name)
    except (AttributeError, ValueError):
        fields = ", ".join(message_type.__slots__)
        raise ValueError(f"{message_type.__name__} has no field {path!r}; it has {fields}") from None
    typename, dimensions = kind.__typenames__[index], kind.__dimensions__[index] or []
    variable = [dimension for dimension in dimensions if isinstance(dimension, str)]
    if typename not in FORMATS or (variable and len(dimensions) > 1):
        shape = "".join(f"[{dimension}]" for dimension in dimensions)
        raise ValueError(
            f"field {path} of {message_type.__name__} is a {typename}{shape}: a vector signal travels in numbers, in "
            "arrays of fixed dimensions, or in an array of one dimension; write an LcmMap for it"
        )
    integer = typename not in ("float", "double")
    return Field(path, () if variable else tuple(dimensions), variable[0] if variable else "", integer)


def compose(
    message_type: Any, fields: Mapping[str, Sequence[Field]], values: Mapping[str, Any], stamp: str, utime: int
) -> Any:
    """The message of these values; what is not given is zero, and arrays that may be empty are.

    Raises:
        LookupError: the message cannot leave out a signal that is missing.
    """
    message = message_type()
    if stamp:
        owner, name = owner_of(message, stamp)
        setattr(owner, name, utime)
    for signal, value in values.items():
        numbers = np.asarray(value, dtype=float).tolist()
        for field in fields[signal]:
            count = len(numbers) if field.count is None else field.count
            field.write(message, numbers[:count])
            numbers = numbers[count:]
    for owner in {id(owner): owner for owner, _ in (owner_of(message, path) for path in _paths(fields))}.values():
        _fill(owner)
    for signal in fields.keys() - values.keys():
        for field in fields[signal]:
            owner, _ = owner_of(message, field.path)
            if not field.length or getattr(owner, field.length):
                raise LookupError(signal)
    return message


def _paths(fields: Mapping[str, Sequence[Field]]) -> list[str]:
    return [field.path for parts in fields.values() for field in parts]


def _fill(message: Any) -> None:
    """Gives arrays that share their length with one that was written that length."""
    kind = type(message)
    for name, typename, dimensions in zip(kind.__slots__, kind.__typenames__, kind.__dimensions__, strict=True):
        if typename in FORMATS and len(dimensions or ()) == 1 and isinstance(dimensions[0], str):
            missing = getattr(message, dimensions[0]) - len(getattr(message, name))
            if missing > 0:
                setattr(message, name, [0] * missing)
