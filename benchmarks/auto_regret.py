"""Regret of the default solver after few rollouts, against solvers that are known to be good.

The gap of a run is the difference of its best point from the optimum, in units of the median gap of random points. Gaps
below `SOLVED` count as equal to it: no simulation is that exact. For every function and budget, the medians of the gaps
over the seeds are compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import get_context

import numpy as np
from pydrake.systems.analysis import SimulatorConfig

import vtbdrake as vtb
from benchmarks.measure import HIGHER, LOWER, Benchmark
from tests.testbeds import PendulumScenario
from vtbdrake.optimization.parameter import Choice, Dimension, Parameter
from vtbdrake.optimization.problem import Problem
from vtbdrake.optimization.solvers import Evaluation, Point, make_solver
from vtbdrake.rollout import RolloutRunner

BUDGETS, SHORT_BUDGETS = (30, 100, 400), (30, 100)
# The best of five medians is compared with one: with few seeds, luck alone makes rows of 5 and more.
SEEDS, SHORT_SEEDS = range(10), range(5)
# Below this part of a typical gap, an optimum counts as found.
SOLVED = 1e-4
# A row is good up to this ratio; this share of all rows shall be, none above the largest, and in none `auto` the worst.
GOOD, GOAL, LARGEST = 1.5, 28 / 33, 5.0
# The penalty of a violation of 1, far above the multiplier of the constraint.
PENALTY = 10.0
AUTO, STUDY = "auto", "study"

ANGLE, RATE, DAMPING = (f"sim.sys.Pendulum.theta.{name}" for name in ("position", "velocity", "damping"))
DAMPINGS = (0.1, 0.6)

Costs = tuple[float, ...]


@dataclass(frozen=True)
class Case:
    """A function to be minimized.

    Attributes:
        cost: The cost, or two costs, that a solver gets at a point.
        space: The parameters.
        lowest: The smallest cost; of two costs, the hypervolume of the ideal front, negated.
        true: The cost without noise, which is compared; None if `cost` has no noise.
        corner: The reference point of the hypervolume of two costs.
        rollouts: The number of rollouts of an evaluation.
        violation: A constraint, which holds where it is at most 0; None if there is none. Only points that keep it
            count. Solvers that take no constraints get the cost with `PENALTY` times the violation.
    """

    cost: Callable[[Point], Costs]
    space: tuple[Dimension, ...]
    lowest: float
    true: Callable[[Point], Costs] | None = None
    corner: tuple[float, float] | None = None
    rollouts: int = 1
    violation: Callable[[Point], float] | None = None

    @property
    def objectives(self) -> int:
        return 2 if self.corner else 1

    def penalized(self, point: Point) -> Costs:
        """The costs, with the penalty of a violated constraint."""
        costs = self.cost(point)
        beyond = 0.0 if self.violation is None else max(self.violation(point), 0.0)
        return tuple(cost + PENALTY * beyond for cost in costs)


# ------------------------------------------------------------------------------ public test functions


def _box(size: int, lower: float, upper: float) -> tuple[Dimension, ...]:
    return tuple(Parameter(f"x{i}", lower, upper) for i in range(size))


def _branin(p: Point) -> Costs:
    x, y = p
    valley = y - 5.1 / (4.0 * np.pi**2) * x**2 + 5.0 / np.pi * x - 6.0
    return (float(valley**2 + 10.0 * (1.0 - 1.0 / (8.0 * np.pi)) * np.cos(x) + 10.0),)


def _rosenbrock(p: Point) -> Costs:
    x = np.array(p)
    return (float(np.sum(100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2)),)


def _levy(p: Point) -> Costs:
    w = 1.0 + (np.array(p) - 1.0) / 4.0
    middle = (w[:-1] - 1.0) ** 2 * (1.0 + 10.0 * np.sin(np.pi * w[:-1] + 1.0) ** 2)
    end = (w[-1] - 1.0) ** 2 * (1.0 + np.sin(2.0 * np.pi * w[-1]) ** 2)
    return (float(np.sin(np.pi * w[0]) ** 2 + np.sum(middle) + end),)


def _ackley(p: Point) -> Costs:
    x = np.array(p, dtype=float)
    slope = 20.0 - 20.0 * np.exp(-0.2 * np.sqrt(np.mean(x**2)))
    return (float(slope + np.e - np.exp(np.mean(np.cos(2.0 * np.pi * x)))),)


# alpha, A and 1e4 P of Hartmann's functions of 3 and of 6 variables.
_HARTMANN_ALPHA = np.array([1.0, 1.2, 3.0, 3.2])
_HARTMANN = {
    3: (
        np.array([[3.0, 10, 30], [0.1, 10, 35], [3.0, 10, 30], [0.1, 10, 35]]),
        np.array([[3689, 1170, 2673], [4699, 4387, 7470], [1091, 8732, 5547], [381, 5743, 8828]]),
    ),
    6: (
        np.array(
            [[10, 3, 17, 3.5, 1.7, 8], [0.05, 10, 17, 0.1, 8, 14], [3, 3.5, 1.7, 10, 17, 8], [17, 8, 0.05, 10, 0.1, 14]]
        ),
        np.array(
            [
                [1312, 1696, 5569, 124, 8283, 5886],
                [2329, 4135, 8307, 3736, 1004, 9991],
                [2348, 1451, 3522, 2883, 3047, 6650],
                [4047, 8828, 8732, 5743, 1091, 381],
            ]
        ),
    ),
}


def _hartmann(p: Point) -> Costs:
    A, P = _HARTMANN[len(p)]
    return (float(-_HARTMANN_ALPHA @ np.exp(-np.sum(A * (np.array(p) - 1e-4 * P) ** 2, axis=1))),)


def _noisy(p: Point) -> Costs:
    """Hartmann's function of three variables with noise that is normal, and the same whenever a point is repeated."""
    seed = np.array(p).view(np.uint32).tolist()
    return (_hartmann(p)[0] + 0.1 * float(np.random.default_rng(seed).standard_normal()),)


# The wells, their places as columns, of Shekel's function of four variables and ten wells, and their depths.
_SHEKEL = np.array(
    [
        [4, 1, 8, 6, 3, 2, 5, 8, 6, 7.0],
        [4, 1, 8, 6, 7, 9, 5, 1, 2, 3.6],
        [4, 1, 8, 6, 3, 2, 3, 8, 6, 7.0],
        [4, 1, 8, 6, 7, 9, 3, 1, 2, 3.6],
    ]
)
_SHEKEL_DEPTH = np.array([0.1, 0.2, 0.2, 0.4, 0.4, 0.6, 0.3, 0.7, 0.5, 0.5])


def _shekel(p: Point) -> Costs:
    """Narrow wells in a plain: a search that has found one does not see the others."""
    distance = np.sum((np.array(p)[:, np.newaxis] - _SHEKEL) ** 2, axis=0)
    return (float(-np.sum(1.0 / (distance + _SHEKEL_DEPTH))),)


def _outside_disk(p: Point) -> float:
    """Rosenbrock's valley meets the unit circle at its best point: along it the constraint is curved, too."""
    return float(p[0] ** 2 + p[1] ** 2 - 1.0)


def _camel(x: float, y: float) -> float:
    return (4.0 - 2.1 * x**2 + x**4 / 3.0) * x**2 + x * y + (4.0 * y**2 - 4.0) * y**2


def _beale(x: float, y: float) -> float:
    return (1.5 - x + x * y) ** 2 + (2.25 - x + x * y**2) ** 2 + (2.625 - x + x * y**3) ** 2


def _choices(p: Point) -> Costs:
    """Func2C of Ru et al. (2020), arXiv:1906.08878: two choices between functions, which are added."""
    first, second, x, y = p
    functions = {
        "rosenbrock": lambda: _rosenbrock((2.0 * x, 2.0 * y))[0] / 300.0,
        "camel": lambda: _camel(2.0 * x, y) / 10.0,
        "beale": lambda: _beale(2.0 * x, 2.0 * y) / 50.0,
        "sphere": lambda: x**2 + y**2,
        "nothing": lambda: 0.0,
    }
    return (float(functions[first]() + functions[second]()),)


_CHOICES = (
    Choice("first", ["rosenbrock", "camel", "beale"]),
    Choice("second", ["rosenbrock", "camel", "beale", "sphere", "nothing"]),
    Parameter("x", -1.0, 1.0),
    Parameter("y", -1.0, 1.0),
)
_INTEGERS = (
    Parameter("i", -12, 7, integer=True),
    Parameter("j", -9, 15, integer=True),
    Parameter("x", -12.0, 8.0),
    Parameter("y", -9.0, 15.0),
)


def _fonseca(p: Point) -> Costs:
    """Fonseca and Fleming's two costs of three variables; the front is x = y = z in [-1/sqrt 3, 1/sqrt 3]."""
    x, shift = np.array(p), 1.0 / np.sqrt(len(p))
    return float(1.0 - np.exp(-np.sum((x - shift) ** 2))), float(1.0 - np.exp(-np.sum((x + shift) ** 2)))


def _zdt1(p: Point) -> Costs:
    """Zitzler, Deb and Thiele's first problem; the front is x[1:] = 0, where the second cost is 1 - sqrt(x[0])."""
    g = 1.0 + 9.0 * float(np.mean(p[1:]))
    return float(p[0]), g * (1.0 - math.sqrt(p[0] / g))


# The ideal front of `_fonseca`, and the area between it and (1, 1).
_t = np.linspace(-1.0, 1.0, 20_001)
_FONSECA = math.exp(-4.0) - float(np.trapezoid(np.exp(-((_t + 1.0) ** 2)), 1.0 - np.exp(-((_t - 1.0) ** 2))))


# ------------------------------------------------------------------------------ a real problem


@cache
def pendulum() -> Problem:
    """Which swing of a pendulum ends near 0.3 rad, whatever its damping is? At worst, at each of `DAMPINGS`."""
    return vtb.Problem(
        # Less exact than usual, so that the benchmark is quick.
        scenario=PendulumScenario(simulator_config=SimulatorConfig(accuracy=1e-4, max_step_size=0.1)),
        parameters=[vtb.Parameter(ANGLE, -1.5, 1.5), vtb.Parameter(RATE, -6.0, 6.0)],
        quality=vtb.Quality(lambda theta: abs(theta - 0.3), ANGLE, minimize=True, reading="end"),
        horizon=0.8,
        sample_period=0.4,
        conditions=[{DAMPING: damping} for damping in DAMPINGS],
    )


@cache
def _runner() -> RolloutRunner:
    return RolloutRunner(pendulum().task, pendulum().testbed)


def _swing(p: Point) -> Costs:
    problem = pendulum()
    values = (_runner().run(problem.values(p, condition=c)).value for c in range(len(problem.conditions)))
    return (max(float(value) for value in values),)


CASES: dict[str, Callable[[], Case]] = {
    "branin": lambda: Case(_branin, (Parameter("x", -5.0, 10.0), Parameter("y", 0.0, 15.0)), 5.0 / (4.0 * np.pi)),
    "rosenbrock_4": lambda: Case(_rosenbrock, _box(4, -2.0, 2.5), 0.0),
    "levy_5": lambda: Case(_levy, _box(5, -9.0, 8.0), 0.0),
    "ackley_3": lambda: Case(_ackley, _box(3, -20.0, 14.0), 0.0),
    "hartmann_6": lambda: Case(_hartmann, _box(6, 0.0, 1.0), -3.322368011391339),
    "noisy_3": lambda: Case(_noisy, _box(3, 0.0, 1.0), -3.8627797873327696, true=_hartmann),
    "choices": lambda: Case(_choices, _CHOICES, -0.20632569069797535),
    "integers": lambda: Case(_ackley, _INTEGERS, 0.0),
    "two_qualities_fonseca": lambda: Case(_fonseca, _box(3, -4.0, 4.0), -_FONSECA, corner=(1.0, 1.0)),
    "two_qualities_zdt1": lambda: Case(_zdt1, _box(4, 0.0, 1.0), -2.0 / 3.0, corner=(1.0, 1.0)),
    "shekel_4": lambda: Case(_shekel, _box(4, 0.0, 10.0), -10.53644315348353),
    "curved_constraint": lambda: Case(_rosenbrock, _box(2, -1.5, 1.5), 0.0456748087, violation=_outside_disk),
    STUDY: lambda: Case(_swing, pendulum().parameters, 0.0964855, rollouts=len(DAMPINGS)),
}


# ------------------------------------------------------------------------------ the solvers


class _SpentError(Exception):
    """The budget is spent."""


class _Record:
    """The result of a solver: the true costs of its points, each once, and the best after each rollout."""

    def __init__(self, case: Case, budget: int) -> None:
        self._case = case
        self._budget = budget // case.rollouts
        self.costs: list[Costs] = []
        self.true: list[Costs] = []

    def __call__(self, point: Point) -> Costs:
        if len(self.costs) == self._budget:
            raise _SpentError
        costs = self._case.penalized(point)
        broken = self._case.violation is not None and self._case.violation(point) > 0.0
        self.costs.append((math.inf,) if broken else costs)
        self.true.append(self._case.true(point) if self._case.true else self.costs[-1])
        return costs

    def at(self, u: np.ndarray) -> float:
        """The cost at ``u`` in the unit cube, shape (n,)."""
        return self(tuple(parameter.from_unit(x) for parameter, x in zip(self._case.space, u, strict=True)))[0]

    def gap(self, budget: int) -> float:
        """Return the distance of the apparently best point after ``budget`` rollouts from the optimum."""
        count = budget // self._case.rollouts
        costs, true = self.costs[:count], self.true[:count]
        if self._case.corner:
            return -hypervolume(costs, self._case.corner) - self._case.lowest
        return true[int(np.argmin(costs))][0] - self._case.lowest


def hypervolume(costs: Sequence[Costs], corner: tuple[float, float]) -> float:
    """Return the area that points with two costs dominate below ``corner``."""
    area, ceiling = 0.0, corner[1]
    for first, second in sorted(costs):
        if first < corner[0] and second < ceiling:
            area += (corner[0] - first) * (ceiling - second)
            ceiling = second
    return area


def _our(name: str, record: _Record, case: Case, seed: int, budget: int) -> None:
    """Run one of our solvers from one start to its end."""
    start = None
    if name.startswith("LN_"):
        start = tuple(p.from_unit(x) for p, x in zip(case.space, np.random.default_rng(seed).random(9), strict=False))
    violation = case.violation
    solver = make_solver(
        name,
        case.space,
        objectives=case.objectives,
        constraints=0 if violation is None else 1,
        seed=seed,
        budget=budget,
        start=start,
    )

    def evaluated(point: Point) -> Evaluation:
        costs = record(point)
        if violation is None:
            return Evaluation(point, tuple(-cost for cost in costs))
        return Evaluation(point, tuple(-cost for cost in case.cost(point)), (violation(point),))

    try:
        while points := solver.ask():
            solver.tell([evaluated(point) for point in points])
    finally:
        solver.close()


def _bobyqa(record: _Record, case: Case, seed: int, budget: int) -> None:
    """BOBYQA from random starts, one after the other."""
    cube = Case(lambda u: (record.at(np.array(u)),), _box(len(case.space), 0.0, 1.0), 0.0)
    for start in range(budget):
        _our("LN_BOBYQA", lambda u: cube.cost(u), cube, 1000 * seed + start, budget)


def _cmaes(record: _Record, case: Case, seed: int, budget: int) -> None:
    """The package cmaes; where it has converged, it restarts at a random point with twice the population."""
    from cmaes import CMA

    size = len(case.space)
    generator = np.random.default_rng(seed)
    for start in range(budget):
        population = (4 + int(3 * math.log(size))) << start
        strategy = CMA(
            mean=generator.random(size),
            sigma=0.3,
            bounds=np.tile([0.0, 1.0], (size, 1)),
            seed=1000 * seed + start,
            population_size=population,
        )
        while not strategy.should_stop():
            drawn = [strategy.ask() for _ in range(population)]
            strategy.tell([(x, record.at(x)) for x in drawn])


def _dual_annealing(record: _Record, case: Case, seed: int, budget: int) -> None:
    from scipy.optimize import dual_annealing

    for restart in range(budget):
        dual_annealing(record.at, [(0.0, 1.0)] * len(case.space), rng=1000 * seed + restart)


def _optuna(sampler: str, record: _Record, case: Case, seed: int, budget: int) -> None:
    """A sampler of Optuna with its default options, one point at a time."""
    import optuna

    from vtbdrake.optimization.solvers.optuna_samplers import distribution, quiet

    with quiet():
        made = getattr(optuna.samplers, sampler)(seed=seed)
        study = optuna.create_study(sampler=made, directions=["minimize"] * case.objectives)
        names = [parameter.address for parameter in case.space]
        distributions = {p.address: distribution(p, optuna) for p in case.space}
        for _ in range(budget):
            trial = study.ask(distributions)
            values = [trial.params[name] for name in names]
            point = tuple(p.options[x] if isinstance(p, Choice) else x for p, x in zip(case.space, values, strict=True))
            study.tell(trial, record(point))


Run = Callable[[_Record, Case, int, int], None]
RIVALS: dict[str, Run] = {
    "TPE": partial(_optuna, "TPESampler"),
    "Optuna's CMA-ES": partial(_optuna, "CmaEsSampler"),
    "cmaes": _cmaes,
    "dual annealing": _dual_annealing,
    "BOBYQA": _bobyqa,
}
RIVALS_OF_TWO: dict[str, Run] = {
    "TPE": partial(_optuna, "TPESampler"),
    "NSGA-II": partial(_optuna, "NSGAIISampler"),
}


def gaps(task: tuple[str, str, int], budgets: Sequence[int]) -> list[float]:
    """The gaps of a solver on a case with a seed, one per budget."""
    name, solver, seed = task
    case = CASES[name]()
    if solver != AUTO:
        record = _recorded((RIVALS_OF_TWO if case.corner else RIVALS)[solver], case, seed, max(budgets))
        return [record.gap(budget) for budget in budgets]
    # Only `auto` plans with its budget: what the others find with less is the beginning of what they find with more.
    if name == STUDY:
        return [_studied(seed, budget) - case.lowest for budget in budgets]
    return [_recorded(partial(_our, AUTO), case, seed, budget).gap(budget) for budget in budgets]


def _recorded(run: Run, case: Case, seed: int, budget: int) -> _Record:
    record = _Record(case, budget)
    with suppress(_SpentError):
        run(record, case, seed, budget)
    return record


def _studied(seed: int, budget: int) -> float:
    """The best cost that a study of the pendulum finds; it drops points by racing, as is usual."""
    with pendulum().study(seed=seed) as study:
        return float(study.run(rollouts=budget, executor="serial", progress=False).best.value)


# ------------------------------------------------------------------------------ the benchmark


def auto_regret() -> list[Benchmark]:
    """The comparison of `auto_regret_full`, without the largest budget, and with half of the seeds: a quick look."""
    return _regret("auto_regret", SHORT_BUDGETS, SHORT_SEEDS)


def auto_regret_full() -> list[Benchmark]:
    """Return the median gap of `auto` over the best other gap, row by row, and the share of good rows."""
    return _regret("auto_regret_full", BUDGETS, SEEDS)


def _regret(title: str, budgets: Sequence[int], seeds: Sequence[int]) -> list[Benchmark]:
    solvers = {name: [AUTO, *(RIVALS_OF_TWO if case().corner else RIVALS)] for name, case in CASES.items()}
    tasks = [(name, solver, seed) for name, names in solvers.items() for solver in names for seed in seeds]
    rows = []
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        gaps_by_task = pool.map(partial(gaps, budgets=budgets), tasks)
        for name, names in solvers.items():
            scale = _typical_gap(CASES[name]())
            # The gaps of a solver, one row per seed and one column per budget, in the order of the tasks.
            by_solver = {solver: np.array([next(gaps_by_task) for _ in seeds]) / scale for solver in names}
            for i, budget in enumerate(budgets):
                medians = {solver: float(np.median(of_solver[:, i])) for solver, of_solver in by_solver.items()}
                rows.append(_row(f"{title}_{name}_{budget}", medians))
                # The whole takes minutes.
                print(f"{rows[-1].name}: {rows[-1].value:.3g} of {rows[-1].against}; {rows[-1].note}", flush=True)
    ratios = [row.value for row in rows]
    worst = [row.name for row in rows if "the worst" in row.note]
    largest = max(rows, key=lambda row: row.value)
    share = sum(ratio <= GOOD for ratio in ratios) / len(ratios)
    summary = Benchmark(
        name=title,
        value=share,
        unit="1",
        goal=GOAL,
        better=HIGHER,
        against="the best of TPE, CMA-ES, cmaes, dual annealing, multi-start BOBYQA",
        holds=share >= GOAL and largest.value <= LARGEST and not worst,
        note=f"the share of {len(ratios)} rows whose ratio of gaps is at most {GOOD}; the median is "
        f"{np.median(ratios):.2g}, the largest {largest.value:.2g} in {largest.name}, where the goal is {LARGEST:g}; "
        f"the worst of all solvers in {', '.join(worst) or 'none'}",
    )
    return [summary, *rows]


def _row(name: str, medians: Mapping[str, float]) -> Benchmark:
    """One function and budget."""
    counted = {solver: max(gap, SOLVED) for solver, gap in medians.items()}
    auto = counted.pop(AUTO)
    best = min(counted, key=lambda solver: counted[solver])
    verdict = ", the worst" if auto > max(counted.values()) else ""
    return Benchmark(
        name=name,
        value=auto / counted[best],
        unit="1",
        goal=None,
        better=LOWER,
        against=best,
        note=f"auto {auto:.2g}{verdict}; " + ", ".join(f"{solver} {gap:.2g}" for solver, gap in counted.items()),
    )


def _typical_gap(case: Case) -> float:
    """The median gap of random points; of two costs, the gap of no point at all."""
    if case.corner:
        return -case.lowest
    generator = np.random.default_rng(0)
    units = generator.random((200, len(case.space)))
    points = [tuple(p.from_unit(x) for p, x in zip(case.space, u, strict=True)) for u in units]
    return float(np.median([(case.true or case.penalized)(point)[0] for point in points])) - case.lowest
