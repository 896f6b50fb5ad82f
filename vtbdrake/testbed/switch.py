"""The switches T_sense and T_act of Figure 4."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.symbolic import Expression, MakeVectorContinuousVariable, if_then_else, sqrt
from pydrake.symbolic import Variable as Symbol
from pydrake.systems.framework import (
    BasicVector_,
    Context,
    DiagramBuilder,
    InputPort,
    InputPortIndex,
    LeafSystem_,
    OutputPort,
    System,
    SystemScalarConverter,
)
from pydrake.systems.primitives import Adder, ConstantValueSource, Gain, PortSwitch, SymbolicVectorSystem
from pydrake.systems.scalar_conversion import TemplateSystem

from vtbdrake.state.declarations import DISCRETE, NO_DICT, AddressedSystem, Codec, Element
from vtbdrake.state.systems import class_for_float, leaf_variables
from vtbdrake.state.variables import Variable, VariableError, X
from vtbdrake.testbed.signal import Interface, Signal


class Position(StrEnum):
    """A position of a switch: its name is what users write and what files hold, its number is what s holds."""

    SIM = "sim"
    REAL = "real"
    TWIN = "twin"

    @property
    def number(self) -> int:
        """Return the position as an element of s: 0 is sim, 1 is real, 2 is twin."""
        return ACT_POSITIONS.index(self)

    @property
    def port(self) -> InputPortIndex:
        """Return the input port of a PortSwitch that the position selects; port 0 is its selector port."""
        return InputPortIndex(1 + self.number)


SENSE_POSITIONS = (Position.SIM, Position.REAL)
ACT_POSITIONS = tuple(Position)

T_SENSE = "T_sense."
T_ACT = "T_act."
COMMAND = "u."
BOARD = "switches"


# The scope is named, because Drake would look for it in the stack of all callers, which takes time.
@TemplateSystem.define("SwitchBoard_", scope=sys.modules[__name__])  # type: ignore[untyped-decorator]
def SwitchBoard_(T: type) -> type:
    """Make the class `SwitchBoard` for the scalar type ``T``.

    A switch board holds the state of all switches, the commands u, and the constants that an actuator gets while the
    DPS does not command it. Every system of a Diagram costs time in each step of a simulation, even if it computes
    nothing: so one system holds all of these. Its ports show its state, which needs no Python while time runs.

    .. pydrake_system::

        name: SwitchBoard
        output_ports:
        - <switch> (InputPortIndex, for the selector port of a PortSwitch)
        - <constant>
        - active (1 for every actuator signal whose switch lets it command, else 0)
    """

    class Impl(LeafSystem_[T]):
        __slots__ = NO_DICT

        def _construct(
            self,
            switches: Mapping[str, int],
            constants: Mapping[str, np.ndarray],
            active: np.ndarray,
            converter: SystemScalarConverter | None = None,
        ) -> None:
            LeafSystem_[T].__init__(self, converter)
            self._arguments = switches, constants, active
            for name, port in switches.items():
                self.DeclareStateOutputPort(name, self.DeclareAbstractState(Value(InputPortIndex(port))))
            for name, value in {**constants, "active": active}.items():
                # A constant is state that never changes: a parameter would need a calculation to reach a port.
                state = self.DeclareDiscreteState(BasicVector_[T](np.array(value)))
                self.DeclareStateOutputPort(name, state)
            self.variables = ()
            self.codecs = dict.fromkeys(range(len(switches)), _POSITION_CODEC)

        def _construct_copy(self, other: Any, converter: SystemScalarConverter | None = None) -> None:
            switches, constants, active = other._arguments
            Impl._construct(self, switches, constants, active, converter=converter)

    return Impl


SwitchBoard = class_for_float(SwitchBoard_)
_POSITION_CODEC = Codec(
    encode=lambda port: {"port": np.array(int(port))}, decode=lambda arrays: InputPortIndex(int(arrays["port"]))
)


def finite_command(size: int) -> SymbolicVectorSystem:
    """Return a system that passes a vector, bit for bit, and raises a ValueError where an entry is NaN or infinite.

    It computes y = u if |u| < infinity, else sqrt(-1 - u^2), which has no value. Python is not involved. Its continuous
    state, a number that is always 0, is there because Drake refuses such a system without one in a continuous Diagram.
    """
    u, z = MakeVectorContinuousVariable(size, "u"), Symbol("z")
    output = [if_then_else(abs(x) < np.inf, x, sqrt(-1.0 - x**2)) for x in u]
    return SymbolicVectorSystem(state=[z], dynamics=[Expression(0.0)], input=u, output=output)


class Selector:
    """The position of one switch: abstract state ``index`` of the switch board.

    ``flag`` is its entry in the board's ``active``; None for a sensor signal.

    Args:
        board: The switch board.
        name: The address of the switch.
        positions: The positions that it has.
        index: The number of its abstract state.
        flag: Its entry in the board's ``active``; None for a sensor signal.
    """

    def __init__(self, board: System, name: str, positions: Sequence[Position], index: int, flag: int | None) -> None:
        self.name = name
        self._positions = positions
        self._board = board
        self._index = index
        self._flag = flag

    def get(self, context: Context) -> Position:
        """Return the position in a context of the testbed."""
        port = self._board.GetMyContextFromRoot(context).get_abstract_state(self._index).get_value()
        return self._positions[int(port) - 1]

    def set(self, context: Context, position: Position) -> None:
        """Set the position in a context of the testbed.

        Args:
            context: A root context of the testbed, which is changed.
            position: The position; an actuator signal commands the machine in all but `Position.SIM`.
        """
        board = self._board.GetMyMutableContextFromRoot(context)
        board.SetAbstractState(self._index, position.port)
        if self._flag is not None:
            group = board.num_discrete_state_groups() - 1
            active = np.array(board.get_discrete_state(group).value())
            active[self._flag] = float(position != Position.SIM)
            board.SetDiscreteState(group, active)

    def variable(self) -> Variable:
        """Return the position as an element of s, see `Position.number`."""

        def refuse(value: np.ndarray) -> None:
            if not float(value).is_integer():
                numbers = ", ".join(f"{position.number} ({position})" for position in self._positions)
                raise VariableError(f"{self.name} is one of {numbers}, not {float(value):g}")

        return Variable(
            self.name,
            X,
            (),
            "1",
            lambda context: float(self.get(context).number),
            lambda context, value: self.set(context, self._positions[int(value)]),
            bounds=(0.0, len(self._positions) - 1.0),
            refuse=refuse,
            choices=tuple((float(position.number), str(position)) for position in self._positions),
        )


class CommandBoard:
    """The system that holds the constant commands u and, in a testbed, the state of all switches.

    Args:
        builder: The builder of the Diagram.
        u: Default values of the commands, by signal.
        switches: Initial port of each switch, by its name.
        constants: Further constants, by the name of their port.
        active: Flags of the actuator signals whose switch lets the DPS command.

    Attributes:
        system: The `SwitchBoard`.
        ports: Output ports of the commands, by signal.
    """

    def __init__(
        self,
        builder: DiagramBuilder,
        u: Mapping[str, np.ndarray],
        *,
        switches: Mapping[str, int] = MappingProxyType({}),
        constants: Mapping[str, np.ndarray] = MappingProxyType({}),
        active: Sequence[float] = (),
    ) -> None:
        commands = {f"{COMMAND}{name}": value for name, value in u.items()}
        board = SwitchBoard(switches, {**commands, **constants}, np.array(active, dtype=float))
        self.system = builder.AddNamedSystem(BOARD, board)
        self.ports: dict[str, OutputPort] = {name: self.system.GetOutputPort(f"{COMMAND}{name}") for name in u}

    def variables(self, signals: Sequence[Signal]) -> Iterator[Variable]:
        """Yield the commands as variables ``u.<signal>``, with the units and bounds of ``signals``."""
        by_name = {signal.name: signal for signal in signals}
        for index, name in enumerate(self.ports):
            yield self.variable(f"{COMMAND}{name}", index, by_name[name])

    def variable(self, address: str, index: int, signal: Signal) -> Variable:
        """Return the constant ``index`` of the board as a variable with the unit and bounds of a signal.

        Args:
            address: The address of the variable.
            index: The number of the constant among the board's groups of discrete state.
            signal: The signal, with the size, unit, bounds and allowed values of the constant.
        """
        size = signal.vector(0.0).size
        shape = () if size == 1 else (size,)
        bounds = (signal.vector(signal.lower).reshape(shape), signal.vector(signal.upper).reshape(shape))
        element = Element("", DISCRETE, index, shape, unit=signal.unit, bounds=bounds)
        (variable,) = leaf_variables(address, self.system, declared=[element])
        variable = replace(variable, entry_names=tuple(signal.entry_names), choices=signal.choices)
        if signal.values is None:
            return variable

        def refuse(value: np.ndarray) -> None:
            if (index := signal.foreign_entry(value)) is not None:
                entry = f"{address}[{index}]" if shape else address
                raise VariableError(f"{entry} is one of {signal.values_text()}, not {float(np.ravel(value)[index])}")

        return replace(variable, refuse=refuse)


class Switches:
    """T_sense and T_act of all signals.

    T_sense: `sim` and `real` lead to the DPS. T_act: the DPS leads to the simulated actuators, to the real ports, or
    (twin) to both.

    Attributes:
        sense, act: The selectors, by signal.
        sim_sense, real_sense: Input ports for the simulated and the real sensors, by signal.
        dps_sense: Output ports for the sensor inputs of the DPS, by signal.
        sim_act, real_act: Output ports for the simulated and the real actuators, by signal.
        active: Output port of the flags of all actuator signals.
        commands: The board of the constant commands u.

    Args:
        u: Default values of the constant commands, by signal.
        guarded: The actuator signals whose commands are checked before they enter the simulated world -> whether they
            enter a plant, which refuses NaN itself.
        builder: The DiagramBuilder that gets them.
        interface: The signals of the DPS.
        sense_position: The initial position of T_sense.
        act_position: The initial position of T_act.
        dps: The data processing system.
    """

    def __init__(
        self,
        builder: DiagramBuilder,
        interface: Interface,
        sense_position: Position,
        act_position: Position,
        dps: System,
        u: Mapping[str, np.ndarray],
        *,
        guarded: Mapping[str, bool] | None = None,
    ) -> None:
        self._builder = builder
        sense = {f"{T_SENSE}{signal.name}": signal for signal in interface.sense}
        act = {f"{T_ACT}{signal.name}": signal for signal in interface.act}
        ports = {**dict.fromkeys(sense, int(sense_position.port)), **dict.fromkeys(act, int(act_position.port))}
        constants: dict[str, np.ndarray] = {}
        for name, signal in act.items():
            if signal.is_vector:
                constants[f"{name}.idle"] = signal.vector(signal.idle)
                constants[f"{name}.none"] = signal.vector(np.nan)
        active = [float(act_position != Position.SIM)] * len(act)
        self.commands = CommandBoard(builder, u, switches=ports, constants=constants, active=active)
        self._board = self.commands.system
        self._act_signals = interface.act
        self.sense = {
            s.name: Selector(self._board, n, SENSE_POSITIONS, i, None) for i, (n, s) in enumerate(sense.items())
        }
        self.act = {
            s.name: Selector(self._board, n, ACT_POSITIONS, len(sense) + i, i) for i, (n, s) in enumerate(act.items())
        }
        self.sim_sense: dict[str, InputPort] = {}
        self.real_sense: dict[str, InputPort] = {}
        self.dps_sense: dict[str, OutputPort] = {}
        for name, signal in sense.items():
            inputs, output = self._add_switch(name, name, signal, SENSE_POSITIONS)
            self.sim_sense[signal.name], self.real_sense[signal.name] = inputs
            self.dps_sense[signal.name] = output
        self.sim_act: dict[str, OutputPort] = {}
        self.real_act: dict[str, OutputPort] = {}
        for name, signal in act.items():
            command = dps.GetOutputPort(signal.name)
            idle = self._idle(name, signal)
            checked = command
            if guarded and signal.name in guarded:
                checked = self._finite(name, command, plant=guarded[signal.name])
            self.sim_act[signal.name] = self._choose(name, f"{name}.sim", signal, checked, idle, checked)
            if signal.is_vector:
                none = self._board.GetOutputPort(f"{name}.none")
                self.real_act[signal.name] = self._choose(name, f"{name}.real", signal, none, command, command)
            else:
                self.real_act[signal.name] = self._gate(name, signal, command)
        self.active = self._board.GetOutputPort("active")

    def idle_variables(self) -> dict[str, Callable[[], Variable]]:
        """Return functions that make the variables ``T_act.<signal>.idle``, by address.

        Each is the command that the simulated actuator of a vector signal gets while T_act is on real.
        """
        u = len(self.commands.ports)
        signals = [signal for signal in self._act_signals if signal.is_vector]
        return {
            f"{T_ACT}{signal.name}.idle": partial(
                self.commands.variable, f"{T_ACT}{signal.name}.idle", u + 2 * i, signal
            )
            for i, signal in enumerate(signals)
        }

    def _idle(self, name: str, signal: Signal) -> OutputPort:
        if signal.is_vector:
            return self._board.GetOutputPort(f"{name}.idle")
        source = ConstantValueSource(Value(signal.idle))
        return self._builder.AddNamedSystem(f"{name}.idle", source).get_output_port()

    def _finite(self, switch: str, command: OutputPort, *, plant: bool) -> OutputPort:
        size = command.size()
        if plant:
            # u + 0 u is u, and NaN where u is infinite.
            zero = self._builder.AddNamedSystem(f"{switch}.zero", Gain(0.0, size))
            total = self._builder.AddNamedSystem(f"{switch}.finite", Adder(2, size))
            self._builder.Connect(command, zero.get_input_port())
            self._builder.Connect(command, total.get_input_port(0))
            self._builder.Connect(zero.get_output_port(), total.get_input_port(1))
            return total.get_output_port()
        guard = self._builder.AddNamedSystem(f"{switch}.finite", finite_command(size))
        self._builder.Connect(command, guard.get_input_port())
        return guard.get_output_port()

    def _choose(self, switch: str, name: str, signal: Signal, *sources: OutputPort) -> OutputPort:
        inputs, output = self._add_switch(switch, name, signal, ACT_POSITIONS)
        for source, port in zip(sources, inputs, strict=True):
            self._builder.Connect(source, port)
        return output

    def _gate(self, switch: str, signal: Signal, command: OutputPort) -> OutputPort:
        gate = self._builder.AddNamedSystem(f"{switch}.real", ActuatorGate(signal, closed=Position.SIM.port))
        self._builder.Connect(self._board.GetOutputPort(switch), gate.GetInputPort("port_selector"))
        self._builder.Connect(command, gate.GetInputPort("command"))
        return gate.get_output_port()

    def _add_switch(
        self, switch: str, name: str, signal: Signal, positions: Sequence[Position]
    ) -> tuple[list[InputPort], OutputPort]:
        system: System
        if signal.is_vector:
            system = PortSwitch(signal.size)
            inputs = [system.DeclareInputPort(position) for position in positions]
        else:
            system = AbstractSwitch(signal, len(positions))
            inputs = [system.get_input_port(1 + i) for i in range(len(positions))]
        self._builder.AddNamedSystem(name, system)
        self._builder.Connect(self._board.GetOutputPort(switch), system.get_input_port(0))
        return inputs, system.get_output_port()


@dataclass(frozen=True)
class ActuatorCommand:
    """A value of the port ``real.act.<signal>`` of an abstract signal: a command, or none (``value`` is None)."""

    value: Any = None


class AbstractSwitch(AddressedSystem):
    """A PortSwitch for abstract values, which pydrake binds for vectors only. It evaluates the selected input alone.

    .. pydrake_system::

        name: AbstractSwitch
        input_ports:
        - port_selector
        - in1
        - in2
        - ...
        output_ports:
        - value

    Args:
        signal: The signal.
        count: The number of inputs.
    """

    def __init__(self, signal: Signal, count: int) -> None:
        super().__init__()
        self._selector = self.DeclareAbstractInputPort("port_selector", Value(InputPortIndex(1)))
        for i in range(count):
            self.DeclareAbstractInputPort(f"in{i + 1}", signal.abstract_value())
        self.DeclareAbstractOutputPort(
            "value",
            signal.abstract_value,
            self._calc,
            prerequisites_of_calc={self.all_input_ports_ticket()},
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        selected = self._selector.Eval(context)
        output.SetFrom(self.EvalAbstractInput(context, int(selected)))


class ActuatorGate(AddressedSystem):
    """A gate before the real port of an abstract actuator signal, with an `ActuatorCommand` as output.

    The command is empty while the switch is at port ``closed``.

    .. pydrake_system::

        name: ActuatorGate
        input_ports:
        - port_selector
        - command
        output_ports:
        - value

    Args:
        signal: The actuator signal.
        closed: The port of the switch at which the command is empty.
    """

    def __init__(self, signal: Signal, *, closed: InputPortIndex) -> None:
        super().__init__()
        self._closed = closed
        self._selector = self.DeclareAbstractInputPort("port_selector", Value(InputPortIndex(1)))
        self._command = self.DeclareAbstractInputPort("command", signal.abstract_value())
        self.DeclareAbstractOutputPort(
            "value",
            lambda: Value(ActuatorCommand()),
            self._calc,
            prerequisites_of_calc={self.all_input_ports_ticket()},
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        closed = self._selector.Eval(context) == self._closed
        output.set_value(ActuatorCommand() if closed else ActuatorCommand(self._command.Eval(context)))
