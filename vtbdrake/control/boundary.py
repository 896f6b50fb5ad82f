"""The real ports of a Diagram, fed and read once per cycle."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.testbed import Command
from vtbdrake.testbed.addressed import AddressedDiagram
from vtbdrake.testbed.signal import Feed


class RealPorts:
    """``real.sense.*``, ``real.act.*`` and ``real.act.active`` of one context.

    Attributes:
        feed: gives a sensor signal its newest value, by name.
    """

    def __init__(self, target: AddressedDiagram, context: Context) -> None:
        diagram, interface = target.diagram, target.interface
        self._context = context
        self.feed = Feed({s.name: (s, diagram.GetInputPort(f"real.sense.{s.name}")) for s in interface.sense}, context)
        self._outputs = {s.name: (s, diagram.GetOutputPort(f"real.act.{s.name}").Eval) for s in interface.act}
        self._active = diagram.GetOutputPort("real.act.active") if interface.act else None

    def active(self) -> tuple[str, ...]:
        """The actuator signals that are on real; it asks the switches and not the DPS."""
        if self._active is None:
            return ()
        flags = self._active.Eval(self._context)
        return tuple(name for name, flag in zip(self._outputs, flags, strict=True) if flag)

    def commands(self, names: Iterable[str]) -> dict[str, Any]:
        """What the DPS commands to the machine now, by actuator signal."""
        commands: dict[str, Any] = {}
        for name in names:
            signal, evaluate = self._outputs[name]
            value = evaluate(self._context)
            if signal.is_vector:
                value = np.array(value)
            elif isinstance(value, Command):
                value = value.value
            commands[name] = value
        return commands
