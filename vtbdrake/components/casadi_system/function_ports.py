"""The mapping of the arguments and results of casadi.Functions to ports, state, parameters and time of a system."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from math import inf
from typing import Any

import casadi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.common.argument_checks import as_array
from vtbdrake.components.casadi_system.kernel import Expression, Kernel
from vtbdrake.state import declarations
from vtbdrake.state.declarations import Element

NEXT = "_next"
INPUT = "input"
STATE = "state"
PARAMETER = "parameter"
TIME = "time"

Shape = tuple[int, int]


@dataclass(frozen=True)
class ArgumentBlock:
    """Arguments that are read from the Context together, one after the other.

    Attributes:
        source: Where they are read: time, an input port, or a group of state or parameters.
        names: The names of the arguments, in their order.
    """

    source: str
    names: tuple[str, ...]


@dataclass(frozen=True)
class FunctionResult:
    """Something to be computed from ``blocks``, of ``size`` entries. ``shows`` names the state that it is, if any.

    Blocks of state come first, in order.

    Attributes:
        size: The number of its entries.
        blocks: The arguments that it is computed from; blocks of state come first.
        kernel: The function that computes it.
        shows: The name of the state that it is; None if it is none.
    """

    size: int
    blocks: tuple[ArgumentBlock, ...]
    kernel: Kernel
    shows: str | None


class Model:
    """The functions of a system, independent of its scalar type.

    Args:
        output: The function of the outputs, or None.
        time: The name of the argument that is the time, or None.
        units: SI units of state and parameters, by name.
        bounds: Closed intervals of state and parameters, by name.
        compile: Whether to make machine code; None: if there is a C compiler.

    Attributes:
        shapes: (rows, columns) of every argument and state.
        period: Period of the updates (s), or None.
        variables: State and parameters by address.
        inputs: The names of the arguments that are input ports.
        state, parameters: Default values, by name; flat, row after row.
        outputs: Outputs by name.
        update: All next states, one after the other, from all states; or None.
    """

    def __init__(
        self,
        output: casadi.Function | None,
        update: casadi.Function | None,
        *,
        state: Mapping[str, ArrayLike],
        period: float | None,
        parameters: Mapping[str, ArrayLike],
        time: str | None,
        units: Mapping[str, str],
        bounds: Mapping[str, tuple[float, float]],
        compile: bool | None,
    ) -> None:
        functions = {n: f for n, f in (("output", output), ("update", update)) if f is not None}
        if not functions:
            raise ValueError("a CasadiSystem needs a function: give output, update, or both.")
        for role, function in functions.items():
            _check_function(role, function)
        _check_sampling(update, state, period)
        self.period = period
        self.shapes = _argument_shapes(functions.values())
        arguments = tuple(self.shapes)
        if update is not None:
            self.shapes |= _next_shapes(update, self.shapes, tuple(state))
        clock = () if time is None else (time,)
        _check_names(PARAMETER, parameters, arguments)
        _check_names(TIME, clock, arguments)
        _check_names("units of", units, (*state, *parameters))
        _check_names("bounds of", bounds, (*state, *parameters))
        _check_disjoint({STATE: state, PARAMETER: parameters, TIME: clock})
        if time is not None and self.shapes[time] != (1, 1):
            raise ValueError(f"time is a scalar, but the argument {time!r} is {_size(self.shapes[time])}.")
        self.state = {name: _flat(STATE, name, value, self.shapes[name]) for name, value in state.items()}
        self.parameters = {name: _flat(PARAMETER, name, value, self.shapes[name]) for name, value in parameters.items()}
        self.variables = tuple(self._elements(units, bounds))
        arguments_of_model = {*state, *parameters, time}
        self.inputs = tuple(name for name in arguments if name not in arguments_of_model)
        self._blocks = (
            *(ArgumentBlock(STATE, (name,)) for name in state),
            *([ArgumentBlock(TIME, clock)] if clock else []),
            *([ArgumentBlock(PARAMETER, tuple(parameters))] if parameters else []),
            *(ArgumentBlock(INPUT, (name,)) for name in self.inputs),
        )
        self.update = None
        if update is not None:
            symbols, values = self._evaluated(update)
            following = casadi.vertcat(*(values[f"{name}{NEXT}"] for name in state))
            self.update = self._result(update.name(), symbols, following, compile, always=tuple(state))
        if output is not None:
            prefix = output.name()
            symbols, values = self._evaluated(output)
        else:
            prefix = "state"
            symbols = self._symbols(casadi.SX)
            values = {name: symbols[name] for name in state}
        self.outputs = {n: self._result(f"{prefix}_{n}", symbols, value, compile) for n, value in values.items()}

    def size(self, name: str) -> int:
        """Return the number of entries of an argument or state."""
        rows, columns = self.shapes[name]
        return rows * columns

    def state_index(self, name: str) -> int:
        """Return the number of a state's group in the Context. All parameters lie in group 0, one after the other."""
        return list(self.state).index(name)

    def _elements(self, units: Mapping[str, str], bounds: Mapping[str, tuple[float, float]]) -> Iterator[Element]:
        def described(name: str) -> dict[str, Any]:
            rows, columns = self.shapes[name]
            shape = (rows, columns) if columns > 1 else (rows,) if rows > 1 else ()
            return {"shape": shape, "unit": units.get(name, "1"), "bounds": bounds.get(name, (-inf, inf))}

        start = 0
        for name in self.parameters:
            yield Element(name, declarations.PARAMETER, 0, start=start, **described(name))
            start += self.size(name)
        for index, name in enumerate(self.state):
            yield Element(name, declarations.DISCRETE, index, **described(name))

    def _symbols(self, kind: type) -> dict[str, Expression]:
        return {name: kind.sym(f"a{k}", self.size(name)) for k, name in enumerate(self.shapes)}  # type: ignore[attr-defined]

    def _evaluated(self, function: casadi.Function) -> tuple[dict[str, Expression], dict[str, Expression]]:
        """Return the symbols of all arguments and the results, as columns that hold a matrix row after row."""
        symbols = self._symbols(casadi.SX if function.is_a("SXFunction") else casadi.MX)
        arguments = [casadi.reshape(symbols[n], *self.shapes[n][::-1]).T for n in function.name_in()]
        try:
            values = function.call(arguments, True, False)
        except RuntimeError:  # it was made with never_inline
            values = function.call(arguments)
        names = function.name_out()
        return symbols, {n: casadi.vec(casadi.densify(v).T) for n, v in zip(names, values, strict=True)}

    def _result(
        self,
        name: str,
        symbols: Mapping[str, Expression],
        y: Expression,
        compile: bool | None,
        always: tuple[str, ...] = (),
    ) -> FunctionResult:
        """Return ``y`` as a kernel of the arguments that occur in it and of those in ``always``."""
        # Which symbols occur, not Function.jac_sparsity: it leaves out symbols without a derivative, such as an index.
        names = {f"a{k}": name for k, name in enumerate(symbols)}
        # The entries of a vector a1 are a1_0, a1_1, ...
        used = {*always, *(names[symbol.name().partition("_")[0]] for symbol in casadi.symvar(y))}
        blocks = tuple(block for block in self._blocks if used.intersection(block.names))
        arguments = [symbols[n] for block in blocks for n in block.names]
        shows = None
        if len(blocks) == 1 and blocks[0].source == STATE and y.numel() == self.size(blocks[0].names[0]):
            shows = blocks[0].names[0] if casadi.is_equal(y, arguments[0]) else None
        return FunctionResult(
            y.numel(), blocks, Kernel(name, arguments, y, compile=compile if shows is None else False), shows
        )


def _check_function(role: str, function: object) -> None:
    if not isinstance(function, casadi.Function):
        raise ValueError(f"{role} is a casadi.Function, not {function!r}.")
    if function.has_free():
        raise ValueError(
            f"{function.name()} has the free variables {_listed(function.get_free())}: make them arguments."
        )
    for i, name in enumerate(function.name_in()):
        if not function.sparsity_in(i).is_dense() or function.numel_in(i) == 0:
            raise ValueError(
                f"{function.name()}: the argument {name!r} is {function.sparsity_in(i).dim(True)}, but must be dense "
                "and have entries."
            )
    for i, name in enumerate(function.name_out()):
        if function.numel_out(i) == 0:
            raise ValueError(f"{function.name()}: the result {name!r} is empty; leave it out.")


def _check_sampling(update: object, state: Mapping[str, ArrayLike], period: float | None) -> None:
    if update is None:
        if state:
            raise ValueError(f"the state {_listed(state)} never changes: give update, or make it a parameter.")
        if period is not None:
            raise ValueError(f"period is {period} s, but there is no update that it belongs to; leave it out.")
    elif period is None or not 0 < period < inf:
        raise ValueError(f"period is {period} s, but update needs a positive one.")
    elif not state:
        raise ValueError("update needs state: give the initial values by name, such as state={'x': [0.0, 0.0]}.")


def _argument_shapes(functions: Iterable[casadi.Function]) -> dict[str, Shape]:
    shapes: dict[str, Shape] = {}
    for function in functions:
        for i, name in enumerate(function.name_in()):
            shape = function.size_in(i)
            if shapes.setdefault(name, shape) != shape:
                raise ValueError(
                    f"the argument {name!r} is {_size(shapes[name])} in output, but {_size(shape)} in update; they are "
                    "one port, state or parameter of the system."
                )
    return shapes


def _next_shapes(update: casadi.Function, shapes: Mapping[str, Shape], state: tuple[str, ...]) -> dict[str, Shape]:
    """Return the shapes of the states after `update`."""
    expected, updated = [f"{name}{NEXT}" for name in state], update.name_out()
    if set(expected) != set(updated):
        raise ValueError(
            f"{update.name()} gives {_listed(updated)}, but the next values of the state {_listed(state)} are "
            f"expected: {_listed(expected)}."
        )
    following = {name: update.size_out(f"{name}{NEXT}") for name in state}
    for name, shape in following.items():
        if shapes.get(name, shape) != shape:
            raise ValueError(f"the state {name!r} is {_size(shapes[name])}, but {name + NEXT!r} is {_size(shape)}.")
    return following


def _check_names(role: str, names: Iterable[str], arguments: Iterable[str]) -> None:
    unknown = [name for name in names if name not in arguments]
    if unknown:
        raise ValueError(f"{role} {_listed(unknown)}: no such argument; there are {_listed(arguments)}.")


def _check_disjoint(roles: Mapping[str, Iterable[str]]) -> None:
    roles_by_name: dict[str, str] = {}
    for role, names in roles.items():
        for name in names:
            if name in roles_by_name:
                raise ValueError(f"{name!r} is {roles_by_name[name]} and {role}, but can be one thing only.")
            roles_by_name[name] = role


def _flat(role: str, name: str, value: ArrayLike, shape: Shape) -> NDArray[np.float64]:
    array = as_array(f"{role} {name!r}", value)
    accepted = {shape} | ({(max(shape),)} if 1 in shape else set()) | ({()} if shape == (1, 1) else set())
    if array.shape not in accepted:
        raise ValueError(f"{role} {name!r} has a value of shape {array.shape}, but is {_size(shape)}.")
    return array.ravel()


def _listed(names: Iterable[str]) -> str:
    return ", ".join(repr(str(name)) for name in names) or "none"


def _size(shape: Shape) -> str:
    return f"{shape[0]}x{shape[1]}"
