"""Sensors of the forces in joints: force/torque sensors, and torque sensors in the joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.value import Value
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.components.sensors.errors import ErrorModel
from vtbdrake.components.sensors.sampled import SampledSensor

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import Joint


class ForceTorqueSensor(SampledSensor):
    """Measures the wrench that a joint transmits.

    .. pydrake_system::

        name: ForceTorqueSensor
        input_ports:
        - reaction_forces
        output_ports:
        - wrench

    ``wrench`` is [torque (3, N m); force (3, N)], in the order of Drake's SpatialForce: what the joint's child exerts
    on its parent, about the origin of the frame Jc in which the joint is attached to the child, expressed in Jc. A
    child at rest so shows its weight m g and whatever pushes it. Before the first sample it shows zeros.

    Drake's reaction force F_CJc_Jc acts on the child; this is its opposite. Whatever the joint carries is in it:
    gravity and inertia of all bodies beyond.

    In a discrete plant whose output ports are sampled, reaction forces come from the last step, and are empty between a
    restore and the next step; copies continue exactly where the plant has ``use_sampled_output_ports=False``. Then, and
    in a continuous plant, they follow from state and actuation of the same instant.

    Args:
        plant: The finalized plant.
        joint: The joint.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        joint: Joint,
        *,
        period: float,
        stream: int | None = None,
        errors: ErrorModel | None = None,
    ) -> None:
        (self.place,) = places(plant, [joint])
        super().__init__(
            "wrench",
            default=np.zeros(6),
            period=period,
            unit="N m, N",
            noise={"torque_noise": (3, "N m"), "force_noise": (3, "N")},
            stream=stream,
            errors=errors,
        )
        self.entry_names = tuple(f"{quantity} {axis}" for quantity in ("torque", "force") for axis in "xyz")
        self._port = self.DeclareAbstractInputPort("reaction_forces", Value[list[SpatialForce]]())

    def _measure(self, context: Context, state: DiscreteValues) -> NDArray[np.float64]:
        F_CJc_Jc: SpatialForce = self._port.Eval(context)[self.place]
        return -F_CJc_Jc.get_coeffs()


class JointTorqueSensors(SampledSensor):
    """Measures the torques about the axes of revolute joints, or the forces along prismatic ones, on their output side.

    .. pydrake_system::

        name: JointTorqueSensors
        input_ports:
        - reaction_forces
        output_ports:
        - joint_torque

    ``joint_torque`` (N m, or N) holds for each of ``joints`` what its drive exerts on the child about or along the
    joint's axis: the drive's torque, less what accelerates its rotor. Before the first sample it shows ``initial``, a
    scalar or one torque per joint. About restored contexts, see `ForceTorqueSensor`.

    Args:
        plant: The finalized plant.
        joints: The joints, revolute or prismatic.
        initial: The reading before the first sample, a scalar or shape (n,).
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        joints: Sequence[Joint],
        *,
        period: float,
        initial: ArrayLike = 0.0,
        stream: int | None = None,
        errors: ErrorModel | None = None,
    ) -> None:
        for joint in joints:
            if joint.type_name() not in ("revolute", "prismatic"):
                raise ValueError(
                    f"Joint '{joint.name()}' is {joint.type_name()}; JointTorqueSensors measures revolute and "
                    "prismatic joints."
                )
        self.entry_names = tuple(joint.name() for joint in joints)
        self.places = places(plant, joints)
        # In Jc and in the frame of the parent, an axis has the same components. A torque is the power at unit rate.
        self.motions = [_unit_velocity(joint) for joint in joints]
        unit = ", ".join(dict.fromkeys("N" if joint.type_name() == "prismatic" else "N m" for joint in joints))
        super().__init__(
            "joint_torque",
            default=np.broadcast_to(np.asarray(initial, dtype=float), (len(joints),)),
            period=period,
            unit=unit,
            noise={"noise": (len(joints), unit)},
            stream=stream,
            errors=errors,
        )
        self._port = self.DeclareAbstractInputPort("reaction_forces", Value[list[SpatialForce]]())

    def _measure(self, context: Context, state: DiscreteValues) -> NDArray[np.float64]:
        F_CJc_Jc = self._port.Eval(context)
        return np.array([F_CJc_Jc[k].dot(motion) for k, motion in zip(self.places, self.motions, strict=True)])


def _unit_velocity(joint: Joint) -> SpatialVelocity:
    """Return the velocity of the child at the rate 1 of a revolute or prismatic joint, in Jc."""
    if joint.type_name() == "prismatic":
        return SpatialVelocity(w=np.zeros(3), v=joint.translation_axis())
    return SpatialVelocity(w=joint.revolute_axis(), v=np.zeros(3))


def places(plant: MultibodyPlant, joints: Sequence[Joint]) -> list[int]:
    """Return the places of the joints' forces in the plant's reaction forces, which follow the order of its joints.

    Args:
        plant: The plant, finalized.
        joints: Joints of the plant, in the order of the result.
    """
    order = {int(index): k for k, index in enumerate(plant.GetJointIndices())}
    return [order[int(joint.index())] for joint in joints]
