"""The vector z of all discrete state and parameters of a Diagram: where they lie in it; from a context, and to one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.common.arrays import Array
from vtbdrake.compiled.leaf_systems import LeafSystems
from vtbdrake.state.declarations import DISCRETE, PARAMETER
from vtbdrake.state.layout import StateLayout
from vtbdrake.state.systems import is_plant, read_group, write_group
from vtbdrake.state.variables import Place

EXTRA = "extra"
CONSTANT = "constant"

# The last entries of z are no state; they are 0 where a rollout begins.
_NOTES = 4
# When a system has ended the simulation, in s.
ENDING_TIME = -4
# The number of that ending, from 1 on; 0 while none has.
ENDING = -3
# When the rollout has departed from the Diagram's, in s.
DOUBT_TIME = -2
# The number of the reason, from 1 on; 0 while it has not.
DOUBT = -1


@dataclass(frozen=True)
class Block:
    """A part of the vector z.

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


@dataclass(frozen=True)
class FixedEntries:
    """Entries of z whose values are compiled in.

    Attributes:
        entries: Where they lie in z.
        path: Path of the system.
        reason: Why they cannot be varied.
    """

    entries: slice
    path: str
    reason: str


class StateVector:
    """The layout of z, the vector of all discrete state and parameters of a Diagram.

    Behind them, the last entries of z note what happens in a rollout: when a system ends the simulation, the time and
    the number of the ending are written there (`ENDING_TIME`, `ENDING`), and nothing is updated any more. When the
    rollout departs from the Diagram's, because a state is not finite, or by `Equations.doubt`, so are the time and the
    number of the reason (`DOUBT_TIME`, `DOUBT`), which stay so.

    Args:
        systems: The leaf systems of the Diagram.

    Attributes:
        blocks: The parts of z, by path of the system, kind and name.
        size: The number of entries of z.
        fixed: The entries of z whose values are compiled in.
    """

    def __init__(self, systems: LeafSystems) -> None:
        self._systems, self._variables = systems, systems.variables
        self.blocks = {(block.path, block.kind, block.name): block for block in _layout(systems)}
        self.size = max((block.entries.stop for block in self.blocks.values()), default=0) + _NOTES
        self.fixed = tuple(self._fixed())
        self._extras = {self._address(b): b.entries for b in self.blocks.values() if b.kind == EXTRA}
        self._places: dict[str, slice] = {}

    def _fixed(self) -> Iterator[FixedEntries]:
        for path, equations in self._systems.equations.items():
            for fixed in equations.fixed():
                block = self.blocks[path, PARAMETER, fixed.group].entries
                indices = range(block.start, block.stop)[fixed.entries]
                yield FixedEntries(slice(indices.start, indices.stop), path, fixed.reason)

    def _address(self, block: Block) -> str:
        """Return the address of a variable that lies in no numeric group."""
        candidates = (f"{prefix}.{block.name}" for prefix in (block.path, "sim.sys", "sim.env"))
        return next(address for address in candidates if address in self._variables)

    # -- where variables lie

    def place(self, address: str) -> slice:
        """Return the slice of z that holds the value of a variable, to be varied.

        Raises:
            ValueError: It does not lie there, or is compiled in; the reason is named.
        """
        if address not in self._places:
            entries = self.find(address)
            if entries is None:
                reason = self._systems.reason_not_in_state(address)
                raise ValueError(f"{address} cannot be varied in the compiled testbed: {reason}")
            for fixed in self.fixed:
                if fixed.entries.start < entries.stop and entries.start < fixed.entries.stop:
                    raise ValueError(f"{address} cannot be varied in the compiled testbed: {fixed.reason}")
            self._places[address] = entries
        return self._places[address]

    def can_vary(self, address: str) -> bool:
        """Return whether a variable can be varied, see `place`."""
        try:
            self.place(address)
        except ValueError:
            return False
        return True

    def find(self, address: str) -> slice | None:
        """Return the slice of z that holds a variable, compiled in or not; None if it does not lie there."""
        variable = self._variables[address]
        size = int(np.prod(variable.shape, dtype=int))
        if variable.place is not None:
            entries = self._entries(variable.place, size)
            if entries is not None:
                return entries
        whole, _, entry = address.partition("[")
        if whole not in self._extras:
            return None
        start = self._extras[whole].start + int(entry.rstrip("]") or 0)
        return slice(start, start + size)

    def _entries(self, place: Place, size: int) -> slice | None:
        block = self.blocks.get((self._systems.path_of(place.system), place.group, place.index))
        if block is None:
            return None
        start = block.entries.start + place.start
        return slice(start, start + size)

    def shared_with(self, layout: StateLayout) -> tuple[Array, Array]:
        """Return two arrays of indices: of a layout's numbers in z, and among the numbers of the layout."""
        pairs = [
            (block.entries, place)
            for block in self.blocks.values()
            if block.kind in (DISCRETE, PARAMETER)
            for place in [layout.slice_of_group(self._systems.by_path[block.path], block.kind, int(block.name))]
            if place is not None
        ]
        return indices_of(entries for entries, _ in pairs), indices_of(place for _, place in pairs)

    # -- its values

    def read(self, context: Context) -> Array:
        """Return z of a root context, shape (size,), without doubt."""
        z = np.zeros(self.size)
        for block in self.blocks.values():
            if block.kind == EXTRA:
                z[block.entries] = np.ravel(self._variables[self._address(block)].get(context))
            elif block.kind == CONSTANT:
                z[block.entries] = self._constant(block)
            else:
                leaf_context = self._systems.context_of(block.path, context)
                z[block.entries] = read_group(leaf_context, block.kind, int(block.name))
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
                leaf_context = self._systems.by_path[block.path].GetMyMutableContextFromRoot(context)
                write_group(leaf_context, block.kind, int(block.name), z[block.entries])

    def with_constants(self, z: Array) -> Array:
        """Return vectors z, shape (n, size), with the present values of `Equations.constants`."""
        constants = [block for block in self.blocks.values() if block.kind == CONSTANT]
        if constants:
            z = z.copy()
        for block in constants:
            z[:, block.entries] = self._constant(block)
        return z

    def settle(self, begin: Array, z: Array, values: Mapping[str, Array]) -> None:
        """Set what a value changes beside itself, such as the inertia that a mass scales, and check inertias.

        Args:
            begin: The vector of state and parameters without the values, shape (size,).
            z: The vectors with the values, shape (n, size).
            values: Address -> values, of shape (1 or n, size of the variable).

        Raises:
            ValueError: A value is impossible: no rigid body has this inertia.
        """
        extras, variables = self._extras, self._variables
        values = {address: value for address, value in values.items() if address.partition("[")[0] in extras}
        if not values or all(variables[address].refuse is None for address in extras):
            return
        context = self._systems.context.Clone()
        for k, row in enumerate(z):
            self._write_extras(begin, context)
            shapes = {address: variables[address].shape for address in values}
            variables.write(
                context, {a: value[k if len(value) > 1 else 0].reshape(shapes[a]) for a, value in values.items()}
            )
            for address, entries in extras.items():
                row[entries] = np.ravel(variables[address].get(context))

    def write_extras_of(self, source: Context, context: Context) -> None:
        """Set the variables that lie in no numeric group to the values of another root context.

        Args:
            source: The root context whose values are read.
            context: The root context that is set.
        """
        self._variables.write(context, {address: self._variables[address].get(source) for address in self._extras})

    def _write_extras(self, z: Array, context: Context) -> None:
        extras = self._extras.items()
        self._variables.write(context, {a: z[entries].reshape(self._variables[a].shape) for a, entries in extras})

    def _constant(self, block: Block) -> float:
        return self._systems.equations[block.path].constants[str(block.name)]


def indices_of(entries: Iterable[slice]) -> Array:
    """Return the indices in all slices, one after the other."""
    return np.concatenate([np.arange(0), *(np.arange(part.start, part.stop) for part in entries)])


def _layout(systems: LeafSystems) -> Iterator[Block]:
    start = 0
    for path, equations in systems.equations.items():
        context = systems.context_of(path, systems.context)
        sizes: list[tuple[str, int | str, int]] = [
            (DISCRETE, i, context.get_discrete_state(i).size()) for i in range(context.num_discrete_state_groups())
        ]
        if not is_plant(equations.system):
            count = context.num_numeric_parameter_groups()
            sizes += [(PARAMETER, i, context.get_numeric_parameter(i).size()) for i in range(count)]
        sizes += [(EXTRA, name, size) for name, size in equations.extras.items()]
        sizes += [(CONSTANT, name, 1) for name in equations.constants]
        for kind, name, size in sizes:
            yield Block(path, kind, name, slice(start, start + size))
            start += size
