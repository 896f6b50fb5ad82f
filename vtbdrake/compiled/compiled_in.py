"""The values that are compiled in: they are compared whenever a context or a vector z is given."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.common.arrays import Array
from vtbdrake.compiled.equations import UnsupportedTestbedError
from vtbdrake.compiled.leaf_systems import LeafSystems
from vtbdrake.compiled.state_vector import StateVector, indices_of
from vtbdrake.state.variables import A


class CompiledIn:
    """The values of a root context that are compiled in: they are no entries of z, or entries that cannot be varied.

    Args:
        systems: The leaf systems of the Diagram; their context has the values.
        vector: The layout of z.
    """

    def __init__(self, systems: LeafSystems, vector: StateVector) -> None:
        self._systems, self._vector = systems, vector
        self._values = self._read(systems.context)
        self._entries = indices_of(fixed.entries for fixed in vector.fixed)
        self._at_ports: dict[tuple[str, int], Array] = {}

    def fixed_input(self, path: str, number: int) -> Array | None:
        """Return the value that is fixed at an input port to which nothing is connected, shape (n,), if any.

        From now on it is compiled in.

        Args:
            path: Path of the leaf system.
            number: Index of the input port.

        Raises:
            UnsupportedTestbedError: The port is abstract.
        """
        value = self._systems.fixed_value(path, number, self._systems.context)
        if value is not None:
            self._at_ports[path, number] = value
        return value

    def check_context(self, context: Context) -> None:
        """Check that a root context differs from the compiled one only in z, and there not in what is compiled in.

        Raises:
            UnsupportedTestbedError: It differs.
        """
        for path, value in self._read(context).items():
            if value != self._values[path]:
                raise UnsupportedTestbedError(
                    f"{path} differs from what was compiled{self._difference(path, context)}: compile the testbed in "
                    "this context, or name what varies in parameters="
                )
        for (path, number), value in self._at_ports.items():
            other = self._systems.fixed_value(path, number, context)
            if other is None or not np.array_equal(value, other):
                name = self._systems.by_path[path].get_input_port(number).get_name()
                raise UnsupportedTestbedError(
                    f"the value fixed at the input port {name} of {path} differs from what was compiled: compile the "
                    "testbed in this context"
                )

    def check_vectors(self, z: Array, compiled: Array) -> None:
        """Check that vectors z have the values of the compiled one in what is compiled in.

        Args:
            z: The vectors to check, shape (n, size).
            compiled: The vector z with what was compiled in, shape (size,).

        Raises:
            UnsupportedTestbedError: They differ.
        """
        if (z[:, self._entries] == compiled[self._entries]).all():
            return
        fixed = next(f for f in self._vector.fixed if not (z[:, f.entries] == compiled[f.entries]).all())
        raise UnsupportedTestbedError(f"{fixed.path} differs from what was compiled: {fixed.reason}")

    def _read(self, context: Context) -> dict[str, Any]:
        """Return the compiled values of each system that are neither in z nor at ports, by its path."""
        probe = context.Clone()
        self._vector.write_extras_of(self._systems.context, probe)  # These may differ.
        return {
            path: equations.compiled_in(self._systems.context_of(path, probe))
            for path, equations in self._systems.equations.items()
        }

    def _difference(self, path: str, context: Context) -> str:
        """Return the variables of a system that differ from the compiled ones as text, at most three of them."""
        pairs = {
            address: (variable.get(context), variable.get(self._systems.context))
            for address, variable in self._systems.variables.items()
            if variable.kind == A and not variable.derived and self._systems.name_within(path, address)
        }
        differing = [
            f"{address} is {np.asarray(value).tolist()} instead of {np.asarray(compiled).tolist()}"
            for address, (value, compiled) in pairs.items()
            if not np.array_equal(value, compiled)
        ]
        return f" ({', '.join([*differing[:3], *(['...'] if differing[3:] else [])])})" if differing else ""
