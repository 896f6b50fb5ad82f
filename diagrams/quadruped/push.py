"""A push: a force on the trunk, for a short time."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.systems.framework import Context

from vtbdrake.state import AddressedSystem, Quantity


class Push(AddressedSystem):
    """A source of a constant force on the centre of a body, for a short time.

    .. pydrake_system::

        name: Push
        output_ports:
        - spatial_force

    The parameters: ``impulse`` in N s, in the world, ``begin`` in s and ``duration`` in s. The force is the impulse
    divided by the duration.
    """

    def __init__(self, plant: MultibodyPlant, body: str) -> None:
        super().__init__()
        pushed = plant.GetBodyByName(body)
        # A copy: Drake's array would keep the whole Diagram.
        self.body, self.p_BoBq_B = pushed.index(), np.array(pushed.default_com())
        self._push = self.declare_parameters(
            impulse=Quantity(np.zeros(3), "N s"), begin=Quantity(1.0, "s"), duration=Quantity(0.1, "s")
        )
        self.DeclareAbstractOutputPort(
            "spatial_force",
            lambda: Value([ExternallyAppliedSpatialForce()]),
            self._calc,
            prerequisites_of_calc={self.numeric_parameter_ticket(self._push.index), self.time_ticket()},
        )

    def _calc(self, context: Context, output: Value) -> None:  # type: ignore[valid-type]
        push = self._push.view(context)
        force = ExternallyAppliedSpatialForce()
        force.body_index, force.p_BoBq_B = self.body, self.p_BoBq_B
        acts = push.begin <= context.get_time() < push.begin + push.duration
        f = push.impulse / push.duration if acts else np.zeros(3)
        force.F_Bq_W = SpatialForce(tau=np.zeros(3), f=f)
        output.set_value([force])  # type: ignore[attr-defined]
