"""The variables and ports whose values a session tells in each frame."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.common.failures import FAILURES
from vtbdrake.common.json_data import plain
from vtbdrake.state.variables import X, entry_units
from vtbdrake.testbed.switch import COMMAND

# What a page opens with, at most; of a model file, whose joints are commands, it shows all.
_OPENING_COMMANDS = 4
_OPENING_JOINTS = 8

if TYPE_CHECKING:
    from pydrake.systems.framework import Context

    from vtbdrake.state import Variable
    from vtbdrake.testbed import VirtualTestbed


class Groups:
    """What each of several viewers has asked for, such as addresses or layers."""

    def __init__(self) -> None:
        self._names: dict[object, tuple[str, ...]] = {}

    def set(self, viewer: object, names: Collection[str]) -> None:
        """Replace what a viewer has asked for; nothing ends it.

        Args:
            viewer: Who asks: any object that can be a key.
            names: What it asks for from now on.
        """
        self._names.pop(viewer, None)
        if names:
            self._names[viewer] = tuple(names)

    def names(self) -> tuple[str, ...]:
        """Return the names that anybody has asked for, each once."""
        return tuple(dict.fromkeys(name for group in list(self._names.values()) for name in group))


class Watching:
    """Reads what several watchers want to see.

    Args:
        testbed: The testbed.
    """

    def __init__(self, testbed: VirtualTestbed) -> None:
        self._testbed = testbed
        self._watched = Groups()
        self._readers: dict[str, Callable[..., Any]] = {}

    @property
    def addresses(self) -> tuple[str, ...]:
        """Return the watched addresses."""
        return tuple(self._readers)

    def watch(self, watcher: object, addresses: Collection[str]) -> None:
        """Read variables and ports for one of several watchers; an empty list ends it.

        Args:
            watcher: Who watches: any object that can be a key; what it has watched before is replaced.
            addresses: Addresses of variables and ports.

        Raises:
            AddressError: There is no such variable or port.
        """
        readers = self._readers | {address: self._testbed.reader(address) for address in addresses}
        self._watched.set(watcher, addresses)
        watched = set(self._watched.names())
        self._readers = {address: reader for address, reader in readers.items() if address in watched}

    def read(self, context: Context, world: Context) -> tuple[dict[str, Any], list[BaseException]]:
        """Return the watched values as plain data, and errors; None stands for a value that a state does not have.

        Args:
            context: The root context from which the values are read, unless they are simulated.
            world: The root context from which the simulated values are read, whose addresses begin with ``sim.``.
        """
        values: dict[str, Any] = {}
        errors: list[BaseException] = []
        for address, reader in self._readers.items():
            try:
                values[address] = page_value(reader(world if address.startswith("sim.") else context))
            except FAILURES as error:
                values[address] = None
                errors.append(error)
        return values, errors


def describe(variable: Variable) -> dict[str, Any]:
    """Return the description of a variable for a page, for JSON.

    ``unit`` has the units of its entries once each; ``units`` has one for each entry, where they differ.
    """
    units = entry_units(variable.unit, variable.shape)
    return {
        "kind": variable.kind,
        "shape": list(variable.shape),
        "unit": ", ".join(dict.fromkeys(units)),
        "units": list(units) if len(set(units)) > 1 else [],
        "bounds": [page_value(np.broadcast_to(bound, variable.shape)) for bound in variable.bounds],
        "settable": not variable.derived,
        "entries": list(variable.entry_names),
        "choices": [{"value": value, "name": name or f"{value:g}"} for value, name in variable.choices],
    }


def opening_addresses(variables: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the addresses that a page watches first: commands u, then joints, or else poses of floating bodies.

    Where nothing but commands moves the world, as in a model file that is shown without dynamics, these are all
    commands.

    Args:
        variables: Descriptions by address, see `describe`.
    """
    moving = [address for address, variable in variables.items() if variable["settable"] and variable["kind"] == X]
    commands = [address for address in moving if address.startswith(COMMAND)]
    joints = [a for a in moving if a.startswith("sim.sys.") and a.endswith(".position") and not variables[a]["shape"]]
    poses = [a for a in moving if a.startswith("sim.sys.") and a.endswith(".pose")]
    if not (joints or poses):
        return commands
    return [*commands[:_OPENING_COMMANDS], *(joints or poses)[:_OPENING_JOINTS]]


def page_value(value: Any) -> Any:
    """Return a value of a variable or a port as plain data, for JSON: numbers, or the class of an abstract value."""
    if isinstance(value, float | int | bool):
        return plain(float(value))
    if isinstance(value, np.ndarray):
        return plain(value.astype(float).ravel())
    return type(value).__name__
