"""Changes between two cycles, as events of a log and back."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby
from typing import Any

import numpy as np

from vtbdrake.control.cycle import Change
from vtbdrake.recording.lcm_types.lcmt_vtb_change import lcmt_vtb_change


def change_events(changes: Iterable[Change], number: int, utime: int) -> Iterator[lcmt_vtb_change]:
    """The messages of what changed before the step of cycle ``number``."""
    for index, (kind, values) in enumerate(changes):
        for address, name, value in _entries(values):
            array = np.ascontiguousarray(value)
            message = lcmt_vtb_change()
            message.utime, message.number, message.change = utime, number, index
            message.kind, message.address, message.name = kind, address, name
            message.dtype, message.shape = array.dtype.str, np.shape(value)
            message.ndim = len(message.shape)
            message.data = array.tobytes()
            message.size = len(message.data)
            yield message


def _entries(values: Mapping[str, Any]) -> Iterator[tuple[str, str, Any]]:
    if not values:
        yield "", "", 0
    for address, value in values.items():
        if isinstance(value, Mapping):
            yield from ((address, name, part) for name, part in value.items())
        else:
            yield address, "", value


def changes_of(messages: Iterable[lcmt_vtb_change]) -> list[tuple[int, Change]]:
    """The changes of some messages, in order, each with the number of its cycle.

    Args:
        messages: such that `value_of` each can be told.
    """
    found = []
    for (number, _), group in groupby(messages, key=lambda message: (message.number, message.change)):
        values: dict[str, Any] = {}
        kind = ""
        for message in group:
            kind = message.kind
            if message.name:
                parts = values.setdefault(message.address, {})
                if isinstance(parts, dict):
                    parts[message.name] = value_of(message)
            elif message.address:
                values[message.address] = value_of(message)
        found.append((number, Change(kind, values)))
    return found


def value_of(message: lcmt_vtb_change) -> Any:
    """Return the number, the text, or the array of such, that a message carries.

    Raises:
        ValueError: it carries none.
    """
    if not re.fullmatch(r"[<>|][biufU][0-9]{1,5}", message.dtype) or any(size < 0 for size in message.shape):
        raise ValueError(f"an array of type {message.dtype[:20]!r} and shape {message.shape[:9]}")
    array = np.frombuffer(message.data, np.dtype(message.dtype)).reshape(message.shape)
    return array if message.shape else array.item()
