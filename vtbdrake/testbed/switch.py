"""T_sense and T_act (Figure 4): for every signal, a selector in the Context and the switch that it throws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    InputPort,
    InputPortIndex,
    LeafSystem,
    OutputPort,
    System,
)
from pydrake.systems.primitives import (
    ConstantValueSource,
    ConstantVectorSource,
    Demultiplexer,
    Multiplexer,
    PortSwitch,
    ZeroOrderHold,
)

from vtbdrake.state.variable import Variable, VariableError, X
from vtbdrake.testbed.signal import Signal

SIM, REAL, TWIN = "sim", "real", "twin"
SENSE_POSITIONS = (SIM, REAL)
ACT_POSITIONS = (SIM, REAL, TWIN)

# A ZeroOrderHold whose update never comes is a C++ system that keeps an abstract value in the Context.
_NEVER = 1e300


@dataclass(frozen=True)
class Command:
    """What an abstract signal's port ``real.act.<signal>`` carries: a command, or none (``value`` is None)."""

    value: Any = None


class Selector:
    """The position of one switch, kept in the Context as abstract state of a C++ system."""

    def __init__(self, builder: DiagramBuilder, name: str, positions: tuple[str, ...], position: str) -> None:
        self.name = name
        self.positions = positions
        self._system = builder.AddNamedSystem(
            f"{name}.selector", ZeroOrderHold(1.0, Value(self._port(position)), _NEVER)
        )

    def _port(self, position: str) -> InputPortIndex:
        # Port 0 of a PortSwitch is its selector port.
        return InputPortIndex(1 + self.positions.index(position))

    @property
    def output_port(self) -> OutputPort:
        return self._system.get_output_port()

    def get(self, context: Context) -> str:
        """The position in a context of the testbed."""
        state = self._system.GetMyContextFromRoot(context).get_abstract_state(0).get_value()
        return self.positions[int(state) - 1]

    def set(self, context: Context, position: str) -> None:
        """Throws the switch in a context of the testbed; ``position`` is one of `positions`."""
        self._system.GetMyMutableContextFromRoot(context).SetAbstractState(0, self._port(position))

    def variable(self) -> Variable:
        """The position as an element of s: 0 is sim, 1 is real, 2 is twin."""

        def write(context: Context, value: np.ndarray) -> None:
            index = float(value)
            if not index.is_integer():
                known = ", ".join(f"{i} ({p})" for i, p in enumerate(self.positions))
                raise VariableError(f"{self.name} is one of {known}, not {index:g}")
            self.set(context, self.positions[int(index)])

        return Variable(
            self.name,
            X,
            (),
            "1",
            lambda context: float(self.positions.index(self.get(context))),
            write,
            bounds=(0.0, len(self.positions) - 1.0),
            carried_by=self.name,
        )


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

    def __init__(self, signal: Signal, count: int) -> None:
        super().__init__()
        self._selector = self.DeclareAbstractInputPort("port_selector", Value(InputPortIndex(1)))
        for i in range(count):
            self.DeclareAbstractInputPort(f"in{i + 1}", signal.abstract_value())
        self.DeclareAbstractOutputPort(
            "value", signal.abstract_value, self._calc, prerequisites_of_calc={self.all_input_ports_ticket()}
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        selected = self._selector.Eval(context)
        output.SetFrom(self.EvalAbstractInput(context, int(selected)))


class CommandGate(LeafSystem):
    """What an abstract actuator signal's real port carries: a `Command`, empty while T_act is on sim.

    .. pydrake_system::

        name: CommandGate
        input_ports:
        - port_selector
        - command
        output_ports:
        - value
    """

    def __init__(self, signal: Signal) -> None:
        super().__init__()
        self._selector = self.DeclareAbstractInputPort("port_selector", Value(InputPortIndex(1)))
        self._command = self.DeclareAbstractInputPort("command", signal.abstract_value())
        self.DeclareAbstractOutputPort(
            "value", lambda: Value(Command()), self._calc, prerequisites_of_calc={self.all_input_ports_ticket()}
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        position = ACT_POSITIONS[int(self._selector.Eval(context)) - 1]
        output.set_value(Command() if position == SIM else Command(self._command.Eval(context)))


class SenseSwitch:
    """T_sense of one signal: `sim` and `real` lead to the DPS."""

    def __init__(self, builder: DiagramBuilder, signal: Signal, position: str) -> None:
        name = f"T_sense.{signal.name}"
        self.signal = signal
        self.selector = Selector(builder, name, SENSE_POSITIONS, position)
        ports, self.output_port = _add_switch(builder, name, signal, self.selector, SENSE_POSITIONS)
        self.sim_port, self.real_port = ports


class ActSide:
    """T_act of all signals: the DPS leads to the simulated actuators, to the real ports, or (twin) to both.

    The constants of all signals (idle commands, no commands, flags) come from one source: every system that a Diagram
    has costs time at each of its steps, whether it computes or not.
    """

    def __init__(self, builder: DiagramBuilder, signals: Sequence[Signal], position: str, dps: System) -> None:
        self._builder = builder
        self.selectors: dict[str, Selector] = {}
        self.sim_ports: dict[str, OutputPort] = {}
        self.real_ports: dict[str, OutputPort] = {}
        active = []
        constants = self._add_constants([signal for signal in signals if signal.is_vector])
        for signal in signals:
            name, command = f"T_act.{signal.name}", dps.GetOutputPort(signal.name)
            selector = self.selectors[signal.name] = Selector(builder, name, ACT_POSITIONS, position)
            idle = constants[f"{signal.name}.idle"] if signal.is_vector else self._add_value(f"{name}.idle", signal)
            self.sim_ports[signal.name] = self._add(f"{name}.sim", signal, selector, command, idle, command)
            if signal.is_vector:
                none = constants[f"{signal.name}.none"]
                self.real_ports[signal.name] = self._add(f"{name}.real", signal, selector, none, command, command)
            else:
                self.real_ports[signal.name] = self._add_gate(f"{name}.real", signal, selector, command)
            yes, no = constants["yes"], constants["no"]
            active.append(self._add(f"{name}.active", _FLAG, selector, no, yes, yes))
        self.active_port = active[0] if len(active) == 1 else self._add_mux(active)

    def _add_constants(self, signals: Sequence[Signal]) -> dict[str, OutputPort]:
        values = {"no": np.zeros(1), "yes": np.ones(1)}
        for signal in signals:
            values[f"{signal.name}.idle"] = signal.vector(signal.idle)
            values[f"{signal.name}.none"] = signal.vector(np.nan)
        source = self._builder.AddNamedSystem(
            "T_act.constants", ConstantVectorSource(np.concatenate(list(values.values())))
        )
        split = self._builder.AddNamedSystem("T_act.split", Demultiplexer([value.size for value in values.values()]))
        self._builder.Connect(source.get_output_port(), split.get_input_port())
        return {name: split.get_output_port(i) for i, name in enumerate(values)}

    def _add(self, name: str, signal: Signal, selector: Selector, *sources: OutputPort) -> OutputPort:
        inputs, output = _add_switch(self._builder, name, signal, selector, ACT_POSITIONS)
        for source, port in zip(sources, inputs, strict=True):
            self._builder.Connect(source, port)
        return output

    def _add_value(self, name: str, signal: Signal) -> OutputPort:
        return self._builder.AddNamedSystem(name, ConstantValueSource(Value(signal.idle))).get_output_port()

    def _add_gate(self, name: str, signal: Signal, selector: Selector, command: OutputPort) -> OutputPort:
        gate = self._builder.AddNamedSystem(name, CommandGate(signal))
        self._builder.Connect(selector.output_port, gate.GetInputPort("port_selector"))
        self._builder.Connect(command, gate.GetInputPort("command"))
        return gate.get_output_port()

    def _add_mux(self, flags: Sequence[OutputPort]) -> OutputPort:
        mux = self._builder.AddNamedSystem("T_act.active", Multiplexer(len(flags)))
        for i, flag in enumerate(flags):
            self._builder.Connect(flag, mux.get_input_port(i))
        return mux.get_output_port()


# 1 for a signal that commands the real actuator, else 0.
_FLAG = Signal("active", size=1)


def _add_switch(
    builder: DiagramBuilder, name: str, signal: Signal, selector: Selector, positions: tuple[str, ...]
) -> tuple[list[InputPort], OutputPort]:
    system: System
    if signal.is_vector:
        system = PortSwitch(signal.size)
        inputs = [system.DeclareInputPort(position) for position in positions]
    else:
        system = AbstractSwitch(signal, len(positions))
        inputs = [system.get_input_port(1 + i) for i in range(len(positions))]
    builder.AddNamedSystem(name, system)
    builder.Connect(selector.output_port, system.get_input_port(0))
    return inputs, system.get_output_port()
