"""Walks over a Diagram: its leaf systems, connections, state and parameters as expressions of CasADi."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from pydrake.systems.framework import (
    Context,
    Diagram,
    OutputPort,
    PortDataType,
    System,
)

from vtbdrake.common.argument_checks import suggestion
from vtbdrake.common.arrays import Array
from vtbdrake.compiled.equations import (
    At,
    Draw,
    Equations,
    Expression,
    RefusedSystemError,
    Timing,
    UnsupportedTestbedError,
    zeros,
)
from vtbdrake.compiled.registry import equations_of
from vtbdrake.compiled.schedule import Instant
from vtbdrake.state import AddressError, Variables
from vtbdrake.state.declarations import DISCRETE, PARAMETER
from vtbdrake.state.layout import StateLayout
from vtbdrake.state.systems import (
    class_name,
    is_plant,
    is_python,
    is_scene_graph,
    leaves,
    output_ports,
    read_group,
    write_group,
)
from vtbdrake.state.variables import A, Place
from vtbdrake.testbed.dependencies import connections, writer_of
from vtbdrake.testbed.switch import T_ACT

EXTRA = "extra"
CONSTANT = "constant"


@dataclass(frozen=True)
class Block:
    """A part of the vector z, in which all state and parameters of a Diagram lie.

    Attributes:
        path: Path of the system.
        kind: ``discrete`` or ``parameter`` for a group of its context, or ``extra`` or ``constant``, see `Equations`.
        name: Number of the group, or the name.
        entries: Where it lies in z.
    """

    path: str
    kind: str
    name: int | str
    entries: slice


class Walker:
    """A Diagram as expressions of z, the vector of all its discrete state and parameters, and of the time.

    The last four entries of z are no state. When a system ends the simulation, the time and the number of the ending
    (see ``endings``) are written into the first two; nothing is updated any more. The last one is the doubt: it becomes
    positive when the rollout departs from the Diagram's, because a state is not finite, or by `Equations.doubt`, and
    stays so. It is then the number of a reason, and the entry before it is the time.

    Attributes:
        diagram: The Diagram.
        context: The root context with what is compiled in.
        timings: The different timings of its updates.
        blocks: The parts of z, by path of the system, kind and name.
        size: The number of entries of z.
        equations: The equations of the systems that have some, by path.
        uncovered: Why other systems have none, by path.
        draws: The random numbers of the updates, and other data, with their entries in w: (path, name, draw, entries).
        noise: The number of entries of w.
        fixed: Entries of z whose values are compiled in, with the address and the reason: (entries, path, reason).
        reasons: The reasons of a doubt, by its number from 1 on.
        endings: (path, message) of all endings of a simulation, by number from 1 on.
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
        self.diagram, self.variables = diagram, variables
        self.context = context
        self._sources = {reader: writer for writer, reader in connections(diagram)}
        self._paths = {system: path for path, system in leaves(diagram)}
        self._systems = {path: system for system, path in self._paths.items()}
        self._ports = output_ports(diagram)
        self._fixed_inputs: dict[tuple[str, int], Array] = {}
        self._places: dict[str, slice] = {}
        bases = [variables[address].address.partition("[")[0] for address in varied]
        self._refuse_continuous_systems()  # Quickly, before equations are written.
        self.equations, self.uncovered = self._written_equations(bases)
        self.timings = tuple(dict.fromkeys(when for each in self.equations.values() for when, _ in each.updates()))
        self.blocks = {(block.path, block.kind, block.name): block for block in self._layout()}
        self._extras = {self._address(b): b.entries for b in self.blocks.values() if b.kind == EXTRA}
        self.size = max((block.entries.stop for block in self.blocks.values()), default=0) + 4
        self.draws = tuple(self._reserved())
        self.noise = self.draws[-1][-1].stop if self.draws else 0
        self.fixed = tuple(self._fixed())
        self._states = {
            path: _indices(b.entries for b in self.blocks.values() if b.kind == DISCRETE and b.path == path)
            for path, equations in self.equations.items()
            if not equations.may_be_infinite
        }
        self.reasons = [f"the state of {path} is not finite" for path in self.equations]
        self.reasons += [f"{path}: {equations.doubtful}" for path, equations in self.equations.items()]
        self.endings = tuple((path, message) for path, each in self.equations.items() for message in each.endings)
        self._refuse_data_with_endings()
        self._all_fixed = _indices(entries for entries, _, _ in self.fixed)
        self._compiled_in = self._read_compiled_in(context)

    # -- z

    def read(self, context: Context) -> Array:
        """Return z of a root context, shape (size,), without doubt."""
        z = np.zeros(self.size)
        for block in self.blocks.values():
            if block.kind == EXTRA:
                z[block.entries] = np.ravel(self.variables[self._address(block)].get(context))
            elif block.kind == CONSTANT:
                z[block.entries] = self.equations[block.path].constants[str(block.name)]
            else:
                leaf_context = self._systems[block.path].GetMyContextFromRoot(context)
                z[block.entries] = read_group(leaf_context, block.kind, int(block.name))
        return z

    def with_constants(self, z: Array) -> Array:
        """Return vectors z, shape (n, size), with the present values of `Equations.constants`."""
        constants = [block for block in self.blocks.values() if block.kind == CONSTANT]
        if constants:
            z = z.copy()
        for block in constants:
            z[:, block.entries] = self.equations[block.path].constants[str(block.name)]
        return z

    def write(self, z: Array, context: Context) -> None:
        """Set a root context to z.

        Args:
            z: The vector z, shape (size,).
            context: The root context, whose state and parameters are set; its time is left as it is.
        """
        self._write_extras(z, context)
        for block in self.blocks.values():
            if block.kind not in (EXTRA, CONSTANT):
                leaf_context = self._systems[block.path].GetMyMutableContextFromRoot(context)
                write_group(leaf_context, block.kind, int(block.name), z[block.entries])

    def settle(self, begin: Array, z: Array, values: Mapping[str, Array]) -> None:
        """Set what a value changes beside itself, such as the inertia that a mass scales, and check inertias.

        Args:
            begin: The vector of state and parameters without the values, shape (size,).
            z: The vectors with the values, shape (n, size).
            values: Address -> values, of shape (1 or n, size of the variable).

        Raises:
            ValueError: A value is impossible: no rigid body has this inertia.
        """
        extras = self._extras
        values = {address: value for address, value in values.items() if address.partition("[")[0] in extras}
        if not values or all(self.variables[address].refuse is None for address in extras):
            return
        context = self.context.Clone()
        for k, row in enumerate(z):
            self._write_extras(begin, context)
            shapes = {address: self.variables[address].shape for address in values}
            self.variables.write(
                context, {a: value[k if len(value) > 1 else 0].reshape(shapes[a]) for a, value in values.items()}
            )
            for address, entries in extras.items():
                row[entries] = np.ravel(self.variables[address].get(context))

    def _write_extras(self, z: Array, context: Context) -> None:
        extras = self._extras.items()
        self.variables.write(context, {a: z[entries].reshape(self.variables[a].shape) for a, entries in extras})

    def check(self, context: Context) -> None:
        """Check that a root context differs from the compiled one only in z, and there not in what is compiled in.

        Raises:
            UnsupportedTestbedError: It differs.
        """
        for path, value in self._read_compiled_in(context).items():
            if value != self._compiled_in[path]:
                raise UnsupportedTestbedError(
                    f"{path} differs from what was compiled{self._difference(path, context)}: compile the testbed in "
                    "this context, or name what varies in parameters="
                )
        for (path, number), value in self._fixed_inputs.items():
            other = self._fixed_value(context, path, number)
            if other is None or not np.array_equal(value, other):
                name = self._systems[path].get_input_port(number).get_name()
                raise UnsupportedTestbedError(
                    f"the value fixed at the input port {name} of {path} differs from what was compiled: compile the "
                    "testbed in this context"
                )

    def _difference(self, path: str, context: Context) -> str:
        """Return the variables of a system that differ from the compiled ones as text, at most three of them."""
        pairs = {
            address: (variable.get(context), variable.get(self.context))
            for address, variable in self.variables.items()
            if variable.kind == A and not variable.derived and self._within(path, address)
        }
        differing = [
            f"{address} is {np.asarray(value).tolist()} instead of {np.asarray(compiled).tolist()}"
            for address, (value, compiled) in pairs.items()
            if not np.array_equal(value, compiled)
        ]
        return f" ({', '.join([*differing[:3], *(['...'] if differing[3:] else [])])})" if differing else ""

    def place(self, address: str) -> slice:
        """Return the slice of z that holds the value of a variable, to be varied.

        Raises:
            ValueError: It does not lie there, or is compiled in; the reason is named.
        """
        if address not in self._places:
            entries = self._lies(address)
            if entries is None:
                raise ValueError(f"{address} cannot be varied in the compiled testbed: {self._reason(address)}")
            for fixed, _, reason in self.fixed:
                if fixed.start < entries.stop and entries.start < fixed.stop:
                    raise ValueError(f"{address} cannot be varied in the compiled testbed: {reason}")
            self._places[address] = entries
        return self._places[address]

    def _lies(self, address: str) -> slice | None:
        """Return the slice of z that holds a variable, if it is there."""
        variable = self.variables[address]
        size = int(np.prod(variable.shape, dtype=int))
        if variable.place is not None:
            entries = self._entries(variable.place, size)
            if entries is not None:
                return entries
        base, _, entry = address.partition("[")
        if base not in self._extras:
            return None
        start = self._extras[base].start + int(entry.rstrip("]") or 0)
        return slice(start, start + size)

    def can_vary(self, address: str) -> bool:
        """Return whether a variable can be varied, see `place`."""
        try:
            self.place(address)
        except ValueError:
            return False
        return True

    def check_fixed(self, z: Array, compiled: Array) -> None:
        """Check that vectors z, shape (n, size), have the values of the compiled one in what is compiled in.

        Args:
            z: The vectors to check, a row each.
            compiled: The vector z with what was compiled in, shape (size,).

        Raises:
            UnsupportedTestbedError: They differ.
        """
        if not (z[:, self._all_fixed] == compiled[self._all_fixed]).all():
            path, why = next(
                (path, why) for entries, path, why in self.fixed if not (z[:, entries] == compiled[entries]).all()
            )
            raise UnsupportedTestbedError(f"{path} differs from what was compiled: {why}")

    def shared_with(self, layout: StateLayout) -> tuple[Array, Array]:
        """Return two arrays of indices: of a layout's numbers in z, and among the numbers of the layout."""
        pairs = [
            (block.entries, place)
            for block in self.blocks.values()
            if block.kind in (DISCRETE, PARAMETER)
            for place in [layout.slice_of_group(self._systems[block.path], block.kind, int(block.name))]
            if place is not None
        ]
        return _indices(entries for entries, _ in pairs), _indices(place for _, place in pairs)

    # -- expressions

    def update(self, timing: Timing, at: InstantOutputs, z: Expression) -> Expression:
        """Return z after the updates of a timing.

        Args:
            timing: One of ``timings``.
            at: The outputs before all updates of its kind.
            z: The vector z after the updates of other timings of its kind, if they are due.
        """
        following = casadi.SX(z)
        places: list[slice] = []
        for path, equations in self.equations.items():
            for update in [update for when, update in equations.updates() if when == timing]:
                with _addressed(path):
                    values = update(at.of(path))
                for number, value in values.items():
                    entries = self.blocks[path, DISCRETE, number].entries
                    if entries.start < entries.stop:
                        places.append(entries)
                        following[entries] = value
        following[-4:-2] = self._ending(timing, at, z)
        following[-2:] = self._doubt(at, z, following, _indices(places))
        return casadi.densify(following)

    def record(self, addresses: Sequence[str], at: InstantOutputs) -> tuple[dict[str, Expression], Expression]:
        """Return the values of variables and of vector output ports, each of shape (n, 1), and the doubt about them.

        Args:
            addresses: Addresses of the variables or of the output ports, or ``time``.
            at: The outputs at the instant.

        Returns:
            The values by address; and the time of the doubt and the doubt, shape (2, 1).
        """
        values = {address: self._value(address, at) for address in addresses}
        return values, self._doubt(at, at.z, at.z, np.arange(self.size))

    def reason(self, doubt: float, time: float) -> str:
        """Return the reason that a rollout is not the Diagram's, or an empty text if it is.

        Args:
            doubt: The number of the reason.
            time: When it was noticed, in s.
        """
        return f"{self.reasons[round(doubt) - 1]} at t = {time:.9g} s" if doubt > 0.0 else ""

    def message(self, ending: float, time: float) -> str:
        """Return the message of Drake's Simulator when a system ends the simulation, or an empty text if none has.

        Args:
            ending: The number of the ending.
            time: When it happened, in s.
        """
        if ending <= 0.0:
            return ""
        path, message = self.endings[round(ending) - 1]
        system, when = self._systems[path], f"{time:.0f}" if float(time).is_integer() else repr(float(time))
        return (
            f"Simulator returned early at time {when} because {type(system).__module__}.{type(system).__qualname__} "
            f"System '{system.GetSystemPathname()}' requested termination with message: \"{message}\""
        )

    def _ending(self, timing: Timing, at: InstantOutputs, z: Expression) -> Expression:
        """Return the time and the number of the first ending of an instant, shape (2, 1)."""
        number, present = 1, z[-3]
        for path, equations in self.equations.items():
            if equations.endings and equations.timing == timing:
                with _addressed(path):
                    ending = equations.ending(at.of(path))
                ending_number = casadi.if_else(ending > 0, number - 1 + ending, 0)
                is_first = casadi.logic_and(ending_number > 0, casadi.logic_or(present <= 0, ending_number < present))
                present = casadi.if_else(is_first, ending_number, present)
            number += len(equations.endings)
        return casadi.vertcat(casadi.if_else(present > 0, at.time, z[-4]), present)

    def _refuse_data_with_endings(self) -> None:
        """Refuse outputs that go on changing after the end of the simulation, when its last sample is taken."""
        data = [path for path, _, _, _ in self.draws if self.equations[path].timing is None]
        if data and self.endings:
            raise UnsupportedTestbedError(
                f"{self.endings[0][0]} ends the simulation, and {data[0]} shows data without updates, which is not "
                "compiled together: keep this testbed in Drake"
            )

    def _doubt(self, at: InstantOutputs, earlier: Expression, following: Expression, entries: Array) -> Expression:
        """Return the time of the doubt and the doubt, shape (2, 1); all that counts at the instant has been written.

        Args:
            at: The outputs at the instant.
            earlier: The vector z with a doubt that there may be already.
            following: The vector z with the entries that are checked.
            entries: The places of these entries.
        """
        doubt = casadi.SX(0)
        for number, (path, equations) in enumerate(self.equations.items(), 1):
            checked = np.intersect1d(entries, self._states.get(path, np.arange(0))).tolist()
            total = casadi.sum1(following[checked])
            doubt = casadi.if_else(casadi.fabs(total) < np.inf, doubt, number)
            about = equations.doubt(at.of(path))
            if about is not None:
                doubt = casadi.if_else(about <= 0, doubt, number + len(self.equations))
        is_new = casadi.logic_and(earlier[-1] <= 0, doubt > 0)
        return casadi.if_else(is_new, casadi.vertcat(at.time, doubt), earlier[-2:])

    def _value(self, address: str, at: InstantOutputs) -> Expression:
        if address == "time":
            return at.time
        if address in self.variables:
            entries = self._lies(address)
            value = self._derived(address, at) if entries is None else at.z[entries]
            if value is None:
                raise ValueError(f"{address} cannot be recorded in the compiled testbed: {self._reason(address)}")
            return value
        system, port = self._port(address)
        if port.get_data_type() != PortDataType.kVectorValued:
            raise ValueError(f"{address} is an abstract port, whose value cannot be recorded in a compiled testbed")
        leaf, number = writer_of(system, port.get_index())
        return casadi.densify(at.output(self._paths[leaf], leaf.get_output_port(number).get_name()))

    def _derived(self, address: str, evaluation: InstantOutputs) -> Expression | None:
        """Return the value of a variable that its system computes from the state, if it has an expression."""
        if self.variables[address].derived:
            for path, equations in self.equations.items():
                name = self._within(path, address)
                value = equations.derived(name, evaluation.of(path)) if name else None
                if value is not None:
                    return value
        return None

    def reader(self, address: str) -> Callable[[Context], Any]:
        """Return a function that reads an output of `output` from a root context."""
        if address in self.variables:
            return self.variables[address].get
        system, port = self._port(address)
        return lambda context: port.Eval(context if system is self.diagram else system.GetMyContextFromRoot(context))

    def _port(self, address: str) -> tuple[System, OutputPort]:
        if address not in self._ports:
            near = suggestion(address, [*self.variables, *self._ports])
            raise AddressError(f"there is no variable and no port {address!r}{near}")
        return self._ports[address]

    def source(self, path: str, number: int) -> tuple[str, str] | None:
        """Return (path, name) of the output port that is connected to an input port of a leaf system, if any.

        Args:
            path: Path of the leaf system.
            number: Index of the input port.
        """
        source = self._sources.get((self._systems[path], number))
        if source is None:
            return None
        system, port = source
        return self._paths[system], system.get_output_port(port).get_name()

    def fixed_input(self, path: str, number: int) -> Expression | None:
        """Return the value that is fixed at an input port to which nothing is connected, if any.

        Args:
            path: Path of the leaf system.
            number: Index of the input port.
        """
        value = self._fixed_value(self.context, path, number)
        if value is None:
            return None
        self._fixed_inputs[path, number] = value
        return casadi.SX(casadi.DM(value))

    def _fixed_value(self, context: Context, path: str, number: int) -> Array | None:
        system = self._systems[path]
        leaf_context = system.GetMyContextFromRoot(context)
        port = system.get_input_port(number)
        if not port.HasValue(leaf_context):
            return None
        if port.get_data_type() != PortDataType.kVectorValued:
            raise UnsupportedTestbedError(
                f"{path}: a value is fixed at the abstract input port {port.get_name()}, which is not compiled: "
                "connect a ConstantValueSource"
            )
        return np.array(port.Eval(leaf_context))

    # -- how it is done

    def _refuse_continuous_systems(self) -> None:
        """Refuse systems with continuous state, but for the ones that the testbed has for them, and name the remedies.

        Raises:
            UnsupportedTestbedError: There are some.
        """
        continuous = [
            (path, system)
            for path, system in self._systems.items()
            if system.GetMyContextFromRoot(self.context).num_continuous_states()
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

    def _written_equations(self, varied: Sequence[str]) -> tuple[dict[str, Equations], dict[str, str]]:
        """Return the equations of systems by path, and why the other systems have none.

        Args:
            varied: Addresses of whole variables that will be varied.

        Raises:
            UnsupportedTestbedError: One of the others computes something.
        """
        equations: dict[str, Equations] = {}
        uncovered: dict[str, str] = {}
        for path, system in self._systems.items():
            names = frozenset(filter(None, (self._within(path, address) for address in varied)))
            try:
                equations[path] = self._equations_of(path, system, names)
            except UnsupportedTestbedError as error:
                uncovered[path] = str(error)
        if refused := [f"{path}: {why}" for path, why in uncovered.items() if _matters(self._systems[path])]:
            raise UnsupportedTestbedError(f"the testbed cannot be compiled: {'; '.join(refused)}")
        return equations, uncovered

    def _equations_of(self, path: str, system: System, names: frozenset[str]) -> Equations:
        leaf_context = system.GetMyContextFromRoot(self.context)
        if is_scene_graph(system):
            raise UnsupportedTestbedError("geometry is not compiled")
        return equations_of(system, leaf_context, names)

    def _within(self, path: str, address: str) -> str:
        """Return the name of a variable within the system at a path, or nothing."""
        prefixes = [path, "sim.sys", "sim.env"] if is_plant(self._systems[path]) else [path]
        return next((address[len(p) + 1 :] for p in prefixes if address.startswith(f"{p}.")), "")

    def _address(self, block: Block) -> str:
        candidates = (f"{prefix}.{block.name}" for prefix in (block.path, "sim.sys", "sim.env"))
        return next(address for address in candidates if address in self.variables)

    def _reason(self, address: str) -> str:
        if self.variables[address].derived:
            return "it is computed from others"
        base = address.partition("[")[0]
        for path, equations in self.equations.items():
            if name := self._within(path, base):
                return equations.refused(name)
        for path, why in self.uncovered.items():
            if self._within(path, base):
                return why
        if base.startswith("T_"):
            return "the positions of the switches are compiled in"
        return "it is computed from others"

    def _entries(self, place: Place, size: int) -> slice | None:
        path = self._paths.get(place.system, "")
        block = self.blocks.get((path, place.group, place.index))
        if block is None:
            return None
        start = block.entries.start + place.start
        return slice(start, start + size)

    def _layout(self) -> Iterator[Block]:
        start = 0
        for path, equations in self.equations.items():
            leaf_context = equations.system.GetMyContextFromRoot(self.context)
            sizes: list[tuple[str, int | str, int]] = [
                (DISCRETE, i, leaf_context.get_discrete_state(i).size())
                for i in range(leaf_context.num_discrete_state_groups())
            ]
            if not is_plant(equations.system):
                count = leaf_context.num_numeric_parameter_groups()
                sizes += [(PARAMETER, i, leaf_context.get_numeric_parameter(i).size()) for i in range(count)]
            sizes += [(EXTRA, name, size) for name, size in equations.extras.items()]
            sizes += [(CONSTANT, name, 1) for name in equations.constants]
            for kind, name, size in sizes:
                yield Block(path, kind, name, slice(start, start + size))
                start += size

    def _fixed(self) -> Iterator[tuple[slice, str, str]]:
        for path, equations in self.equations.items():
            for fixed in equations.fixed():
                block = self.blocks[path, PARAMETER, fixed.group]
                indices = range(block.entries.stop - block.entries.start)[fixed.entries]
                yield slice(block.entries.start + indices.start, block.entries.start + indices.stop), path, fixed.reason

    def _read_compiled_in(self, context: Context) -> dict[str, Any]:
        probe = context.Clone()
        # These may differ.
        self.variables.write(probe, {address: self.variables[address].get(self.context) for address in self._extras})
        systems = {path: equations.system for path, equations in self.equations.items()}
        return {
            path: equations.compiled_in(systems[path].GetMyContextFromRoot(probe))
            for path, equations in self.equations.items()
        }

    def _reserved(self) -> Iterator[tuple[str, str, Draw, slice]]:
        start = 0
        for path, equations in self.equations.items():
            for name, draw in equations.draws.items():
                yield path, name, draw, slice(start, start + draw.size)
                start += draw.size

    def seeds(self, z: Array) -> Array:
        """Return the seeds of all draws in vectors z, shape (n, size), as an array of shape (n, draws)."""
        seeds = np.zeros((len(z), len(self.draws)))
        for k, (path, _, draw, _) in enumerate(self.draws):
            if draw.seed is not None:
                group, entry = draw.seed
                seeds[:, k] = z[:, self.blocks[path, PARAMETER, group].entries.start + entry]
        return seeds

    def draw_numbers(self, seeds: Array, instants: Sequence[Instant], count: int) -> Array:
        """Return the random numbers and other data of instants, shape (n, count, noise), 0 where none are used.

        Args:
            seeds: The seeds of the draws, shape (n, draws).
            instants: The instants.
            count: The number of rows, at least one for each instant.
        """
        numbers = np.zeros((len(seeds), count, max(1, self.noise)))
        for column, (path, _, draw, entries) in zip(seeds.T, self.draws, strict=True):
            timing = self.equations[path].timing
            number = None if timing is None else self.timings.index(timing)
            due = [k for k, instant in enumerate(instants) if number is None or number in instant.updates]
            times = np.array([instants[k].time for k in due])
            is_same = bool((column == column[0]).all())
            numbers[:, due, entries] = draw.numbers(column[:1] if is_same else column, times)
        return numbers


class InstantOutputs:
    """The outputs of all systems at one instant, each computed once.

    Args:
        walker: The Diagram.
        z: Its state and parameters.
        time: The time.
        w: The random numbers and other data of this instant.
    """

    def __init__(self, walker: Walker, z: Expression, time: Expression, w: Expression) -> None:
        self.walker, self.z, self.time, self.w = walker, z, time, w
        self._values: dict[tuple[str, str], Expression] = {}
        self._under_way: list[tuple[str, str]] = []
        self.shared: dict[tuple[str, str], Any] = {}

    def of(self, path: str) -> At:
        """Return the inputs, state and parameters that the system at a path reads."""
        return _Reading(self, path)

    def output(self, path: str, port: str) -> Expression:
        """Return the value of an output port of a leaf system.

        Args:
            path: Path of the leaf system.
            port: Name of its output port.

        Raises:
            UnsupportedTestbedError: The system cannot be compiled, or is part of an algebraic loop.
        """
        key = path, port
        if key in self._under_way:
            loop = " -> ".join(p for p, _ in [*self._under_way[self._under_way.index(key) :], key])
            raise UnsupportedTestbedError(f"the testbed has an algebraic loop, which is not compiled: {loop}")
        if key not in self._values:
            if path not in self.walker.equations:
                raise UnsupportedTestbedError(f"{path}: {self.walker.uncovered[path]}")
            self._under_way.append(key)
            with _addressed(path):
                self._values[key] = self.walker.equations[path].output(port, self.of(path))
            self._under_way.pop()
        return self._values[key]


@contextmanager
def _addressed(path: str) -> Iterator[None]:
    """Give the address of a system to the error that it cannot be compiled."""
    try:
        yield
    except RefusedSystemError as refusal:
        raise UnsupportedTestbedError(f"{path}: {refusal}") from None


class _Reading(At):
    """What the system at a path reads in an evaluation."""

    def __init__(self, evaluation: InstantOutputs, path: str) -> None:
        self._evaluation, self._path = evaluation, path
        self.time = evaluation.time

    def input(self, port: int | str) -> Expression:
        walker, number = self._evaluation.walker, self._number(port)
        source = walker.source(self._path, number)
        if source is not None:
            return self._evaluation.output(*source)
        value = walker.fixed_input(self._path, number)
        if value is None:
            name = walker.equations[self._path].system.get_input_port(number).get_name()
            raise UnsupportedTestbedError(f"{self._path}: nothing is connected to the input port {name}")
        return value

    def is_connected(self, port: int | str) -> bool:
        walker, number = self._evaluation.walker, self._number(port)
        return walker.source(self._path, number) is not None or walker.fixed_input(self._path, number) is not None

    def state(self, group: int) -> Expression:
        return self._entries(DISCRETE, group)

    def parameter(self, group: int) -> Expression:
        return self._entries(PARAMETER, group)

    def extra(self, name: str) -> Expression:
        return self._entries(EXTRA, name)

    def constant(self, name: str) -> Expression:
        return self._entries(CONSTANT, name)

    def shared(self, name: str, make: Callable[[], Any]) -> Any:
        shared, key = self._evaluation.shared, (self._path, name)
        if key not in shared:
            shared[key] = make()
        return shared[key]

    def is_shared(self, name: str) -> bool:
        return (self._path, name) in self._evaluation.shared

    def draw(self, name: str) -> Expression:
        draws = self._evaluation.walker.draws
        return self._evaluation.w[next(e for path, n, _, e in draws if (path, n) == (self._path, name))]

    def _entries(self, kind: str, name: int | str) -> Expression:
        entries = self._evaluation.walker.blocks[self._path, kind, name].entries
        return self._evaluation.z[entries] if entries.start < entries.stop else zeros(0)

    def _number(self, port: int | str) -> int:
        if isinstance(port, int):
            return port
        return int(self._evaluation.walker.equations[self._path].system.GetInputPort(port).get_index())


def _indices(places: Iterable[slice]) -> Array:
    return np.concatenate([np.arange(0), *(np.arange(place.start, place.stop) for place in places)])


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
