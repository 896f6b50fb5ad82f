"""What the values of a signal can be."""

from __future__ import annotations

from typing import Any

import numpy as np

from vtbdrake.control.kernels import Box
from vtbdrake.testbed import Signal

_LARGEST = float(np.finfo(float).max)


class Range:
    """What a signal's values can be: arrays of its size, finite and within its limits, or objects of its type.

    Attributes:
        lower, upper: of a vector signal, by entry, finite: so what is infinite is not within them.
        box: of both.
    """

    def __init__(self, signal: Signal) -> None:
        self._size = signal.size
        self._type: type | None = None
        self.lower: list[float] = []
        self.upper: list[float] = []
        if signal.size is None:
            self._type = type(signal.abstract_value().get_value())
        else:
            self.lower = np.maximum(signal.vector(signal.lower), -_LARGEST).tolist()
            self.upper = np.minimum(signal.vector(signal.upper), _LARGEST).tolist()
            self.box = Box(self.lower, self.upper)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Range) and self._shape() == other._shape()

    def __hash__(self) -> int:
        return hash((self._size, self._type))

    def check(self, value: Any) -> str:
        """Why ``value`` is not one of this signal (``type``, ``size``, ``limits``, ``not finite``); empty if it is."""
        if self._type is not None:
            return "" if isinstance(value, self._type) else "type"
        if self.box.contains(value):
            return ""
        try:
            entries = np.array(value, dtype=float)
        except (TypeError, ValueError):
            return "type"
        if entries.shape != (self._size,):
            return "size"
        if self.box.contains(entries):
            return ""
        return "limits" if np.isfinite(entries).all() else "not finite"

    def _shape(self) -> tuple[Any, ...]:
        return self._size, self._type, self.lower, self.upper
