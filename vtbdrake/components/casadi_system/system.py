"""Any casadi.Function as a Drake system."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any

import casadi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.autodiffutils import AutoDiffXd
from pydrake.systems.framework import (
    BasicVector_,
    Context,
    Context_,
    DependencyTicket,
    DiscreteStateIndex,
    DiscreteValues_,
    InputPort_,
    LeafSystem_,
    NumericParameterIndex,
    SystemScalarConverter,
)
from pydrake.systems.scalar_conversion import TemplateSystem

from vtbdrake.components.casadi_system.function_ports import (
    INPUT,
    PARAMETER,
    STATE,
    TIME,
    ArgumentBlock,
    FunctionResult,
    Model,
)
from vtbdrake.components.casadi_system.handler import handler
from vtbdrake.state.declarations import NO_DICT, weakly
from vtbdrake.state.systems import class_for_float


# The scope is named, because Drake would look for it in the stack of all callers, which takes time.
@TemplateSystem.define(  # type: ignore[untyped-decorator]
    "CasadiSystem_", T_list=[float, AutoDiffXd], scope=sys.modules[__name__]
)
def CasadiSystem_(T: type) -> type:
    """`CasadiSystem` by scalar type."""

    class Impl(LeafSystem_[T]):
        r"""Controllers, estimators and other systems written in CasADi.

        .. pydrake_system::

            name: CasadiSystem
            input_ports:
            - <every argument that is neither state, nor parameter, nor time>
            output_ports:
            - <every result of output; without output, every state>

        Without state, y = output(u, p, t). With discrete state, y = output(x, u, p, t), and at t = 0, T, 2 T, ...
        x\ :sub:`next` = update(x, u, p, t). What an argument is, its name decides::

            law = casadi.Function("law", [q, v, k], [-k[0] * q - k[1] * v], ["q", "v", "gain"], ["torque"])
            CasadiSystem(law, parameters={"gain": [100.0, 10.0]}, units={"gain": "N m/rad, N m s/rad"})

            filter = casadi.Function("filter", [x, u], [x + 0.1 * (u - x)], ["x", "u"], ["x_next"])
            CasadiSystem(update=filter, state={"x": [0.0, 0.0]}, period=0.02)

        A matrix is a vector on ports, row after row (C order, as numpy's ``ravel`` and as the variables by address);
        CasADi's own order is column after column. Parameters and state are variables by address.

        An output depends exactly on the arguments whose symbols occur in it: so an output of the state
        alone is no direct feedthrough, and is computed only when the state changes. An output that is a state (and
        every output when ``output`` is left out) costs nothing. Every other output is computed for itself; what has
        much in common is cheaper as one vector. If the function is an MX graph with calls in it, all results of a
        call depend on all its arguments; `casadi.Function.expand` makes that exact, and is often faster.

        With AutoDiffXd the derivatives are CasADi's, by the chain rule.

        Args:
            output: Its results become output ports; its arguments are dense.
            update: Its results are the next values of all states, the one of ``x`` being named ``x_next``.
            state: The initial values, by name.
            period: Period of the updates (s).
            parameters: The default values, by name.
            time: The name of the argument that is the time (s).
            units: Units of states and parameters, by name; "1" if left out.
            bounds: (lower, upper) of the entries of states and parameters, by name; infinite if left out.
            compile: Evaluates machine code, which gives the same results. The first time, it is made by the C compiler
                ``cc`` (or CC, from the environment, with its CFLAGS), and kept in ``~/.cache/vtbdrake`` (or
                XDG_CACHE_HOME). None does so where it is possible. A Jacobian of more than 100,000 operations is
                interpreted.

        Raises:
            ValueError: Names, sizes or arguments that do not fit together.
            CompilerError: There is no C compiler, or it fails.
        """

        __slots__ = NO_DICT

        def _construct(
            self,
            output: casadi.Function | None = None,
            *,
            update: casadi.Function | None = None,
            state: Mapping[str, ArrayLike] | None = None,
            period: float | None = None,
            parameters: Mapping[str, ArrayLike] | None = None,
            time: str | None = None,
            units: Mapping[str, str] | None = None,
            bounds: Mapping[str, tuple[float, float]] | None = None,
            compile: bool | None = False,
            converter: SystemScalarConverter | None = None,
        ) -> None:
            model = Model(
                output,
                update,
                state=state or {},
                period=period,
                parameters=parameters or {},
                time=time,
                units=units or {},
                bounds=bounds or {},
                compile=compile,
            )
            Impl._declare(self, model, converter)

        def _construct_copy(self, other: Any, converter: SystemScalarConverter | None = None) -> None:
            Impl._declare(self, other.model, converter)

        def _declare(self, model: Model, converter: SystemScalarConverter | None) -> None:
            LeafSystem_[T].__init__(self, converter)
            self.variables = model.variables
            self._declaration = _Declaration(self, model, T)

        @property
        def model(self) -> Model:
            """Return the functions of the system."""
            return self._declaration.model

    return Impl


class _Declaration:
    """Declares what a `CasadiSystem` has: its ports, its state, its parameters, and what computes them.

    Args:
        system: The system, which has nothing yet.
        model: Its functions.
        T: Its scalar type.

    Attributes:
        model: As given.
    """

    def __init__(self, system: Any, model: Model, T: type) -> None:
        self.model = model
        self._T = T
        self._ports = {name: system.DeclareVectorInputPort(name, model.size(name)) for name in model.inputs}
        for value in model.state.values():
            system.DeclareDiscreteState(BasicVector_[T](value))
        if model.parameters:
            system.DeclareNumericParameter(BasicVector_[T](np.concatenate(list(model.parameters.values()))))
        for name, result in model.outputs.items():
            if result.shows is not None:
                system.DeclareStateOutputPort(name, DiscreteStateIndex(model.state_index(result.shows)))
            else:
                tickets = {self._ticket(system, block) for block in result.blocks} or {system.nothing_ticket()}
                system.DeclareVectorOutputPort(name, result.size, self._calc(result), prerequisites_of_calc=tickets)
        if model.update is not None:
            system.DeclarePeriodicDiscreteUpdateEvent(model.period, 0.0, self._update(model.update))

    def _calc(self, result: FunctionResult) -> Callable[[Context, Any], None]:
        return self._handler(result, deliver=BasicVector_[self._T].set_value, updates=False)

    def _update(self, result: FunctionResult) -> Callable[[Context, Any], None]:
        if self._T is float:
            return self._handler(result, deliver=None, updates=True)
        ends = np.cumsum([value.size for value in self.model.state.values()]).tolist()
        groups = [(i, slice(start, end)) for i, (start, end) in enumerate(pairwise([0, *ends]))]

        def deliver(state: Any, following: NDArray[Any]) -> None:
            for i, entries in groups:
                state.set_value(i, following[entries])

        return self._handler(result, deliver=deliver, updates=True)

    def _handler(
        self, result: FunctionResult, *, deliver: Callable[[Any, NDArray[Any]], None] | None, updates: bool
    ) -> Callable[[Context, Any], None]:
        """Return the compiled event handler (see `handler`), which needs few calls of Python functions per step."""
        T = self._T
        sources = {block.source for block in result.blocks}
        return handler(
            states=tuple(self.model.state_index(b.names[0]) for b in result.blocks if b.source == STATE),
            updates=updates,
            clock=TIME in sources,
            parameters=Context_[T].get_numeric_parameter if PARAMETER in sources else None,
            inputs=tuple(
                weakly(self._ports[b.names[0]], InputPort_[T].Eval) for b in result.blocks if b.source == INPUT
            ),
            # Views are cheaper, but there are none of AutoDiffXd.
            state_value=DiscreteValues_[T].value if deliver else DiscreteValues_[T].get_mutable_value,
            vector_value=BasicVector_[T].value if T is float else BasicVector_[T].CopyToVector,
            compute=result.kernel.value if T is float else result.kernel.autodiff,
            deliver=deliver,
        )

    def _ticket(self, system: Any, block: ArgumentBlock) -> DependencyTicket:
        name = block.names[0]
        if block.source == INPUT:
            return self._ports[name].ticket()
        if block.source == STATE:
            return system.discrete_state_ticket(DiscreteStateIndex(self.model.state_index(name)))
        if block.source == PARAMETER:
            return system.numeric_parameter_ticket(NumericParameterIndex(0))
        return system.time_ticket()


CasadiSystem = class_for_float(CasadiSystem_)
