"""Regret of the default solver after few rollouts, against seven solvers that are known to be good.

The gap of a run is the difference of its best point from the optimum, in units of the median gap of random points. Gaps
below `SOLVED` count as equal to it: no simulation is that exact. For every function and budget, the medians of the gaps
over the seeds are compared. `HELD_OUT` judges: `auto` was not tuned on these functions, but on others, which
`auto_regret_tuning` runs. `auto_regret_mixed` has other problems: choices, integers, two qualities, a constraint, a
study.
"""

from __future__ import annotations

import math
import time
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
from benchmarks.solver_functions import HELD_OUT, TUNING
from tests.testbeds import PendulumScenario
from vtbdrake.optimization.parameter import Choice, Dimension, Parameter
from vtbdrake.optimization.problem import Problem
from vtbdrake.optimization.solvers import Evaluation, Point, make_solver
from vtbdrake.rollout import RolloutRunner

BUDGETS = (30, 100, 300)
SHORT_BUDGETS = (30, 100)
# The best of seven medians is compared with one: with few seeds, luck alone makes rows of 5 and more.
SEEDS = range(10)
SHORT_SEEDS = range(3)
# Below this part of a typical gap, an optimum counts as found.
SOLVED = 1e-5
# A row is good up to this ratio, or if no other solver is better.
GOOD = 1.5
# The share of all rows that shall be good; in none shall `auto` be the last.
GOAL = 0.8
# The processor time that `auto` may take for a point, in seconds.
OWN_TIME = 0.05
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


# ------------------------------------------------------------------------------ mixed problems


def _box(size: int, lower: float, upper: float) -> tuple[Dimension, ...]:
    return tuple(Parameter(f"x{i}", lower, upper) for i in range(size))


def _rosenbrock(p: Point) -> Costs:
    x = np.array(p)
    return (float(np.sum(100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2)),)


def _ackley(p: Point) -> Costs:
    x = np.array(p, dtype=float)
    slope = 20.0 - 20.0 * np.exp(-0.2 * np.sqrt(np.mean(x**2)))
    return (float(slope + np.e - np.exp(np.mean(np.cos(2.0 * np.pi * x)))),)


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


def _case(name: str) -> Case:
    """Return a function of numbers as a case."""
    function = NUMERIC[name]

    def cost(p: Point) -> Costs:
        return (function.cost(np.array(p, dtype=float)),)

    def true(p: Point) -> Costs:
        return (function.true(np.array(p, dtype=float)),)

    return Case(cost, _box(function.size, 0.0, 1.0), function.lowest, true=true)


NUMERIC = {**TUNING, **HELD_OUT}
CASES: dict[str, Callable[[], Case]] = {
    "choices": lambda: Case(_choices, _CHOICES, -0.20632569069797535),
    "integers": lambda: Case(_ackley, _INTEGERS, 0.0),
    "two_qualities_fonseca": lambda: Case(_fonseca, _box(3, -4.0, 4.0), -_FONSECA, corner=(1.0, 1.0)),
    "two_qualities_zdt1": lambda: Case(_zdt1, _box(4, 0.0, 1.0), -2.0 / 3.0, corner=(1.0, 1.0)),
    "curved_constraint": lambda: Case(_rosenbrock, _box(2, -1.5, 1.5), 0.0456748087, violation=_outside_disk),
    STUDY: lambda: Case(_swing, pendulum().parameters, 0.0964855, rollouts=len(DAMPINGS)),
    **{name: partial(_case, name) for name in NUMERIC},
}
MIXED = [name for name in CASES if name not in NUMERIC]


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
        if not self.costs:
            return math.inf
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
        start = tuple(
            p.from_unit(x) for p, x in zip(case.space, np.random.default_rng(seed).random(len(case.space)), strict=True)
        )
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
    """BOBYQA from random starts, one after the other; with one parameter, for which there is none, COBYQA."""
    if len(case.space) == 1:
        return _cobyqa(record, case, seed, budget)
    cube = Case(lambda u: (record.at(np.array(u)),), _box(len(case.space), 0.0, 1.0), 0.0)
    for start in range(budget):
        _our("LN_BOBYQA", lambda u: cube.cost(u), cube, 1000 * seed + start, budget)
    return None


def _cobyqa(record: _Record, case: Case, seed: int, budget: int) -> None:
    """SciPy's COBYQA from random starts, one after the other, with its own options."""
    from scipy.optimize import minimize

    generator, size = np.random.default_rng(seed), len(case.space)
    for _ in range(budget):
        minimize(record.at, generator.random(size), method="COBYQA", bounds=[(0.0, 1.0)] * size)


def _ngopt(record: _Record, case: Case, seed: int, budget: int) -> None:
    """Nevergrad's NGOpt, which chooses its method by the number of parameters and the budget."""
    import nevergrad
    from nevergrad.optimization import metamodel

    # Its models are arrays of one number, which numpy does not turn into a float any more.
    metamodel.float = lambda x: np.asarray(x).item()
    parametrization = nevergrad.p.Array(shape=(len(case.space),), lower=0.0, upper=1.0)
    parametrization.random_state.seed(seed)
    optimizer = nevergrad.optimizers.NGOpt(parametrization=parametrization, budget=budget)
    for _ in range(budget):
        asked = optimizer.ask()
        optimizer.tell(asked, record.at(np.clip(asked.value, 0.0, 1.0)))


def _cmaes(record: _Record, case: Case, seed: int, budget: int) -> None:
    """The package cmaes; where it has converged, it restarts at a random point with twice the population."""
    from cmaes import CMA

    size = len(case.space)
    generator = np.random.default_rng(seed)
    if size == 1:
        return  # It has no method for one parameter.
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
    "COBYQA": _cobyqa,
    "NGOpt": _ngopt,
}
# Those that take numbers as they are, without a penalty, and so no problem that is mixed.
NUMBERS = ("COBYQA", "NGOpt")
RIVALS_OF_TWO: dict[str, Run] = {
    "TPE": partial(_optuna, "TPESampler"),
    "NSGA-II": partial(_optuna, "NSGAIISampler"),
}


# What plans with its budget: of the others, what they find with less is the beginning of what they find with more.
PLANS = ("NGOpt",)


def gaps(task: tuple[str, str, int], budgets: Sequence[int]) -> tuple[list[float], float]:
    """The gaps of a solver on a case with a seed, one per budget, and its processor time per point, in seconds."""
    name, solver, seed = task
    case = CASES[name]()
    run = partial(_our, AUTO) if solver == AUTO else (RIVALS_OF_TWO if case.corner else RIVALS)[solver]
    if name == STUDY and solver == AUTO:
        return [_studied(seed, budget) - case.lowest for budget in budgets], 0.0
    if solver in PLANS or (solver == AUTO and name in MIXED):
        return [_recorded(run, case, seed, budget).gap(budget) for budget in budgets], 0.0
    began = time.process_time()
    record = _recorded(run, case, seed, max(budgets))
    own = (time.process_time() - began) / max(len(record.costs), 1)
    return [record.gap(budget) for budget in budgets], own


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
    """The comparison of `auto_regret_full`, without the largest budget, and with three seeds: a quick look."""
    return _regret("auto_regret", [*HELD_OUT], SHORT_BUDGETS, SHORT_SEEDS)


def auto_regret_full() -> list[Benchmark]:
    """Return the median gap of `auto` over the best other gap, row by row, and the share of good rows."""
    return _regret("auto_regret_full", [*HELD_OUT], BUDGETS, SEEDS)


def auto_regret_tuning() -> list[Benchmark]:
    """The comparison on the functions that `auto` may be tuned on: run it before and after a change."""
    return _regret("auto_regret_tuning", [*TUNING], SHORT_BUDGETS, SHORT_SEEDS)


def auto_regret_mixed() -> list[Benchmark]:
    """The comparison on problems with choices, integers, two qualities, a constraint, and in a study."""
    return _regret("auto_regret_mixed", MIXED, SHORT_BUDGETS, range(5))


def _regret(title: str, names: Sequence[str], budgets: Sequence[int], seeds: Sequence[int]) -> list[Benchmark]:
    rivals = {name: RIVALS_OF_TWO if CASES[name]().corner else RIVALS for name in names}
    solvers = {name: [AUTO, *(r for r in rivals[name] if name in NUMERIC or r not in NUMBERS)] for name in names}
    tasks = [(name, solver, seed) for name, of_case in solvers.items() for solver in of_case for seed in seeds]
    rows, own_times = [], []
    medians_by_budget: dict[int, list[dict[str, float]]] = {budget: [] for budget in budgets}
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        outcomes = pool.map(partial(gaps, budgets=budgets), tasks)
        for name, of_case in solvers.items():
            scale = _typical_gap(CASES[name]())
            # The gaps of a solver, one row per seed and one column per budget, in the order of the tasks.
            by_solver = {}
            for solver in of_case:
                found = [next(outcomes) for _ in seeds]
                by_solver[solver] = np.array([gap for gap, _ in found]) / scale
                own_times += [own for _, own in found if solver == AUTO]
            for i, budget in enumerate(budgets):
                medians = {solver: float(np.median(of_solver[:, i])) for solver, of_solver in by_solver.items()}
                medians_by_budget[budget].append(medians)
                rows.append(_row(f"{title}_{name}_{budget}", medians))
                # The whole takes minutes.
                print(f"{rows[-1].name}: {rows[-1].value:.3g} of {rows[-1].against}; {rows[-1].note}", flush=True)
    shares = [_share(f"{title}_{budget}", medians) for budget, medians in medians_by_budget.items()]
    return [_summary(title, rows, max(own_times)), *shares, *rows]


def _summary(title: str, rows: Sequence[Benchmark], own: float) -> Benchmark:
    """The share of good rows; it holds if `auto` is the last in none and takes its time at most."""
    ratios = [row.value for row in rows]
    last = [row.name for row in rows if ", the last" in row.note]
    largest = max(rows, key=lambda row: row.value)
    share = sum(ratio <= GOOD for ratio in ratios) / len(ratios)
    return Benchmark(
        name=title,
        value=share,
        unit="1",
        goal=GOAL,
        better=HIGHER,
        against=f"the best of {', '.join(RIVALS)}",
        holds=share >= GOAL and own <= OWN_TIME and not last,
        note=f"the share of {len(ratios)} rows whose ratio of gaps is at most {GOOD}; the median is "
        f"{np.median(ratios):.2g}, the largest {largest.value:.2g} in {largest.name}; auto is the last in "
        f"{', '.join(last) or 'none'}, and takes {1e3 * own:.2g} ms per point at most, the cost included",
    )


def _share(name: str, rows: Sequence[Mapping[str, float]]) -> Benchmark:
    """Return the share of good rows of `auto`, beside the shares of the others: whether anyone reaches the goal.

    A solver is good in a row by the same rule as `auto`: its gap is at most `GOOD` times the best gap of the others.
    """
    good: dict[str, list[bool]] = {}
    for medians in rows:
        for solver in medians:
            least = max(min(gap for rival, gap in medians.items() if rival not in (solver, AUTO)), SOLVED)
            good.setdefault(solver, []).append(medians[solver] <= GOOD * least)
    ours = good.pop(AUTO)
    best = max(good, key=lambda solver: sum(good[solver]))
    counts = ", ".join(f"{solver} in {sum(held)} of {len(held)}" for solver, held in good.items())
    return Benchmark(
        name=name,
        value=sum(ours) / len(ours),
        unit="1",
        goal=None,
        better=HIGHER,
        against=f"the best single solver, {best}: {sum(good[best]) / len(good[best]):.2g}",
        note=f"auto is good in {sum(ours)} of {len(ours)} rows; by the same rule {counts}",
    )


def _row(name: str, medians: Mapping[str, float]) -> Benchmark:
    """One function and budget."""
    counted = {solver: max(gap, SOLVED) for solver, gap in medians.items()}
    auto = counted.pop(AUTO)
    best = min(counted, key=lambda solver: counted[solver])
    verdict = ", the last" if auto > max(counted.values()) else ""
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
