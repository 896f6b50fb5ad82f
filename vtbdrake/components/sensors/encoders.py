"""Joint encoders and tachometers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from vtbdrake.components.sensors.errors import ErrorModel
from vtbdrake.components.sensors.sampled import SampledSensor, StateSensor

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import Joint


class JointEncoders(StateSensor):
    """Measures the positions of joints that have one degree of freedom.

    .. pydrake_system::

        name: JointEncoders
        input_ports:
        - state
        output_ports:
        - joint_encoders

    ``state`` is the plant's [q; v]; ``joint_encoders`` holds one position (rad or m) per joint, in the order of
    ``joints``. Before the first sample it shows the plant's default positions.

    Args:
        plant: The finalized plant.
        joints: The joints, of one degree of freedom each.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        joints: Sequence[Joint],
        *,
        period: float,
        stream: int | None = None,
        errors: ErrorModel | None = None,
    ) -> None:
        _check_single(joints, self)
        positions = plant.GetDefaultPositions()  # Before Finalize it raises; position_start would raise SystemExit.
        entries = [joint.position_start() for joint in joints]
        default, unit = positions[entries], _unit(joints)
        noise = {"noise": (len(entries), unit)}
        super().__init__(
            "joint_encoders",
            plant,
            entries,
            default=default,
            period=period,
            unit=unit,
            noise=noise,
            stream=stream,
            errors=errors,
        )
        self.entry_names = tuple(joint.name() for joint in joints)


class JointTachometers(StateSensor):
    """Measures the velocities of joints that have one degree of freedom.

    .. pydrake_system::

        name: JointTachometers
        input_ports:
        - state
        output_ports:
        - joint_velocity

    ``state`` is the plant's [q; v]; ``joint_velocity`` holds one velocity (rad/s or m/s) per joint, in the order of
    ``joints``. Before the first sample it shows zeros.

    Args:
        plant: The finalized plant.
        joints: The joints, of one degree of freedom each.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        joints: Sequence[Joint],
        *,
        period: float,
        stream: int | None = None,
        errors: ErrorModel | None = None,
    ) -> None:
        _check_single(joints, self)
        entries = [plant.num_positions() + joint.velocity_start() for joint in joints]
        default, unit = np.zeros(len(joints)), _unit(joints, "/s")
        noise = {"noise": (len(entries), unit)}
        super().__init__(
            "joint_velocity",
            plant,
            entries,
            default=default,
            period=period,
            unit=unit,
            noise=noise,
            stream=stream,
            errors=errors,
        )
        self.entry_names = tuple(joint.name() for joint in joints)


def _unit(joints: Sequence[Joint], per: str = "") -> str:
    """Return the units of the joints' positions, each once, followed by ``per``."""
    return ", ".join(dict.fromkeys(("m" if joint.type_name() == "prismatic" else "rad") + per for joint in joints))


def _check_single(joints: Sequence[Joint], sensor: SampledSensor) -> None:
    """Raise a ValueError if a joint has not exactly one degree of freedom."""
    for joint in joints:
        if joint.num_positions() != 1:
            raise ValueError(
                f"Joint '{joint.name()}' has {joint.num_positions()} positions; "
                f"{type(sensor).__name__} measures joints with exactly one."
            )
