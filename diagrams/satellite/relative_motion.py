"""How the grapple fixture moves against the base, and where the gripper is: what the capture is controlled by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import AngleAxis, Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from vtbdrake.state.declarations import NO_DICT, weakly
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, JOINT_NAMES, Target
from vtbdrake_diagrams.satellite.estimation import BASE
from vtbdrake_diagrams.satellite.kinematics import arm_kernels

Array = NDArray[np.float64]

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


class RelativeMotion(LeafSystem):
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

    __slots__ = NO_DICT

    def __init__(self, *, period: float) -> None:
        super().__init__()
        self._period = period
        self._X_TH = Target().X_TH
        self._gripper, _ = arm_kernels()
        self._base = self.DeclareVectorInputPort("base", BASE)
        self._target = self.DeclareVectorInputPort("target", 13)
        self._status = self.DeclareVectorInputPort("status", 4)
        self._joints = self.DeclareVectorInputPort("joint_position", len(JOINT_NAMES))
        self.DeclareVectorOutputPort("relative", RELATIVE, weakly(self, RelativeMotion._calc))

    def _calc(self, context: Context, output: BasicVector) -> None:
        base, target = self._base.Eval(context), self._target.Eval(context)
        valid, age = self._status.Eval(context)[:2].tolist()
        w_IB, v_IB = base[8:11], base[11:14]
        X_IB = moved(base[1:8], w_IB, v_IB, self._period)
        X_IT = moved(target[:7], target[7:10], target[10:13], 0.0)
        R_BI = X_IB.rotation().matrix().T
        X_IH = X_IT @ self._X_TH
        p_IH, p_IT, p_IB = X_IH.translation(), X_IT.translation(), X_IB.translation()
        w_IT = target[7:10]
        w = R_BI @ (w_IT - w_IB)
        v = R_BI @ (target[10:13] + np.cross(w_IT, p_IH - p_IT) - v_IB - np.cross(w_IB, p_IH - p_IB))
        R_BH = R_BI @ X_IH.rotation().matrix()
        gripper = self._gripper.value((self._joints.Eval(context)[:ARM_JOINTS],))
        output.SetFromVector(
            np.concatenate(((min(age, 1e6), valid), R_BH.ravel(), R_BI @ (p_IH - p_IB), w, v, gripper))
        )


def moved(pose: Array, w: Array, v: Array, dt: float) -> RigidTransform:
    """Return where a body is ``dt`` seconds later.

    Args:
        pose: [quaternion wxyz, position (m)], shape (7,).
        w: Its angular velocity in the frame in which its pose is given (rad/s), shape (3,).
        v: Its velocity (m/s), shape (3,).
        dt: In s.
    """
    R = RotationMatrix(Quaternion(pose[:4] / np.linalg.norm(pose[:4])))
    angle = float(np.linalg.norm(w)) * dt
    if angle:
        R = RotationMatrix(AngleAxis(angle, w * (dt / angle))) @ R
    return RigidTransform(R, pose[4:7] + dt * v)
