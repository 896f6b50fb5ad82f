"""The equations of Drake's own systems: those that it converts to symbolic expressions, switches, trajectories."""

from __future__ import annotations

import operator
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any

import casadi
import numpy as np
from pydrake.symbolic import Expression as DrakeExpression
from pydrake.symbolic import ExpressionKind, Formula, FormulaKind, Variable
from pydrake.systems.framework import Context, PortDataType, System

from vtbdrake.common.arrays import Array
from vtbdrake.compiled.equations import (
    REMEDY,
    At,
    Draw,
    Equations,
    Expression,
    UnsupportedTestbedError,
    refusal,
)


class SymbolicEquations(Equations):
    """The equations of a system that Drake itself converts to symbolic expressions.

    Gains, sums, multiplexers, saturations, holds, delays, discrete integrators and derivatives, linear and affine
    systems, constant sources, sines, `SymbolicVectorSystem` and others are converted; systems in C++ and templates in
    Python that support `Expression` as their scalar, too.
    """

    def __init__(self, system: System, context: Context, varied: frozenset[str]) -> None:
        super().__init__(system, context, varied)
        symbolic = system.ToSymbolicMaybe()
        if symbolic is None:
            raise self._unwritten()
        # A converted context: some systems have values beside the numeric groups.
        self._symbolic, self._context = symbolic, symbolic.CreateDefaultContext()
        sizes = [context.get_discrete_state(i).size() for i in range(context.num_discrete_state_groups())]
        if (self.timing is None and any(sizes)) or context.num_abstract_states():
            raise refusal(system, f"has state beside one periodic discrete update: {REMEDY}")
        if system.GetWitnessFunctions(context):
            raise refusal(system, f"has witness functions: {REMEDY}")
        self._variables: dict[str, list[Variable]] = {}
        c = self._context
        c.SetTime(DrakeExpression(self._new("time", 1)[0]))
        for i in range(symbolic.num_input_ports()):
            port = symbolic.get_input_port(i)
            if port.get_data_type() != PortDataType.kVectorValued:
                raise refusal(system, f"has the abstract input port {port.get_name()}: {REMEDY}")
            port.FixValue(c, _expressions(self._new(f"input {i}", port.size())))
        for i in range(c.num_discrete_state_groups()):
            c.SetDiscreteState(i, _expressions(self._new(f"state {i}", c.get_discrete_state(i).size())))
        for i in range(c.num_numeric_parameter_groups()):
            parameter = c.get_mutable_numeric_parameter(i)
            parameter.SetFromVector(_expressions(self._new(f"parameter {i}", parameter.size())))

    def output(self, port: str, at: At) -> Expression:
        if self.system.GetOutputPort(port).get_data_type() != PortDataType.kVectorValued:
            raise refusal(self.system, f"has the abstract output port {port}: {REMEDY}")
        try:
            value = self._symbolic.GetOutputPort(port).Eval(self._context)
        except RuntimeError as error:
            raise self._unwritten(error) from None
        return self._translated(value, at)

    def update(self, at: At) -> dict[int, Expression]:
        try:
            following = self._symbolic.EvalUniquePeriodicDiscreteUpdate(self._context)
        except RuntimeError as error:
            raise self._unwritten(error) from None
        return {i: self._translated(following.value(i), at) for i in range(following.num_groups())}

    def _unwritten(self, error: RuntimeError | None = None) -> UnsupportedTestbedError:
        why = "" if error is None else f" ({' '.join(str(error).split())})"
        return refusal(self.system, f"has no equations that Drake can write down{why}: {REMEDY}")

    def _new(self, name: str, size: int) -> list[Variable]:
        return self._variables.setdefault(name, [Variable(f"{name} {k}") for k in range(size)])

    def _translated(self, values: Any, at: At) -> Expression:
        expressions = [_as_expression(value) for value in np.ravel(values)]
        used = {variable.get_id() for e in expressions for variable in e.GetVariables()}
        symbols: dict[int, Expression] = {}
        for name, variables in self._variables.items():
            if used.intersection(variable.get_id() for variable in variables):
                source, _, number = name.partition(" ")
                value = at.time if source == "time" else getattr(at, source)(int(number))
                symbols |= {variable.get_id(): value[k] for k, variable in enumerate(variables)}
        try:
            return casadi.vertcat(casadi.SX(0, 1), *(from_drake(e, symbols) for e in expressions))
        except NotImplementedError as error:
            raise self._unwritten(error) from None


def _expressions(variables: Sequence[Variable]) -> np.ndarray:
    return np.array([DrakeExpression(variable) for variable in variables], dtype=object)


def from_drake(expression: DrakeExpression, symbols: Mapping[int, Expression]) -> Expression:
    """Return a symbolic expression of Drake as one of CasADi; ``symbols`` are its variables, by their ids.

    Args:
        expression: The expression of Drake.
        symbols: The expression that stands for each variable, by the id that Drake gives the variable.
    """
    kind = expression.get_kind()
    if kind == ExpressionKind.Var:
        (variable,) = expression.GetVariables()
        return symbols[variable.get_id()]
    if kind == ExpressionKind.Constant:
        return casadi.SX(expression.Evaluate())
    _, arguments = expression.Unapply()
    if kind not in _OPERATIONS:
        raise NotImplementedError(f"there is no expression of CasADi for {expression}")
    return _OPERATIONS[kind](*(_argument(argument, symbols) for argument in arguments))


def _as_expression(value: Any) -> DrakeExpression:
    return value if isinstance(value, DrakeExpression) else DrakeExpression(value)


def _argument(argument: Any, symbols: Mapping[int, Expression]) -> Expression:
    if isinstance(argument, Formula):
        return _from_formula(argument, symbols)
    return from_drake(_as_expression(argument), symbols)


def _from_formula(formula: Formula, symbols: Mapping[int, Expression]) -> Expression:
    kind = formula.get_kind()
    if kind in (FormulaKind.True_, FormulaKind.False_):
        return casadi.SX(float(kind == FormulaKind.True_))
    _, arguments = formula.Unapply()
    if kind not in _RELATIONS:
        raise NotImplementedError(f"there is no expression of CasADi for {formula}")
    return _RELATIONS[kind](*(_argument(argument, symbols) for argument in arguments))


def _folded(operation: Callable[[Any, Any], Any]) -> Callable[..., Any]:
    return lambda *arguments: reduce(operation, arguments)


_K = ExpressionKind
_F = FormulaKind
_OPERATIONS: dict[Any, Callable[..., Any]] = {
    _K.Add: _folded(operator.add),
    _K.Mul: _folded(operator.mul),
    _K.Div: operator.truediv,
    _K.Pow: operator.pow,
    _K.Min: casadi.fmin,
    _K.Max: casadi.fmax,
    _K.Abs: casadi.fabs,
    _K.Sqrt: casadi.sqrt,
    _K.Exp: casadi.exp,
    _K.Log: casadi.log,
    _K.Sin: casadi.sin,
    _K.Cos: casadi.cos,
    _K.Tan: casadi.tan,
    _K.Asin: casadi.asin,
    _K.Acos: casadi.acos,
    _K.Atan: casadi.atan,
    _K.Atan2: casadi.atan2,
    _K.Sinh: casadi.sinh,
    _K.Cosh: casadi.cosh,
    _K.Tanh: casadi.tanh,
    _K.Ceil: casadi.ceil,
    _K.Floor: casadi.floor,
    _K.IfThenElse: casadi.if_else,
}
_RELATIONS: dict[Any, Callable[..., Any]] = {
    _F.Eq: operator.eq,
    _F.Neq: operator.ne,
    _F.Gt: operator.gt,
    _F.Geq: operator.ge,
    _F.Lt: operator.lt,
    _F.Leq: operator.le,
    _F.And: _folded(casadi.logic_and),
    _F.Or: _folded(casadi.logic_or),
    _F.Not: casadi.logic_not,
}


class PortSwitchEquations(Equations):
    """Drake's PortSwitch, whose selected input is compiled in."""

    def output(self, port: str, at: At) -> Expression:
        return at.input(int(at.input(0)))


class ConstantValueEquations(Equations):
    """Drake's ConstantValueSource, whose abstract value is compiled in."""

    def output(self, port: str, at: At) -> Expression:
        return self.system.GetOutputPort(port).Eval(self.system.CreateDefaultContext())


class TrajectoryEquations(Equations):
    """Drake's TrajectorySource, whose values are data: they are looked up before a rollout, at its instants."""

    def __init__(self, system: System, context: Context, varied: frozenset[str]) -> None:
        super().__init__(system, context, varied)
        port, clock, lock = system.get_output_port(), system.CreateDefaultContext(), threading.Lock()

        def values(_: Array, times: Array) -> Array:
            looked_up = np.empty((1, len(times), port.size()))
            with lock:
                for row, time in zip(looked_up[0], times.tolist(), strict=True):
                    clock.SetTime(time)
                    row[:] = port.Eval(clock)
            return looked_up

        self.draws["value"] = Draw(port.size(), None, values)

    def output(self, port: str, at: At) -> Expression:
        return at.draw("value")
