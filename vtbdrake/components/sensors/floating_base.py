"""Sensors of a floating base, which stand for a state estimator or a motion capture system."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vtbdrake.components.sensors.errors import ErrorModel
from vtbdrake.components.sensors.sampled import SampledSensor, StateSensor

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import RigidBody


class BasePoseSensor(StateSensor):
    """Measures the pose X_WB of a floating base B in the world.

    .. pydrake_system::

        name: BasePoseSensor
        input_ports:
        - state
        output_ports:
        - base_pose

    ``state`` is the plant's [q; v]; ``base_pose`` is [quaternion wxyz, of either sign; position (m)], as in Drake's
    positions of a floating base. Before the first sample it shows the plant's default pose. The white noise of its
    `ErrorModel` is added to each of the seven numbers, so that a noise of s is one of s m in the position and, as the
    quaternion's vector is half the angle, of 2 s rad in the orientation. The quaternion is then not of length 1.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        base: RigidBody,
        *,
        period: float,
        stream: int | None = None,
        errors: ErrorModel | None = None,
    ) -> None:
        """Declare the sensor.

        Args:
            plant: The plant, finalized.
            base: The floating base B.
            period: Sample period in seconds.
            stream: Number of the random stream, see `SampledSensor`.
            errors: The measurement errors; None for an exact sensor.

        Raises:
            ValueError: The body is no floating base.
        """
        _check_floating(base, self)
        start = base.floating_positions_start()
        super().__init__(
            "base_pose",
            plant,
            range(start, start + 7),
            default=plant.GetDefaultPositions()[start : start + 7],
            period=period,
            unit="1, 1, 1, 1, m, m, m",
            noise={"orientation_noise": (4, "1"), "position_noise": (3, "m")},
            stream=stream,
            errors=errors,
        )
        self.entry_names = ("qw", "qx", "qy", "qz", "x", "y", "z")


class BaseTwistSensor(StateSensor):
    """Measures the spatial velocity V_WB of a floating base B in the world.

    .. pydrake_system::

        name: BaseTwistSensor
        input_ports:
        - state
        output_ports:
        - base_twist

    ``state`` is the plant's [q; v]; ``base_twist`` is [angular velocity (rad/s), velocity of B's origin (m/s)], both
    expressed in the world. Before the first sample it shows zeros.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        base: RigidBody,
        *,
        period: float,
        stream: int | None = None,
        errors: ErrorModel | None = None,
    ) -> None:
        """Declare the sensor.

        Args:
            plant: The plant, finalized.
            base: The floating base B.
            period: Sample period in seconds.
            stream: Number of the random stream, see `SampledSensor`.
            errors: The measurement errors; None for an exact sensor.

        Raises:
            ValueError: The body is no floating base.
        """
        _check_floating(base, self)
        start = plant.num_positions() + base.floating_velocities_start_in_v()
        super().__init__(
            "base_twist",
            plant,
            range(start, start + 6),
            default=np.zeros(6),
            period=period,
            unit="rad/s, m/s",
            noise={"angular_noise": (3, "rad/s"), "linear_noise": (3, "m/s")},
            stream=stream,
            errors=errors,
        )
        self.entry_names = tuple(f"{quantity} {axis}" for quantity in ("rate", "velocity") for axis in "xyz")


def _check_floating(base: RigidBody, sensor: SampledSensor) -> None:
    """Raise a ValueError if a body is no floating base with a quaternion."""
    if not (base.is_floating_base_body() and base.has_quaternion_dofs()):
        raise ValueError(
            f"{type(sensor).__name__}: {base.name()} is no floating base with a quaternion; give the body that moves "
            "freely, or leave its joint to the world out of the file"
        )
