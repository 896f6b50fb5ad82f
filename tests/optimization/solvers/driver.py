"""A driver of solvers in a few lines, and functions whose optima are known."""

from dataclasses import dataclass

import numpy as np

from vtbdrake.optimization.parameter import Parameter
from vtbdrake.optimization.solvers import Evaluation, make_solver


@dataclass(frozen=True)
class Function:
    """A cost to be minimized over a box, and where that is."""

    cost: object
    space: tuple
    best: tuple
    lowest: float = 0.0


def box(size, lower, upper):
    return tuple(Parameter(f"x{i}", lower, upper) for i in range(size))


def _ackley(p):
    x = np.array(p) - 0.7
    return 20.0 + np.e - 20.0 * np.exp(-0.2 * np.sqrt(np.mean(x**2))) - np.exp(np.mean(np.cos(2.0 * np.pi * x)))


SPHERE = Function(lambda p: (p[0] - 1.0) ** 2 + (p[1] + 0.5) ** 2, box(2, -3.0, 4.0), (1.0, -0.5))
ROSENBROCK = Function(lambda p: (1.0 - p[0]) ** 2 + 100.0 * (p[1] - p[0] ** 2) ** 2, box(2, -2.0, 2.5), (1.0, 1.0))
ACKLEY = Function(_ackley, box(3, -20.0, 15.0), (0.7, 0.7, 0.7))

# Three minima of equal value: (-pi, 12.275), (pi, 2.275), (9.42478, 2.475).
BRANIN = Function(
    lambda p: (
        (p[1] - 5.1 / (4.0 * np.pi**2) * p[0] ** 2 + 5.0 / np.pi * p[0] - 6.0) ** 2
        + 10.0 * (1.0 - 1.0 / (8.0 * np.pi)) * np.cos(p[0])
        + 10.0
    ),
    (Parameter("a", -5.0, 10.0), Parameter("b", 0.0, 15.0)),
    (np.pi, 2.275),
    lowest=10.0 / (8.0 * np.pi),
)

# min |x - (1, 2)|^2 under x + y <= 1: KKT gives (0, 1), multiplier 2, value 2.
CONSTRAINED = Function(lambda p: (p[0] - 1.0) ** 2 + (p[1] - 2.0) ** 2, box(2, -3.0, 4.0), (0.0, 1.0), lowest=2.0)


def half_plane(p):
    return (p[0] + p[1] - 1.0,)


def evaluation(point, cost, violations=None, fails=None):
    """The evaluation of a cost, or of several in a tuple, as a study would tell it."""
    costs = cost(point)
    values = tuple(-float(c) for c in (costs if isinstance(costs, tuple) else (costs,)))
    broken = tuple(map(float, violations(point))) if violations else ()
    if fails is not None and fails(point):
        return Evaluation(point, (np.nan,) * len(values), (np.nan,) * len(broken))
    return Evaluation(point, values, broken)


def drive(solver, cost, *, violations=None, fails=None, limit=20_000):
    """Runs a solver to its end, or to ``limit`` evaluations; returns all of them."""
    log = []
    while points := solver.ask():
        told = [evaluation(point, cost, violations, fails) for point in points]
        log += told
        if len(log) >= limit:
            break
        solver.tell(told)
    solver.close()
    return log


def solve(name, function, *, violations=None, limit=20_000, **arguments):
    """The solver after its run on a function, and the best feasible evaluation."""
    solver = make_solver(name, function.space, constraints=1 if violations else 0, **arguments)
    log = drive(solver, function.cost, violations=violations, limit=limit)
    return solver, max((e for e in log if e.feasible), key=lambda e: e.values[0])
