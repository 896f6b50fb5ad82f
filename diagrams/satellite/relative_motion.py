"""The motion of the grapple fixture against the base, and the pose of the gripper, by which a capture is controlled."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi
from pydrake.systems.framework import BasicVector, Context

from vtbdrake.common.arrays import Array
from vtbdrake.components.casadi_system.kernel import Kernel
from vtbdrake.components.casadi_system.rotations import rotation_vector
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
        vector: All numbers, shape (`RELATIVE`,).
    """

    vector: Array

    @property
    def age(self) -> float:
        """Return the age of the newest estimate of the target, in s."""
        return self.vector.item(0)

    @property
    def valid(self) -> bool:
        """Return whether the target is tracked."""
        return self.vector.item(1) > 0.5

    @property
    def R_BH(self) -> Array:
        """Return the orientation of the fixture, (3, 3)."""
        return self.vector[2:11].reshape(3, 3)

    @property
    def p_BH(self) -> Array:
        """Return the position of the fixture, (3,) in m."""
        return self.vector[11:14]

    @property
    def w_BH(self) -> Array:
        """Return the angular velocity of the fixture against the base, (3,) in rad/s."""
        return self.vector[14:17]

    @property
    def v_BH(self) -> Array:
        """Return the velocity of the fixture's origin against the base, (3,) in m/s."""
        return self.vector[17:20]

    @property
    def R_BG(self) -> Array:
        """Return the orientation of the gripper, (3, 3)."""
        return self.vector[20:29].reshape(3, 3)

    @property
    def p_BG(self) -> Array:
        """Return the position of the gripper, (3,) in m."""
        return self.vector[29:32]


def gripper_errors(relative: casadi.SX, distance: casadi.SX, flip: casadi.SX) -> tuple[casadi.SX, casadi.SX]:
    """Return the errors of the gripper's position (m) and orientation (rotation vector, rad), in B.

    Args:
        relative: The numbers of a `Relative`.
        distance: From the place where the gripper should be to the fixture, along its z axis, in m.
        flip: 1 if the gripper is to be turned by pi about that axis, else 0.
    """
    R_BH, R_BG = (casadi.reshape(numbers, 3, 3).T for numbers in (relative[2:11], relative[20:29]))
    turn = casadi.if_else(flip > 0.5, -1, 1)
    R_BD = casadi.horzcat(turn * R_BH[:, 0], turn * R_BH[:, 1], R_BH[:, 2])
    return relative[11:14] - distance * R_BH[:, 2] - relative[29:32], rotation_vector(R_BD @ R_BG.T)


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

    ``base`` comes from a `BaseEstimator`, ``target`` and ``status`` from a `TargetTracker`. The pose of the
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
        ports = self._base, self._target, self._status, self._joints
        output.SetFromVector(self._kernel.value([port.Eval(context) for port in ports]))


@lru_cache
def _relative(period: float) -> Kernel:
    """Return a `Relative` as a kernel of (base, target, status, joint positions)."""
    base, target, status = casadi.SX.sym("base", BASE), casadi.SX.sym("target", 13), casadi.SX.sym("status", 4)
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
    valid, age = status[0], casadi.fmin(status[1], _LONG_AGO)
    values = [age, valid, R_BH.T.reshape((9, 1)), p_BH, in_base(w_IT - w_IB), in_base(v), G.R.T.reshape((9, 1)), G.p]
    return Kernel("relative", [base, target, status, joints], casadi.densify(casadi.vertcat(*values)), compile=None)


def _inverse(q: casadi.SX) -> casadi.SX:
    return casadi.vertcat(q[0], -q[1:])
