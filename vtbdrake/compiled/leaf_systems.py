"""The leaf systems of a Diagram: their equations, or why one has none, and what their input ports are connected to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, Diagram, OutputPort, PortDataType, System

from vtbdrake.common.argument_checks import suggestion
from vtbdrake.common.arrays import Array
from vtbdrake.compiled.equations import Equations, UnsupportedTestbedError
from vtbdrake.compiled.registry import equations_of
from vtbdrake.state import AddressError, Variables
from vtbdrake.state.systems import class_name, is_plant, is_python, is_scene_graph, leaves, output_ports
from vtbdrake.testbed.dependencies import connections, writer_of
from vtbdrake.testbed.switch import T_ACT


class LeafSystems:
    """The leaf systems of a Diagram by path, with their equations and their connections.

    Attributes:
        diagram: The Diagram.
        context: The root context with what is compiled in.
        variables: The variables of the Diagram.
        by_path: The leaf systems by path.
        equations: The equations of the systems that have some, by path.
        uncovered: Why other systems have none, by path.
        timings: The different timings of their updates.
    """

    def __init__(self, diagram: Diagram, context: Context, variables: Variables, varied: Sequence[str]) -> None:
        """Read a Diagram.

        Args:
            diagram: The Diagram.
            context: A root context, with what is compiled in.
            variables: Its variables.
            varied: Addresses of variables that will be varied.

        Raises:
            UnsupportedTestbedError: Parts of the Diagram cannot be compiled; all are named.
            ValueError: An address does not exist.
        """
        self.diagram, self.context, self.variables = diagram, context, variables
        self._paths = {system: path for path, system in leaves(diagram)}
        self._sources = {reader: writer for writer, reader in connections(diagram)}
        self._ports = output_ports(diagram)
        self.by_path: Mapping[str, System] = {path: system for system, path in self._paths.items()}
        whole = [variables[address].address.partition("[")[0] for address in varied]
        _refuse_continuous_systems(self.by_path, context)  # Quickly, before equations are written.
        self.equations, self.uncovered = self._written_equations(whole)
        self.timings = tuple(dict.fromkeys(when for each in self.equations.values() for when, _ in each.updates()))

    def _written_equations(self, varied: Sequence[str]) -> tuple[dict[str, Equations], dict[str, str]]:
        """Return the equations of systems by path, and why the other systems have none.

        Args:
            varied: Addresses of whole variables that will be varied.

        Raises:
            UnsupportedTestbedError: One of the others computes something.
        """
        equations: dict[str, Equations] = {}
        uncovered: dict[str, str] = {}
        for path, system in self.by_path.items():
            names = frozenset(filter(None, (self.name_within(path, address) for address in varied)))
            try:
                if is_scene_graph(system):
                    raise UnsupportedTestbedError("geometry is not compiled")
                equations[path] = equations_of(system, self.context_of(path, self.context), names)
            except UnsupportedTestbedError as error:
                uncovered[path] = str(error)
        if refused := [f"{path}: {why}" for path, why in uncovered.items() if _matters(self.by_path[path])]:
            raise UnsupportedTestbedError(f"the testbed cannot be compiled: {'; '.join(refused)}")
        return equations, uncovered

    def path_of(self, system: System) -> str:
        """Return the path of a leaf system; empty if it is none."""
        return self._paths.get(system, "")

    def context_of(self, path: str, root: Context) -> Context:
        """Return the context of a leaf system in a root context.

        Args:
            path: Path of the leaf system.
            root: The root context.
        """
        return self.by_path[path].GetMyContextFromRoot(root)

    def source(self, path: str, number: int) -> tuple[str, str] | None:
        """Return (path, name) of the output port that is connected to an input port of a leaf system, if any.

        Args:
            path: Path of the leaf system.
            number: Index of the input port.
        """
        source = self._sources.get((self.by_path[path], number))
        return None if source is None else self._port_of_leaf(*source)

    def fixed_value(self, path: str, number: int, root: Context) -> Array | None:
        """Return the value that is fixed at an input port to which nothing is connected, shape (n,), if any.

        Args:
            path: Path of the leaf system.
            number: Index of the input port.
            root: A root context.

        Raises:
            UnsupportedTestbedError: The port is abstract.
        """
        context = self.context_of(path, root)
        port = self.by_path[path].get_input_port(number)
        if not port.HasValue(context):
            return None
        if port.get_data_type() != PortDataType.kVectorValued:
            raise UnsupportedTestbedError(
                f"{path}: a value is fixed at the abstract input port {port.get_name()}, which is not compiled: "
                "connect a ConstantValueSource"
            )
        return np.array(port.Eval(context))

    def output_port(self, address: str) -> tuple[str, str]:
        """Return (path, name) of the leaf system's output port that an address names, or that is exported there.

        Raises:
            AddressError: There is no such port.
            ValueError: It is abstract.
        """
        system, port = self._port(address)
        if port.get_data_type() != PortDataType.kVectorValued:
            raise ValueError(f"{address} is an abstract port, whose value cannot be recorded in a compiled testbed")
        return self._port_of_leaf(*writer_of(system, port.get_index()))

    def reader(self, address: str) -> Callable[[Context], Any]:
        """Return a function that reads a variable or an output port from a root context."""
        if address in self.variables:
            return self.variables[address].get
        system, port = self._port(address)
        return lambda context: port.Eval(context if system is self.diagram else system.GetMyContextFromRoot(context))

    def _port(self, address: str) -> tuple[System, OutputPort]:
        if address not in self._ports:
            near = suggestion(address, [*self.variables, *self._ports])
            raise AddressError(f"there is no variable and no port {address!r}{near}")
        return self._ports[address]

    def _port_of_leaf(self, leaf: System, number: int) -> tuple[str, str]:
        return self._paths[leaf], leaf.get_output_port(number).get_name()

    def name_within(self, path: str, address: str) -> str:
        """Return the name of a variable within the system at a path; empty if it belongs to another one.

        Args:
            path: Path of the leaf system.
            address: Address of the variable.
        """
        prefixes = [path, "sim.sys", "sim.env"] if is_plant(self.by_path[path]) else [path]
        return next((address[len(p) + 1 :] for p in prefixes if address.startswith(f"{p}.")), "")

    def reason_not_in_state(self, address: str) -> str:
        """Return the reason that a variable is not among the compiled state and parameters."""
        if self.variables[address].derived:
            return "it is computed from others"
        whole = address.partition("[")[0]
        for path, equations in self.equations.items():
            if name := self.name_within(path, whole):
                return equations.refused(name)
        for path, why in self.uncovered.items():
            if self.name_within(path, whole):
                return why
        if whole.startswith("T_"):
            return "the positions of the switches are compiled in"
        return "it is computed from others"


def _refuse_continuous_systems(systems: Mapping[str, System], root: Context) -> None:
    """Refuse systems with continuous state, but for the ones that the testbed has for them, and name the remedies.

    Raises:
        UnsupportedTestbedError: There are some.
    """
    continuous = [
        (path, system) for path, system in systems.items() if system.GetMyContextFromRoot(root).num_continuous_states()
    ]
    # Where the world is continuous, the actuators' switches have states that notice what is not finite.
    users = [(path, system) for path, system in continuous if not path.startswith(T_ACT)] or continuous
    remedies = [
        f"{path}: {class_name(system)} has continuous state, and a compiled rollout has steps: "
        + (
            "give it a time step (MultibodyPlantConfig(time_step=0.001)), or take another executor"
            if is_plant(system)
            else "give it a time step, write its update as a casadi.Function, or take another executor"
        )
        for path, system in users
    ]
    if remedies:
        raise UnsupportedTestbedError(f"the testbed cannot be compiled: {'; '.join(remedies)}")


def _matters(system: System) -> bool:
    """Return whether a compiled Diagram without a system could be another one, though no other system reads it.

    So it is with state, and with events of a user's system in Python, which may end a simulation.
    """
    if is_scene_graph(system):
        return False
    if is_python(system) and not type(system).__module__.startswith("vtbdrake."):
        return True
    context = system.CreateDefaultContext()
    return bool(context.num_continuous_states() or context.num_discrete_state_groups() or context.num_abstract_states())
