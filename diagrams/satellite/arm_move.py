r"""Moves of the arm that disturb the base little: the problem of application R2.

The arm moves from a start to a goal, at rest at both ends, in a given time, while wheels and thrusters are off. What
is minimized is the base attitude deviation at the end,

    q = angle of R_B0B(T),

because it stays: total momentum is zero, so the base stops with the arm, and q is the error with which the capture
begins, and which the attitude control has to take back. The deviation on the way passes; it is a constraint that it is
at no time larger than the largest one on the straight path. (It cannot vanish, since the base reacts at once to every
joint. But the arm can turn it back on the way, as a cat does that lands on its feet, so that q = 0.) A move can have a
lower limit there, `Move.turn`, and weigh the mean of the squared deviation beside q, `Move.weight`. Further
constraints: the positions, rates and torques of the joints, and the arm keeps clear of base, panels and itself.

The unknowns are the inner knots of a clamped B-spline in joint space; two equal knots at each end let it begin and end
at rest. Positions and rates are limited at every instant, by the convex hull of the curve; the others at instants. What
a solver proposes is then checked between the instants, too: see `MoveSpace.clearance`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from math import inf

import casadi
import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake.common.arrays import Array
from vtbdrake.common.spline import Spline
from vtbdrake.components.compiled_plant import BaseMotion, BaseReaction, MomentumModel, base_poses
from vtbdrake.components.compiled_plant.links import Expression
from vtbdrake_diagrams.satellite.bodies import ARM_JOINT_NAMES, ARM_JOINTS, Servicer
from vtbdrake_diagrams.satellite.clearance import CLEARANCE, ArmClearance
from vtbdrake_diagrams.satellite.plant import add_servicer

ORDER = "bspline"
RESTING = 2
"""The number of equal knots at each end of a plan, for a rate of zero there."""

# Steps of the integration for each piece of the curve.
_STEPS_PER_PIECE = 6
# Where the bar is in the middle of the arm's workspace, the gripper looking ahead (rad).
REACHING = (0.0, 0.9, 0.0, 1.9, 0.0, 1.0, 0.0)
# Instants per step of the integration at which solvers see the clearance.
_INSTANTS_PER_STEP = 2
# Clearance that they keep beside what is asked for, because of what lies between these instants, in m.
_MARGIN = 0.005
# The share of the rate limits that solvers use: the servos of the full testbed add up to 6 % to the rates of a plan.
_RATE_SHARE = 0.95
# The accuracy of the least clearance of a plan, in m.
_ACCURACY = 5e-4
FEASIBILITY = 1e-5
"""The share of a limit by which a solver may exceed it. The limits are tightened by twice as much."""


class MoveSpace:
    """The arm's moves of one duration: the plans, and their effect on the base; compiled once.

    What a plan does to the base, its disturbance, is how far the base turns if it floats freely. With ``wheels`` it is
    the torque dh_B/dt that they have to give so that the base does not turn at all, see `MomentumModel.reaction`.

    Attributes:
        spline: The curve of each joint.
        servicer: The satellite.
        wheels: Whether it holds its attitude by wheels.
        model: Its momentum model, fingers open.
        reaction: The function that computes the motion of the base and the torques.
        arm: The distances of the arm from base, panels and itself.
    """

    def __init__(
        self, *, duration: float = 20.0, knots: int = 9, servicer: Servicer | None = None, wheels: bool = False
    ) -> None:
        """Read the servicer's plant.

        Args:
            duration: The duration of a move in seconds.
            knots: The number of knots of a plan; all but the two at each end are free.
            servicer: The satellite; by default the testbed's.
            wheels: Whether it holds its attitude by wheels.

        Raises:
            ValueError: No knot is free.
        """
        if knots <= 2 * RESTING:
            raise ValueError(f"a plan from rest to rest has more than {2 * RESTING} knots, not {knots}")
        self.servicer, self.wheels = servicer or Servicer(), wheels
        self.spline = Spline(ORDER, knots, duration)
        self.free = knots - 2 * RESTING
        plant = MultibodyPlant(0.0)
        instance = add_servicer(plant, self.servicer, wheels=wheels, servos=False)
        plant.Finalize()
        joints = [plant.GetJointByName(name, instance) for name in ARM_JOINT_NAMES]
        self.model = MomentumModel(plant, plant.CreateDefaultContext(), joints=joints)
        self.steps = _STEPS_PER_PIECE * len(self.spline.pieces)
        self.reaction = BaseReaction(self.model, self.spline, steps=self.steps)
        self._instants = np.linspace(0.0, duration, self.steps + 1)
        q = casadi.SX.sym("q", ARM_JOINTS)
        rate, change = casadi.SX.sym("rate", ARM_JOINTS), casadi.SX.sym("change", ARM_JOINTS)
        torque = self.model.torque(q, rate, change)
        self._velocity = casadi.Function("velocity", [q, rate], [self.model.base_velocity(q, rate)], {"cse": True})
        self._torque = casadi.Function("torque", [q, rate, change], [torque], {"cse": True})
        h = self.model.reaction(q, rate)[0]
        reaction = (casadi.jtimes(h, q, rate) + casadi.jtimes(h, rate, change)) / self.servicer.wheel_torque
        self._load = casadi.Function("load", [q, rate, change], [casadi.sumsqr(reaction)], {"cse": True})
        self.arm = ArmClearance(self.servicer)
        # At the ends the arm is where it is.
        self._watched = np.linspace(0.0, duration, _INSTANTS_PER_STEP * self.steps + 1)[1:-1]

    @cached_property
    def functions(self) -> tuple[casadi.Function, casadi.Function]:
        """Return (z, p) -> cost, g and (z, p) -> cost, its gradient, g, its Jacobian.

        z are the free knots, shape (7 k,), knot by knot; p is `Move.numbers`, shape (15,). g are the constraints of
        `bounds`, which begin with the squares of the disturbance: 4 sin^2 of half the deviation at the end of each
        step; with wheels, their torque squared at some instants, as a share of the square of what they give. The cost
        is the deviation's square at the end, which is q^2 for small q, plus the weight times its mean over the move, in
        rad^2; with wheels, the mean of the torque's fourth power, which keeps its largest value low.
        """
        z, p = casadi.MX.sym("z", ARM_JOINTS * self.free), casadi.MX.sym("p", 2 * ARM_JOINTS + 1)
        start, goal, weight = p[:ARM_JOINTS], p[ARM_JOINTS:-1], p[-1]
        knots = casadi.horzcat(start, start, casadi.reshape(z, ARM_JOINTS, self.free), goal, goal)
        squares, by_knots = self._loads(knots) if self.wheels else self._deviations(knots)
        some, limits = self._some_instants, self.servicer.torques
        at, rate, change = (knots @ casadi.DM(self.spline.matrix(some, k).T) for k in range(3))
        torques = self._torque.map(len(some))(at, rate, change) / casadi.DM(limits)
        rates = knots @ casadi.DM(self.spline.bezier(1).T) / casadi.DM(self.servicer.speeds)
        clear = self.arm.soft.map(len(self._watched))(knots @ casadi.DM(self.spline.matrix(self._watched).T))
        if self.wheels:
            cost, shares = casadi.sumsqr(squares) / squares.numel(), 2.0 * squares / squares.numel()
        else:  # The deviations at the ends of the steps.
            shares = casadi.vertcat(casadi.repmat(weight / self.steps, self.steps - 1, 1), 1.0 + weight / self.steps)
            cost = casadi.dot(shares, squares)
        g = casadi.vertcat(squares, casadi.vec(torques), casadi.vec(rates), casadi.vec(clear))
        value = casadi.Function("arm_move", [z, p], [cost, g], ["z", "p"], ["cost", "g"])
        slope = casadi.vertcat(
            by_knots,
            self._slope(self._torque, knots, some, 3) / casadi.DM(np.tile(limits, len(some))),
            casadi.jacobian(casadi.vec(rates), z),
            self._slope(self.arm.soft, knots, self._watched, 1),
        )
        return value, casadi.Function("arm_move_slopes", [z, p], [cost, by_knots.T @ shares, g, slope])

    @property
    def _some_instants(self) -> Array:
        """The accelerations are linear between the breaks: there, and halfway, torques are known well."""
        return self._instants[:: _STEPS_PER_PIECE // 2]

    def _deviations(self, knots: Expression) -> tuple[Expression, Expression]:
        """Return the squares of the deviation at the ends of the steps, and their Jacobian by the free knots."""
        rotation = self.reaction.function(knots)[0]
        # They follow from the velocities at the ends and in the middles of the steps.
        halves = np.linspace(0.0, self.spline.duration, 2 * self.steps + 1)
        at, rate = (knots @ casadi.DM(self.spline.matrix(halves, k).T) for k in range(2))
        V = casadi.MX.sym("V", 6, len(halves))
        squares = 4.0 * casadi.sum1(base_poses(self.steps, self.spline.duration)(V)[0][1:, 1:] ** 2).T
        by_velocity = casadi.Function("by_velocity", [V], [casadi.jacobian(squares, V)])
        turned = by_velocity(self._velocity.map(len(halves))(at, rate)) @ self._slope(self._velocity, knots, halves, 2)
        return 4.0 * casadi.sum1(rotation[1:, 1:] ** 2).T, turned

    def _loads(self, knots: Expression) -> tuple[Expression, Expression]:
        """Return the squares of the wheels' torque at some instants, and their Jacobian by the free knots."""
        some = self._some_instants
        at, rate, change = (knots @ casadi.DM(self.spline.matrix(some, k).T) for k in range(3))
        return self._load.map(len(some))(at, rate, change).T, self._slope(self._load, knots, some, 3)

    def disturbance(self, g: Array) -> float:
        """Return the deviation q in rad by the constraints g; with wheels, their largest torque as a share of it."""
        if self.wheels:
            return float(np.sqrt(max(np.max(g[: len(self._some_instants)]), 0.0)))
        return float(2.0 * np.arcsin(min(np.sqrt(max(g[self.steps - 1], 0.0)) / 2.0, 1.0)))

    def _slope(self, function: casadi.Function, knots: Expression, times: Array, count: int) -> Expression:
        """Return the Jacobian of a function of a plan by its free knots, shape (m p, 7 k).

        Args:
            function: The function of positions, rates and accelerations, or of the first ``count`` of them, shape (m,).
            knots: All knots, shape (7, n).
            times: Shape (p,), in s.
            count: 1, 2 or 3.
        """
        symbols = [casadi.SX.sym(f"q_{k}", ARM_JOINTS) for k in range(count)]
        value = function(*symbols)
        slopes = [casadi.densify(casadi.jacobian(value, symbol)).T for symbol in symbols]
        matrices = [self.spline.matrix(times, k) for k in range(count)]
        parts = (
            casadi.Function("own_slope", symbols, slopes, {"cse": True})
            .map(len(times))
            .call([knots @ casadi.DM(matrix.T) for matrix in matrices])
        )
        rows = value.numel()

        def by_knot(j: int) -> Expression:
            weights = (casadi.DM(np.repeat(matrix[:, [j]], rows, axis=0)) for matrix in matrices)
            return sum(part.T * casadi.repmat(w, 1, ARM_JOINTS) for part, w in zip(parts, weights, strict=True))

        return casadi.horzcat(*map(by_knot, range(RESTING, RESTING + self.free)))

    def bounds(self, largest: float, clear: Array) -> tuple[Array, Array]:
        """Return the lower and upper bounds of g.

        Args:
            largest: Deviation of the base in rad, infinite with wheels.
            clear: The least clearance of each group of `ArmClearance` in m.
        """
        some = len(self._some_instants)
        counts = some if self.wheels else self.steps, ARM_JOINTS * some, ARM_JOINTS * len(self.spline.bezier(1))
        least = np.repeat([-inf, -1.0, -_RATE_SHARE], counts)
        square = 4.0 * np.sin(largest / 2.0) ** 2 if largest < inf else inf
        most = np.repeat([square, 1.0, _RATE_SHARE], counts)
        clear = np.tile(clear, len(self._watched))
        lower, upper = np.concatenate([least, clear]), np.concatenate([most, np.full(clear.size, inf)])
        return lower + 2.0 * FEASIBILITY, upper - 2.0 * FEASIBILITY * np.minimum(upper, 1.0)

    def clearance(self, knots: Array) -> float:
        """Return a lower bound of the clearance of a plan, shape (n, 7), over all of its duration, in m.

        Between two instants with the distances a and b, h seconds apart, the distance is at least (a + b - L h) / 2,
        where L bounds its rate: the sum of the joints' rates times their reach. Intervals are halved until these bounds
        are within 0.5 mm of the least distance.
        """
        bend = np.max(np.abs(self.spline.extremes(knots, 2)), axis=0)
        samples = self._sample(self._instants, knots)
        left, right, least, bound = samples[:-1], samples[1:], samples[:, 1].min(), inf
        while True:
            h = right[:, 0] - left[:, 0]
            rates = np.maximum(left[:, 2:], right[:, 2:]) + 0.5 * h[:, None] * bend
            bounds = 0.5 * (left[:, 1] + right[:, 1] - h * (rates @ self.arm.reaches))
            halve = bounds < least - _ACCURACY
            bound = min(bound, bounds[~halve].min(initial=inf))
            if not halve.any():
                return float(bound)
            left, right = left[halve], right[halve]
            middle = self._sample(0.5 * (left[:, 0] + right[:, 0]), knots)
            least = min(least, middle[:, 1].min())
            left, right = np.concatenate([left, middle]), np.concatenate([middle, right])

    def _sample(self, times: Array, knots: Array) -> Array:
        """Return time, least distance and the joints' rates at some times of a plan, shape (p, 2 + 7)."""
        q, rates = (self.spline.matrix(times, k) @ knots for k in range(2))
        return np.column_stack([times, self.arm.least(q), np.abs(rates)])


@dataclass(frozen=True)
class Move:
    """A move of the arm from rest to rest.

    Attributes:
        space: The moves of that duration.
        start: Joint positions in rad, shape (7,).
        goal: Joint positions in rad, shape (7,).
        turn: The largest deviation that a plan may have on the way, as a share of the straight path's largest.
        weight: The weight of the mean over the move of the squared deviation, beside the one at the end.

    Raises:
        ValueError: The arm is closer than `CLEARANCE` to base, panels or itself at the start or at the goal.
    """

    space: MoveSpace
    start: Array
    goal: Array
    turn: float = 1.0
    weight: float = 0.0

    def __post_init__(self) -> None:
        for name, q in (("start", self.start), ("goal", self.goal)):
            distance, pair = self.space.arm.nearest(q)
            if not distance >= CLEARANCE:
                raise ValueError(
                    f"the {name} is in collision, or nearly: the distance of {pair} is {1e3 * distance:.1f} mm by the "
                    f"spheres that cover the arm; choose one of at least {1e3 * CLEARANCE:g} mm"
                )

    @property
    def numbers(self) -> Array:
        """Return start, goal and the weight, shape (15,)."""
        return np.concatenate([self.start, self.goal, [self.weight]])

    @cached_property
    def straight(self) -> Array:
        """Return the knots of the straight path in joint space, shape (n, 7)."""
        share = np.concatenate([np.zeros(RESTING - 1), np.linspace(0.0, 1.0, self.space.free + 2), [1.0]])
        return self.start + share[:, None] * (self.goal - self.start)

    @cached_property
    def straight_motion(self) -> BaseMotion:
        """Return how the base moves on the straight path."""
        return self.motion(self.straight)

    @property
    def largest(self) -> float:
        """Return the largest deviation that a plan may have, in rad; with wheels, there is no limit."""
        return inf if self.space.wheels else self.turn * float(self.straight_motion.angle.max())

    def knots(self, z: ArrayLike) -> Array:
        """Return all knots, shape (n, 7), of the free ones, shape (7 k,)."""
        inner = np.reshape(np.asarray(z, dtype=float), (self.space.free, ARM_JOINTS))
        return np.vstack([*[self.start] * RESTING, inner, *[self.goal] * RESTING])

    @property
    def search_range(self) -> tuple[Array, Array]:
        """Return the ends of the free knots, two of shape (7 k,): the joints' limits, in rad."""
        servicer, free = self.space.servicer, self.space.free
        return np.tile(servicer.lower, free), np.tile(servicer.upper, free)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Return the lower and upper bounds of the constraints g of `MoveSpace.functions`.

        The clearance is less than `CLEARANCE` plus a margin where it is so at the start or at the goal.
        """
        soft = self.space.arm.soft
        ends = np.minimum(*(soft(q).full().ravel() for q in (self.start, self.goal)))
        return self.space.bounds(self.largest, np.minimum(ends, CLEARANCE + _MARGIN))

    def motion(self, knots: Array) -> BaseMotion:
        """Return how the base moves under a plan, shape (n, 7)."""
        return self.space.reaction(knots)

    def excess(self, knots: Array) -> dict[str, float]:
        """Return by how much a plan, shape (n, 7), exceeds each limit that it does not keep, by name.

        ``position`` is in rad, ``clearance`` in m, the others are shares of the limit.
        """
        servicer, motion = self.space.servicer, self.motion(knots)
        lowest, highest = self.space.spline.extremes(knots)
        rates = np.max(np.abs(self.space.spline.extremes(knots, 1)), axis=0)
        excesses = {
            "position": max(np.max(servicer.lower - lowest), np.max(highest - servicer.upper)),
            "rate": np.max(rates / servicer.speeds) - 1.0,
            "torque": np.max(np.abs(motion.torque) / np.array(servicer.torques)) - 1.0,
            "deviation": motion.angle.max() / self.largest - 1.0,
            "clearance": CLEARANCE - self.space.clearance(knots),
        }
        return {name: float(value) for name, value in excesses.items() if not value <= 1e-9}

    def touched(self, knots: Array) -> list[str]:
        """Return the limits that a plan, shape (n, 7), uses to 99 %, by the names of `excess`.

        For rates and clearance they are those that solvers keep.
        """
        servicer, motion = self.space.servicer, self.motion(knots)
        middle, half = 0.5 * (servicer.upper + servicer.lower), 0.5 * (servicer.upper - servicer.lower)
        used = {
            "position": np.max(np.abs(np.array(self.space.spline.extremes(knots)) - middle) / half),
            "rate": np.max(np.abs(self.space.spline.extremes(knots, 1)) / servicer.speeds) / _RATE_SHARE,
            "torque": np.max(np.abs(motion.torque) / np.array(servicer.torques)),
            "deviation": motion.angle.max() / self.largest,
            "clearance": (CLEARANCE + _MARGIN) / self.space.clearance(knots),
        }
        return [name for name, share in used.items() if share >= 0.99]


@cache
def move_space(duration: float, knots: int, *, wheels: bool = False) -> MoveSpace:
    """Return the moves of one duration in seconds, made once per process."""
    return MoveSpace(duration=duration, knots=knots, wheels=wheels)
