"""Racing: what it leaves out never changes the best point, for every problem, risk and solver."""

import functools
import importlib.util
import itertools
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.optimization.studies import DAMPING, THETA, StatedExecutor
from tests.testbeds import PendulumScenario
from vtbdrake.optimization import CVaR, Mean, Outcome, Parameter, Problem, Quantile, Risk, Worst
from vtbdrake.optimization.evaluator import Evaluator
from vtbdrake.optimization.solvers import CATALOGUE
from vtbdrake.optimization.solvers.blocking import BlockingSolver
from vtbdrake.rollout import Constraint, Quality

pytestmark = pytest.mark.one_python

risks = st.one_of(
    st.sampled_from([Mean(), Worst()]),
    st.floats(0.01, 1.0).map(Quantile),
    st.floats(0.01, 1.0).map(CVaR),
)

QUALITIES = {
    "maximized": Quality(abs, THETA),
    "maximized up to 1": Quality(abs, THETA, upper=1.0),
    "an integral up to 1": Quality(abs, THETA, upper=1.0, reading="integral"),
    "minimized": Quality(abs, THETA, minimize=True),
}


class Weighted(Risk):
    """A mean in which some conditions count for nothing: what is infinite there becomes NaN."""

    def __call__(self, h: np.ndarray) -> float:
        return float(h @ (np.arange(h.size) % 2)) / h.size


def problem(conditions: int, risk, *, quality=QUALITIES["maximized up to 1"], constraints=()):
    """A problem with a number of conditions, whose rollouts are not run here: their outcomes are stated."""
    return Problem(
        scenario=PendulumScenario(),
        parameters=[Parameter(THETA, 0.0, 1.0)],
        quality=quality,
        horizon=1.0,
        conditions=[{DAMPING: 0.01 * i} for i in range(conditions)],
        risk=risk,
        constraints=constraints,
    )


LIMIT = Constraint(abs, THETA, at_most=1.0)
KINDS = list(itertools.product((2, 4, 7), QUALITIES, (False, True)))


@functools.cache
def stated_problem(conditions: int, quality: str, constrained: bool) -> Problem:
    return problem(conditions, "worst", quality=QUALITIES[quality], constraints=[LIMIT] * constrained)


def outcome(value: float, violation: float | None = None, end: str = "horizon") -> Outcome:
    return Outcome(value, value, () if violation is None else (violation,), 0.0, end, "", 0.0)


def evaluated(stated: Problem, table: dict, batches, *, racing: bool, budget: float = np.inf):
    """(evaluations by point, rollouts run)."""
    known: dict = {}
    evaluator = Evaluator(
        stated, known, lambda rows: known.update({row: table[row] for row in rows}), racing=racing, budget=budget
    )
    evaluations = {e.point: e for batch in batches for e in evaluator.evaluate(batch)}
    assert sum(e.effort for e in evaluations.values()) * len(stated.conditions) == pytest.approx(len(known))
    return evaluations, len(known)


def by_definition(risk: Risk, h: np.ndarray) -> float:
    """The risk of all conditions, from its definition."""
    match risk:
        case Mean():
            return sum(h) / len(h)
        case Worst():
            return min(h)
        case Quantile(level):
            return min(x for x in h if np.mean(h <= x) >= level - 1e-12)
        case CVaR(level):
            return max(c - np.mean(np.maximum(c - h, 0.0)) / level for c in h)
        case _:
            return sum(h[1::2]) / len(h)


@given(
    st.integers(0, 10_000),
    st.one_of(risks, st.just(Weighted())),
    st.sampled_from(KINDS),
    st.sampled_from([0.0, 0.05, 0.9]),
    st.sampled_from([10, 60, np.inf]),
)
def test_racing_finds_the_winner_of_brute_force_with_no_more_rollouts(seed, risk, kind, failing, budget):
    rng = np.random.default_rng(seed)
    stated, conditions, sign = stated_problem(*kind), kind[0], -1.0 if kind[1] == "minimized" else 1.0
    stated.risk = risk
    points = [(float(p),) for p in rng.permutation(24) / 24.0]

    def one():
        if rng.random() < failing:
            return outcome(np.nan, np.nan if kind[2] else None, end="failed")
        return outcome(float(rng.random()), rng.uniform(-3.0, 1.0) if kind[2] else None)

    table = {(p, c): one() for p in points for c in range(conditions)}
    raced, run = evaluated(stated, table, [points[i : i + 6] for i in range(0, 24, 6)], racing=True, budget=budget)
    assert run <= len(table)
    truth = {}
    for point in points:
        rows = [table[point, c] for c in range(conditions)]
        if all(o.end != "failed" and all(v <= 0.0 for v in o.measures) for o in rows):
            truth[point] = by_definition(risk, sign * np.array([o.value for o in rows]))
    best = max((e for e in raced.values() if e.counts), key=lambda e: e.values[0], default=None)
    assert (best is None) == (not truth)
    for point, evaluation in raced.items():
        if evaluation.counts:
            assert evaluation.values[0] == pytest.approx(truth[point])
        if point in truth:
            assert not evaluation.failed
            assert evaluation.values[0] >= truth[point] - 1e-12, "what is dropped is bounded from above"
            assert best.values[0] >= truth[point] - 1e-12


BATCH_SOLVERS = [
    name
    for name, kind in CATALOGUE.items()
    if (name != "GP" or importlib.util.find_spec("torch"))
    and name != "QMC"
    and (name == "differential-evolution" or not issubclass(kind, BlockingSolver))
]

SLOW = {"auto", "bayesian", "GP"}


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("solver", "kind"),
    [
        pytest.param(solver, kind, marks=[pytest.mark.slow] if solver in SLOW else [])
        for solver in [*BATCH_SOLVERS, "LN_COBYLA", "SNOPT"]
        for kind in QUALITIES
        # Those that fit a Gaussian process take seconds.
        if solver not in SLOW or kind == "maximized"
    ],
)
def test_racing_keeps_the_best_point(solver, kind):
    rng = np.random.default_rng([len(solver), len(kind)])
    risk = [Mean(), Worst(), Quantile(0.5), CVaR(0.5)][rng.integers(4)]
    centers = rng.uniform(0.2, 0.8, 4)

    def f(values):
        x, c = values[THETA], round(values[DAMPING] / 0.01)
        return None if x > 0.9 and c == 1 else (1.0 / (1.0 + 20.0 * abs(x - centers[c])), (x - 0.7 + 0.05 * c,))

    stated = problem(4, risk, quality=QUALITIES[kind], constraints=[LIMIT])
    study = stated.study(solver=solver, seed=3).run(rollouts=160, executor=StatedExecutor(f), progress=False)
    sign = -1.0 if kind == "minimized" else 1.0
    truth = {}
    for trial in study.trials:
        rows = [f({THETA: trial.parameters[THETA], DAMPING: 0.01 * c}) for c in range(4)]
        if all(row is not None and row[1][0] <= 0.0 for row in rows):
            truth[trial.number] = by_definition(risk, sign * np.array([h for h, _ in rows]))
    assert len(study) <= 160
    assert sign * study.best.value == pytest.approx(max(truth.values()))


def test_a_solver_may_ask_for_more_points_where_racing_drops_some():
    # Every point but those next to 0.5 fails in the first condition, which the best point fares worst in.
    def f(values):
        return values[DAMPING] + max(0.0, 1.0 - abs(values[THETA] - 0.5)), ()

    stated = problem(4, "worst", quality=QUALITIES["maximized"])
    raced, full = (
        stated.study(solver=solver).run(rollouts=400, racing=racing, executor=StatedExecutor(f), progress=False)
        for solver, racing in (("sobol", True), ("sobol", False))
    )
    assert len(full.trials) == 100 and len(raced.trials) > 200
    assert 396 < len(raced) <= 400, "what was not taken is not left"


@pytest.mark.parametrize(
    ("solver", "rollouts", "run", "reason"), [("CMA-ES", 40, 37, "budget"), ("sobol", 42, 41, "solver")]
)
def test_a_rest_smaller_than_a_point_is_left_and_named(solver, rollouts, run, reason):
    def f(values):
        return values[DAMPING] + max(0.0, 1.0 - abs(values[THETA] - 0.5)), ()

    study = problem(4, "worst", quality=QUALITIES["maximized"]).study(solver=solver)
    study.run(rollouts=rollouts, executor=StatedExecutor(f), progress=False)
    assert (len(study), study.reason) == (run, reason)
    spent = f"the budget of {rollouts} rollouts is spent but for {rollouts - run}, fewer than the 4 that a point takes"
    assert study.message.endswith(spent)


@pytest.mark.slow
def test_auto_comes_to_its_local_search_under_racing():
    def f(values):
        return 1.0 / (1.0 + (values[THETA] - 0.321) ** 2 + values[DAMPING]), ()

    study = problem(4, "mean", quality=QUALITIES["maximized up to 1"]).study()
    study.run(rollouts=400, executor=StatedExecutor(f), progress=False)
    assert any("COBYQA" in trial.method for trial in study.trials)
    assert 396 < len(study) <= 400, "all is spent but what is less than a point under all conditions"


def test_racing_saves_what_the_worst_condition_tells():
    points = [(i / 16.0,) for i in range(1, 16)]
    # The first is the best; of the others, condition 3 alone says that they are worse.
    table = {(p, c): outcome(0.9 if c != 3 or p == points[0] else 0.1) for p in points for c in range(8)}
    table[points[0], 3] = outcome(0.5)
    _, run = evaluated(problem(8, "worst"), table, [points[:1], *[[p] * 1 for p in points[1:]]], racing=True)
    assert run == 8 * 15, "alone, a point meets all conditions in one round of eight"
    _, run = evaluated(problem(8, "worst"), table, [points[:1], points[1:]], racing=True)
    assert run == 8 + 14, "together, each meets the condition in which the best fares worst, and is dropped"


@pytest.mark.parametrize("budget", [4, 10, 23, 40])
def test_racing_finishes_points_within_a_small_budget(budget):
    class SpentError(Exception):
        pass

    known: dict = {}

    def run(rows):
        known.update({row: outcome(row[0][0]) for row in rows[: budget - len(known)]})
        if len(known) == budget:
            raise SpentError

    evaluator = Evaluator(problem(4, "mean"), known, run, racing=True, budget=budget)
    points = [(i / 64.0,) for i in range(1, 41)]
    with pytest.raises(SpentError):
        evaluator.evaluate(points)
    assert sum(evaluator.evaluation(point).exact for point in points) >= 1


def test_a_point_that_breaks_a_constraint_is_dropped():
    stated = problem(4, "mean", constraints=[Constraint(abs, THETA, at_most=1.0)])
    a, b = (0.1,), (0.2,)
    table = {(a, c): outcome(0.2, -1.0) for c in range(4)} | {(b, c): outcome(0.9, c - 0.5) for c in range(4)}
    evaluations, _ = evaluated(stated, table, [[a], [b]], racing=False)
    assert evaluations[b].violations == (2.5,) and not evaluations[b].feasible
    assert evaluations[a].feasible


def test_one_failed_simulation_leaves_a_point_without_value():
    a = (0.1,)
    table = {(a, 0): outcome(0.2), (a, 1): outcome(np.nan, end="failed"), (a, 2): outcome(0.4)}
    evaluations, _ = evaluated(problem(3, "mean"), table, [[a]], racing=False)
    assert evaluations[a].failed and not evaluations[a].feasible


def test_racing_drops_failed_points_before_there_is_a_best_one():
    points = [(0.1,), (0.2,)]
    table = {(a, c): outcome(0.2) if c else outcome(np.nan, end="failed") for a in points for c in range(40)}
    evaluations, rollouts = evaluated(problem(40, "worst"), table, [points], racing=True)
    assert all(evaluations[a].failed for a in points) and rollouts < 20


def test_equal_points_are_evaluated_once():
    a = (0.25,)
    runs: list = []
    known: dict = {}

    def run(rows):
        runs.extend(rows)
        known.update({row: outcome(0.5) for row in rows})

    evaluator = Evaluator(problem(2, "mean"), known, run)
    first, second = evaluator.evaluate([a, a])
    assert first.values == second.values and (first.effort, second.effort) == (1.0, 0.0)
    assert runs == [(a, 0), (a, 1)]
    evaluator.evaluate([a])
    assert len(runs) == 2


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 8))])
def test_random_operations_leave_a_study_whole(tmp_path, seed):
    chance, rollouts, by_hand = random.Random(seed), 0, []
    kind = chance.choice(list(QUALITIES))
    solver = chance.choice(["sobol", "CMA-ES", "TPE", "LN_COBYLA", "differential-evolution", "latin-hypercube"])

    def f(values):
        x, c = values[THETA], round(values[DAMPING] / 0.01)
        return None if x > 0.9 and c == 2 else (1.0 / (1.0 + abs(x - 0.4 - 0.05 * c)), (x - 0.7,))

    def mean(trial):
        """The mean of all conditions; None if a rollout fails or breaks the constraint."""
        rows = [f({**trial.parameters, DAMPING: 0.01 * c}) for c in range(4)]
        whole = all(row is not None and row[1][0] <= 0.0 for row in rows)
        return sum(h for h, _ in rows) / 4.0 if whole else None

    for _ in range(4):
        rollouts += chance.randrange(1, 60)
        stated = problem(4, "mean", quality=QUALITIES[kind], constraints=[LIMIT])
        with stated.study(tmp_path / "a.db", solver=solver) as study:
            given = [chance.random() for _ in range(chance.choice([0, 0, 1, 3]))]
            study.add(*([x] for x in given))
            by_hand += given
            left = [chance.choice([5, 17, 10_000])]

            def interrupted(values, left=left):
                left[0] -= 1
                if left[0] == 0:
                    raise KeyboardInterrupt
                return f(values)

            racing = chance.choice([None, None, True, False])
            study.run(rollouts=rollouts, racing=racing, executor=StatedExecutor(interrupted), progress=False)
            study.run(rollouts=rollouts, executor=StatedExecutor(f), progress=False)
            trials = study.trials
            assert len(study) <= rollouts
            assert len({(*t.parameters.values(), t.exact) for t in trials}) == len(trials)
            truth = {t.number: h for t in trials if (h := mean(t)) is not None}
            assert all(t.value == pytest.approx(truth[t.number]) for t in trials if t.counts)
            if truth:
                best = min(truth.values()) if kind == "minimized" else max(truth.values())
                assert study.best.value == pytest.approx(best)
            count = len(study)
    assert count == rollouts or set(by_hand) <= {t.parameters[THETA] for t in trials}
