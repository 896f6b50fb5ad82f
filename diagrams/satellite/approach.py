r"""The planned approach of the arm: from where it is stowed to where the gripper is before the bar, decided on board.

It is application R2 in the capture. The DPS predicts from its belief where the bar will be when the arm has arrived,
and plans a move from rest to rest (`arm_move.py`) that hardly turns the base; with wheels, one whose torque they can
give. Total momentum is zero until the grip, so the common centre of mass of servicer and arm stays where it is. With
the base's attitude as it is now, the gripper G is then at

    p_IG = p_ICm + R_IB (p_BG(q) - p_BCm(q)),

and the posture q of the arm follows by inverse kinematics; see Vafa and Dubowsky, "The kinematics and dynamics of space
manipulators: the virtual manipulator approach", Int. J. Robotics Research 9, 1990.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from math import isfinite

import casadi
import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from vtbdrake.common.arrays import Array
from vtbdrake.components.casadi_system.rotations import rotation_vector
from vtbdrake.components.perception.target_tracker import MotionModel, Track, pose_of_state
from vtbdrake_diagrams.satellite.arm_move import Move, MoveSpace, move_space
from vtbdrake_diagrams.satellite.arm_planning import Plan, plan_by_casadi, plan_near
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, Servicer, Target
from vtbdrake_diagrams.satellite.clearance import CLEARANCE
from vtbdrake_diagrams.satellite.kinematics import REST, gripper
from vtbdrake_diagrams.satellite.supervisor import PLAN_KNOTS, Guidance

ITERATIONS = 40
"""The budget of a decision: the most iterations of the solver."""
CLEAR_OF_TARGET = 0.05
"""The least distance of the arm from the target along a plan, by the prediction, in m."""

# The largest deviation on the way that a plan may have, as a share of the straight path's: there is less time than in
# `plan_calmly`.
_TURN = 0.8
# A posture in the middle of those before the bar, in rad.
_USUAL = (0.0, 0.5, 0.0, 2.0, 0.0, 1.4, 0.0)
# The deviation of the base at which the solver stops, in rad: the prediction is no better.
_TARGET = 2e-3
# What a posture may miss the pose of the gripper by, in m and rad.
_MISS = 1e-3
# The most iterations of the solver that looks for the posture.
_POSTURE_ITERATIONS = 100
# How much farther from itself and the base than a plan the arm is at its end, in m.
_MARGIN = 0.002
# The instants at which the distance from the target is looked at.
_INSTANTS = 61


@dataclass(frozen=True)
class ApproachPlanner:
    """The function of the slow part that plans the approach.

    Attributes:
        duration: The duration of the move, in s.
        period: The period of the DPS, in s.
        latency: The time after which the part shows its result, in s.
        wheels: Whether wheels hold the base's attitude.
        motion: How the target moves.
    """

    duration: float
    period: float
    latency: float
    wheels: bool = False
    motion: MotionModel = field(default_factory=MotionModel)

    def prepare(self) -> None:
        """Compile the moves, and make the plan that all others begin near."""
        _postures(_usual_plan(self.duration, self.wheels).move.space)

    def __call__(
        self, *, base: Array, target: Array, guidance: Array, joint_position: Array, request: Array
    ) -> dict[str, Array] | None:
        """Return the plan, the fixture's place p_IHo in m at its end, and its disturbance; None if there is no plan.

        Args:
            base: The estimate of a `BaseEstimator`, a period older than the one of the target.
            target: The state of a `TargetTracker`.
            guidance: A `Guidance`: how far before the fixture the gripper is to be, and whether it is turned by pi.
            joint_position: The commanded positions of the joints, in rad and m; they rest.
            request: The request; its value does not matter.
        """
        # The result is shown a period and the latency after the estimate of the target, and begins a period later.
        observed_at = float(base[0]) + self.period
        begin = observed_at + self.period + self.latency + self.period
        X_IB, start = pose_of_state(base[1:8]), joint_position[:ARM_JOINTS]
        flight = Flight(target, observed_at, self.motion)
        X_IH = flight.at(begin + self.duration) @ Target().X_TH
        instructions = Guidance.of(guidance)
        turn = RotationMatrix.MakeZRotation(np.pi if instructions.flip else 0.0)
        X_IG = X_IH @ RigidTransform(turn, [0.0, 0.0, -instructions.distance])
        plan = plan_approach(X_IB, start, X_IG, duration=self.duration, wheels=self.wheels)
        if plan is None or distance_from_target(plan, X_IB, flight, begin=begin) < CLEAR_OF_TARGET:
            return None
        return {
            "plan": np.concatenate([[begin], plan.knots.ravel()]),
            "fixture": X_IH.translation(),
            "disturbance": np.array([plan.deviation]),
        }


@dataclass(frozen=True, eq=False)
class Flight:
    """The predicted motion of the target.

    Attributes:
        state: The state of a `TargetTracker`, (13,).
        time: The time of it, in s.
        motion: How the target moves.
    """

    state: Array
    time: float
    motion: MotionModel

    def at(self, time: float) -> RigidTransform:
        """Return X_IT at a time in s."""
        X_IT = pose_of_state(self.state)
        track = Track(
            self.time,
            X_IT.rotation().matrix(),
            X_IT.translation(),
            self.state[7:10],
            self.state[10:],
            np.zeros((12, 12)),
        )
        return pose_of_state(self.motion.present(track.numbers(), time))


def plan_approach(
    X_IB: RigidTransform, start: Array, X_IG: RigidTransform, *, duration: float, wheels: bool = False
) -> Plan | None:
    """Return a plan to a pose of the gripper; None if the arm does not reach it, or no plan keeps the limits.

    Args:
        X_IB: The pose of the base at the start, at rest.
        start: The positions of the joints at the start in rad, (7,).
        X_IG: The pose of the gripper at the end.
        duration: The duration of the move, in s.
        wheels: Whether wheels hold the base's attitude.
    """
    usual = _usual_plan(duration, wheels)
    space = usual.move.space
    goal = posture(space, X_IB, start, X_IG)
    if goal is None:
        return None
    try:
        move = Move(space, np.array(start), goal, turn=_TURN)
    except ValueError:  # The arm would be in collision at the end.
        return None
    plan = plan_near(move, usual, iterations=ITERATIONS, target=_TARGET)
    return plan if isfinite(plan.deviation) else None


def posture(space: MoveSpace, X_IB: RigidTransform, start: Array, X_IG: RigidTransform) -> Array | None:
    """Return the arm's positions in rad, (7,), with the gripper at a pose, if the base keeps its attitude; or None.

    Args:
        space: The moves of the arm.
        X_IB: The pose of the base while the arm is at ``start``.
        start: The positions of the joints before, in rad, (7,).
        X_IG: The pose of the gripper.
    """
    solver, center = _postures(space)
    R_BG = (X_IB.rotation().inverse() @ X_IG.rotation()).matrix()
    p_CmG = X_IB.rotation().inverse() @ (X_IG.translation() - X_IB @ center(start).full().ravel())
    servicer, groups = space.servicer, len(space.arm.groups)
    solution = solver(
        x0=REST,
        p=np.concatenate([R_BG.T.ravel(), p_CmG]),
        lbx=servicer.lower,
        ubx=servicer.upper,
        lbg=np.concatenate([np.zeros(6), np.full(groups, CLEARANCE + _MARGIN)]),
        ubg=np.concatenate([np.zeros(6), np.full(groups, np.inf)]),
    )
    missed = np.abs(solution["g"].full().ravel()[:6]).max()
    return solution["x"].full().ravel() if missed < _MISS and solver.stats()["success"] else None


def distance_from_target(plan: Plan, X_IB: RigidTransform, flight: Flight, *, begin: float) -> float:
    """Return the least distance between the arm's spheres and the target's boxes along a plan, as predicted, in m.

    Args:
        plan: The plan.
        X_IB: The pose of the base at the start, at rest.
        flight: The motion of the target.
        begin: The time at which the plan begins, in s.
    """
    space = plan.move.space
    center = _postures(space)[1]
    times = np.linspace(0.0, space.spline.duration, _INSTANTS)
    positions, motion = space.spline.matrix(times) @ plan.knots, plan.move.motion(plan.knots)
    p_ICm = X_IB @ center(plan.move.start).full().ravel()
    least = np.inf
    for t, q in zip(times.tolist(), positions, strict=True):
        R_IB = X_IB.rotation()
        if not space.wheels:
            turned = motion.rotation[np.abs(motion.times - t).argmin()]
            R_IB = R_IB @ pose_of_state(np.append(turned, np.zeros(3))).rotation()
        p_IBo = p_ICm - R_IB @ center(q).full().ravel()
        X_TB = flight.at(begin + t).inverse() @ RigidTransform(R_IB, p_IBo)
        least = min(least, space.arm.from_boxes(q, X_TB, Target().boxes))
    return least


@lru_cache
def _usual_plan(duration: float, wheels: bool) -> Plan:
    """Return the plan to the middle of the workspace, made once per process."""
    space: MoveSpace = move_space(duration, PLAN_KNOTS, wheels=wheels)
    move = Move(space, np.array(Servicer().stowed), np.array(_USUAL), turn=_TURN)
    return plan_by_casadi(move, attempts=1)


@lru_cache
def _postures(space: MoveSpace) -> tuple[casadi.Function, casadi.Function]:
    """Return the solver of `posture`, and the function (q) -> p_BoCm in m."""
    q, aim = casadi.SX.sym("q", ARM_JOINTS), casadi.SX.sym("aim", 12)
    G, center = gripper(q), space.model.center(q)
    misses = rotation_vector(G.R @ casadi.reshape(aim[:9], 3, 3).T), G.p - center - aim[9:]
    problem = {
        "x": q,
        "p": aim,
        "f": casadi.dot(casadi.DM([1.0, 1.0, 1.0, 1.0, 0.3, 0.2, 0.1]), (q - casadi.DM(REST)) ** 2),
        "g": casadi.vertcat(*misses, space.arm.soft(q)),
    }
    options = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.max_iter": _POSTURE_ITERATIONS}
    solver = casadi.nlpsol("posture", "ipopt", problem, options)
    return solver, casadi.Function("center", [q], [casadi.densify(center)], {"cse": True})
