"""Cartesian impedance control of a seven-joint arm with gravity compensation, once in numpy and once in CasADi.

tau = J' (K e - D J v) + g(q), with e the position and orientation error of the hand. The arm's measures come from a
KUKA LBR iiwa, its masses rounded.
"""

from __future__ import annotations

import casadi
import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from vtbdrake.components.casadi_system import CasadiSystem

# Denavit-Hartenberg: offset along the joint's axis (m), and cosine and sine of the twist to the next one.
OFFSET = np.array([0.36, 0.0, 0.42, 0.0, 0.4, 0.0, 0.126])
COS_TWIST = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
SIN_TWIST = np.array([-1.0, 1.0, 1.0, -1.0, -1.0, 1.0, 0.0])
MASS = np.array([5.8, 6.3, 3.5, 3.5, 3.5, 1.8, 1.2])
CENTER = np.array([0.0, 0.03, 0.06])  # of mass, of each link in its own frame
GRAVITY = 9.81
R_WD = np.diag([1.0, -1.0, -1.0])  # the hand points downwards
STIFFNESS = np.array([600.0, 600.0, 600.0, 30.0, 30.0, 30.0])
DAMPING = np.array([40.0, 40.0, 40.0, 2.0, 2.0, 2.0])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Row by row; several times faster than numpy.cross on so few."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


class NumpyImpedance(LeafSystem):
    """The controller in numpy, vectorized over the joints.

    .. pydrake_system::

        name: NumpyImpedance
        input_ports:
        - q
        - v
        - target
        output_ports:
        - torque
    """

    def __init__(self) -> None:
        super().__init__()
        self._q = self.DeclareVectorInputPort("q", 7)
        self._v = self.DeclareVectorInputPort("v", 7)
        self._target = self.DeclareVectorInputPort("target", 3)
        inputs = {self.all_input_ports_ticket()}
        self.DeclareVectorOutputPort("torque", 7, self._calc, prerequisites_of_calc=inputs)

    def _calc(self, context: Context, output: BasicVector) -> None:
        q, v, target = self._q.Eval(context), self._v.Eval(context), self._target.Eval(context)
        c, s = np.cos(q), np.sin(q)
        links = np.zeros((7, 4, 4))
        links[:, 0, 0], links[:, 0, 1], links[:, 0, 2] = c, -s * COS_TWIST, s * SIN_TWIST
        links[:, 1, 0], links[:, 1, 1], links[:, 1, 2] = s, c * COS_TWIST, -c * SIN_TWIST
        links[:, 2, 1], links[:, 2, 2], links[:, 2, 3] = SIN_TWIST, COS_TWIST, OFFSET
        links[:, 3, 3] = 1.0
        poses = np.empty((8, 4, 4))
        poses[0] = np.eye(4)
        for i in range(7):
            np.matmul(poses[i], links[i], out=poses[i + 1])
        axes, origins = poses[:7, :3, 2], poses[:7, :3, 3]
        hand, rotation = poses[7, :3, 3], poses[7, :3, :3]
        J = np.concatenate([_cross(axes, hand - origins), axes], axis=1).T
        error = np.concatenate([target - hand, 0.5 * _cross(rotation.T, R_WD.T).sum(axis=0)])
        moments = MASS[:, None] * (poses[1:, :3, 3] + poses[1:, :3, :3] @ CENTER)
        # What joint i carries: the links i, ..., 6.
        carried = np.cumsum(moments[::-1], axis=0)[::-1] - np.cumsum(MASS[::-1])[::-1, None] * origins
        gravity = GRAVITY * (axes[:, 0] * carried[:, 1] - axes[:, 1] * carried[:, 0])
        output.SetFromVector(J.T @ (STIFFNESS * error - DAMPING * (J @ v)) + gravity)


def casadi_impedance(*, compile: bool) -> CasadiSystem:
    """The controller in CasADi, where Jacobian and gravity are derivatives of the forward kinematics."""
    q, v, target = casadi.SX.sym("q", 7), casadi.SX.sym("v", 7), casadi.SX.sym("target", 3)
    R, p, potential = casadi.SX.eye(3), casadi.SX.zeros(3), 0
    axes = []
    for i in range(7):
        c, s = casadi.cos(q[i]), casadi.sin(q[i])
        axes.append(R[:, 2])
        p = p + R[:, 2] * OFFSET[i]
        turn = casadi.blockcat([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        twist = np.array([[1, 0, 0], [0, COS_TWIST[i], -SIN_TWIST[i]], [0, SIN_TWIST[i], COS_TWIST[i]]])
        R = R @ turn @ twist
        potential += GRAVITY * MASS[i] * (p + R @ CENTER)[2]
    J = casadi.vertcat(casadi.jacobian(p, q), casadi.horzcat(*axes))
    orientation = sum((casadi.cross(R[:, k], R_WD[:, k]) for k in range(3)), casadi.SX.zeros(3)) / 2
    error = casadi.vertcat(target - p, orientation)
    torque = J.T @ (STIFFNESS * error - DAMPING * (J @ v)) + casadi.gradient(potential, q)
    names = ["q", "v", "target"], ["torque"]
    return CasadiSystem(casadi.Function("impedance", [q, v, target], [torque], *names, {"cse": True}), compile=compile)
