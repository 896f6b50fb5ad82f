"""The base class of environmental conditions: a vector of parameters that sensors read through a port."""

from __future__ import annotations

from pydrake.systems.framework import BasicVector, Context

from vtbdrake.state import AddressedSystem, Quantity


class Conditions(AddressedSystem):
    """Shows a vector of parameters at its only output port.

    They are variables: a rollout changes the conditions by writing them.

    Args:
        port: The name of the output port.
        quantities: The parameters, by name.
    """

    def __init__(self, port: str, **quantities: Quantity) -> None:
        super().__init__()
        self._conditions = self.declare_parameters(**quantities)
        ticket = self.numeric_parameter_ticket(self._conditions.index)
        self.DeclareVectorOutputPort(port, self._conditions.vector.size, self._calc, {ticket})

    def _calc(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._conditions.array(context))
