"""Systems written in CasADi whose state lies in few groups of the Context: what Python reads and writes per sample."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import casadi
import numpy as np
from pydrake.systems.framework import System

from vtbdrake.components.casadi_system import CasadiSystem
from vtbdrake.state import NamedVector
from vtbdrake.state.declarations import DISCRETE

Expression = Any  # casadi.SX
Step = Callable[[SimpleNamespace, SimpleNamespace, SimpleNamespace], Mapping[str, Expression]]


def packed_system(
    name: str,
    step: Step,
    *,
    state: Mapping[str, NamedVector],
    inputs: Mapping[str, NamedVector],
    parameters: NamedVector | None = None,
    period: float,
) -> System:
    """Return the `CasadiSystem` with the equation x_next = step(x, u, p), sampled at t = 0, T, 2 T, ...

    Each group of the state is an output port, and each quantity in it a variable with an address of its own.

    Args:
        name: Name of the function in messages.
        step: Function of the states, inputs and parameters, each an attribute by its name, that returns all next
            states by name; vectors have the shape (n, 1), matrices their own.
        state: The groups of the state, by name of the output port.
        inputs: The input ports, by name.
        parameters: The parameters.
        period: The sample period T in s.
    """
    parameters = parameters or NamedVector()
    x, x_values = _symbols(state)
    u, u_values = _symbols(inputs)
    p = {key: casadi.SX.sym(key, _size(parameters, key)) for key in parameters.quantities}
    p_values = SimpleNamespace(**{key: _shaped(symbol, parameters, key) for key, symbol in p.items()})
    following = step(x_values, u_values, p_values)
    results = {
        f"{group}_next": casadi.densify(casadi.vertcat(*(_column(following[key]) for key in vector.quantities)))
        for group, vector in state.items()
    }
    arguments = {**x, **p, **u}
    # What no equation reads has a port all the same.
    update = casadi.Function(name, [*arguments.values()], [*results.values()], [*arguments], [*results], {"cse": True})
    system = CasadiSystem(
        update=update,
        state={group: vector.array() for group, vector in state.items()},
        parameters={key: np.asarray(quantity.default, dtype=float) for key, quantity in parameters.quantities.items()},
        units={key: quantity.unit for key, quantity in parameters.quantities.items()},
        bounds={key: quantity.bounds for key, quantity in parameters.quantities.items()},
        period=period,
    )
    elements = (element for k, vector in enumerate(state.values()) for element in vector.elements(DISCRETE, k))
    system.variables = (*(each for each in system.variables if each.name not in state), *elements)
    return system


def _symbols(groups: Mapping[str, NamedVector]) -> tuple[dict[str, Expression], SimpleNamespace]:
    """Return a symbol for each group, and the quantities in them by name."""
    symbols = {group: casadi.SX.sym(group, vector.size) for group, vector in groups.items()}
    values = SimpleNamespace()
    for group, vector in groups.items():
        for key in vector.quantities:
            setattr(values, key, _shaped(symbols[group][vector.slice_of(key)], vector, key))
    return symbols, values


def _size(vector: NamedVector, key: str) -> int:
    return int(np.size(vector.quantities[key].default))


def _shaped(column: Expression, vector: NamedVector, key: str) -> Expression:
    """Return a quantity in its shape from a column that holds it row after row."""
    shape = np.shape(vector.quantities[key].default)
    return casadi.reshape(column, *shape[::-1]).T if len(shape) == 2 else column


def _column(value: Expression) -> Expression:
    """Return a matrix row after row as a column."""
    return casadi.vec(casadi.SX(value).T)
