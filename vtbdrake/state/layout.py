"""The contents of many systems as one flat array: quick to read, to send and to write."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from vtbdrake.state.codecs import AbstractState, abstract_state
from vtbdrake.state.declarations import CONTINUOUS, DISCRETE, PARAMETER
from vtbdrake.state.systems import stateful_leaves, write_group
from vtbdrake.state.variables import Variable

_ABSTRACT = "/abstract"


class LayoutError(ValueError):
    """Contents have another layout."""


@dataclass(frozen=True, eq=False)
class FlatState:
    """The contents of some leaf systems, taken by a `StateLayout`: plain data, which pickles quickly.

    Attributes:
        names: The groups and their sizes, see `StateLayout.names`.
        numbers: The numbers of all groups, concatenated, shape (n,); read only.
        abstract: The abstract states as arrays, by ``path/index/part``.
    """

    names: tuple[str, ...]
    numbers: np.ndarray
    abstract: Mapping[str, np.ndarray]


class StateLayout:
    """Reads and writes the numeric groups and the abstract states of some leaf systems of a Diagram.

    The contents of SceneGraph and cameras are not part of a layout, nor is a plant's memory of its last discrete step.

    Args:
        diagram: The Diagram.
        state: Selects the systems whose state belongs to the layout, by path.
        parameters: Selects the systems whose parameters belong to it.

    Attributes:
        names: ``path/group/index (size)`` of each numeric group, then ``path/abstract`` of each system with abstract
            state. Layouts with the same names exchange their contents.

    Raises:
        SnapshotError: A system keeps an abstract value that no codec can carry.
    """

    def __init__(self, diagram: Diagram, *, state: Callable[[str], bool], parameters: Callable[[str], bool]) -> None:
        self._groups: list[tuple[System, list[tuple[str, int, slice]]]] = []
        self._abstract: list[tuple[str, System, AbstractState]] = []
        self._slices: dict[str, slice] = {}
        start = 0
        for leaf in stateful_leaves(diagram, only=lambda path: state(path) or parameters(path)):
            path, system = leaf.path, leaf.system
            if leaf.holds_ids:
                continue
            groups = []
            for kind, index, size in leaf.groups:
                if (parameters if kind == PARAMETER else state)(path):
                    groups.append((kind, index, slice(start, start + size)))
                    self._slices[f"{path}/{kind}/{index} ({size})"] = groups[-1][-1]
                    start += size
            if groups:
                self._groups.append((system, groups))
            if state(path) and (codecs := abstract_state(path, system, system.CreateDefaultContext())):
                self._abstract.append((path, system, codecs))
        self.names = (*self._slices, *(f"{path}{_ABSTRACT}" for path, _, _ in self._abstract))
        self.size = start

    def indices_in(self, whole: StateLayout) -> np.ndarray:
        """Return the indices of this layout's numbers in a layout that contains this one, shape (size,)."""
        places = [whole._slices[name] for name in self._slices]
        return np.concatenate([np.arange(place.start, place.stop) for place in places] or [np.arange(0)])

    def name_at(self, index: int) -> str:
        """Return the name of the group in which the number ``index`` lies."""
        return next(name for name, place in self._slices.items() if place.start <= index < place.stop)

    def slice_of(self, variable: Variable) -> slice | None:
        """Return the slice of the numbers with the value of a variable, in C order; None if it is not among them."""
        place = variable.place
        whole = None if place is None else self.slice_of_group(place.system, place.group, place.index)
        if place is None or whole is None:
            return None
        start = whole.start + place.start
        return slice(start, start + int(np.prod(variable.shape, dtype=int)))

    def slice_of_group(self, system: System, group: str, index: int) -> slice | None:
        """Return the slice of the numbers with a numeric group of a leaf system; None if it is not among them.

        Args:
            system: The leaf system.
            group: Kind of the group: `CONTINUOUS`, `DISCRETE` or `PARAMETER`.
            index: Number of the group among the system's groups of this kind.
        """
        groups = next((groups for each, groups in self._groups if each is system), [])
        return next((place for kind, number, place in groups if (kind, number) == (group, index)), None)

    def take(self, context: Context) -> FlatState:
        """Return the contents in a root context.

        Raises:
            SnapshotError: A codec does not accept the present abstract state.
        """
        numbers = np.empty(self.size)
        for system, groups in self._groups:
            leaf_context = system.GetMyContextFromRoot(context)
            for group, index, place in groups:
                if group == CONTINUOUS:
                    numbers[place] = leaf_context.get_continuous_state_vector().CopyToVector()
                elif group == DISCRETE:
                    numbers[place] = leaf_context.get_discrete_state(index).value()
                else:
                    numbers[place] = leaf_context.get_numeric_parameter(index).value()
        numbers.flags.writeable = False
        abstract = {
            f"{path}/{name}": np.array(array)
            for path, system, codecs in self._abstract
            for name, array in codecs.read(system.GetMyContextFromRoot(context)).items()
        }
        return FlatState(self.names, numbers, abstract)

    def put(self, context: Context, contents: FlatState) -> None:
        """Set the contents of a root context.

        Args:
            context: A root context of the Diagram, which is changed.
            contents: What `take` of a layout with the same names has returned.

        Raises:
            LayoutError: The contents are of another layout; nothing has been set.
            SnapshotError: The arrays of an abstract state do not fit.
        """
        self.check(contents)
        writers = [(system, codecs.writer(_of(path, contents.abstract))) for path, system, codecs in self._abstract]
        for system, groups in self._groups:
            leaf_context = system.GetMyMutableContextFromRoot(context)
            for group, index, place in groups:
                write_group(leaf_context, group, index, contents.numbers[place])
        for system, write in writers:
            write(system.GetMyMutableContextFromRoot(context))

    def part_of(self, contents: FlatState) -> FlatState:
        """Return the contents of this layout, out of contents that have more: of another Diagram with the same systems.

        Args:
            contents: Contents with all groups and abstract states of this layout.

        Raises:
            LayoutError: They lack one.
        """
        if missing := sorted(set(self.names) - set(contents.names)):
            raise LayoutError(f"the contents lack {missing[0]}")
        sizes = [int(name.rpartition("(")[2].rstrip(")")) for name in contents.names if not name.endswith(_ABSTRACT)]
        parts = dict(zip(contents.names, np.split(contents.numbers, np.cumsum(sizes)), strict=False))
        numbers = np.concatenate([np.zeros(0), *(parts[name] for name in self._slices)])
        prefixes = tuple(f"{path}/" for path, _, _ in self._abstract)
        abstract = {key: array for key, array in contents.abstract.items() if key.startswith(prefixes)}
        return FlatState(self.names, numbers, abstract)

    def check(self, contents: FlatState) -> None:
        """Check that contents are of this layout.

        Raises:
            LayoutError: The contents are of another layout; the message names the first difference.
        """
        if contents.names != self.names:
            raise LayoutError(difference(contents.names, self.names))
        if contents.numbers.shape != (self.size,):
            raise LayoutError(f"the contents are {self.size} numbers, not an array of shape {contents.numbers.shape}")


def difference(names: tuple[str, ...], expected: tuple[str, ...]) -> str:
    """Return the first differences between the names of two layouts as text; empty if there are none.

    Args:
        names: The names of the layout that is judged, see `StateLayout`.
        expected: The names of the layout with which it is compared.
    """
    missing = [name for name in expected if name not in names]
    foreign = [name for name in names if name not in expected]
    parts = [f"it lacks {missing[0]}"] if missing else []
    parts += [f"it has {foreign[0]}, which is not part of this testbed"] if foreign else []
    if not parts and names != expected:
        parts = ["its systems are in another order"]
    return "; ".join(parts)


def _of(path: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    prefix = f"{path}/"
    return {key.removeprefix(prefix): array for key, array in arrays.items() if key.startswith(prefix)}
