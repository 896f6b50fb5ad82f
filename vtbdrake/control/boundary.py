"""The real ports of a Diagram, fed and read once per cycle."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.testbed import Command, Signal
from vtbdrake.testbed.addressed import AddressedDiagram


class RealPorts:
    """``real.sense.*``, ``real.act.*`` and ``real.act.active`` of one context.

    A value that was fixed once is changed in place afterwards, which costs a microsecond or two; a pointer to it is
    never kept from cycle to cycle, since a write through an old one would not be noticed.
    """

    def __init__(self, target: AddressedDiagram, context: Context) -> None:
        diagram, interface = target.diagram, target.interface
        self._context = context
        self._inputs = {s.name: (s, diagram.GetInputPort(f"real.sense.{s.name}")) for s in interface.sense}
        self._outputs = {s.name: (s, diagram.GetOutputPort(f"real.act.{s.name}")) for s in interface.act}
        self._active = diagram.GetOutputPort("real.act.active") if interface.act else None
        self._fixed: dict[str, tuple[bool, Any]] = {}

    def feed(self, name: str, value: Any) -> None:
        """Gives a sensor signal its newest value."""
        if name not in self._fixed:
            signal, port = self._inputs[name]
            fixed = port.FixValue(self._context, value if signal.is_vector else _wrapped(signal, value))
            self._fixed[name] = (signal.is_vector, fixed)
            return
        is_vector, fixed = self._fixed[name]
        data = fixed.GetMutableData()
        if is_vector:
            data.get_mutable_value().SetFromVector(value)
        else:
            data.set_value(value)

    def active(self) -> list[str]:
        """The actuator signals that are on real; it asks the switches and not the DPS."""
        if self._active is None:
            return []
        flags = self._active.Eval(self._context)
        return [name for name, flag in zip(self._outputs, flags, strict=True) if flag]

    def commands(self, names: Iterable[str]) -> dict[str, Any]:
        """What the DPS commands to the machine now, by actuator signal."""
        return {name: self._value(*self._outputs[name]) for name in names}

    def _value(self, signal: Signal, port: Any) -> Any:
        if signal.is_vector:
            return np.array(port.Eval(self._context))
        value = port.Eval(self._context)
        return value.value if isinstance(value, Command) else value


def _wrapped(signal: Signal, value: Any) -> Any:
    wrapped = signal.abstract_value()
    wrapped.set_value(value)
    return wrapped
