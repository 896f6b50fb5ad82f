"""What the arm does when its DPS cannot be relied on: it floats where it is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from diagrams.manipulator.arm import JOINTS, Arm
from diagrams.manipulator.dynamics import ArmDynamics, function
from diagrams.manipulator.laws import LAWS
from vtbdrake.control.fallback import Fallback, Zero

# The switch to real is refused where the command is further than this from the measured torque (N m).
CONTINUITY = {"joint_torque": ("joint_torque_measured", 100.0)}

SLIP = 0.02
"""How far the held pose may be from the arm (rad)."""


class FloatInPlace(Fallback):
    """Carries the arm's weight, and holds it by the joint impedance law's springs and dampers, tau = g(q) + K (h - q)
    - D v.

    The pose h is dragged along where the arm is more than `SLIP` away: the arm is held wherever it was when this takes
    over, and gives way to who pushes it. Without a fresh position it carries the weight of the last one (which does not
    accelerate the arm much, unlike no torque at all); without any, there is no torque.
    """

    otherwise = Zero()

    def __init__(self, arm: Arm | None = None) -> None:
        model = ArmDynamics(arm)
        q, zero = casadi.SX.sym("q", JOINTS), casadi.SX(JOINTS, 1)
        self._gravity = function("gravity", {"q": q}, {"torque": model.inverse_dynamics(q, zero, zero)})
        gains = LAWS["joint_impedance"].parameters
        self._stiffness, self._damping = (np.array(gains[name][0]) for name in ("stiffness", "damping"))
        self._position: NDArray[np.float64] | None = None
        self._held: NDArray[np.float64] | None = None

    def take_over(self) -> None:
        self._position = self._held = None

    def command(self, last_sent: Any, sensed: Mapping[str, Any], dt: float) -> NDArray[np.float64]:
        fresh = "joint_position" in sensed and "joint_velocity" in sensed
        if fresh:
            self._position = q = np.array(sensed["joint_position"])
            self._held = q.copy() if self._held is None else np.clip(self._held, q - SLIP, q + SLIP)
        if self._position is None or self._held is None:
            raise RuntimeError("no position of the arm is known")
        torque: NDArray[np.float64] = self._gravity(self._position).full().ravel()
        if fresh:
            torque += self._stiffness * (self._held - self._position) - self._damping * sensed["joint_velocity"]
        return torque


def arm_fallback() -> dict[str, Fallback]:
    """What commands the arm after a fault: it floats in place."""
    return {"joint_torque": FloatInPlace()}
