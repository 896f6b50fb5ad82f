"""Contact switches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import BasicVector, Context, DiscreteValues

from vtbdrake.components.sensors.sampled import SampledSensor
from vtbdrake.state import parameter


class ContactSensor(SampledSensor):
    """Tells which bodies touch something: 1 where the sum of the normal contact forces exceeds a threshold, else 0.

    .. pydrake_system::

        name: ContactSensor
        input_ports:
        - contact_results
        output_ports:
        - foot_contact

    ``foot_contact`` has one entry per body, in the order of ``bodies``. Point contact and hydroelastic contact both count.
    With a continuous plant the contact results follow from its state alone; with a discrete one they are those of its
    last step, and empty between a restore and the next step.
    """

    def __init__(
        self, plant: MultibodyPlant, bodies: Sequence[RigidBody], *, threshold: float = 1.0, period: float, stream: int = 2
    ) -> None:
        """``threshold`` is a force (N), and a parameter of the Context."""
        super().__init__(
            "foot_contact", default=np.zeros(len(bodies)), period=period, unit="1", noise={}, stream=stream
        )
        self._results_port = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        self._slots = {body.index(): k for k, body in enumerate(bodies)}
        self._geometry_slots = {
            geometry: k for k, body in enumerate(bodies) for geometry in plant.GetCollisionGeometriesForBody(body)
        }
        self._threshold = int(self.DeclareNumericParameter(BasicVector([threshold])))
        self.variables += (parameter("threshold", self._threshold, unit="N", bounds=(0.0, np.inf)),)

    def _measure(self, context: Context, state: DiscreteValues) -> NDArray[np.float64]:
        results = self._results_port.Eval(context)
        force = [0.0] * len(self._slots)
        slots = self._slots
        for k in range(results.num_point_pair_contacts()):
            info = results.point_pair_contact_info(k)
            normal = abs(float(info.contact_force() @ info.point_pair().nhat_BA_W))
            for body in (info.bodyA_index(), info.bodyB_index()):
                if body in slots:
                    force[slots[body]] += normal
        for k in range(results.num_hydroelastic_contacts()):
            info = results.hydroelastic_contact_info(k)
            magnitude = float(np.linalg.norm(info.F_Ac_W().translational()))
            surface = info.contact_surface()
            for geometry in (surface.id_M(), surface.id_N()):
                if geometry in self._geometry_slots:
                    force[self._geometry_slots[geometry]] += magnitude
        threshold = context.get_numeric_parameter(self._threshold)[0]
        return np.array([1.0 if f > threshold else 0.0 for f in force])
