"""The motion of the grapple fixture against the base, and the pose of the gripper, by which a capture is controlled."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi
import numpy as np
from pydrake.systems.framework import BasicVector, Context

from vtbdrake.arrays import Array
from vtbdrake.components.casadi_system.kernel import Kernel
from vtbdrake.state import AddressedSystem
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, JOINT_NAMES, Target
from vtbdrake_diagrams.satellite.estimation import BASE, rotated, turned
from vtbdrake_diagrams.satellite.kinematics import gripper

# An age in s that stands for never, because ports carry finite numbers.
_LONG_AGO = 1e6

RELATIVE = 32
"""Size of a `Relative` as a vector."""


@dataclass(frozen=True)
class Relative:
    """The grapple fixture H and the gripper G, seen from the base B; all in B.

    Attributes:
        age: Age of the newest estimate of the target, in s.
        valid: Whether the target is tracked.
        R_BH, p_BH: Orientation (3, 3) and position (3,) in m of the fixture.
        w_BH, v_BH: Its angular velocity (rad/s) and the velocity of its origin (m/s) against the base, (3,) each.
        R_BG, p_BG: Orientation (3, 3) and position (3,) in m of the gripper.
    """

    age: float
    valid: bool
    R_BH: Array
    p_BH: Array
    w_BH: Array
    v_BH: Array
    R_BG: Array
    p_BG: Array

    @staticmethod
    def of(x: Array) -> Relative:
        """Return what is in a vector of shape (`RELATIVE`,)."""
        R_BH, R_BG = x[2:11].reshape(3, 3), x[20:29].reshape(3, 3)
        return Relative(float(x[0]), x[1] > 0.5, R_BH, x[11:14], x[14:17], x[17:20], R_BG, x[29:32])


class RelativeMotion(AddressedSystem):
    """The motion of the grapple fixture H against the base B, and where the gripper G is.

    .. pydrake_system::

        name: RelativeMotion
        input_ports:
        - base
        - target
        - status
        - joint_position
        output_ports:
        - relative

    ``base`` is that of a `BaseEstimator`, ``target`` and ``status`` are those of a `TargetTracker`. The pose of the
    base is extrapolated to the time of the others, one period later. ``relative`` is a `Relative` as a vector.
    """

    def __init__(self, *, period: float) -> None:
        super().__init__()
        self._period = period
        self._kernel = _relative(period)
        self._base = self.DeclareVectorInputPort("base", BASE)
        self._target = self.DeclareVectorInputPort("target", 13)
        self._status = self.DeclareVectorInputPort("status", 4)
        self._joints = self.DeclareVectorInputPort("joint_position", len(JOINT_NAMES))
        self.DeclareVectorOutputPort("relative", RELATIVE, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        valid, age = self._status.Eval(context)[:2].tolist()
        arguments = self._base.Eval(context), self._target.Eval(context), self._joints.Eval(context)
        output.SetFromVector(np.concatenate(((min(age, _LONG_AGO), valid), self._kernel.value(arguments))))


@lru_cache
def _relative(period: float) -> Kernel:
    """Return all but age and validity of a `Relative` as a kernel of (base, target, joint positions)."""
    base, target = casadi.SX.sym("base", BASE), casadi.SX.sym("target", 13)
    joints = casadi.SX.sym("joints", len(JOINT_NAMES))
    _, q_IB, p_IB, w_IB, v_IB = casadi.vertsplit(base, [0, 1, 5, 8, 11, BASE])
    q_IT, p_IT, w_IT, v_IT = casadi.vertsplit(target, [0, 4, 7, 10, 13])
    q_IB = turned(q_IB, period * rotated(_inverse(q_IB), w_IB))
    p_IB = p_IB + period * v_IB
    X_TH = Target().X_TH
    arm = rotated(q_IT, casadi.DM(X_TH.translation()))

    def in_base(u: casadi.SX) -> casadi.SX:
        return rotated(_inverse(q_IB), u)

    axes = [in_base(rotated(q_IT, casadi.DM(column))) for column in X_TH.rotation().matrix().T]
    R_BH, p_BH = casadi.horzcat(*axes), in_base(p_IT + arm - p_IB)
    v = v_IT + casadi.cross(w_IT, arm) - v_IB - casadi.cross(w_IB, p_IT + arm - p_IB)
    G = gripper(joints[:ARM_JOINTS])
    values = [R_BH.T.reshape((9, 1)), p_BH, in_base(w_IT - w_IB), in_base(v), G.R.T.reshape((9, 1)), G.p]
    return Kernel("relative", [base, target, joints], casadi.densify(casadi.vertcat(*values)), compile=False)


def _inverse(q: casadi.SX) -> casadi.SX:
    return casadi.vertcat(q[0], -q[1:])
