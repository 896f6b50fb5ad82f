"""Switches of abstract signals, which pydrake has for vectors only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, InputPortIndex, LeafSystem

from vtbdrake.state.collectable import NO_DICT, weakly
from vtbdrake.testbed.signal import Signal


@dataclass(frozen=True)
class Command:
    """What an abstract signal's port ``real.act.<signal>`` carries: a command, or none (``value`` is None)."""

    value: Any = None


class AbstractSwitch(LeafSystem):
    """PortSwitch for abstract values, which pydrake binds for vectors only. Evaluates the selected input alone.

    .. pydrake_system::

        name: AbstractSwitch
        input_ports:
        - port_selector
        - in1
        - in2
        - ...
        output_ports:
        - value
    """

    __slots__ = NO_DICT

    def __init__(self, signal: Signal, count: int) -> None:
        super().__init__()
        self._selector = self.DeclareAbstractInputPort("port_selector", Value(InputPortIndex(1)))
        for i in range(count):
            self.DeclareAbstractInputPort(f"in{i + 1}", signal.abstract_value())
        self.DeclareAbstractOutputPort(
            "value",
            signal.abstract_value,
            weakly(self, AbstractSwitch._calc),
            prerequisites_of_calc={self.all_input_ports_ticket()},
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        selected = self._selector.Eval(context)
        output.SetFrom(self.EvalAbstractInput(context, int(selected)))


class CommandGate(LeafSystem):
    """What an abstract actuator signal's real port carries: a `Command`, empty while the switch is at port ``closed``.

    .. pydrake_system::

        name: CommandGate
        input_ports:
        - port_selector
        - command
        output_ports:
        - value
    """

    __slots__ = NO_DICT

    def __init__(self, signal: Signal, closed: InputPortIndex) -> None:
        super().__init__()
        self._closed = closed
        self._selector = self.DeclareAbstractInputPort("port_selector", Value(InputPortIndex(1)))
        self._command = self.DeclareAbstractInputPort("command", signal.abstract_value())
        self.DeclareAbstractOutputPort(
            "value",
            lambda: Value(Command()),
            weakly(self, CommandGate._calc),
            prerequisites_of_calc={self.all_input_ports_ticket()},
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        closed = self._selector.Eval(context) == self._closed
        output.set_value(Command() if closed else Command(self._command.Eval(context)))
