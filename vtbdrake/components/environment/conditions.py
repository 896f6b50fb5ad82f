"""The base class of environmental conditions: a vector of parameters that sensors read through a port."""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, LeafSystem, NumericParameterIndex

from vtbdrake.state import Element
from vtbdrake.state.declarations import NO_DICT, weakly


class Conditions(LeafSystem):
    """Shows one numeric parameter group at its only output port.

    Its named pieces are variables: a rollout changes the conditions by writing them.
    """

    __slots__ = NO_DICT

    def __init__(self, port: str, values: Sequence[float], variables: tuple[Element, ...]) -> None:
        super().__init__()
        index = NumericParameterIndex(self.DeclareNumericParameter(BasicVector(list(values))))
        self.DeclareVectorOutputPort(
            port, len(values), weakly(self, Conditions._calc), {self.numeric_parameter_ticket(index)}
        )
        self.variables = variables

    def _calc(self, context: Context, output: BasicVector) -> None:
        values: ArrayLike = context.get_numeric_parameter(0).value()
        output.SetFromVector(values)
