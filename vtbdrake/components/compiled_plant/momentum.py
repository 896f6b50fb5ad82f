r"""How the base of a free-floating tree moves when its joints do: from the conservation of momentum, without forces.

A tree of bodies floats without gravity, at rest at first. Its joints move as prescribed. Nothing acts from outside, so
both its momenta stay zero, about any point:

    M_bb(q) V_WB + M_bm(q) qdot = 0,   V_WB = -M_bb^-1 M_bm qdot,

where M_bb is the inertia of the whole tree about Bo, as if its joints were rigid, and M_bm the momentum of one rad/s
(or m/s) of each joint; see Umetani and Yoshida, "Resolved motion rate control of space manipulators with generalized
Jacobian matrix", IEEE Trans. Robotics and Automation 5, 1989. Expressed in B, both depend on the joints alone. So V_WB
follows from the curve of the joints at once, and only the pose of the base is integrated. How fast the joints move
along their path has no effect on where the base ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi
import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, Joint
from pydrake.systems.framework import Context

from vtbdrake.common.arrays import Array
from vtbdrake.common.spline import Spline
from vtbdrake.components.casadi_system import CasadiSystem
from vtbdrake.components.casadi_system.kernel import TRANSLATIONS, Buffers
from vtbdrake.components.compiled_plant.dynamics import PlantDynamics
from vtbdrake.components.compiled_plant.links import FLOATING, Expression, UnsupportedPlantError, skew


class MomentumModel(PlantDynamics):
    """A free-floating tree with zero momentum, some of whose joints move as prescribed, as CasADi expressions.

    The other joints keep their positions in the Context. Joint quantities have m entries, in the order of ``joints``.
    Positions and velocities of the base B, the body that floats, are relative to its initial frame B0.

    Attributes:
        joints: The names of the joints that move.
        damping: Damping of these joints, shape (m,), in N m s/rad (or N s/m).
        base: The name of the body that floats.
    """

    def __init__(self, plant: MultibodyPlant, context: Context, *, joints: Sequence[Joint]) -> None:
        """Read the plant through its own Context.

        Args:
            plant: The plant, finalized, without gravity; it is not kept.
            context: Its own Context, with the parameters, and the positions of the joints that do not move.
            joints: The m joints that move, revolute or prismatic.

        Raises:
            UnsupportedPlantError: The plant cannot be compiled; or it is not one free-floating tree without gravity.
            ValueError: No joint moves, one is given twice, or it has not exactly one velocity.
        """
        super().__init__(plant, context)
        self._check_tree(plant)
        names = [joint.name() for joint in joints]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"the joints that move are given once each, and are not {', '.join(names) or 'none'}")
        for joint in joints:
            if joint.num_velocities() != 1:
                raise ValueError(f"the joint {joint.name()} has {joint.num_velocities()} velocities instead of one")
        self.joints = tuple(names)
        self.damping = np.array([joint.GetDampingVector(context)[0] for joint in joints])
        self._q, self._v = ([at(joint) for joint in joints] for at in (Joint.position_start, Joint.velocity_start))
        self._default_positions = np.array(plant.GetPositions(context))
        base = self._links[0]
        self._base = base.v
        everything = (plant.get_joint(index) for index in plant.GetJointIndices())
        (self.base,) = (joint.child_body().name() for joint in everything if joint.type_name() == FLOATING)
        # The base frame is its joint's frame, with the axes of B0.
        self._default_positions[base.q] = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]

    def _check_tree(self, plant: MultibodyPlant) -> None:
        """Refuse what is not one free-floating tree without gravity."""
        reasons = []
        carried = [link for link in self._links if link.parent < 0]
        floating = [link for link in self._links if link.kind == FLOATING]
        if len(floating) != 1:
            reasons.append(f"{len(floating)} bodies float instead of one")
        if len(carried) > len(floating):
            reasons.append(f"{len(carried) - len(floating)} joints are attached to the world")
        if np.any(plant.gravity_field().gravity_vector()):
            reasons.append(f"there is gravity, {plant.gravity_field().gravity_vector().tolist()} m/s^2")
        for k in plant.GetJointIndices():
            joint = plant.get_joint(k)
            if joint.type_name() == FLOATING and not joint.frame_on_child().is_body_frame():
                reasons.append(f"the joint {joint.name()} is not at the origin of its body")
        if reasons:
            raise UnsupportedPlantError(f"the plant has no free-floating base: {'; '.join(reasons)}.")

    def base_velocity(self, q: Expression, qdot: Expression) -> Expression:
        """Return V_B0B_B = -M_bb^-1 M_bm qdot, [angular; linear] in the axes of B, shape (6, 1).

        Args:
            q: Positions of the joints, shape (m, 1).
            qdot: Their rates, shape (m, 1).
        """
        at, still = self._positions(q), casadi.SX(self.nv, 1)
        momentum = self._momentum(at, still, self._velocities(qdot))
        return self._free(at, momentum)

    def reaction(self, q: Expression, qdot: Expression) -> tuple[Expression, Expression]:
        """Return (h_B, J_B), the momentum that turns the base and its inertia, about the centre of mass, in B's axes.

        h_B, shape (3, 1) in N m s, is the angular momentum of the joints' motion while the base keeps its attitude;
        J_B, shape (3, 3) in kg m^2, is the inertia with the joints locked. So the base turns by -J_B^-1 h_B if nothing
        else has momentum, and a torque of dh_B/dt on the base keeps its attitude.

        Args:
            q: Positions of the joints, shape (m, 1).
            qdot: Their rates, shape (m, 1).
        """
        at = self._positions(q)
        momentum = self._momentum(at, casadi.SX(self.nv, 1), self._velocities(qdot))
        M = self._locked(at)
        lever = M[:3, 3:] / M[5, 5]  # [p_BoBcm]x
        return momentum[:3] - lever @ momentum[3:], M[:3, :3] - lever @ M[3:, :3]

    def center(self, q: Expression) -> Expression:
        """Return p_BoCm_B of the whole tree's centre of mass, shape (3, 1), in m: free of forces, it stays where it is.

        Args:
            q: Positions of the joints, shape (m, 1).
        """
        M = self._locked(self._positions(q))
        lever = M[:3, 3:] / M[5, 5]
        return casadi.vertcat(lever[2, 1], lever[0, 2], lever[1, 0])

    def torque(self, q: Expression, qdot: Expression, qddot: Expression) -> Expression:
        """Return the torques of the drives that move the joints so, shape (m, 1), in N m (or N).

        They include reflected inertias and damping. The base follows freely.

        Args:
            q: Positions of the joints, shape (m, 1).
            qdot: Their rates, shape (m, 1).
            qddot: Their accelerations, shape (m, 1).
        """
        at, v, vdot = self._positions(q), self._velocities(qdot), self._velocities(qddot)
        v[self._base] = self.base_velocity(q, qdot)
        vdot[self._base] = self._free(at, self._momentum(at, v, vdot))
        return self.inverse_dynamics(at, v, vdot)[self._v] + self.damping * qdot

    def point(self, frame: Frame, q: Expression) -> Expression:
        """Return p_BoFo_B of a frame F, shape (3, 1), in m.

        Args:
            frame: The frame F of the plant.
            q: Positions of the joints, shape (m, 1).
        """
        return self.frame(frame, self._positions(q)).p

    def motion(self, spline: Spline, *, steps: int) -> casadi.Function:
        """Return the function (knots) -> rotation, position, torque of the joints' curve over its duration.

        Pose by the Runge-Kutta method of fourth order. ``knots`` has the shape (m, n); ``rotation`` holds quaternions
        [w, x, y, z] of R_B0B, shape (4, N + 1); ``position`` p_B0B_B0, shape (3, N + 1), in m; ``torque`` the drives'
        torques, shape (m, N + 1).

        Args:
            spline: The curve of each joint; smooth, ``cubic`` or ``bspline``.
            steps: Number N of the integration's steps; best a multiple of the pieces of the curve.

        Raises:
            ValueError: The curve has no continuous rate, or there is no step.
        """
        if spline.smoothness < 2:
            raise ValueError(f"joints cannot follow a curve of order {spline.order!r}: take 'cubic' or 'bspline'")
        if steps < 1:
            raise ValueError(f"the pose of the base is integrated in at least 1 step, not {steps}")
        m, h = len(self.joints), spline.duration / steps
        q, qdot, qddot = (casadi.SX.sym(name, m) for name in ("q", "qdot", "qddot"))
        velocity = _dense("velocity", [q, qdot], self.base_velocity(q, qdot))
        torque = _dense("torque", [q, qdot, qddot], self.torque(q, qdot, qddot))
        knots = casadi.MX.sym("knots", m, spline.knots)
        halves = 0.5 * h * np.arange(2 * steps + 1)
        at, rate, change = (knots @ casadi.DM(spline.matrix(halves, derivative).T) for derivative in range(3))
        rotation, position = base_poses(steps, spline.duration)(velocity.map(2 * steps + 1)(at, rate))
        torques = torque.map(steps + 1)(at[:, ::2], rate[:, ::2], change[:, ::2])
        return casadi.Function(
            "base_motion", [knots], [rotation, position, torques], ["knots"], ["rotation", "position", "torque"]
        )

    # -- parts

    def _positions(self, q: Expression) -> Expression:
        positions = casadi.SX(casadi.DM(self._default_positions))
        positions[self._q] = q
        return positions

    def _velocities(self, qdot: Expression) -> Expression:
        velocities = casadi.SX(self.nv, 1)
        velocities[self._v] = qdot
        return velocities

    def _momentum(self, q: Expression, v: Expression, vdot: Expression) -> Expression:
        """Return d/dt (M_bb V + M_bm qdot) of the velocities v and vdot; with v = 0, the momentum of vdot."""
        return self.inverse_dynamics(q, v, vdot, rotors=False, gravity=False)[self._base]

    def _free(self, q: Expression, momentum: Expression) -> Expression:
        """Return -M_bb^-1 times a momentum (or its change), shape (6, 1)."""
        root = casadi.chol(self._locked(q))
        return -casadi.solve(root, casadi.solve(root.T, momentum))

    def _locked(self, q: Expression) -> Expression:
        """Return M_bb, the inertia of all about Bo with the joints locked, shape (6, 6), angular before linear."""
        moves = self._moves(q, casadi.SX(self.nv, 1))
        inertias = [link.inertia for link in self._links]
        for k in range(len(self._links) - 1, 0, -1):
            inertias[self._links[k].parent] += moves[k].inertia_to_parent(inertias[k])
        return casadi.densify(inertias[0])


@dataclass(frozen=True)
class BaseMotion:
    """How the base moves.

    Attributes:
        times: Times in s, shape (N + 1,).
        rotation: Quaternions [w, x, y, z] of R_B0B, shape (N + 1, 4).
        position: p_B0B_B0 in m, shape (N + 1, 3).
        torque: Torques of the drives, shape (N + 1, m), in N m (or N).
    """

    times: Array
    rotation: Array
    position: Array
    torque: Array

    @cached_property
    def angle(self) -> Array:
        """Return the angle of R_B0B, in [0, pi], shape (N + 1,), in rad."""
        return rotation_angle(self.rotation)


class BaseReaction:
    """Computes how the base moves under a plan of the joints, as machine code."""

    def __init__(self, model: MomentumModel, spline: Spline, *, steps: int, compile: bool | None = None) -> None:
        """Translate `MomentumModel.motion`, which has the same arguments.

        Args:
            model: The model.
            spline: The curve of each joint.
            steps: Number N of the integration's steps.
            compile: True makes machine code, which is kept for the next time; None does so if there is a C compiler.

        Raises:
            ValueError: The curve has no continuous rate, or there is no step.
            CompilerError: There is no C compiler, or it fails.
        """
        self.function = model.motion(spline, steps=steps)
        self._times = np.linspace(0.0, spline.duration, steps + 1)
        knots = self.function.mx_in()
        packed = casadi.Function("packed_base_motion", knots, [casadi.vertcat(*self.function.call(knots))])
        self._shape = spline.knots, len(model.joints)
        self._buffers = Buffers(TRANSLATIONS[compile](packed), may_fail=False)

    def __call__(self, knots: ArrayLike) -> BaseMotion:
        """Return the motion of the base.

        Args:
            knots: The knots of the plan, shape (n, m), or flat.

        Raises:
            ValueError: The shape does not fit.
        """
        w = np.asarray(knots, dtype=float)
        if w.shape not in (self._shape, (self._shape[0] * self._shape[1],)):
            raise ValueError(f"the knots of a plan have the shape {self._shape}, not {w.shape}")
        arguments, evaluate, result = self._buffers.parts
        arguments[:] = w.ravel()
        evaluate()
        motion = result.reshape(len(self._times), -1).copy()
        return BaseMotion(self._times, motion[:, :4], motion[:, 4:7], motion[:, 7:])


def base_poses(steps: int, duration: float) -> casadi.Function:
    """Return the function (V) -> rotation, position, by the Runge-Kutta method of fourth order.

    V are velocities V_B0B_B at the 2 N + 1 ends and middles of the N steps, shape (6, 2 N + 1); ``rotation`` and
    ``position`` are as in `MomentumModel.motion`.

    Args:
        steps: Number N of steps.
        duration: Duration of all steps in seconds.
    """
    V, begin = casadi.MX.sym("V", 6, 2 * steps + 1), casadi.DM([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    following = _pose_step(duration / steps).mapaccum(steps)(begin, V[:, :-1:2], V[:, 1::2], V[:, 2::2])
    poses = casadi.horzcat(begin, following)
    return casadi.Function("base_poses", [V], [poses[:4, :], poses[4:, :]], ["V"], ["rotation", "position"])


def momentum_world(model: MomentumModel, positions: ArrayLike, *, period: float) -> CasadiSystem:
    r"""Return a System in which the joints follow their commands exactly, and the base moves accordingly.

    .. pydrake_system::

        name: CasadiSystem
        input_ports:
        - position
        output_ports:
        - state

    At t = 0, T, 2 T, ... the joints move to ``position`` (rad or m, shape (m,)), at a constant rate since the last
    sample; the velocity of the base is taken halfway. ``state`` is [quaternion of R_WB, p_WoBo_W; q], shape (7 + m,).
    Its variables, ``<base>.position`` and ``<joint>.position``, are named like the plant's variables, where the plant
    is added to a testbed as ``sim.sys.<model instance>``: beliefs and qualities fit both.

    Args:
        model: The model.
        positions: Initial positions of the joints, shape (m,); the base starts at the origin of W.
        period: T in seconds.
    """
    m = len(model.joints)
    x, u = casadi.SX.sym("x", 7 + m), casadi.SX.sym("u", m)
    q = x[7:]
    velocity = model.base_velocity((q + u) / 2.0, (u - q) / period)
    pose = _pose_step(period)(x[:7], velocity, velocity, velocity)
    update = casadi.Function(
        "momentum_world", [x, u], [casadi.vertcat(pose, u)], ["state", "position"], ["state_next"], {"cse": True}
    )
    start = np.concatenate([[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], np.asarray(positions, dtype=float)])
    world = CasadiSystem(update=update, state={"state": start}, period=period)
    (state,) = world.variables
    joints = (replace(state, name=f"{name}.position", shape=(), start=7 + k) for k, name in enumerate(model.joints))
    world.variables = (replace(state, name=f"{model.base}.position", shape=(7,)), *joints)
    return world


def rotation_angle(quaternions: ArrayLike) -> Array:
    """Return the angles of rotations, in [0, pi], in rad.

    Args:
        quaternions: [w, x, y, z] of any norm, shape (..., 4).
    """
    e = np.asarray(quaternions, dtype=float)
    return np.asarray(2.0 * np.arctan2(np.linalg.norm(e[..., 1:], axis=-1), np.abs(e[..., 0])), dtype=float)


def _pose_step(h: float) -> casadi.Function:
    """Return the function (pose, V_begin, V_middle, V_end) -> pose after h seconds; pose is [quaternion; position]."""
    x, *V = casadi.SX.sym("x", 7), *(casadi.SX.sym(name, 6) for name in ("V0", "V1", "V2"))

    def rate(pose: Expression, velocity: Expression) -> Expression:
        w, a = pose[0], pose[1:4]
        omega, v = velocity[:3], velocity[3:]
        turned = v + 2.0 * casadi.cross(a, casadi.cross(a, v) + w * v) / casadi.sumsqr(pose[:4])
        return casadi.vertcat(-0.5 * casadi.dot(a, omega), 0.5 * (w * omega + skew(a) @ omega), turned)

    k1 = rate(x, V[0])
    k2 = rate(x + 0.5 * h * k1, V[1])
    k3 = rate(x + 0.5 * h * k2, V[1])
    k4 = rate(x + h * k3, V[2])
    end = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return _dense("pose_step", [x, *V], casadi.vertcat(end[:4] / casadi.norm_2(end[:4]), end[4:]))


def _dense(name: str, arguments: Sequence[Expression], result: Expression) -> casadi.Function:
    return casadi.Function(name, list(arguments), [casadi.densify(result)], {"cse": True})
