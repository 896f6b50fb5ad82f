"""Methods of a reasoner on known decisions: ``python -m benchmarks.decision_regret``.

Prints the table of docs/reasoning.md. The best of each decision is known in
closed form, so that the regret of a method is exact; there is no simulation, so that the time is the method's own. A
method begins as in a reasoner: at a plan in use, whose cost it is told. A seed determines the plan in use, the goal
and the random numbers of the method. The regret is the cost above the best one, over the plan in use's.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from math import inf

import click
import numpy as np

from vtbdrake.cli.output import table
from vtbdrake.optimization import Choice, Parameter
from vtbdrake.optimization.parameter import Dimension
from vtbdrake.optimization.solvers import make_solver, solver_type
from vtbdrake.optimization.solvers.solver import Evaluation, Point, SolverError

METHODS = ("MPPI", "CEM", "predictive-sampling", "CMA-ES", "COBYQA", "auto", "grid", "random")
# Methods that take long for a decision: fewer seeds.
SLOW = ("auto", "bayesian", "COBYQA")
SEEDS = 15
SEEDS_OF_SLOW = 3
ROLLOUTS = (30, 100)
SECONDS = 0.1  # a budget of wall time
ROLLOUT = 1e-3  # s, what a rollout takes
# A decision ends after this many batches in a row with known candidates only, as a reasoner's.
SILENT = 50
# Regrets below this are equal.
EXACT = 1e-6


@dataclass(frozen=True)
class Known:
    """A decision whose best cost is 0.

    Attributes:
        space: What is decided.
        cost: Function of a point.
        violation: Function of a point, at most 0 where the constraint holds; None: no constraint.
    """

    space: tuple[Dimension, ...]
    cost: Callable[[Point], float]
    violation: Callable[[Point], float] | None = None


def _box(size: int, lower: float, upper: float) -> tuple[Parameter, ...]:
    return tuple(Parameter(f"x{k}", lower, upper) for k in range(size))


def switching_time(generator: np.random.Generator) -> Known:
    """Return the problem when to brake a mass, which comes to rest s^2 further if it is braked after s."""
    goal = generator.uniform(0.2, 2.0)
    return Known(_box(1, 0.0, 3.0), lambda p: abs(p[0] ** 2 - goal))


def two_gains(generator: np.random.Generator) -> Known:
    """Two numbers that depend on each other: Rosenbrock's valley, moved."""
    a = generator.uniform(-1.0, 1.0)
    return Known(_box(2, -2.0, 2.0), lambda p: (a - p[0]) ** 2 + 100.0 * (p[1] - p[0] ** 2) ** 2)


def many_basins(generator: np.random.Generator) -> Known:
    """Four numbers with many local optima: Ackley's function, moved."""
    best = generator.uniform(-2.0, 2.0, 4)

    def cost(p: Point) -> float:
        x = np.array(p) - best
        far, waves = np.sqrt(np.mean(x**2)), np.mean(np.cos(2.0 * np.pi * x))
        return float(20.0 - 20.0 * np.exp(-0.2 * far) + np.e - np.exp(waves))

    return Known(_box(4, -5.0, 5.0), cost)


def constrained(generator: np.random.Generator) -> Known:
    """Return the least stiffness of four joints under loads: each gives way by its load over its stiffness."""
    load = generator.uniform(0.2, 0.8, 4)
    return Known(
        _box(4, 0.1, 4.0),
        lambda p: float(np.sum(np.array(p) - load)),
        lambda p: float(np.max(load / np.array(p))) - 1.0,
    )


def trajectory(generator: np.random.Generator) -> Known:
    """Ten forces that bring a mass to rest at a goal, with as little force as possible: least squares."""
    n, h, goal = 10, 0.3, generator.uniform(-1.0, 1.0)
    # What the forces do to position and velocity at the end.
    position, velocity = h * h * (np.arange(n)[::-1] + 0.5), np.full(n, h)
    A = np.vstack([0.1 * np.eye(n), 3.0 * position, 3.0 * velocity])
    b = np.concatenate([np.zeros(n), [3.0 * goal, 0.0]])
    best = np.linalg.lstsq(A, b, rcond=None)[0]
    least = float(np.sum((A @ best - b) ** 2))
    return Known(_box(n, -2.0, 2.0), lambda p: float(np.sum((A @ np.array(p) - b) ** 2)) - least)


def trajectory_at_limits(generator: np.random.Generator) -> Known:
    """Ten forces that move a mass as far as possible: all at their limits."""
    reach = np.arange(10, 0, -1) * generator.uniform(0.5, 1.0)
    return Known(_box(10, -1.0, 1.0), lambda p: float(reach @ (1.0 - np.array(p))))


def whole_numbers(generator: np.random.Generator) -> Known:
    """Two whole numbers out of 41 each: a bowl with ripples."""
    best = generator.integers(-15, 16, 2)
    space = tuple(Parameter(f"n{k}", -20, 20, integer=True) for k in range(2))
    return Known(space, lambda p: float(np.sum((np.array(p) - best) ** 2 + 9.0 * (np.array(p) != best))))


def choices(generator: np.random.Generator) -> Known:
    """One gait of six, and a number that is right for each of them."""
    of_gait, best = generator.permutation(6), generator.uniform(0.0, 1.0, 6)
    space = (Choice("gait", list(range(6))), Parameter("speed", 0.0, 1.0))
    return Known(space, lambda p: float(of_gait[p[0]]) + 4.0 * (p[1] - best[p[0]]) ** 2)


Make = Callable[[np.random.Generator], Known]
KINDS: dict[str, Make] = {
    "one number": switching_time,
    "2 numbers, a valley": two_gains,
    "4 numbers, many basins": many_basins,
    "4 numbers, constrained": constrained,
    "trajectory, 10 knots": trajectory,
    "trajectory at its limits": trajectory_at_limits,
    "2 whole numbers": whole_numbers,
    "a choice and a number": choices,
}


@dataclass(frozen=True)
class Outcome:
    """The result of one decision.

    Attributes:
        regret: The cost of the best eligible candidate, over the plan in use's; infinite without one.
        own: The method's own processor time, in seconds.
    """

    regret: float
    own: float


def decide(
    make: Callable[[np.random.Generator], Known], method: str, seed: int, rollouts: int | None
) -> Outcome | None:
    """Return the outcome of a decision within rollouts, or else within `SECONDS`; None if the method cannot decide it.

    Args:
        make: Function that makes the known decision.
        method: The name of the method.
        seed: The seed of the decision and of the method.
        rollouts: The budget, the plan in use included; None: a budget of wall time.
    """
    generator = np.random.default_rng(seed)
    known = make(generator)
    in_use: Point = tuple(
        parameter.from_unit(u) for parameter, u in zip(known.space, generator.random(10), strict=False)
    )
    start = in_use if solver_type(method).takes_start else None
    constraints = int(known.violation is not None)
    began, own, count, silent = time.process_time(), 0.0, 1, 0
    try:
        budget = None if rollouts is None else rollouts - 1
        solver = make_solver(method, known.space, constraints=constraints, seed=seed, budget=budget, start=start)
    except SolverError:
        return None

    def evaluation(point: Point, effort: float) -> Evaluation:
        violations = () if known.violation is None else (known.violation(point),)
        return Evaluation(point, (-known.cost(point),), violations, effort=effort)

    told = {in_use: evaluation(in_use, 0.0)}
    extra = [told[in_use]]
    try:
        while points := solver.ask():
            own = time.process_time() - began
            if rollouts is None:
                affordable = int((SECONDS - own) / ROLLOUT) - count
                if affordable < len(points):
                    told |= {p: evaluation(p, 1.0) for p in points[: max(0, affordable)]}
                    break
            batch = [evaluation(point, float(point not in told)) for point in points]
            told |= zip(points, batch, strict=True)
            silent = silent + 1 if len(told) == count else 0
            count = len(told)
            solver.tell([*batch, *extra])
            extra = []
            if silent == SILENT or (rollouts is not None and count >= rollouts):
                break
    finally:
        solver.close()
    own = time.process_time() - began
    scale = abs(known.cost(in_use)) or 1.0
    costs = [-each.values[0] for each in told.values() if each.feasible]
    return Outcome(min(costs, default=inf) / scale, own)


def outcomes(kind: str, method: str, rollouts: int | None) -> list[Outcome]:
    """Return the outcomes of all seeds; none if the method cannot decide this kind."""
    seeds = range(SEEDS_OF_SLOW if method in SLOW else SEEDS)
    return [found for seed in seeds if (found := decide(KINDS[kind], method, seed, rollouts)) is not None]


def _cell(found: list[Outcome]) -> str:
    if not found:
        return "-"
    regret = float(np.median([each.regret for each in found]))
    text = "none" if regret == inf else f"{max(regret, EXACT):.1g}" if regret > EXACT else "0"
    return f"{text} ({1e3 * float(np.median([each.own for each in found])):.2g} ms)"


@click.command()
@click.argument("only", nargs=-1)
def main(only: tuple[str, ...]) -> None:
    """Print the median regret of the methods ONLY, or of `METHODS`, and the median of their own processor time."""
    methods = only or METHODS
    rows = []
    for kind in KINDS:
        for rollouts in (*ROLLOUTS, None):
            budget = f"{rollouts} rollouts" if rollouts else f"{SECONDS:g} s"
            rows.append([kind, budget, *(_cell(outcomes(kind, method, rollouts)) for method in methods)])
            click.echo(" | ".join(rows[-1]), err=True)
    click.echo(table(["decision", "budget", *methods], rows))


if __name__ == "__main__":
    main()
