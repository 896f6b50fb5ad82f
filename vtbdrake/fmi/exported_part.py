"""What an exported FMU computes: a testbed, its DPS or its world, with the variables that cross its boundary."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from math import prod
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.framework import Context
from pydrake.systems.primitives import ConstantVectorSource

from vtbdrake.common.argument_checks import as_addresses
from vtbdrake.common.arrays import Array
from vtbdrake.state.systems import output_ports
from vtbdrake.state.variables import A, VariableError
from vtbdrake.testbed import Interface, Scenario
from vtbdrake.testbed.addressed import AddressedDiagram
from vtbdrake.testbed.builder import VirtualTestbedBuilder
from vtbdrake.testbed.parts import unpaced
from vtbdrake.testbed.switch import COMMAND, CommandBoard

Names = Sequence[str] | Mapping[str, str] | None


class ExportedVariable(NamedTuple):
    """A variable of an exported FMU.

    Attributes:
        name: Its name in the FMU.
        address: Its address in the Diagram.
        causality: ``input``, ``parameter`` or ``output``.
        is_fixed: Whether it is a parameter that can be set until the end of the initialization only.
        shape: Its shape; ``()`` is a scalar.
        unit: SI unit; ``"1"`` if it has none.
        start: Its value in s0, flat; None for an output.
        lower, upper: The limits of its entries, flat.
    """

    name: str
    address: str
    causality: str
    is_fixed: bool
    shape: tuple[int, ...]
    unit: str
    start: Array | None
    lower: Array
    upper: Array

    @property
    def size(self) -> int:
        """Return the number of entries."""
        return prod(self.shape)


class ExportedPart:
    """A part of a scenario with the variables that cross its boundary.

    Args:
        scenario: The scenario.
        part: ``testbed``; ``dps``: the DPS alone, which has its sensor signals as inputs; or ``world``: the simulated
            world alone, which has the actuator signals as inputs.
        inputs: Addresses, or names in the FMU with their addresses, that the importer sets while time runs.
        parameters: Likewise for what it sets before; parameters of systems also later.
        outputs: Likewise for what it reads: variables, or vector output ports.

    Attributes:
        scenario, part: As given.
        target: The Diagram with its addresses.
        variables: The inputs, the parameters and the outputs.

    Raises:
        ValueError: There is no such part, a name or an address is there twice, cannot be set, or is no vector of
            numbers; or there are no outputs.
        AddressError: There is no such address.
    """

    def __init__(
        self, scenario: Scenario, part: str, *, inputs: Names = None, parameters: Names = (), outputs: Names = None
    ) -> None:
        if part not in _PARTS:
            raise ValueError(f"part is {', '.join(_PARTS)}, not {part!r}")
        self.scenario, self.part = scenario, part
        self.target, signals_in, signals_out = _PARTS[part](scenario)
        commands = [f"{COMMAND}{signal.name}" for signal in self.target.interface.commands]
        defaults = signals_in | {address: address for address in commands if address in self.target.variables()}
        self._context = self.target.default_context()
        self.variables = (
            *self._settable("input", _addresses("inputs", inputs, signals_in, defaults)),
            *self._settable("parameter", _addresses("parameters", parameters, {}, {})),
            *self._outputs(_addresses("outputs", outputs, signals_out, signals_out)),
        )
        self._check()

    @property
    def settable(self) -> tuple[ExportedVariable, ...]:
        """Return the inputs and the parameters."""
        return tuple(variable for variable in self.variables if variable.causality != "output")

    @property
    def outputs(self) -> tuple[ExportedVariable, ...]:
        """Return the outputs."""
        return tuple(variable for variable in self.variables if variable.causality == "output")

    def addresses(self) -> dict[str, dict[str, str]]:
        """Return the arguments ``inputs``, ``parameters`` and ``outputs`` with which the same part is made again."""
        return {
            f"{causality}s": {v.name: v.address for v in self.variables if v.causality == causality}
            for causality in ("input", "parameter", "output")
        }

    def write(self, context: Context, variable: ExportedVariable, values: Array) -> None:
        """Set an input or a parameter.

        Args:
            context: A root context of ``target``.
            variable: The variable.
            values: Its entries, flat.
        """
        self.target.write(context, {variable.address: values.reshape(variable.shape)})

    def read(self, context: Context) -> Array:
        """Return the outputs in a root context of ``target``, one after the other, flat."""
        return np.concatenate([np.ravel(self.target.read(context, v.address)) for v in self.outputs]).astype(float)

    def _settable(self, causality: str, addresses: Mapping[str, str]) -> Iterator[ExportedVariable]:
        for name, address in addresses.items():
            variable = self.target.variables()[address]
            if variable.derived:
                raise ValueError(f"{address} is computed from other variables, and cannot be the {causality} {name!r}")
            start = np.array(variable.get(self._context), dtype=float)
            try:
                variable.check(start)
            except VariableError as error:
                raise ValueError(f"the {causality} {name!r} has no value to start with: {error}") from error
            lower, upper = (np.broadcast_to(bound, variable.shape).ravel() for bound in variable.bounds)
            is_fixed = causality == "parameter" and variable.kind != A
            yield ExportedVariable(
                name, address, causality, is_fixed, variable.shape, variable.unit, start.ravel(), lower, upper
            )

    def _outputs(self, addresses: Mapping[str, str]) -> Iterator[ExportedVariable]:
        for name, address in addresses.items():
            read = self.target.reader(address)
            value: Any = np.asarray(read(self._context))
            if value.dtype.kind not in "fiub":
                raise ValueError(f"{address} has no numbers, and cannot be the output {name!r}: name a vector port")
            variables = self.target.variables()
            variable = variables.get(address)
            # A port of one entry is a scalar.
            shape = value.shape if variable is not None or value.size != 1 else ()
            unit, none = "1" if variable is None else variable.unit, np.zeros(0)
            yield ExportedVariable(name, address, "output", False, shape, unit, None, none, none)

    def _check(self) -> None:
        names = ["time", *(variable.name for variable in self.variables)]
        addresses = [variable.address for variable in self.variables]
        for kind, values in {"name": names, "address": addresses}.items():
            if twice := sorted({value for value in values if values.count(value) > 1}):
                raise ValueError(f"the {kind} {twice[0]!r} is there twice: each variable of an FMU has one of its own")
        if not self.outputs:
            raise ValueError("name in outputs what the FMU is to show: addresses of variables or vector output ports")
        if empty := [variable.name for variable in self.variables if not variable.size]:
            raise ValueError(f"{empty[0]} has no entries, and cannot be a variable of an FMU")


def _addresses(
    argument: str, names: Names, signals: Mapping[str, str], default: Mapping[str, str]
) -> Mapping[str, str]:
    """Return the addresses by name; a signal's name stands for the address of its port."""
    if names is None:
        return default
    if not isinstance(names, Mapping):
        names = {name: name for name in as_addresses(argument, names)}
    return {name: signals.get(address, address) for name, address in names.items()}


def _testbed(scenario: Scenario) -> tuple[AddressedDiagram, dict[str, str], dict[str, str]]:
    return scenario.build(), {}, {}


def _dps(scenario: Scenario) -> tuple[AddressedDiagram, dict[str, str], dict[str, str]]:
    """Return the DPS, whose sensor signals are parameters of sources, and the addresses of its signals by name.

    Returns:
        The Diagram; the addresses of its sensor signals; the addresses of its actuator signals.
    """
    scenario.validate()
    interface = scenario.interface()
    _refuse_abstract(interface)
    parts = VirtualTestbedBuilder(interface)
    dps = parts.set_dps(scenario.make_dps())
    builder = parts.diagram_builder
    board = CommandBoard(builder, {signal.name: signal.default_vector() for signal in interface.commands})
    for name, port in board.ports.items():
        builder.Connect(port, dps.GetInputPort(name))
    for signal in interface.sense:
        source = builder.AddNamedSystem(f"sense.{signal.name}", ConstantVectorSource(signal.vector(0.0)))
        builder.Connect(source.get_output_port(), dps.GetInputPort(signal.name))
    target = AddressedDiagram(
        diagram=parts.build_diagram("exported_dps"),
        interface=interface,
        simulator_config=unpaced(scenario.simulator_config, has_plant=False),
        scenario=scenario,
        extra=board.variables(interface.commands),
    )
    inputs = {signal.name: f"sense.{signal.name}.value" for signal in interface.sense}
    return target, inputs, {signal.name: f"dps.{signal.name}" for signal in interface.act}


def _world(scenario: Scenario) -> tuple[AddressedDiagram, dict[str, str], dict[str, str]]:
    """Return the simulated world, whose actuator signals are parameters of sources, and the addresses of its signals.

    Returns:
        The Diagram; the addresses of its actuator signals; the addresses of its sensor signals.
    """
    scenario.validate()
    scenario = copy.deepcopy(scenario)
    interface = scenario.interface()
    _refuse_abstract(interface)
    parts = VirtualTestbedBuilder(interface, simulator_config=scenario.simulator_config)
    parts.place_of = scenario.where_position
    scenario.add_world(parts)
    parts.finish_world()
    builder = parts.diagram_builder
    for signal in interface.act:
        source = builder.AddNamedSystem(f"act.{signal.name}", ConstantVectorSource(signal.vector(signal.idle)))
        builder.Connect(source.get_output_port(), parts.actuators[signal.name])
    target = AddressedDiagram(
        diagram=parts.build_diagram("exported_world"),
        interface=interface,
        simulator_config=unpaced(scenario.simulator_config),
        scenario=scenario,
        plant_roles=parts.plant_roles(),
    )
    ports = {
        (port.get_system(), port.get_index()): address for address, (_, port) in output_ports(target.diagram).items()
    }
    sensors = {name: ports[port.get_system(), port.get_index()] for name, port in parts.sensors.items()}
    return target, {signal.name: f"act.{signal.name}.value" for signal in interface.act}, sensors


def _refuse_abstract(interface: Interface) -> None:
    abstract = [signal.name for signal in (*interface.sense, *interface.act) if not signal.is_vector]
    if abstract:
        raise ValueError(f"the signal {abstract[0]} is abstract, and an FMU takes numbers: export part='testbed'")


_PARTS = {"testbed": _testbed, "dps": _dps, "world": _world}
