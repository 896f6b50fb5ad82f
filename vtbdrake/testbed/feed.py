"""Input ports that get new values again and again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, InputPort

from vtbdrake.testbed.signal import Signal


class Feed:
    """Input ports of one context, by signal, which carry what they were given last.

    A value that was fixed once is changed in place afterwards, which costs a microsecond or two. A vector's numbers are
    written through a view of them that is kept; `GetMutableData` must say each time, before, that they change.
    """

    def __init__(self, ports: Mapping[str, tuple[Signal, InputPort]], context: Context) -> None:
        self._ports = ports
        self._context = context
        self._fixed: dict[str, tuple[Callable[[], Any], np.ndarray | None]] = {}

    def __call__(self, name: str, value: Any) -> None:
        """Gives the port of a signal a value: for a vector signal an array of its size."""
        known = self._fixed.get(name)
        if known is None:
            signal, port = self._ports[name]
            fixed = port.FixValue(self._context, value if signal.is_vector else _wrapped(signal, value))
            numbers = fixed.GetMutableData().get_mutable_value().get_mutable_value() if signal.is_vector else None
            self._fixed[name] = (fixed.GetMutableData, numbers)
            return
        changed, numbers = known
        data = changed()
        if numbers is None:
            data.set_value(value)
        else:
            numbers[:] = value


def _wrapped(signal: Signal, value: Any) -> Any:
    wrapped = signal.abstract_value()
    wrapped.set_value(value)
    return wrapped
