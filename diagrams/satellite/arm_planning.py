"""Solvers of application R2: plans of the arm by gradients on the momentum model, with CasADi and with Drake.

They solve the same problem, see `vtbdrake_diagrams.satellite.arm_move`, with derivatives from CasADi, and from
the same starts: near the straight path, but not on it, since there the cost may be stationary across it (a motion in a
plane).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.solvers import IpoptSolver, MathematicalProgram, SnoptSolver, SolverInterface, SolverOptions

from vtbdrake.common.arrays import Array
from vtbdrake.optimization.solvers.solver import Evaluation, Point, Search, Solver, SolverError
from vtbdrake_diagrams.satellite.arm_move import FEASIBILITY, RESTING, Move, move_space

GOOD_ENOUGH = 2e-3
"""The deviation q at which no further start is tried, in rad."""
GOOD_SHARE = 0.02
"""The deviation q at which no further start is tried, as a share of the deviation on the straight path."""

CALM = 0.6
"""The deviation on the way that a plan is to keep below if it can, as a share of the straight path's largest.

It costs nearly nothing at the end, see ``arm_front``."""

# The standard deviation of the starts from the straight path, in rad.
_SPREAD = 0.2
# The deviation q in rad at which CasADi's solver stops: the full testbed differs by more.
_TARGET = 5e-4
# Factor of the cost for the solvers.
_SCALE = 1e2
# Tolerance of the solvers, relative to the scaled cost.
_TOLERANCE = 1e-4
# Largest number of their iterations.
_ITERATIONS = 60
# The share of what the wheels give at which CasADi's solver stops: the rest is for control.
_HELD = 0.8


@dataclass(frozen=True)
class Plan:
    """A plan of the arm, and how it was found.

    Attributes:
        move: The move, with the limits that were kept.
        knots: The knots in rad, shape (n, 7).
        deviation: The deviation q in rad by the momentum model; with wheels, their largest torque as a share of what
            they give. Infinite if no plan within the limits was found.
        history: The best q so far in rad over the wall time in s: (time, q), each better than the one before.
        message: How the solver ended, in its own words.
    """

    move: Move
    knots: Array
    deviation: float
    history: tuple[tuple[float, float], ...]
    message: str

    def time_to(self, deviation: float) -> float:
        """Return the wall time until q was at most ``deviation`` in rad; infinite if it never was."""
        return next((seconds for seconds, q in self.history if q <= deviation), inf)


class _Best:
    """The best point within the limits among those that a solver has looked at."""

    def __init__(self, move: Move, target: float = _TARGET) -> None:
        self._begin, self._move = time.perf_counter(), move
        self._lower, self._upper = move.bounds
        self._target = target
        self.z: Array | None = None
        self.cost = self.deviation = inf
        self.history: list[tuple[float, float]] = []

    @property
    def is_there(self) -> bool:
        """Return whether the solver may stop."""
        return self.deviation <= _HELD if self._move.space.wheels else self.cost <= _cost(self._target)

    def look(self, z: Array, cost: float, g: Array) -> None:
        """Take note of a point with its cost and its constraints, see `MoveSpace.functions`."""
        beyond = max(np.max(self._lower - g), np.max(g - self._upper))
        if beyond <= FEASIBILITY and cost < self.cost and not self._move.excess(self._move.knots(z)):
            self.z, self.cost = np.array(z), cost
            self.deviation = self._move.space.disturbance(g)
            self.history.append((time.perf_counter() - self._begin, self.deviation))


# Looks for the best plan from a start z, shape (7 k,), and returns how it ended.
_Method = Callable[[Move, Array, _Best], str]


def plan_by_casadi(move: Move, *, attempts: int = 4) -> Plan:
    """Return a plan by IPOPT, called by CasADi.

    Args:
        move: The move.
        attempts: The most starts that are tried, until one is `good_enough`.
    """
    return _plan(move, _by_casadi, attempts)


def plan_calmly(move: Move, *, attempts: int = 4) -> Plan:
    """Return a plan by IPOPT that turns the base no farther on the way than `CALM`, or than the move's limit.

    Args:
        move: The move.
        attempts: See `plan_by_casadi`.
    """
    plan = plan_by_casadi(replace(move, turn=CALM), attempts=attempts)
    return plan if isfinite(plan.deviation) else plan_by_casadi(move, attempts=attempts)


def plan_near(move: Move, plan: Plan, *, iterations: int, target: float = _TARGET) -> Plan:
    """Return a plan by IPOPT, from one start: a plan of a similar move, bent to the ends of this one.

    Args:
        move: The move.
        plan: The plan of the similar move, in the same `MoveSpace`.
        iterations: The most iterations.
        target: The deviation q in rad at which the solver stops.
    """
    best = _Best(move, target)
    start = (move.straight + plan.knots - plan.move.straight)[RESTING:-RESTING].ravel()
    message = _by_casadi(move, np.clip(start, *move.search_range), best, iterations)
    return _best_plan(move, best, message)


def plan_by_drake(move: Move, solver: str = "SNOPT", *, attempts: int = 4) -> Plan:
    """Return a plan by a solver of Drake's MathematicalProgram.

    Args:
        move: The move.
        solver: ``SNOPT`` or ``IPOPT``.
        attempts: See `plan_by_casadi`.

    Raises:
        ValueError: There is no such solver.
    """
    if solver not in _DRAKE:
        raise ValueError(f"the solver is one of {', '.join(_DRAKE)}, not {solver!r}")
    kind, options = _DRAKE[solver]
    return _plan(move, lambda *arguments: _by_drake(kind(), options, *arguments), attempts)


def _plan(move: Move, method: _Method, attempts: int) -> Plan:
    best, message = _Best(move), "no attempt was made"
    for attempt in range(attempts):
        message = method(move, start_of(move, attempt), best)
        if best.cost <= _cost(good_enough(move)):
            break
    return _best_plan(move, best, message)


def _best_plan(move: Move, best: _Best, message: str) -> Plan:
    z = move.straight[RESTING:-RESTING].ravel() if best.z is None else best.z
    return Plan(move, move.knots(z), best.deviation, tuple(best.history), message)


def good_enough(move: Move) -> float:
    """Return the deviation q in rad at which no further start is tried."""
    return min(GOOD_ENOUGH, GOOD_SHARE * float(move.straight_motion.angle[-1]))


def _cost(deviation: float) -> float:
    """Return the cost of a plan that ends with a deviation in rad, if nothing but the end counts."""
    return float(4.0 * np.sin(deviation / 2.0) ** 2)


def start_of(move: Move, attempt: int) -> Array:
    """Return where a solver starts, shape (7 k,), in rad: near the straight path, the same for all solvers."""
    straight = move.straight[RESTING:-RESTING].ravel()
    noise = np.random.default_rng(attempt).standard_normal(straight.size)
    return np.clip(straight + _SPREAD * noise, *move.search_range)


def _by_casadi(move: Move, start: Array, best: _Best, iterations: int = _ITERATIONS) -> str:
    z, p = casadi.MX.sym("z", start.size), casadi.MX.sym("p", move.numbers.size)
    value, slopes = move.space.functions
    # Inlined, the cost is computed without the constraints.
    cost, g = value.call([z, p], True, False)
    gradient, slope = casadi.gradient(cost, z), slopes(z, p)[3]
    watch = _Watch(best, x=start.size, f=1, g=g.numel(), lam_x=start.size, lam_g=g.numel(), lam_p=p.numel())
    options = {
        "ipopt.hessian_approximation": "limited-memory",
        "ipopt.tol": _TOLERANCE,
        "ipopt.constr_viol_tol": FEASIBILITY,
        "ipopt.max_iter": iterations,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "print_time": False,
        "iteration_callback": watch,
        "grad_f": casadi.Function("grad_f", [z, p], [_SCALE * cost, _SCALE * gradient], ["x", "p"], ["f", "grad_f_x"]),
        "jac_g": casadi.Function("jac_g", [z, p], [g, slope], ["x", "p"], ["g", "jac_g_x"]),
    }
    solver = casadi.nlpsol("arm_plan", "ipopt", {"x": z, "p": p, "f": _SCALE * cost, "g": g}, options)
    lower, upper = move.search_range
    least, most = move.bounds
    solution = solver(x0=start, p=move.numbers, lbx=lower, ubx=upper, lbg=least, ubg=most)
    best.look(solution["x"].full().ravel(), float(solution["f"]) / _SCALE, solution["g"].full().ravel())
    return str(solver.stats()["return_status"])


class _Watch(casadi.Callback):
    """Is shown each iterate of CasADi's solver, and stops it at the target."""

    def __init__(self, best: _Best, **sizes: int) -> None:
        super().__init__()
        self._best, self._sizes = best, sizes
        self.construct("watch", {})

    def get_n_in(self) -> int:
        return int(casadi.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> casadi.Sparsity:
        return casadi.Sparsity.dense(self._sizes[casadi.nlpsol_out(i)], 1)

    def eval(self, arg: Sequence[Any]) -> list[Any]:
        x, f, g = (arg[i].full().ravel() for i in range(3))
        self._best.look(x, float(f[0]) / _SCALE, g)
        return [int(self._best.is_there)]


_DRAKE: dict[str, tuple[type[SolverInterface], dict[str, float]]] = {
    "SNOPT": (
        SnoptSolver,
        {
            "Major optimality tolerance": _TOLERANCE,
            "Major feasibility tolerance": FEASIBILITY,
            "Major iterations limit": _ITERATIONS,
            "Verify level": -1,
        },
    ),
    "IPOPT": (IpoptSolver, {"tol": _TOLERANCE, "constr_viol_tol": FEASIBILITY, "max_iter": _ITERATIONS}),
}


def _by_drake(solver: SolverInterface, options: dict[str, float], move: Move, start: Array, best: _Best) -> str:
    slopes = move.space.functions[1]
    evaluations: dict[bytes, tuple[float, Array, Array, Array]] = {}

    def at(z: Array) -> tuple[float, Array, Array, Array]:
        key = z.tobytes()
        if key not in evaluations:
            evaluations.clear()
            cost, gradient, g, jacobian = (value.full() for value in slopes(z, move.numbers))
            best.look(z, float(cost[0, 0]), g.ravel())
            evaluations[key] = _SCALE * float(cost[0, 0]), _SCALE * gradient.ravel(), g.ravel(), jacobian
        return evaluations[key]

    def with_slopes(x: NDArray[Any], value: Callable[[Array], tuple[Array, Array]]) -> NDArray[Any]:
        if x.dtype != object:
            return value(np.array(x, dtype=float))[0]
        z, dz = ExtractValue(x).ravel(), ExtractGradient(x)
        results, slope = value(z)
        return InitializeAutoDiff(results, slope @ dz).ravel()

    def cost(x: NDArray[Any]) -> Any:
        return with_slopes(x, lambda z: (np.array([at(z)[0]]), at(z)[1][None]))[0]

    program = MathematicalProgram()
    z = program.NewContinuousVariables(start.size, "z")
    program.AddBoundingBoxConstraint(*move.search_range, z)
    least, most = move.bounds
    program.AddCost(cost, vars=z)
    program.AddConstraint(lambda x: with_slopes(x, lambda z: at(z)[2:]), lb=least, ub=most, vars=z)
    solver_options = SolverOptions()
    for key, value in options.items():
        solver_options.SetOption(solver.solver_id(), key, value)
    return str(solver.Solve(program, start, solver_options).get_solution_result().name)


class MomentumDescent(Solver):
    """A method of a reasoner: its candidates are the plans that gradients on the momentum model lead to.

    One candidate is proposed at a time, from the next start, every second one within the limit of `CALM`. The reasoner
    tries each in its mental testbed.

    Args:
        search: The free knots.
        name: The name in the catalogue.
        origin: Joint positions at the begin, in rad.
        goal: Joint positions at the end, in rad.
        duration: The duration of the move in seconds.
        knots: The number of knots of a plan.
        attempts: The most starts that are tried, until one is `good_enough`.
    """

    def __init__(
        self,
        search: Search,
        *,
        name: str,
        origin: Sequence[float],
        goal: Sequence[float],
        duration: float,
        knots: int,
        attempts: int = 4,
    ) -> None:
        search.require(name, continuous=True, one_objective=True)
        super().__init__(search, name=name)
        self._move = Move(move_space(duration, knots), np.array(origin), np.array(goal))
        if search.size != 7 * self._move.space.free:
            raise SolverError(f"{name} searches {7 * self._move.space.free} free knots, not {search.size} parameters")
        self._good, self._attempts, self._attempt = good_enough(self._move), attempts, 0

    def _next(self) -> list[Point]:
        if self._attempt == self._attempts:
            self._end(False, f"none of {self._attempts} starts led to {self._good:.2g} rad")
            return []
        move = self._move if self._attempt % 2 else replace(self._move, turn=CALM)
        best = _Best(move)
        _by_casadi(move, start_of(move, self._attempt), best)
        self._attempt += 1
        z = move.straight[RESTING:-RESTING].ravel() if best.z is None else best.z
        ends = [parameter.ends for parameter in self.search.space]
        return [tuple(float(np.clip(value, *pair)) for value, pair in zip(z, ends, strict=True))]

    def _learn(self, evaluations: Sequence[Evaluation], by_hand: Sequence[Evaluation]) -> None:
        if any(evaluation.feasible and -evaluation.values[0] <= self._good for evaluation in evaluations):
            self._end(True, f"q is at most {self._good:.2g} rad")
