"""Input ports that get new values again and again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydrake.systems.framework import Context, InputPort

from vtbdrake.testbed.signal import Signal


class Feed:
    """Input ports of one context, by signal, which carry what they were given last.

    A value that was fixed once is changed in place afterwards, which costs a microsecond or two; a pointer to it is
    never kept from call to call, since a write through an old one would not be noticed.
    """

    def __init__(self, ports: Mapping[str, tuple[Signal, InputPort]], context: Context) -> None:
        self._ports = ports
        self._context = context
        self._fixed: dict[str, tuple[bool, Any]] = {}

    def __call__(self, name: str, value: Any) -> None:
        """Gives the port of a signal a value: for a vector signal an array of its size."""
        if name not in self._fixed:
            signal, port = self._ports[name]
            fixed = port.FixValue(self._context, value if signal.is_vector else _wrapped(signal, value))
            self._fixed[name] = (signal.is_vector, fixed)
            return
        is_vector, fixed = self._fixed[name]
        data = fixed.GetMutableData()
        if is_vector:
            data.get_mutable_value().SetFromVector(value)
        else:
            data.set_value(value)


def _wrapped(signal: Signal, value: Any) -> Any:
    wrapped = signal.abstract_value()
    wrapped.set_value(value)
    return wrapped
