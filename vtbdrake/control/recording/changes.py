"""Changes between two cycles, as events of a log and back."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby
from typing import Any

import numpy as np

from vtbdrake.control.cycle import Change
from vtbdrake.control.recording.lcm_types.lcmt_vtb_change import lcmt_vtb_change


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

    Raises:
        ValueError: a message says what cannot be.
    """
    found = []
    for (number, _), group in groupby(messages, key=lambda message: (message.number, message.change)):
        values: dict[str, Any] = {}
        kind = ""
        for message in group:
            kind = message.kind
            if message.name:
                values.setdefault(message.address, {})[message.name] = _value(message)
            elif message.address:
                values[message.address] = _value(message)
        found.append((number, Change(kind, values)))
    return found


def _value(message: lcmt_vtb_change) -> Any:
    array = np.frombuffer(message.data, np.dtype(message.dtype)).reshape(message.shape)
    return array if message.shape else array.item()
