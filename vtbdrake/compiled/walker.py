"""A Diagram as expressions of CasADi: its updates, and what is recorded of it, at an instant."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import casadi
import numpy as np
from pydrake.systems.framework import Context, System

from vtbdrake.common.arrays import Array
from vtbdrake.compiled.compiled_in import CompiledIn
from vtbdrake.compiled.draws import Draws
from vtbdrake.compiled.equations import At, Expression, RefusedSystemError, Timing, UnsupportedTestbedError, zeros
from vtbdrake.compiled.leaf_systems import LeafSystems
from vtbdrake.compiled.state_vector import (
    CONSTANT,
    DOUBT,
    DOUBT_TIME,
    ENDING,
    ENDING_TIME,
    EXTRA,
    StateVector,
    indices_of,
)
from vtbdrake.state.declarations import DISCRETE, PARAMETER


class Walker:
    """A Diagram as expressions of z, the vector of all its discrete state and parameters, of the time, and of w.

    It walks over the leaf systems: each one's `Equations` read their inputs by following the connections.

    Attributes:
        systems: The leaf systems of the Diagram.
        vector: The layout of z.
        draws: The layout of w, the vector of the random numbers and other data of an instant.
        compiled_in: What is compiled in.
        context: The root context with what is compiled in.
        equations: The equations of the systems that have some, by path.
        timings: The different timings of their updates.
        reasons: The reasons of a doubt, by its number from 1 on, see `StateVector`.
        endings: (path, message) of all endings of a simulation, by number from 1 on.
    """

    def __init__(self, systems: LeafSystems) -> None:
        """Lay out the vectors z and w of a Diagram.

        Args:
            systems: The leaf systems of the Diagram; their context has what is compiled in.

        Raises:
            UnsupportedTestbedError: A system shows data without updates, and another one ends the simulation.
        """
        self.systems = systems
        self.vector = StateVector(systems)
        self.draws = Draws(systems, self.vector)
        self.context, self.equations, self.timings = systems.context, systems.equations, systems.timings
        self.reasons = [f"the state of {path} is not finite" for path in self.equations]
        self.reasons += [f"{path}: {equations.doubtful}" for path, equations in self.equations.items()]
        self.endings = tuple((path, message) for path, each in self.equations.items() for message in each.endings)
        self._refuse_data_with_endings()
        self.compiled_in = CompiledIn(systems, self.vector)
        # The entries of z that must be finite, by path of the system.
        self._finite = {
            path: indices_of(
                block.entries for block in self.vector.blocks.values() if (block.path, block.kind) == (path, DISCRETE)
            )
            for path, equations in self.equations.items()
            if not equations.may_be_infinite
        }

    def _refuse_data_with_endings(self) -> None:
        """Refuse outputs that go on changing after the end of the simulation, when its last sample is taken."""
        data = [each.path for each in self.draws.placed.values() if each.timing is None]
        if data and self.endings:
            raise UnsupportedTestbedError(
                f"{self.endings[0][0]} ends the simulation, and {data[0]} shows data without updates, which is not "
                "compiled together: keep this testbed in Drake"
            )

    # -- contexts and z, see `StateVector`

    def read(self, context: Context) -> Array:
        """Return z of a root context, shape (size,)."""
        return self.vector.read(context)

    def write(self, z: Array, context: Context) -> None:
        """Set a root context to z; its time is left as it is.

        Args:
            z: The vector z, shape (size,).
            context: The root context.
        """
        self.vector.write(z, context)

    def place(self, address: str) -> slice:
        """Return the slice of z that holds the value of a variable, to be varied.

        Raises:
            ValueError: It does not lie there, or is compiled in; the reason is named.
        """
        return self.vector.place(address)

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
                    entries = self.vector.blocks[path, DISCRETE, number].entries
                    if entries.start < entries.stop:
                        places.append(entries)
                        following[entries] = value
        following[ENDING_TIME:DOUBT_TIME] = self._ending(timing, at, z)
        following[DOUBT_TIME:] = self._doubt(at, z, following, indices_of(places))
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
        return values, self._doubt(at, at.z, at.z, np.arange(self.vector.size))

    def _value(self, address: str, at: InstantOutputs) -> Expression:
        if address == "time":
            return at.time
        if address in self.systems.variables:
            entries = self.vector.find(address)
            value = self._derived(address, at) if entries is None else at.z[entries]
            if value is None:
                reason = self.systems.reason_not_in_state(address)
                raise ValueError(f"{address} cannot be recorded in the compiled testbed: {reason}")
            return value
        return casadi.densify(at.output(*self.systems.output_port(address)))

    def _derived(self, address: str, at: InstantOutputs) -> Expression | None:
        """Return the value of a variable that its system computes from the state, if it has an expression."""
        if self.systems.variables[address].derived:
            for path, equations in self.equations.items():
                name = self.systems.name_within(path, address)
                value = equations.derived(name, at.of(path)) if name else None
                if value is not None:
                    return value
        return None

    def _ending(self, timing: Timing, at: InstantOutputs, z: Expression) -> Expression:
        """Return the time and the number of the first ending of an instant, shape (2, 1)."""
        number, present = 1, z[ENDING]
        for path, equations in self.equations.items():
            if equations.endings and equations.timing == timing:
                with _addressed(path):
                    ending = equations.ending(at.of(path))
                ending_number = casadi.if_else(ending > 0, number - 1 + ending, 0)
                is_first = casadi.logic_and(ending_number > 0, casadi.logic_or(present <= 0, ending_number < present))
                present = casadi.if_else(is_first, ending_number, present)
            number += len(equations.endings)
        return casadi.vertcat(casadi.if_else(present > 0, at.time, z[ENDING_TIME]), present)

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
            checked = np.intersect1d(entries, self._finite.get(path, np.arange(0))).tolist()
            total = casadi.sum1(following[checked])
            doubt = casadi.if_else(casadi.fabs(total) < np.inf, doubt, number)
            about = equations.doubt(at.of(path))
            if about is not None:
                doubt = casadi.if_else(about <= 0, doubt, number + len(self.equations))
        is_new = casadi.logic_and(earlier[DOUBT] <= 0, doubt > 0)
        return casadi.if_else(is_new, casadi.vertcat(at.time, doubt), earlier[DOUBT_TIME:])

    # -- what the last entries of z tell

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
        system, when = self.systems.by_path[path], f"{time:.0f}" if float(time).is_integer() else repr(float(time))
        return (
            f"Simulator returned early at time {when} because {type(system).__module__}.{type(system).__qualname__} "
            f"System '{system.GetSystemPathname()}' requested termination with message: \"{message}\""
        )


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
                raise UnsupportedTestbedError(f"{path}: {self.walker.systems.uncovered[path]}")
            self._under_way.append(key)
            with _addressed(path):
                self._values[key] = self.walker.equations[path].output(port, self.of(path))
            self._under_way.pop()
        return self._values[key]


class _Reading(At):
    """What the system at a path reads at an instant."""

    def __init__(self, instant: InstantOutputs, path: str) -> None:
        self._instant, self._walker, self._path = instant, instant.walker, path
        self.time = instant.time

    def input(self, port: int | str) -> Expression:
        number = self._number(port)
        source = self._walker.systems.source(self._path, number)
        if source is not None:
            return self._instant.output(*source)
        value = self._walker.compiled_in.fixed_input(self._path, number)
        if value is None:
            name = self._system.get_input_port(number).get_name()
            raise UnsupportedTestbedError(f"{self._path}: nothing is connected to the input port {name}")
        return casadi.SX(casadi.DM(value))

    def is_connected(self, port: int | str) -> bool:
        number = self._number(port)
        if self._walker.systems.source(self._path, number) is not None:
            return True
        return self._walker.compiled_in.fixed_input(self._path, number) is not None

    def state(self, group: int) -> Expression:
        return self._entries(DISCRETE, group)

    def parameter(self, group: int) -> Expression:
        return self._entries(PARAMETER, group)

    def extra(self, name: str) -> Expression:
        return self._entries(EXTRA, name)

    def constant(self, name: str) -> Expression:
        return self._entries(CONSTANT, name)

    def shared(self, name: str, make: Callable[[], Any]) -> Any:
        shared, key = self._instant.shared, (self._path, name)
        if key not in shared:
            shared[key] = make()
        return shared[key]

    def is_shared(self, name: str) -> bool:
        return (self._path, name) in self._instant.shared

    def draw(self, name: str) -> Expression:
        return self._instant.w[self._walker.draws.placed[self._path, name].entries]

    def _entries(self, kind: str, name: int | str) -> Expression:
        entries = self._walker.vector.blocks[self._path, kind, name].entries
        return self._instant.z[entries] if entries.start < entries.stop else zeros(0)

    @property
    def _system(self) -> System:
        return self._walker.systems.by_path[self._path]

    def _number(self, port: int | str) -> int:
        return port if isinstance(port, int) else int(self._system.GetInputPort(port).get_index())


@contextmanager
def _addressed(path: str) -> Iterator[None]:
    """Give the address of a system to the error that it cannot be compiled."""
    try:
        yield
    except RefusedSystemError as refusal:
        raise UnsupportedTestbedError(f"{path}: {refusal}") from None
