"""The arm's kinematics and dynamics in CasADi: what its controllers know of it.

This model is the controllers' own; it shares the numbers of `Arm` with the simulated arm, and no code.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np

from vtbdrake_diagrams.manipulator.arm import GRAVITY, JOINTS, Arm

Expression = Any  # casadi.SX or casadi.DM


@dataclass(frozen=True)
class TipMotion:
    """The pose of T in the world, and J with V_WT = [w; v] = J qdot, as in Drake's SpatialVelocity."""

    R: Expression
    p: Expression
    J: Expression


class ArmDynamics:
    """Symbolic kinematics and dynamics of `Arm`."""

    def __init__(self, arm: Arm | None = None) -> None:
        self.arm = arm or Arm()
        self._bodies = []
        for k in range(JOINTS):
            M = self.arm.link_inertia(k)
            if k == JOINTS - 1:
                tool = self.arm.tool_inertia().Shift([0.0, 0.0, -self.arm.lengths[-1]])
                M += tool
            com = M.get_com()
            I_cm = M.Shift(com).CalcRotationalInertia().CopyToFullMatrix3()
            self._bodies.append((M.get_mass(), _sparse(com), _sparse(I_cm)))
        # Of joint k, in the frames of its link and of the one before.
        self._axes = [_sparse(np.array(axis, dtype=float)) for axis in self.arm.axes]
        # Of the origin of link k, in the frame of the one before.
        self._offsets = [_sparse(np.array([0.0, 0.0, offset])) for offset in self.arm.offsets]

    def tip(self, q: Expression) -> TipMotion:
        """Return pose and Jacobian of the tip T for the joint positions q, shape (7,)."""
        R, p = casadi.SX.eye(3), casadi.SX.zeros(3)
        axes, origins = [], []
        for k in range(JOINTS):
            p = p + self.arm.offsets[k] * R[:, 2]
            axes.append(R @ self._axes[k])
            origins.append(p)
            R = R @ self._rotation(k, q[k])
        p = p + self.arm.tip_offset * R[:, 2]
        columns = [casadi.vertcat(a, casadi.cross(a, p - o)) for a, o in zip(axes, origins, strict=True)]
        return TipMotion(R, p, casadi.densify(casadi.horzcat(*columns)))

    def tip_bias(self, q: Expression, v: Expression) -> Expression:
        """Return Jdot v, the [angular; linear] acceleration of the tip at constant joint velocities, in the world."""
        R = casadi.SX.eye(3)
        omega, alpha, acceleration = (casadi.SX.zeros(3) for _ in range(3))
        for k in range(JOINTS):
            acceleration += _turned(omega, alpha, self.arm.offsets[k] * R[:, 2])
            turn = v[k] * (R @ self._axes[k])
            alpha += casadi.cross(omega, turn)
            omega += turn
            R = R @ self._rotation(k, q[k])
        acceleration += _turned(omega, alpha, self.arm.tip_offset * R[:, 2])
        return casadi.vertcat(alpha, acceleration)

    def inverse_dynamics(
        self, q: Expression, v: Expression, a: Expression, *, gravity: float = GRAVITY, rotors: bool = True
    ) -> Expression:
        """Return tau = M(q) a + C(q, v) v + g(q), by the recursion of Newton and Euler in the links' frames.

        With ``rotors``, M has their reflected inertia on its diagonal, and tau is the drives' torque; without, tau is
        what the joints' torque sensors see. Luh, Walker, Paul, "On-Line Computational Scheme for Mechanical
        Manipulators", 1980.
        """
        zero = casadi.SX(3, 1)
        omega, alpha = zero, zero
        # A base that accelerates upwards feels like gravity.
        acceleration = _sparse(np.array([0.0, 0.0, gravity]))
        rotations, forces, moments = [], [], []
        for k, (mass, com, inertia) in enumerate(self._bodies):
            R = self._rotation(k, q[k])
            offset, axis = self._offsets[k], self._axes[k]
            acceleration = R.T @ (acceleration + _turned(omega, alpha, offset))
            carried = R.T @ omega
            alpha = R.T @ alpha + casadi.cross(carried, axis) * v[k] + axis * a[k]
            omega = carried + axis * v[k]
            forces.append(mass * (acceleration + _turned(omega, alpha, com)))
            moments.append(inertia @ alpha + casadi.cross(omega, inertia @ omega))
            rotations.append(R)
        tau = [casadi.SX(0)] * JOINTS
        force, moment = zero, zero
        for k in reversed(range(JOINTS)):
            _, com, _ = self._bodies[k]
            own = forces[k]
            moment = moments[k] + casadi.cross(com, own) + moment
            force = own + force
            tau[k] = casadi.dot(self._axes[k], moment)
            if rotors:
                tau[k] += self.arm.reflected_inertias[k] * a[k]
            # In the frame of the link before, about its origin.
            force = rotations[k] @ force
            moment = rotations[k] @ moment + casadi.cross(self._offsets[k], force)
        return casadi.densify(casadi.vertcat(*tau))

    def momentum(self, q: Expression, v: Expression) -> tuple[Expression, Expression]:
        """Return the momentum p = M(q) v of the links and dL/dq of their Lagrangian L = v' M v / 2 - U.

        Lagrange's equation is then dp/dt = dL/dq + tau, for the torques tau that act on the links.

        Link k and all links beyond it have, in the frame of link k and about its origin, the momentum [l; h] (angular,
        linear) and the first moment s; a is the axis of the joint. Only gravity g and the velocity [w; u] of the link
        before depend on q_k: seen from link k, they turn against the joint. So p_k = a . l and
        dL/dq_k = a . (s x g - w x l - u x h).
        """
        zero = casadi.SX(3, 1)
        omega, velocity, g = zero, zero, _sparse(np.array([0.0, 0.0, -GRAVITY]))
        given, own = [], []
        for k, (mass, com, inertia) in enumerate(self._bodies):
            R = self._rotation(k, q[k])
            velocity = R.T @ (velocity + casadi.cross(omega, self._offsets[k]))
            carried, g = R.T @ omega, R.T @ g
            given.append((R, carried, velocity, g))
            omega = carried + self._axes[k] * v[k]
            linear = mass * (velocity + casadi.cross(omega, com))
            own.append((inertia @ omega + casadi.cross(com, linear), linear, mass * com))
        p, gradient = [casadi.SX(0)] * JOINTS, [casadi.SX(0)] * JOINTS
        mass, angular, linear, first = 0.0, zero, zero, zero
        for k in reversed(range(JOINTS)):
            mass += self._bodies[k][0]
            angular, linear, first = angular + own[k][0], linear + own[k][1], first + own[k][2]
            R, carried, velocity, g = given[k]
            turning = casadi.cross(first, g) - casadi.cross(carried, angular) - casadi.cross(velocity, linear)
            p[k], gradient[k] = casadi.dot(self._axes[k], angular), casadi.dot(self._axes[k], turning)
            # In the frame of the link before, about its origin.
            linear, first = R @ linear, R @ first + mass * self._offsets[k]
            angular = R @ angular + casadi.cross(self._offsets[k], linear)
        return casadi.densify(casadi.vertcat(*p)), casadi.densify(casadi.vertcat(*gradient))

    def _rotation(self, k: int, angle: Expression) -> Expression:
        """Return the rotation of link k in the previous link."""
        sign = sum(self.arm.axes[k])
        c, s = casadi.cos(angle), sign * casadi.sin(angle)
        R = casadi.SX(3, 3)
        if self.arm.axes[k][2]:
            R[0, 0], R[0, 1], R[1, 0], R[1, 1], R[2, 2] = c, -s, s, c, 1.0
        else:
            R[0, 0], R[0, 2], R[2, 0], R[2, 2], R[1, 1] = c, s, -s, c, 1.0
        return R


def function(name: str, arguments: dict[str, Expression], results: dict[str, Expression]) -> casadi.Function:
    """Return a casadi.Function of named arguments, with common subexpressions eliminated."""
    dense = [casadi.densify(value) for value in results.values()]
    return casadi.Function(name, list(arguments.values()), dense, list(arguments), list(results), {"cse": True})


def _turned(omega: Expression, alpha: Expression, r: Expression) -> Expression:
    """Return the acceleration at r due to rotation."""
    return casadi.cross(alpha, r) + casadi.cross(omega, casadi.cross(omega, r))


def _sparse(values: np.ndarray) -> casadi.SX:
    """Return an expression without structural zeros."""
    return casadi.sparsify(casadi.SX(casadi.DM(np.where(np.abs(values) < 1e-15, 0.0, values))))
