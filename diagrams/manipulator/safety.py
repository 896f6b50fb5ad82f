"""The fallback of the arm: after a fault of its DPS or its sensors, it floats in place, or its brakes take over."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from vtbdrake.control.fallback import NO_COMMAND, Fallback, NoCommand, Sample, Silence
from vtbdrake.testbed import Interface, Signal
from vtbdrake_diagrams.manipulator.arm import JOINTS, Arm
from vtbdrake_diagrams.manipulator.dynamics import ArmDynamics, function
from vtbdrake_diagrams.manipulator.laws import LAWS

# The switch to real is refused where the command is further from the measured torque than it may change in a period:
# 6.4 N m in the shoulder, 0.8 N m in the wrist.
CONTINUITY = {"joint_torque": "joint_torque_measured"}

POSITION = "joint_position"
VELOCITY = "joint_velocity"

JUMP_TOLERANCE = {POSITION: 0.03, VELOCITY: 0.3, "joint_torque_measured": 50.0, "wrench": 100.0}
"""The change of each sensor signal that is always plausible, in the unit of the signal."""

DISAGREEMENT = 0.2
"""The largest difference between the measured velocity and the positions' velocity (rad/s)."""

SMOOTHING = 0.01
"""Time constant of the positions' velocity (s)."""

SLIP = 0.02
"""How far the held pose may be from the arm (rad)."""


CARRY = 0.2
"""Seconds for which the arm's weight is carried by the last known pose."""


class FloatInPlace(Fallback):
    """A fallback that carries the weight of the arm, and holds it by the joint impedance law.

        tau = g(q) + K (h - q) - D v

    The pose h is the arm's when the fallback takes over. It follows the arm at a distance of `SLIP`, so the arm
    yields to a push. The measured velocity is limited to what the positions confirm, up to `DISAGREEMENT`.

    Without a fresh position, it carries the weight at the last accepted pose, for `CARRY` seconds after that sample.
    Then, or if no position was ever accepted, it sends nothing, and the time-out of the arm applies its brakes: torques
    cannot hold an arm whose position is unknown.
    """

    otherwise = Silence()

    def __init__(self, arm: Arm | None = None) -> None:
        model = ArmDynamics(arm)
        q, zero = casadi.SX.sym("q", JOINTS), casadi.SX(JOINTS, 1)
        self._gravity = function("gravity", {"q": q}, {"torque": model.inverse_dynamics(q, zero, zero)})
        gains = LAWS["joint_impedance"].parameters
        self._stiffness, self._damping = (np.array(gains[name][0]) for name in ("stiffness", "damping"))
        self.begin()

    def check_signal(self, signal: Signal, *, interface: Interface) -> None:
        sizes = {sensor.name: sensor.size for sensor in interface.sense}
        if signal.size != JOINTS or any(sizes.get(name) != JOINTS for name in (POSITION, VELOCITY)):
            raise ValueError(
                f"FloatInPlace commands {JOINTS} torques from the sensor signals {POSITION} and {VELOCITY} of that "
                f"size; it cannot command {signal.name} from {', '.join(sizes) or 'none'}"
            )

    def begin(self) -> None:
        self._held: NDArray[np.float64] | None = None
        self._before: NDArray[np.float64] | None = None
        self._velocity = np.zeros(JOINTS)

    def command(
        self, last_sent: Any, sensed: Mapping[str, Any], samples: Mapping[str, Sample], dt: float
    ) -> NDArray[np.float64] | NoCommand:
        last = samples.get(POSITION)
        if last is None or (POSITION not in sensed and last.age > CARRY):
            self.begin()
            return NO_COMMAND
        q: NDArray[np.float64] = last.value
        torque: NDArray[np.float64] = self._gravity(q).full().ravel()
        if POSITION in sensed and VELOCITY in sensed:
            self._held = q.copy() if self._held is None else np.clip(self._held, q - SLIP, q + SLIP)
            v = self._confirmed(q, sensed[VELOCITY], dt)
            torque += self._stiffness * (self._held - q) - self._damping * v
        return torque

    def _confirmed(self, q: NDArray[np.float64], v: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """Return the measured velocity ``v``, limited to what the positions confirm."""
        if self._before is None:
            self._velocity = v.copy()  # The guards accepted it until now; the positions correct it.
        elif dt > 0.0:
            self._velocity += min(dt / SMOOTHING, 1.0) * ((q - self._before) / dt - self._velocity)
        self._before = q
        lower, upper = np.minimum(self._velocity, 0.0), np.maximum(self._velocity, 0.0)
        return np.clip(v, lower - DISAGREEMENT, upper + DISAGREEMENT)


def arm_fallback() -> dict[str, Fallback]:
    """Return the fallback by actuator signal: the arm floats in place."""
    return {"joint_torque": FloatInPlace()}
