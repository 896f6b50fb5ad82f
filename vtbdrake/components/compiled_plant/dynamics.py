r"""The equations of motion of a MultibodyPlant, written in CasADi.

The recursions are from Featherstone, "Rigid Body Dynamics Algorithms", 2008 (RBDA), in the frames of the links. A
spatial vector is [angular; linear], as in Drake. The symbols of a link with the frame M: V is its velocity; S v the
velocity of its joint; X takes motions from the frame of the parent to M, and X' takes forces back; V x and V x* are
crm(V) and crf(V). The world accelerates with -g, so that weight needs no force.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import casadi
import numpy as np
from pydrake.multibody.plant import DiscreteContactSolver, MultibodyPlant
from pydrake.multibody.tree import Frame, Joint, RigidBody
from pydrake.systems.framework import Context

from vtbdrake.components.casadi_system.kernel import clamp
from vtbdrake.components.compiled_plant.links import (
    FLOATING,
    PRISMATIC,
    REVOLUTE,
    Expression,
    Link,
    Pose,
    UnsupportedPlantError,
    constant,
    constant_pose,
    input_name,
    read_links,
    rotation,
    rounding_beside,
    skew,
    symmetric,
    times,
)


def plant_dynamics(plant: MultibodyPlant, context: Context, *, inputs: Sequence[str] = ()) -> casadi.Function:
    """Return the function (x, u, inputs) -> xdot of a plant: what `System.EvalTimeDerivatives` computes.

    x is the plant's [q; v], u its actuation. Masses, inertias, frames, damping and reflected inertia are read from the
    Context. All ``inputs`` are arguments, so that nothing is compiled when they change; they follow x and u, and are
    named after their addresses, with ``_`` for each dot.

    Args:
        plant: The plant, finalized; discrete or continuous.
        context: The plant's own Context.
        inputs: Addresses within the plant, such as ``payload.mass``; see `read_links`.

    Raises:
        UnsupportedPlantError: The plant has contact, loops, springs, joints of other types, and so on.
        ValueError: An input is not among the addresses.
    """
    model = PlantDynamics(plant, context, inputs=inputs)
    q, v, u = model.symbols()
    xdot = casadi.vertcat(model.qdot(q, v), model.acceleration(q, v, model.actuation(u)))
    return model.function("dynamics", [casadi.vertcat(q, v), u], {"xdot": xdot})


def plant_step(plant: MultibodyPlant, context: Context, *, inputs: Sequence[str] = ()) -> casadi.Function:
    """Return the function (x, u, inputs) -> x_next, overrun of one step of a discrete plant, as SAP takes it.

    The step is semi-implicit Euler's, with implicit damping. ``overrun`` (rad or m, the largest of all joints) is
    positive as soon as the plant would feel one of its joint stops, which the step lacks; -inf without stops.

    It refuses what `plant_dynamics` refuses, too.

    Args:
        plant: The plant, finalized and discrete.
        context: The plant's own Context.
        inputs: Addresses within the plant, such as ``payload.mass``; see `read_links`.

    Raises:
        UnsupportedPlantError: The plant is continuous, or uses the solver TAMSI.
    """
    if plant.time_step() <= 0.0:
        raise UnsupportedPlantError("a continuous plant has no step: give it a time_step, or use plant_dynamics.")
    if plant.get_discrete_contact_solver() != DiscreteContactSolver.kSap:
        raise UnsupportedPlantError("the solver TAMSI is not compiled: set discrete_contact_approximation to 'sap'.")
    model = PlantDynamics(plant, context, inputs=inputs)
    q, v, u = model.symbols()
    q_next, v_next = model.step(q, v, model.actuation(u), plant.time_step())
    stops = {"x_next": casadi.vertcat(q_next, v_next), "overrun": model.overrun(q, v_next, plant.time_step())}
    return model.function("step", [casadi.vertcat(q, v), u], stops)


@dataclass(frozen=True)
class FrameMotion:
    """How a frame F moves in the world W.

    Attributes:
        R: R_WF, shape (3, 3).
        p: p_WoFo_W, shape (3, 1), in m.
        J: The Jacobian with V_WF_W = [w; v] = J v, shape (6, nv), as Drake's SpatialVelocity.
    """

    R: Expression
    p: Expression
    J: Expression


@dataclass(frozen=True)
class AppliedForce:
    """A force on a body, as Drake's ExternallyAppliedSpatialForce.

    Attributes:
        body: Index of the body B.
        p_BoBq_B: Where it acts, shape (3, 1).
        F_Bq_W: [torque; force] in the world, shape (6, 1).
    """

    body: int
    p_BoBq_B: Expression
    F_Bq_W: Expression


class PlantDynamics:
    """A plant as CasADi expressions. All quantities are the plant's own: q, v and tau in its order and units.

    Args:
        plant: The finalized plant.
        context: Its own Context, with the values that are compiled in.
        controllers: Whether actuators may have PD controllers, whose actuation is then left to a solver, with their
            feed-forward.

    Attributes:
        nq: Number of positions.
        nv: Number of velocities.
        nu: Number of actuators.
        inputs: Addresses of the arguments beside x and u.
        values: What the Context held for them, by address, flat.
    """

    def __init__(
        self, plant: MultibodyPlant, context: Context, *, inputs: Sequence[str] = (), controllers: bool = False
    ) -> None:
        """Read the plant through its own Context; see `plant_dynamics` for arguments and errors."""
        tree = read_links(plant, context, inputs, controllers=controllers)
        self._links = tree.links
        self._symbols = tree.symbols
        self._mounts = tree.mounts
        self._inertias, self._welds = tree.inertias, tree.welds
        self._rounding = tree.rounding
        self._context = context
        gravity = plant.gravity_field().gravity_vector()
        self._gravity = constant(np.concatenate([np.zeros(3), gravity]), rounding_beside(np.max(np.abs(gravity))))
        self._actuation = constant(plant.MakeActuationMatrix())
        actuators = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
        self._effort = {actuator.input_start(): actuator.effort_limit() for actuator in actuators}
        self._controlled = {actuator.input_start() for actuator in actuators if actuator.has_controller()}
        self._stops = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
        self.nq, self.nv, self.nu = plant.num_positions(), plant.num_velocities(), plant.num_actuated_dofs()
        self.inputs = tuple(tree.symbols)
        self.values = tree.values

    def symbols(self) -> tuple[Expression, Expression, Expression]:
        """Return new symbols q, v and u."""
        return casadi.SX.sym("q", self.nq), casadi.SX.sym("v", self.nv), casadi.SX.sym("u", self.nu)

    def function(self, name: str, arguments: Sequence[Expression], results: dict[str, Expression]) -> casadi.Function:
        """Return the function of x and u, and of the inputs, with common subexpressions eliminated.

        Args:
            name: Name of the function.
            arguments: Its arguments before the inputs, such as x and u.
            results: Its results by name.
        """
        names = ["x", "u", *(input_name(address) for address in self.inputs)]
        doubled = sorted({name for name in names if names.count(name) > 1})
        if doubled:
            raise ValueError(f"the inputs need names of their own, but {', '.join(doubled)} is given more than once.")
        values = [casadi.densify(value) for value in results.values()]
        return casadi.Function(name, [*arguments, *self._symbols.values()], values, names, list(results), {"cse": True})

    def substituted(self, results: Sequence[Expression], values: Mapping[str, Expression]) -> list[Expression]:
        """Return results of the methods below with expressions, by address, in place of the inputs.

        Args:
            results: Expressions that depend on the inputs.
            values: The expression for each replaced input, by address.
        """
        symbols = list(self._symbols.values())
        return list(casadi.substitute(list(results), symbols, [casadi.densify(values[name]) for name in self.inputs]))

    # -- dynamics

    def acceleration(self, q: Expression, v: Expression, tau: Expression, *, period: float = 0.0) -> Expression:
        """Return vdot = M(q)^-1 (tau - D v - C(q, v) v + g(q)), by the articulated-body algorithm (RBDA, 7.3).

        D is the damping; M contains the reflected inertias, and period * D: with the period of a step, the damping acts
        at the end of the step, on v + period * vdot.

        Args:
            q: Positions, shape (nq, 1), in rad or m.
            v: Velocities, shape (nv, 1), in rad/s or m/s.
            tau: Generalized forces, shape (nv, 1), in N m or N.
            period: Time step in s for implicit damping; 0 for the continuous plant.
        """
        moves = self._moves(q, v)
        inertias = [link.inertia for link in self._links]
        biases = [_crf(move.V) @ (link.inertia @ move.V) for link, move in zip(self._links, moves, strict=True)]
        gains, forces, factors = [], [], []
        for k in reversed(range(len(self._links))):
            link, move = self._links[k], moves[k]
            U = inertias[k] @ move.S
            rotor = link.reflected_inertia + period * link.damping
            factor = _Factor(symmetric(move.S.T @ U + casadi.diag(rotor)))
            force = tau[link.v] - link.damping * v[link.v] - move.S.T @ biases[k]
            gains.append(U)
            forces.append(force)
            factors.append(factor)
            if link.parent >= 0:
                I_a = symmetric(inertias[k] - U @ factor.solve(U.T))
                p_a = biases[k] + I_a @ move.bias + U @ factor.solve(force)
                inertias[link.parent] += move.inertia_to_parent(I_a)
                biases[link.parent] += move.X.T @ p_a
        vdot = casadi.SX(self.nv, 1)
        accelerations: list[Expression] = []
        backwards = zip(reversed(gains), reversed(forces), reversed(factors), strict=True)
        for link, move, (U, force, factor) in zip(self._links, moves, backwards, strict=True):
            A = move.X @ self._of_parent(accelerations, link, -self._gravity) + move.bias
            vdot[link.v] = factor.solve(force - U.T @ A)
            accelerations.append(A + move.S @ vdot[link.v])
        return vdot

    def inverse_dynamics(
        self, q: Expression, v: Expression, vdot: Expression, *, rotors: bool = True, gravity: bool = True
    ) -> Expression:
        """Return tau = M(q) vdot + C(q, v) v - g(q), by the recursion of Newton and Euler (RBDA, 5.3); no damping.

        Args:
            q: Positions.
            v: Velocities.
            vdot: Accelerations.
            rotors: M contains the reflected inertias: tau is the torque of the drives. Without, tau is what the joints'
                torque sensors feel.
            gravity: Leave out to get M(q) vdot + C(q, v) v.
        """
        moves = self._moves(q, v)
        world = -self._gravity if gravity else casadi.SX(6, 1)
        accelerations: list[Expression] = []
        forces = []
        for link, move in zip(self._links, moves, strict=True):
            A = move.X @ self._of_parent(accelerations, link, world) + move.bias + move.S @ vdot[link.v]
            accelerations.append(A)
            forces.append(link.inertia @ A + _crf(move.V) @ (link.inertia @ move.V))
        tau = casadi.SX(self.nv, 1)
        for k in reversed(range(len(self._links))):
            link, move = self._links[k], moves[k]
            tau[link.v] = move.S.T @ forces[k]
            if rotors:
                tau[link.v] += link.reflected_inertia * vdot[link.v]
            if link.parent >= 0:
                forces[link.parent] += move.X.T @ forces[k]
        return tau

    def momentum_balance(
        self, q: Expression, v: Expression, tau: Expression, period: float
    ) -> tuple[Expression, Expression]:
        """Return A = M(q) + period D and p* = M v + period (tau - C v + g): without contact, A v_next = p*.

        Args:
            q: Positions, shape (nq, 1).
            v: Velocities, shape (nv, 1).
            tau: Generalized forces, shape (nv, 1), in N m or N.
            period: Time step in s.
        """
        vdot = casadi.SX.sym("vdot", self.nv)
        torque = self.inverse_dynamics(q, v, vdot)
        M = casadi.jacobian(torque, vdot)
        (bias,) = casadi.substitute([torque], [vdot], [casadi.SX.zeros(self.nv, 1)])
        damping = casadi.diag(casadi.jacobian(self.damping_torque(vdot), vdot))
        return M + period * casadi.diag(damping), M @ v + period * (tau - bias)

    def damping_torque(self, v: Expression) -> Expression:
        """Return D v, the torques by which the joints' damping resists."""
        torque = casadi.SX(self.nv, 1)
        for link in self._links:
            torque[link.v] = link.damping * v[link.v]
        return torque

    def energy(self, q: Expression, v: Expression, *, rotors: bool = True) -> tuple[Expression, Expression]:
        """Return the kinetic and the potential energy, in J; ``rotors`` as in `inverse_dynamics`.

        Args:
            q: Positions, shape (nq, 1).
            v: Velocities, shape (nv, 1).
            rotors: Whether the reflected inertias count.
        """
        kinetic, potential = casadi.SX(0), casadi.SX(0)
        for link, move, (R, p) in zip(self._links, self._moves(q, v), self._poses(q), strict=True):
            kinetic += casadi.dot(move.V, link.inertia @ move.V) / 2
            if rotors:
                kinetic += casadi.dot(link.reflected_inertia, v[link.v] ** 2) / 2
            mass, first = link.inertia[5, 5], link.inertia[:3, 3:]  # the moment of mass, as a skew matrix
            moment = casadi.vertcat(first[2, 1], first[0, 2], first[1, 0])
            potential -= casadi.dot(self._gravity[3:], mass * p + R @ moment)
        return kinetic, potential

    def momentum(self, q: Expression, v: Expression, *, rotors: bool = True) -> tuple[Expression, Expression]:
        """Return the momentum p = M(q) v, and dL/dq of the Lagrangian L = v' M v / 2 - U; ``rotors`` as above.

        Lagrange's equation is then dp/dt = dL/dq + tau (but not for a floating joint, whose v is not qdot).

        Args:
            q: Positions, shape (nq, 1).
            v: Velocities, shape (nv, 1).
            rotors: Whether the reflected inertias count.
        """
        position, velocity, _ = self.symbols()
        kinetic, potential = self.energy(position, velocity, rotors=rotors)
        results = casadi.gradient(kinetic, velocity), casadi.gradient(kinetic - potential, position)
        p, slope = casadi.substitute(list(results), [position, velocity], [q, v])
        return casadi.densify(p), casadi.densify(slope)

    def step(self, q: Expression, v: Expression, tau: Expression, period: float) -> tuple[Expression, Expression]:
        """Return q and v after one step of Drake's discrete plant: semi-implicit Euler with implicit damping.

        Args:
            q: Positions, shape (nq, 1).
            v: Velocities, shape (nv, 1).
            tau: Generalized forces, shape (nv, 1), in N m or N.
            period: Time step in s.
        """
        v_next = v + period * self.acceleration(q, v, tau, period=period)
        return q + period * self.qdot(q, v_next), v_next

    def overrun(self, q: Expression, v_next: Expression, period: float) -> Expression:
        """Return the largest distance of q + 2 period qdot beyond the joints' stops, of all joints (rad or m).

        SAP's stops push back as soon as it is positive (their dissipation time is the period).

        Args:
            q: Positions, shape (nq, 1).
            v_next: Velocities after the step, shape (nv, 1).
            period: Time step in s.
        """
        ahead = q + 2 * period * self.qdot(q, v_next)
        beyond = [
            side
            for i, (lower, upper) in enumerate(zip(*self._stops, strict=True))
            for side, stop in ((lower - ahead[i], lower), (ahead[i] - upper, upper))
            if np.isfinite(stop)
        ]
        return casadi.mmax(casadi.vertcat(-np.inf, *beyond))

    def actuation(self, u: Expression) -> Expression:
        """Return tau of the actuation u, in which actuators with PD controllers do nothing; see `limited`."""
        limited = casadi.vertsplit(self.limited(u))
        uncontrolled = [casadi.SX(1, 1) if i in self._controlled else limited[i] for i in range(self.nu)]
        return self._actuation @ casadi.vertcat(casadi.SX(0, 1), *uncontrolled)

    def limited(self, u: Expression) -> Expression:
        """Return the actuation u held within the actuators' effort limits, as Drake does, shape (nu, 1)."""
        limits = [self._effort[i] for i in range(self.nu)]
        limited = [clamp(u[i], -limit, limit) if np.isfinite(limit) else u[i] for i, limit in enumerate(limits)]
        return casadi.vertcat(casadi.SX(0, 1), *limited)

    # -- kinematics

    def qdot(self, q: Expression, v: Expression) -> Expression:
        """Return qdot = N(q) v.

        Args:
            q: Positions, shape (nq, 1).
            v: Velocities, shape (nv, 1).
        """
        rates = casadi.SX(self.nq, 1)
        for link in self._links:
            if link.kind == FLOATING:
                rates[link.q] = _floating_rate(q[link.q], v[link.v])
            else:
                rates[link.q] = v[link.v]
        return rates

    def frame(self, frame: Frame, q: Expression) -> FrameMotion:
        """Return pose and Jacobian of a frame of the plant.

        Args:
            frame: A frame of the plant.
            q: Positions, shape (nq, 1).
        """
        return self._motion_on_link(*self._on_link(frame), q)

    def _motion_on_link(self, k: int, X_MF: Pose, q: Expression) -> FrameMotion:
        poses = self._poses(q)
        R, p = X_MF if k < 0 else times(poses[k], X_MF)
        J = casadi.SX(6, self.nv)
        while k >= 0:
            link, (R_WM, p_WM) = self._links[k], poses[k]
            S = _subspace(link, q)
            angular, linear = R_WM @ S[:3, :], R_WM @ S[3:, :]
            J[:3, link.v] = angular
            J[3:, link.v] = linear - skew(p - p_WM) @ angular
            k = link.parent
        return FrameMotion(R, p, casadi.densify(J))

    def frame_bias(self, frame: Frame, q: Expression, v: Expression) -> Expression:
        """Return Jdot v, the [angular; linear] acceleration of a frame in the world at constant v, shape (6, 1).

        Args:
            frame: A frame of the plant.
            q: Positions, shape (nq, 1).
            v: Velocities, shape (nv, 1).
        """
        moves = self._moves(q, v)
        accelerations: list[Expression] = []
        for link, move in zip(self._links, moves, strict=True):
            accelerations.append(move.X @ self._of_parent(accelerations, link, casadi.SX(6, 1)) + move.bias)
        k, (_, p_MF) = self._on_link(frame)
        if k < 0:
            return casadi.SX(6, 1)
        (R, _), omega = self._poses(q)[k], skew(moves[k].V[:3])
        alpha = accelerations[k][:3]
        # A spatial acceleration belongs to a point fixed in space; F's origin moves through it with the link.
        linear = accelerations[k][3:] + omega @ moves[k].V[3:] + skew(alpha) @ p_MF + omega @ (omega @ p_MF)
        return casadi.vertcat(R @ alpha, R @ linear)

    # -- forces

    def pose(self, body: RigidBody, q: Expression) -> Pose:
        """Return the pose of a body in the world, (R_WB, p_WB).

        Args:
            body: A body of the plant.
            q: Positions, shape (nq, 1).
        """
        return self.body_pose(int(body.index()), q)

    def body_pose(self, body: int, q: Expression) -> Pose:
        """Return the pose of a body in the world, (R_WB, p_WB).

        Args:
            body: Index of the body.
            q: Positions, shape (nq, 1).
        """
        k, X_MB = self._mounts[body]
        return X_MB if k < 0 else times(self._poses(q)[k], X_MB)

    def point_jacobian(self, body: int, p_WP: Expression, q: Expression) -> Expression:
        """Return the Jacobian of the velocity of the point P of a body in the world, shape (3, nv).

        Args:
            body: Index of the body.
            p_WP: Where the point is now, in the world, shape (3, 1).
            q: Positions, shape (nq, 1).
        """
        motion = self.body_motion(body, q)
        return motion.J[3:, :] - skew(p_WP - motion.p) @ motion.J[:3, :]

    def body_motion(self, body: int, q: Expression) -> FrameMotion:
        """Return pose and Jacobian of a body.

        Args:
            body: Index of the body.
            q: Positions, shape (nq, 1).
        """
        return self._motion_on_link(*self._mounts[body], q)

    def way(self, body: int) -> list[int]:
        """Return the places of the velocities that move a body."""
        k, places = self._mounts[body][0], list[int]()
        while k >= 0:
            places += range(self.nv)[self._links[k].v]
            k = self._links[k].parent
        return sorted(places)

    def generalized(self, q: Expression, forces: Sequence[AppliedForce]) -> Expression:
        """Return tau of forces in the world that act on bodies.

        Args:
            q: Positions, shape (nq, 1).
            forces: Forces and torques in the world, with their bodies.
        """
        tau = casadi.SX(self.nv, 1)
        for force in forces:
            motion = self._motion_on_link(*self._mounts[force.body], q)
            torque, push = force.F_Bq_W[:3], force.F_Bq_W[3:]
            about_Bo = torque + casadi.cross(motion.R @ force.p_BoBq_B, push)
            tau += motion.J.T @ casadi.vertcat(about_Bo, push)
        return tau

    def reactions(
        self, q: Expression, v: Expression, vdot: Expression, forces: Sequence[AppliedForce]
    ) -> Callable[[Joint], Expression]:
        """Return a function of a joint that returns its reaction force F_CJc_Jc, [torque; force], shape (6, 1).

        It is what Drake's ``reaction_forces`` holds: all that the joint exerts on its child C, about the origin of the
        joint's frame Jc on the child, in Jc.

        Args:
            q: Positions.
            v: Velocities.
            vdot: Accelerations.
            forces: What else acts on the bodies.
        """
        moves = self._moves(q, v)
        poses = self._poses(q)
        accelerations: list[Expression] = []
        for link, move in zip(self._links, moves, strict=True):
            A = move.X @ self._of_parent(accelerations, link, -self._gravity)
            accelerations.append(A + move.bias + move.S @ vdot[link.v])

        def needed(body: int) -> Expression:
            """Return the force, on the link of a body, that the body needs in its motion beside what acts on it."""
            k, X_MB = self._mounts[body]
            if k < 0:
                return casadi.SX(6, 1)
            inertia, V = self._inertias[body], moves[k].V
            F = inertia @ accelerations[k] + _crf(V) @ (inertia @ V)
            R_MW = poses[k][0].T
            for force in forces:
                if force.body == body:
                    push = R_MW @ force.F_Bq_W[3:]
                    arm = X_MB[1] + X_MB[0] @ force.p_BoBq_B
                    F -= casadi.vertcat(R_MW @ force.F_Bq_W[:3] + casadi.cross(arm, push), push)
            return F

        def carried(bodies: set[int]) -> Expression:
            """Return the force on the bodies of one link and all links that hang on them, in the frame of the link."""
            F = casadi.SX(6, 1)
            for body in sorted(bodies):
                F += needed(body)
            for k, link in enumerate(self._links):
                if link.carrier in bodies:
                    F += moves[k].X.T @ carried(self._on(k))
            return F

        def reaction(joint: Joint) -> Expression:
            parent, child = int(joint.parent_body().index()), int(joint.child_body().index())
            k, (R, p) = self._on_link(joint.frame_on_child())
            moved = next((i for i, link in enumerate(self._links) if link.joint == int(joint.index())), None)
            if moved is None and k < 0:
                raise UnsupportedPlantError(
                    f"the reaction force of {joint.name()}, which does not move, is not compiled"
                )
            if moved is None:
                hangs = parent if self._welds.get(parent) == child else child
                F = carried(self._behind(hangs))
            else:
                hangs = parent if self._links[moved].carrier == child else child
                F = carried(self._on(moved))
            if hangs == parent:  # The joint exerts the opposite on its child, which carries the parent.
                F = -F if moved is None else -(moves[moved].X.T @ F)
            return casadi.vertcat(R.T @ (F[:3] - casadi.cross(p, F[3:])), R.T @ F[3:])

        return reaction

    def _on(self, k: int) -> set[int]:
        """Return the bodies of a link."""
        return {body for body, (link, _) in self._mounts.items() if link == k}

    def _behind(self, body: int) -> set[int]:
        """Return a body that is welded to another one, and all that are welded to it."""
        behind = {body}
        for welded, carrier in self._welds.items():  # Carriers come first.
            if carrier in behind:
                behind.add(welded)
        return behind

    # -- recursions

    def _moves(self, q: Expression, v: Expression) -> list[_Move]:
        moves: list[_Move] = []
        for link in self._links:
            R, p = _joint_pose(link, q)
            S = _subspace(link, q)
            V_joint = S @ v[link.v]
            X_joint, X_fixed = _motion(R, p), _motion(*link.X_PF)
            carried = casadi.SX(6, 1) if link.parent < 0 else X_joint @ (X_fixed @ moves[link.parent].V)
            V = carried + V_joint
            bias = _crm(V) @ V_joint
            if link.kind == FLOATING:
                # The axes of S stay with F, which turns against M.
                bias -= casadi.vertcat(casadi.SX(3, 1), skew(V_joint[:3]) @ V_joint[3:])
            moves.append(_Move(X_joint, X_fixed, S, V, bias))
        return moves

    def _poses(self, q: Expression) -> list[Pose]:
        poses: list[Pose] = []
        for link in self._links:
            X_WF = link.X_PF if link.parent < 0 else times(poses[link.parent], link.X_PF)
            poses.append(times(X_WF, _joint_pose(link, q)))
        return poses

    def _on_link(self, frame: Frame) -> tuple[int, Pose]:
        """Return the number of the link that a frame F is on (-1 is the world), and X_MF."""
        k, X_MB = self._mounts[int(frame.body().index())]
        return k, times(X_MB, constant_pose(frame.CalcPoseInBodyFrame(self._context), self._rounding))

    @staticmethod
    def _of_parent(values: list[Expression], link: Link, world: Expression) -> Expression:
        return world if link.parent < 0 else values[link.parent]


@dataclass(frozen=True)
class _Move:
    """How a link moves. X = X_joint X_fixed."""

    X_joint: Expression
    X_fixed: Expression
    S: Expression
    V: Expression
    bias: Expression  # what the velocities add to the acceleration

    @property
    def X(self) -> Expression:
        return self.X_joint @ self.X_fixed

    def inertia_to_parent(self, inertia: Expression) -> Expression:
        """Return X' I X. Two sparse products take half of the operations of a full one."""
        for X in (self.X_joint, self.X_fixed):
            inertia = symmetric(X.T @ inertia @ X)
        return inertia


class _Factor:
    """Solves D x = b for a symmetric, positive definite D, shape (nv, nv) of a joint."""

    def __init__(self, D: Expression) -> None:
        self._D = D
        self._root = casadi.chol(casadi.densify(D)) if D.shape[0] > 1 else None

    def solve(self, b: Expression) -> Expression:
        if self._root is None:
            return b / self._D
        return casadi.solve(self._root, casadi.solve(self._root.T, b))


def _joint_pose(link: Link, q: Expression) -> Pose:
    """Return X_FM."""
    q_joint = q[link.q]
    if link.kind == REVOLUTE:
        return rotation(link.axis, q_joint), casadi.SX(3, 1)
    if link.kind == PRISMATIC:
        return casadi.SX.eye(3), link.axis * q_joint
    return _quaternion_rotation(q_joint[:4]), q_joint[4:]


def _subspace(link: Link, q: Expression) -> Expression:
    """Return S, shape (6, nv)."""
    if link.kind == REVOLUTE:
        return casadi.vertcat(link.axis, casadi.SX(3, 1))
    if link.kind == PRISMATIC:
        return casadi.vertcat(casadi.SX(3, 1), link.axis)
    R = _quaternion_rotation(q[link.q][:4])
    return casadi.diagcat(R.T, R.T)


def _quaternion_rotation(e: Expression) -> Expression:
    """Return R of the quaternion [w, x, y, z], of any norm."""
    w, axis = e[0], skew(e[1:])
    return casadi.SX.eye(3) + 2 / casadi.sumsqr(e) * (w * axis + axis @ axis)


def _floating_rate(q: Expression, v: Expression) -> Expression:
    """Return qdot: of the quaternion [w, x, y, z] with the angular velocity in F, and of the position."""
    w, vector, omega = q[0], q[1:4], v[:3]
    return casadi.vertcat(-casadi.dot(vector, omega), w * omega - skew(vector) @ omega, 2 * v[3:]) / 2


def _motion(R: Expression, p: Expression) -> Expression:
    """Return X of the pose (R, p) of M in P, which takes motions from P to M."""
    return casadi.sparsify(casadi.blockcat([[R.T, casadi.SX(3, 3)], [-(R.T @ skew(p)), R.T]]))


def _crm(V: Expression) -> Expression:
    """Return V x, for motions."""
    omega = skew(V[:3])
    return casadi.blockcat([[omega, casadi.SX(3, 3)], [skew(V[3:]), omega]])


def _crf(V: Expression) -> Expression:
    """Return V x*, for forces."""
    return -_crm(V).T
