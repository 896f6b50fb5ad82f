"""Contact switches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.components.sensors.contact_kernel import contact_forces
from vtbdrake.components.sensors.errors import ErrorModel
from vtbdrake.components.sensors.sampled import SampledSensor
from vtbdrake.state import Quantity

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import RigidBody


class ContactSensor(SampledSensor):
    """Contact switches of bodies: 1 if the contact forces of the body exceed a threshold, else 0.

    .. pydrake_system::

        name: ContactSensor
        input_ports:
        - contact_results
        output_ports:
        - foot_contact

    ``foot_contact`` has one entry per body, in the order of ``bodies``; what counts is the sum of the magnitudes of the
    forces of all its contacts, in point contact and hydroelastic contact. With a continuous plant the contact results
    follow from its state; with a discrete one they come from its last step, and are empty between a restore and the
    next step.

    Args:
        plant: The finalized plant.
        bodies: The bodies that have a switch.
        threshold: The force (N) above which a switch closes; a parameter of the Context.

    Attributes:
        entry_names: Names of the bodies, one for each entry of the output.
        body_indices: Indices of the bodies in the plant.
        settings: The parameter ``threshold``.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        bodies: Sequence[RigidBody],
        *,
        period: float,
        threshold: float = 1.0,
        stream: int | None = None,
        errors: ErrorModel | None = None,
    ) -> None:
        """Declare the sensor; ``threshold`` is a force (N), and a parameter of the Context."""
        from pydrake.multibody.plant import ContactResults

        super().__init__(
            "foot_contact", default=np.zeros(len(bodies)), period=period, unit="1", stream=stream, errors=errors
        )
        self.entry_names = tuple(body.name() for body in bodies)
        self.body_indices = tuple(int(body.index()) for body in bodies)
        self._results_port = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        # Which sum of forces a body or geometry adds to.
        self._count = len(bodies)
        self._slots = [self._count] * plant.num_bodies()
        for k, index in enumerate(self.body_indices):
            self._slots[index] = k
        self._geometry_slots = {
            # By number: the ids themselves would hold the plant.
            geometry.get_value(): k
            for k, body in enumerate(bodies)
            for geometry in plant.GetCollisionGeometriesForBody(body)
        }
        self.settings = self.declare_parameters(threshold=Quantity(threshold, "N", (0.0, np.inf)))

    def _measure(self, context: Context, state: DiscreteValues) -> NDArray[np.float64]:
        results = self._results_port.Eval(context)
        forces = contact_forces(results, self._slots, self._geometry_slots, self._count)
        return (forces > self.settings.view(context).threshold).astype(float)
