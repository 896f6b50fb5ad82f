"""T_sense and T_act (Figure 4): for every signal, a selector in the Context and the switch that it throws."""

from __future__ import annotations

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
            hidden=True,
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


class ActSwitch:
    """T_act of one signal: the DPS leads to the simulated actuator, to the real port, or (twin) to both."""

    def __init__(self, builder: DiagramBuilder, signal: Signal, position: str, command: OutputPort) -> None:
        name = f"T_act.{signal.name}"
        self.signal = signal
        self.selector = Selector(builder, name, ACT_POSITIONS, position)
        (on_sim, on_real, on_twin), self.sim_port = _add_switch(
            builder, f"{name}.sim", signal, self.selector, ACT_POSITIONS
        )
        idle = _add_constant(builder, f"{name}.idle", signal, signal.idle)
        builder.Connect(command, on_sim)
        builder.Connect(idle, on_real)
        builder.Connect(command, on_twin)
        if signal.is_vector:
            (on_sim, on_real, on_twin), self.real_port = _add_switch(
                builder, f"{name}.real", signal, self.selector, ACT_POSITIONS
            )
            builder.Connect(_add_constant(builder, f"{name}.no_command", signal, np.nan), on_sim)
            builder.Connect(command, on_real)
            builder.Connect(command, on_twin)
        else:
            gate = builder.AddNamedSystem(f"{name}.real", CommandGate(signal))
            builder.Connect(self.selector.output_port, gate.GetInputPort("port_selector"))
            builder.Connect(command, gate.GetInputPort("command"))
            self.real_port = gate.get_output_port()
        self.active_port = self._add_active(builder, name)

    def _add_active(self, builder: DiagramBuilder, name: str) -> OutputPort:
        """1 while the signal commands the real actuator, else 0."""
        flag = Signal("active", size=1)
        (on_sim, on_real, on_twin), active = _add_switch(builder, f"{name}.active", flag, self.selector, ACT_POSITIONS)
        yes = _add_constant(builder, f"{name}.active.yes", flag, 1.0)
        builder.Connect(_add_constant(builder, f"{name}.active.no", flag, 0.0), on_sim)
        builder.Connect(yes, on_real)
        builder.Connect(yes, on_twin)
        return active


def add_active_port(builder: DiagramBuilder, switches: list[ActSwitch]) -> OutputPort:
    """One port that says for every actuator signal, in their order, whether it commands the real actuator."""
    mux = builder.AddNamedSystem("T_act.active", Multiplexer(len(switches)))
    for i, switch in enumerate(switches):
        builder.Connect(switch.active_port, mux.get_input_port(i))
    return mux.get_output_port()


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


def _add_constant(builder: DiagramBuilder, name: str, signal: Signal, value: Any) -> OutputPort:
    source: System = (
        ConstantVectorSource(signal.vector(value)) if signal.is_vector else ConstantValueSource(Value(value))
    )
    return builder.AddNamedSystem(name, source).get_output_port()
