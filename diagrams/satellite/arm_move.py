r"""Moves of the arm that disturb the base little: the problem of application R2.

The arm moves from a start to a goal, at rest at both ends, in a given time, while wheels and thrusters are off. What
is minimized is the base attitude deviation at the end,

    q = angle of R_B0B(T),

because it stays: total momentum is zero, so the base stops with the arm, and q is the error with which the capture
begins, and which the attitude control has to take back. The deviation on the way passes; it is a constraint that it is
at no time larger than the largest one on the straight path. (It cannot vanish, since the base reacts at once to every
joint. But the arm can turn it back on the way, as a cat does that lands on its feet, so that q = 0.) Further
constraints: the positions, rates and torques of the joints, and the points of the arm keep clear of base and panels.

The unknowns are the inner knots of a clamped B-spline in joint space; two equal knots at each end let it begin and end
at rest. Positions and rates are limited at every instant, by the convex hull of the curve; the others at instants.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from math import inf

import casadi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake.components.compiled_plant import BaseMotion, BaseReaction, MomentumModel
from vtbdrake.components.compiled_plant.links import Expression
from vtbdrake.spline import Spline
from vtbdrake_diagrams.satellite.bodies import ARM_JOINT_NAMES, ARM_JOINTS, Servicer
from vtbdrake_diagrams.satellite.plant import add_servicer

Array = NDArray[np.float64]

ORDER = "bspline"
RESTING = 2
"""The number of equal knots at each end of a plan, for a rate of zero there."""
REACH = 1.2
"""The largest distance of a free knot from the straight path, in rad: it keeps the space of search small."""

# Steps of the integration for each piece of the curve.
_STEPS_PER_PIECE = 6
# Where the bar is in the middle of the arm's workspace, the gripper looking ahead (rad).
REACHING = (0.0, 0.9, 0.0, 1.9, 0.0, 1.0, 0.0)
# Points of the arm that keep clear of the base: the origins of these frames.
_POINTS = ("link_3", "link_4", "link_5", "link_6", "hand", "gripper")
# m, around box and panels: more than the radius of a link.
_MARGIN = 0.1
FEASIBILITY = 1e-5
"""The share of a limit by which a solver may exceed it. The limits are tightened by twice as much."""


class MoveSpace:
    """The arm's moves of one duration: the plans, and their effect on the base; compiled once.

    Attributes:
        spline: The curve of each joint.
        servicer: The satellite.
        model: Its momentum model, fingers open.
        reaction: The function that computes the motion of the base and the torques.
    """

    def __init__(self, *, duration: float = 20.0, knots: int = 9, servicer: Servicer | None = None) -> None:
        """Read the servicer's plant.

        Args:
            duration: The duration of a move in seconds.
            knots: The number of knots of a plan; all but the two at each end are free.
            servicer: The satellite; by default that of the testbed.

        Raises:
            ValueError: No knot is free.
        """
        if knots <= 2 * RESTING:
            raise ValueError(f"a plan from rest to rest has more than {2 * RESTING} knots, not {knots}")
        self.servicer = servicer or Servicer()
        self.spline = Spline(ORDER, knots, duration)
        self.free = knots - 2 * RESTING
        plant = MultibodyPlant(0.0)
        instance = add_servicer(plant, self.servicer, servos=False)
        plant.Finalize()
        joints = [plant.GetJointByName(name, instance) for name in ARM_JOINT_NAMES]
        self.model = MomentumModel(plant, plant.CreateDefaultContext(), joints=joints)
        self.steps = _STEPS_PER_PIECE * len(self.spline.pieces)
        self.reaction = BaseReaction(self.model, self.spline, steps=self.steps)
        self._instants = np.linspace(0.0, duration, self.steps + 1)
        q = casadi.SX.sym("q", ARM_JOINTS)
        points = [self.model.point(plant.GetFrameByName(name), q) for name in _POINTS]
        rate, change = casadi.SX.sym("rate", ARM_JOINTS), casadi.SX.sym("change", ARM_JOINTS)
        torque = self.model.torque(q, rate, change)
        self._torque = casadi.Function("torque", [q, rate, change], [torque], {"cse": True})
        self._clearance = casadi.Function("clearance", [q], [casadi.vertcat(*map(self._clear, points))], {"cse": True})

    def _clear(self, p_BoP_B: Expression) -> Expression:
        """Return a number above 1 outside of the zone of base and panels, which extends along y."""
        x, _, z = self.servicer.box
        at_x, at_z = p_BoP_B[0] / (x / 2 + _MARGIN), p_BoP_B[2] / (z / 2 + _MARGIN)
        return (at_x**6 + at_z**6) ** (1 / 6)

    @cached_property
    def functions(self) -> tuple[casadi.Function, casadi.Function]:
        """Return (z, ends) -> cost, g and (z, ends) -> cost, its gradient, g, its Jacobian.

        z are the free knots, shape (7 k,), knot by knot; ends the start and the goal, shape (14,). The cost is
        4 sin^2(q / 2), which is q^2 for small q, in rad^2; g are the constraints of `bounds`.
        """
        z, ends = casadi.MX.sym("z", ARM_JOINTS * self.free), casadi.MX.sym("ends", 2 * ARM_JOINTS)
        start, goal = ends[:ARM_JOINTS], ends[ARM_JOINTS:]
        knots = casadi.horzcat(start, start, casadi.reshape(z, ARM_JOINTS, self.free), goal, goal)
        # Inlined, the parts of a function have derivatives of their own.
        rotation = self.reaction.function.call([knots], True, False)[0]
        deviation = 4.0 * casadi.sum1(rotation[1:, 1:] ** 2).T
        at, rate, change = (knots @ casadi.DM(self.spline.matrix(self._instants, k).T) for k in range(3))
        # The acceleration is linear between the breaks of the curve: there, and halfway, the torque is known well.
        some = slice(None, None, _STEPS_PER_PIECE // 2)
        torques = self._torque.map(len(self._instants[some]))(at[:, some], rate[:, some], change[:, some])
        torques /= casadi.DM(self.servicer.torques)
        rates = knots @ casadi.DM(self.spline.bezier(1).T) / casadi.DM(self.servicer.speeds)
        clear = self._clearance.map(self.steps + 1)(at)
        cost = deviation[-1]
        g = casadi.vertcat(deviation, casadi.vec(torques), casadi.vec(rates), casadi.vec(clear))
        value = casadi.Function("arm_move", [z, ends], [cost, g], ["z", "ends"], ["cost", "g"])
        slopes = [cost, casadi.gradient(cost, z), g, casadi.jacobian(g, z)]
        return value, casadi.Function("arm_move_slopes", [z, ends], slopes)

    def bounds(self, largest: float) -> tuple[Array, Array]:
        """Return the lower and upper bounds of g.

        Args:
            largest: Deviation of the base in rad.
        """
        torques = len(self._instants[:: _STEPS_PER_PIECE // 2])
        counts = self.steps, ARM_JOINTS * torques, ARM_JOINTS * len(self.spline.bezier(1))
        clear = len(_POINTS) * (self.steps + 1)
        least = np.repeat([-inf, -1.0, -1.0, 1.0], [*counts, clear])
        most = np.repeat([4.0 * np.sin(largest / 2.0) ** 2, 1.0, 1.0, inf], [*counts, clear])
        return least + 2.0 * FEASIBILITY, most - 2.0 * FEASIBILITY * np.minimum(most, 1.0)

    def clearances(self, knots: Array) -> float:
        """Return the least clearance of a plan, shape (n, 7); 1 is the edge of the zone."""
        at = self.spline.matrix(self._instants) @ knots
        return float(np.min(self._clearance.map(self.steps + 1)(at.T).full()))


@dataclass(frozen=True)
class Move:
    """A move of the arm from rest to rest.

    Attributes:
        space: The moves of that duration.
        start: Joint positions in rad, shape (7,).
        goal: Joint positions in rad, shape (7,).
    """

    space: MoveSpace
    start: Array
    goal: Array

    @property
    def ends(self) -> Array:
        """Return start and goal, shape (14,)."""
        return np.concatenate([self.start, self.goal])

    @cached_property
    def straight(self) -> Array:
        """Return the knots of the straight path in joint space, shape (n, 7)."""
        share = np.concatenate([np.zeros(RESTING - 1), np.linspace(0.0, 1.0, self.space.free + 2), [1.0]])
        return self.start + share[:, None] * (self.goal - self.start)

    @cached_property
    def largest(self) -> float:
        """Return the largest deviation on the straight path, in rad, which no plan may exceed."""
        return float(self.space.reaction(self.straight).angle.max())

    def knots(self, z: ArrayLike) -> Array:
        """Return all knots, shape (n, 7), of the free ones, shape (7 k,)."""
        inner = np.reshape(np.asarray(z, dtype=float), (self.space.free, ARM_JOINTS))
        return np.vstack([*[self.start] * RESTING, inner, *[self.goal] * RESTING])

    @property
    def search_range(self) -> tuple[Array, Array]:
        """Return the ends of the free knots, two of shape (7 k,): the joints' limits, and `REACH`; in rad."""
        straight, servicer = self.straight[RESTING:-RESTING], self.space.servicer
        lower, upper = np.maximum(straight - REACH, servicer.lower), np.minimum(straight + REACH, servicer.upper)
        return lower.ravel(), upper.ravel()

    def motion(self, knots: Array) -> BaseMotion:
        """Return how the base moves under a plan, shape (n, 7)."""
        return self.space.reaction(knots)

    def excess(self, knots: Array) -> dict[str, float]:
        """Return by how much a plan, shape (n, 7), exceeds each limit that it does not keep, by name.

        ``position`` is in rad, the others are shares of the limit.
        """
        servicer, motion = self.space.servicer, self.motion(knots)
        lowest, highest = self.space.spline.extremes(knots)
        rates = np.max(np.abs(self.space.spline.extremes(knots, 1)), axis=0)
        found = {
            "position": max(np.max(servicer.lower - lowest), np.max(highest - servicer.upper)),
            "rate": np.max(rates / servicer.speeds) - 1.0,
            "torque": np.max(np.abs(motion.torque) / np.array(servicer.torques)) - 1.0,
            "deviation": motion.angle.max() / self.largest - 1.0,
            "clearance": 1.0 - self.space.clearances(knots),
        }
        return {name: float(value) for name, value in found.items() if value > 1e-9}


@cache
def move_space(duration: float, knots: int) -> MoveSpace:
    """Return the moves of one duration in seconds, made once per process."""
    return MoveSpace(duration=duration, knots=knots)
