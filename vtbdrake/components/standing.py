"""A controller with which a legged robot stands on its feet and shifts its weight: inverse dynamics by a QP."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.solvers import ClarabelSolver, MathematicalProgram
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.state import AddressedSystem, Quantity

Array = NDArray[np.float64]

# Weights of the squared errors of the tasks, in s^4/m^2 or s^4/rad^2. Feet stay where they are before all else.
_FEET = 1e4
_CENTRE_OF_MASS = 100.0
_TRUNK = 10.0
_POSTURE = 1e-2
# The weight of the forces, relative to the robot's weight: they are shared as equally as the tasks allow.
_FORCES = 1e-1
# How fast a velocity of a foot on the ground is braked, in 1/s.
_FOOT_BRAKE = 20.0
# A trunk that has turned further from its orientation, in rad, has fallen: the robot does not stand on its feet.
_FALLEN = 1.0
# The largest normal force of a contact point, in weights.
_LARGEST_FORCE = 5.0


class Stance(NamedTuple):
    """The stance of a legged robot.

    Attributes:
        base: Name of its trunk, a floating base.
        X_WB: The pose of the trunk, [quaternion wxyz, position in m], with the feet on the ground at z = 0, shape (7,).
        posture: The positions of ``joints`` (rad or m), shape (n,).
        joints: Names of its joints, in the order of what is measured.
        feet: Name of a body -> its contact points in the frame of the body in m, shape (k, 3).
        direction: The direction in which the weight is shifted, in the plane, of length 1: the robot looks in the
            direction of (1, 0), and has (0, 1) on its left.
    """

    base: str
    X_WB: Array
    posture: Array
    joints: tuple[str, ...]
    feet: Mapping[str, Array]
    direction: tuple[float, float] = (0.0, 1.0)


class Gains(NamedTuple):
    """The gains of a `StandingController`.

    Attributes:
        frequency: Natural frequency of the centre of mass and the trunk, in rad/s.
        damping_ratio: Their damping ratio.
        posture_frequency: Natural frequency of the joints, in rad/s; their damping ratio is 1.
        friction: The coefficient of friction of the feet that is made use of.
    """

    frequency: float = 6.0
    damping_ratio: float = 1.0
    posture_frequency: float = 10.0
    friction: float = 0.6


class StandingController(AddressedSystem):
    r"""Whole-body control of a robot that stands on its feet, by inverse dynamics over its contacts.

    .. pydrake_system::

        name: StandingController
        input_ports:
        - pose
        - twist
        - imu
        - position
        - velocity
        - effort_measured
        - shift
        output_ports:
        - effort

    ``pose`` and ``twist`` of the trunk B come from a `BasePoseSensor` and a `BaseTwistSensor`, ``imu`` from an `Imu` in
    B's frame, ``position`` and ``velocity`` from sensors of the joints. ``shift`` (m) moves the centre of mass in
    the stance's ``direction``, as fast as the parameter ``shift_speed``. ``effort_measured`` is for switches to a real
    robot. With the generalized velocity v = [V_WB; B v_r], where v_r are the velocities of the driven joints, each
    sample solves for accelerations a = [A_WB; B a_r] and the forces f of the contact points::

        minimize    sum of w_k |J_k a + dJ_k v - a_k|^2  +  w_f |f / (m g)|^2
        subject to  N' (M a + C v - g + D v - J' f) = [0; effort],
                    |effort| <= limit,   |f_x|, |f_y| <= friction / sqrt(2) f_z,   0 <= f_z,

    which Clarabel does (Drake's `MathematicalProgram`). J_k are the Jacobians of the centre of mass, of the trunk's
    orientation, the joints and the contact points, and a_k = w^2 (x_k - x) - 2 d w v_k lead them to their references,
    with w the ``frequency`` and d the ``damping_ratio``; the joints are led to the posture with
    ``posture_frequency``, weakly. The references of the centre of mass and of the trunk's heading lie above the feet,
    wherever these stand. (Kuindersma et al., "Optimization-based locomotion planning, estimation, and control design
    for Atlas", Autonomous Robots 40, 2016; with the feet's accelerations as a task.)

    Where the trunk has turned over by more than 1 rad, so that the robot is not on its feet, or the solver fails, the
    joints are held at the posture: the torques are m_jj (p^2 (q_r - q) - 2 p v) with p the ``posture_frequency`` and
    m_jj the inertia at each joint, within the limits. The state ``solved`` says which it was. The last measurements are
    state, too: what is believed of the robot.
    """

    def __init__(
        self,
        make_plant: Callable[[], MultibodyPlant],
        stance: Stance,
        *,
        motions: ArrayLike,
        limit: ArrayLike,
        period: float,
        gains: Gains | None = None,
        unit: str = "N m",
    ) -> None:
        """Declare the controller.

        Args:
            make_plant: Function that returns the robot's plant, finalized, without constraints and contact.
            stance: How it stands.
            motions: The matrix B, which maps the velocities of the driven joints, in the order of ``effort``, to the
                velocities of all joints of the stance; shape (joints, driven).
            limit: The largest effort of each driven joint, in N m or N, shape (driven,).
            period: The sample period in seconds.
            gains: The initial values of the gains; ``Gains()`` by default.
            unit: Unit of the efforts.
        """
        super().__init__()
        gains = gains or Gains()
        self.period: float = float(period)  # sample period in seconds
        self.model = WholeBodyModel(make_plant, stance, motions=motions, limit=limit)
        joints, driven = len(stance.joints), self.model.driven
        sizes = {"pose": 7, "twist": 6, "imu": 6, "position": joints, "velocity": joints}
        self._inputs = {name: self.DeclareVectorInputPort(name, size) for name, size in sizes.items()}
        self.DeclareVectorInputPort("effort_measured", driven)  # for the switch to the real robot
        self._shift = self.DeclareVectorInputPort("shift", 1)
        self._settings = self.declare_parameters(
            frequency=Quantity(gains.frequency, "rad/s", (0.0, 0.1 / period)),
            damping_ratio=Quantity(gains.damping_ratio, "1", (0.0, 3.0)),
            posture_frequency=Quantity(gains.posture_frequency, "rad/s", (0.0, 0.1 / period)),
            friction=Quantity(gains.friction, "1", (0.05, 2.0)),
            shift_speed=Quantity(0.05, "m/s", (0.0, 1.0)),
        )
        effort, solved = self.model.effort(self.model.rest, gains=gains, shift=0.0)
        self._command = self.declare_discrete_state(effort=Quantity(effort, unit))
        self._memory = self.declare_discrete_state(
            shift=Quantity(0.0, "m"),
            solved=Quantity(float(solved), "1", (0.0, 1.0)),
            base_pose=Quantity(self.model.rest.pose, "1, 1, 1, 1, m, m, m"),
            base_twist=Quantity(np.zeros(6), "rad/s, m/s"),
            imu=Quantity(np.zeros(6), "rad/s, m/s^2"),
            joint_position=Quantity(self.model.rest.position, "rad, m"),
            joint_velocity=Quantity(np.zeros(joints), "rad/s, m/s"),
        )
        self.DeclareStateOutputPort("effort", self._command.index)
        self.DeclarePeriodicDiscreteUpdateEvent(self.period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        pose, twist, imu, position, velocity = (port.Eval(context) for port in self._inputs.values())
        settings, memory = self._settings.view(context), self._memory.mutable(state)
        reach = self.period * settings.shift_speed
        memory.shift += min(max(self._shift.Eval(context)[0] - memory.shift, -reach), reach)
        memory.base_pose, memory.base_twist, memory.imu = pose, twist, imu
        memory.joint_position, memory.joint_velocity = position, velocity
        measured = WholeBodyMotion(pose, twist, position, velocity)
        gains = Gains(*(getattr(settings, name) for name in Gains._fields))
        effort, solved = self.model.effort(measured, gains=gains, shift=memory.shift)
        self._command.mutable_array(state)[:] = effort
        memory.solved = float(solved)


class WholeBodyMotion(NamedTuple):
    """The state of a legged robot.

    Attributes:
        pose: The pose of its trunk, [quaternion wxyz, position in m], shape (7,).
        twist: The spatial velocity of its trunk in the world, [rad/s, m/s], shape (6,).
        position: The positions of its joints in rad or m, shape (n,).
        velocity: Their velocities, shape (n,).
    """

    pose: Array
    twist: Array
    position: Array
    velocity: Array


class WholeBodyModel:
    """The inverse dynamics of a robot on its feet, a function of its motion, see `StandingController`.

    Attributes:
        stance: How it stands.
        driven: The number of driven joints.
        rest: The motion in which it stands still.
        weight: Its weight in N.
    """

    def __init__(
        self, make_plant: Callable[[], MultibodyPlant], stance: Stance, *, motions: ArrayLike, limit: ArrayLike
    ) -> None:
        """Prepare the model.

        Args:
            make_plant: Function that returns the robot's plant, finalized, without constraints and contact.
            stance: How it stands.
            motions: The matrix B of a `StandingController`, shape (joints, driven).
            limit: The largest effort of each driven joint, in N m or N, shape (driven,).
        """
        self._plant = plant = make_plant()
        self._scratch = _Scratch(plant)
        self.stance = stance
        B = np.asarray(motions, dtype=float)
        self.driven = B.shape[1]
        self._limit = np.asarray(limit, dtype=float)
        base = plant.GetBodyByName(stance.base)
        joints = [plant.GetJointByName(name) for name in stance.joints]
        start = base.floating_velocities_start_in_v()
        self._base_q, self._base_v = base.floating_positions_start() + np.arange(7), start + np.arange(6)
        self._q = np.array([joint.position_start() for joint in joints])
        self._v = np.array([joint.velocity_start() for joint in joints])
        self._damping = np.zeros(plant.num_velocities())
        self._damping[self._v] = [joint.default_damping() for joint in joints]
        # v = N v_r, with v_r = [V_WB; the driven joints' velocities].
        self._N = np.zeros((plant.num_velocities(), 6 + self.driven))
        self._N[self._base_v, np.arange(6)] = 1.0
        self._N[self._v, 6:] = B
        # For each driven joint: the joint that moves with it one to one.
        self._leader = np.array([int(np.argmax(np.isclose(B[:, k], 1.0))) for k in range(self.driven)])
        self._feet = [(plant.GetBodyByName(name).body_frame(), points.T) for name, points in stance.feet.items()]
        n = len(stance.joints)
        self.rest = WholeBodyMotion(np.asarray(stance.X_WB), np.zeros(6), np.asarray(stance.posture), np.zeros(n))
        context = self._scratch.context
        self._set(context, self.rest)
        self.weight = plant.CalcTotalMass(context) * float(np.linalg.norm(plant.gravity_field().gravity_vector()))
        contacts = self._contacts(context)
        self._contacts_at_rest = contacts - contacts.mean(axis=0)
        self._centre_at_rest = plant.CalcCenterOfMassPositionInWorld(context) - contacts.mean(axis=0)
        self._R_WB_at_rest = _rotation(self.rest.pose[:4])

    def _set(self, context: Context, motion: WholeBodyMotion) -> None:
        q, v = np.zeros(self._plant.num_positions()), np.zeros(self._plant.num_velocities())
        q[self._base_q[:4]] = motion.pose[:4] / np.linalg.norm(motion.pose[:4])
        q[self._base_q[4:]] = motion.pose[4:]
        q[self._q] = motion.position
        v[self._base_v], v[self._v] = motion.twist, motion.velocity
        self._plant.SetPositions(context, q)
        self._plant.SetVelocities(context, v)

    def _contacts(self, context: Context) -> Array:
        """Return the contact points in the world in m, shape (k, 3)."""
        world = self._plant.world_frame()
        points = [self._plant.CalcPointsPositions(context, frame, p_FP, world) for frame, p_FP in self._feet]
        return np.hstack(points).T

    def heading(self, contacts: Array) -> float:
        """Return the angle in rad by which the contact points, shape (k, 3), are turned from those at rest."""
        p, r = contacts - contacts.mean(axis=0), self._contacts_at_rest
        return math.atan2((r[:, 0] * p[:, 1] - r[:, 1] * p[:, 0]).sum(), (r[:, :2] * p[:, :2]).sum())

    def centre_of_mass(self, motion: WholeBodyMotion) -> Array:
        """Return the centre of mass in m relative to the middle of the feet, as the feet look; shape (3,)."""
        context = self._scratch.context
        self._set(context, motion)
        contacts = self._contacts(context)
        p_W = self._plant.CalcCenterOfMassPositionInWorld(context) - contacts.mean(axis=0)
        result: Array = RotationMatrix.MakeZRotation(-self.heading(contacts)).matrix() @ p_W
        return result

    def effort(self, motion: WholeBodyMotion, *, gains: Gains, shift: float) -> tuple[Array, bool]:
        """Return the efforts of the driven joints in N m or N, and whether they are a solution of the QP.

        Args:
            motion: The motion of the robot.
            gains: The gains.
            shift: How far the centre of mass is led in the stance's direction, in m.
        """
        solution = self._solution(motion, gains=gains, shift=shift)
        if solution is not None:
            return np.clip(solution[0], -self._limit, self._limit), True
        p, leader = gains.posture_frequency, self._leader
        inertia = np.diagonal(self._plant.CalcMassMatrix(self._scratch.context))[self._v][leader]
        error = (self.rest.position - motion.position)[leader]
        effort = inertia * (p**2 * error - 2.0 * p * motion.velocity[leader])
        return np.clip(effort, -self._limit, self._limit), False

    def settled(self, *, gains: Gains, shift: float, duration: float, step: float = 0.02) -> WholeBodyMotion | None:
        """Return the motion in which the robot ends, from rest, if it accelerates as the QP says, or None.

        There are no delays, and the feet stay on the ground: so robots that can shift their weight are told from those
        that have too few joints for it, or too weak ones, without a simulation of contact.

        Args:
            gains: The gains.
            shift: How far the centre of mass is led in the stance's direction, in m.
            duration: The duration of the motion, in s.
            step: The step of the integration, by the semi-implicit Euler method, in s.
        """
        motion, plant = self.rest, self._plant
        for _ in range(math.ceil(duration / step)):
            solution = self._solution(motion, gains=gains, shift=shift)
            if solution is None:
                return None
            context = self._scratch.context
            v = plant.GetVelocities(context) + step * (self._N @ solution[1])
            q = plant.GetPositions(context) + step * plant.MapVelocityToQDot(context, v)
            motion = WholeBodyMotion(q[self._base_q], v[self._base_v], q[self._q], v[self._v])
        return motion

    def shifted(self, motion: WholeBodyMotion) -> float:
        """Return the distance in m by which the weight is shifted from its place at rest, in the stance's direction."""
        return float((self.centre_of_mass(motion) - self.centre_of_mass(self.rest))[:2] @ self.stance.direction)

    def _solution(self, motion: WholeBodyMotion, *, gains: Gains, shift: float) -> tuple[Array, Array] | None:
        """Return the efforts and accelerations that solve the QP, or None; the scratch context is in ``motion``."""
        plant, context, N = self._plant, self._scratch.context, self._N
        self._set(context, motion)
        v = plant.GetVelocities(context)
        M = plant.CalcMassMatrix(context)
        load = plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context) + self._damping * v
        J, bias = self._contact_jacobian(context)
        R_WH = RotationMatrix.MakeZRotation(self.heading(self._contacts(context)))
        # From the trunk's orientation to that at rest, turned by the heading of the feet.
        turn = (R_WH @ self._R_WB_at_rest @ _rotation(motion.pose[:4]).inverse()).ToAngleAxis()
        if turn.angle() > _FALLEN:
            return None
        tasks = self._tasks(context, motion, R_WH=R_WH, turn=turn.angle() * turn.axis(), gains=gains, shift=shift)
        tasks.append((_FEET, J @ N, -_FOOT_BRAKE * (J @ v) - bias))
        return self._solve(M @ N, load, J, tasks=tasks, friction=gains.friction)

    def _tasks(
        self,
        context: Context,
        motion: WholeBodyMotion,
        *,
        R_WH: RotationMatrix,
        turn: Array,
        gains: Gains,
        shift: float,
    ) -> list[tuple[float, Array, Array]]:
        """Return weight, Jacobian with respect to v_r and target acceleration of centre of mass, trunk and joints."""
        plant, N, world = self._plant, self._N, self._plant.world_frame()
        contacts = self._contacts(context)
        w, d = gains.frequency, gains.damping_ratio
        J = plant.CalcJacobianCenterOfMassTranslationalVelocity(context, JacobianWrtVariable.kV, world, world)
        bias = plant.CalcBiasCenterOfMassTranslationalAcceleration(context, JacobianWrtVariable.kV, world, world)
        target = contacts.mean(axis=0) + R_WH.matrix() @ (
            self._centre_at_rest + np.append(np.multiply(shift, self.stance.direction), 0.0)
        )
        error = target - plant.CalcCenterOfMassPositionInWorld(context)
        velocity = J @ plant.GetVelocities(context)
        centre = w**2 * error - 2.0 * d * w * velocity - bias
        trunk = w**2 * turn - 2.0 * d * w * motion.twist[:3]
        p, leader = gains.posture_frequency, self._leader
        posture = p**2 * (self.rest.position - motion.position)[leader] - 2.0 * p * motion.velocity[leader]
        size = N.shape[1]
        return [
            (_CENTRE_OF_MASS, J @ N, centre),
            (_TRUNK, np.eye(3, size), trunk),
            (_POSTURE, np.eye(size)[6:], posture),
        ]

    def _contact_jacobian(self, context: Context) -> tuple[Array, Array]:
        """Return the Jacobian (3 k, nv) of the velocities of the contact points, and their bias (3 k,)."""
        plant, world, kind = self._plant, self._plant.world_frame(), JacobianWrtVariable.kV
        J, bias = [], []
        for frame, p_FP in self._feet:
            J.append(plant.CalcJacobianTranslationalVelocity(context, kind, frame, p_FP, world, world))
            bias.append(
                plant.CalcBiasTranslationalAcceleration(context, kind, frame, p_FP, world, world).ravel(order="F")
            )
        return np.vstack(J), np.concatenate(bias)

    def _solve(
        self, MN: Array, load: Array, J: Array, *, tasks: list[tuple[float, Array, Array]], friction: float
    ) -> tuple[Array, Array] | None:
        """Return the efforts and the accelerations a_r that solve the QP, or None if there are none."""
        size, forces = self._N.shape[1], J.shape[0]
        program = MathematicalProgram()
        x = program.NewContinuousVariables(size + forces)  # a_r, and f / weight
        H, b = np.zeros((size + forces, size + forces)), np.zeros(size + forces)
        for weight, A, target in tasks:
            H[:size, :size] += weight * A.T @ A
            b[:size] -= weight * A.T @ target
        # Weakly, so that there is one solution only.
        H[range(size), range(size)] += 1e-6
        H[range(size, size + forces), range(size, size + forces)] += _FORCES
        program.AddQuadraticCost(2.0 * H, 2.0 * b, x, is_convex=True)
        # [0; effort] = dynamics @ x + offset
        dynamics = np.hstack([self._N.T @ MN, -self.weight * (J @ self._N).T])
        offset = self._N.T @ load
        program.AddLinearEqualityConstraint(dynamics[:6], -offset[:6], x)
        program.AddLinearConstraint(dynamics[6:], -self._limit - offset[6:], self._limit - offset[6:], x)
        cone, lower, upper = _friction_pyramids(forces // 3, friction)
        program.AddLinearConstraint(cone, lower, upper, x[size:])
        result = ClarabelSolver().Solve(program)
        if not result.is_success():
            return None
        values: Array = result.GetSolution(x)
        return dynamics[6:] @ values + offset[6:], values[:size]


class _Scratch(threading.local):
    """A context of the model for each thread: what is computed with it is a function of the motion."""

    def __init__(self, plant: MultibodyPlant) -> None:
        self.context = plant.CreateDefaultContext()


def _friction_pyramids(points: int, friction: float) -> tuple[Array, Array, Array]:
    """Return A, lower, upper of the pyramids in the friction cones: lower <= A f <= upper, forces in weights."""
    mu = friction / math.sqrt(2.0)
    pyramid = np.array([[1, 0, -mu], [-1, 0, -mu], [0, 1, -mu], [0, -1, -mu], [0, 0, 1]], dtype=float)
    lower = np.tile([-np.inf] * 4 + [0.0], points)
    upper = np.tile([0.0] * 4 + [_LARGEST_FORCE], points)
    return np.kron(np.eye(points), pyramid), lower, upper


def _rotation(wxyz: Array) -> RotationMatrix:
    return RotationMatrix(Quaternion(wxyz / np.linalg.norm(wxyz)))
