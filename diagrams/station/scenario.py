"""The station of ``station.yaml``, and a joint controller for it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.station import Station, StationCommand

FILE = Path(__file__).with_name("station.yaml")
"""The file, with the stations ``Torque``, ``Position`` and ``PositionAndTorque``."""
HOME = np.array([0.0, 0.6, 0.0, -1.2, 0.0, 1.0, 0.0])
"""The joint positions in rad at first."""
OPEN = 0.04
"""The distance of the fingers in m at first."""
PERIOD = 0.005
# Largest speed of the reference, in rad/s.
_SPEED = 0.2
# Largest acceleration of the reference, in rad/s^2.
_ACCELERATION = 1.0
_STIFFNESS = np.array([300.0, 300.0, 200.0, 200.0, 50.0, 40.0, 10.0])  # N m/rad
_DAMPING = np.array([30.0, 30.0, 20.0, 20.0, 3.0, 2.0, 0.3])  # N m s/rad


class JointControl(AddressedSystem):
    """Moves the joints of an iiwa to a target, by positions or by torques on top of its gravity compensation.

    .. pydrake_system::

        name: JointControl
        input_ports:
        - iiwa_position_measured
        - iiwa_velocity_estimated
        - target
        - opening
        output_ports:
        - iiwa_position or iiwa_torque
        - wsg_position

    The reference r moves to the target with at most 0.2 rad/s and 1 rad/s^2: with the speed from which it comes to rest
    there. ``iiwa_position`` is r, ``iiwa_torque`` is K (r - q) - D v. The distance of the gripper's fingers is
    ``opening``.
    """

    def __init__(self, *, torque: bool) -> None:
        super().__init__()
        size = len(HOME)
        for name in ("iiwa_position_measured", "iiwa_velocity_estimated", "target"):
            self.DeclareVectorInputPort(name, size)
        self.DeclareVectorInputPort("opening", 1)
        self._gains = self.declare_parameters(
            stiffness=Quantity(_STIFFNESS, "N m/rad", (0.0, 1e4)),
            damping=Quantity(_DAMPING, "N m s/rad", (0.0, 1e3)),
        )
        self._reference = self.declare_discrete_state(reference=Quantity(HOME, "rad"))
        self._speed = self.declare_discrete_state(speed=Quantity(np.zeros(size), "rad/s"))
        self._torque = self.declare_discrete_state(torque=Quantity(np.zeros(size), "N m"))
        self._opening = self.declare_discrete_state(opening=Quantity([OPEN], "m"))
        if torque:
            self.DeclareStateOutputPort("iiwa_torque", self._torque.index)
        else:
            self.DeclareStateOutputPort("iiwa_position", self._reference.index)
        self.DeclareStateOutputPort("wsg_position", self._opening.index)
        self.timings = ((PERIOD, 0.0),)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    def _update(self, context: Context, discrete: Any) -> None:
        q, v, target, opening = (
            self.GetInputPort(name).Eval(context)
            for name in ("iiwa_position_measured", "iiwa_velocity_estimated", "target", "opening")
        )
        gains, before = self._gains.view(context), self._reference.view(context).reference
        change = _ACCELERATION * PERIOD
        way = target - before
        # The largest speed that shrinks by `change` per period and covers the way.
        approach = np.sign(way) * change * (np.sqrt(1.0 + 8.0 * np.abs(way) / (change * PERIOD)) - 1.0) / 2.0
        aim = np.clip(approach, -_SPEED, _SPEED)
        last = self._speed.view(context).speed
        speed = np.clip(aim, last - change, last + change)
        reference = before + speed * PERIOD
        self._speed.mutable(discrete).speed = speed
        self._reference.mutable(discrete).reference = reference
        self._torque.mutable(discrete).torque = gains.stiffness * (reference - q) - gains.damping * v
        self._opening.mutable(discrete).opening = opening


def _commands() -> dict[str, StationCommand]:
    return {
        "target": StationCommand(default=HOME.tolist(), unit="rad", lower=-3.0, upper=3.0),
        "opening": StationCommand(default=[OPEN], unit="m", lower=0.0, upper=0.11),
    }


@dataclass
class ArmStation(Station):
    """An iiwa with a gripper, from a file of Drake's hardware_sim, under a `JointControl`; by default with torques."""

    file: ClassVar[str] = f"{FILE}#Torque"

    commands: dict[str, StationCommand] = field(default_factory=_commands)

    def make_impl(self) -> JointControl:
        return JointControl(torque="iiwa_torque_added" in self.signals())
