"""Qualities under several conditions: each risk against its definition, and racing against brute force."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.testbeds import PendulumScenario
from vtbdrake.optimization import CVaR, Mean, Parameter, Problem, Quantile, Worst
from vtbdrake.optimization.judge import Judge
from vtbdrake.optimization.outcome import Outcome
from vtbdrake.rollout import Constraint, Quality

THETA = "sim.sys.Pendulum.theta.position"
DAMPING = "sim.sys.Pendulum.theta.damping"

qualities = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12).map(np.array)
risks = st.one_of(
    st.sampled_from([Mean(), Worst()]),
    st.floats(0.01, 1.0).map(Quantile),
    st.floats(0.01, 1.0).map(CVaR),
)


def cvar_by_definition(h: np.ndarray, level: float) -> float:
    """max over c of c - E[max(c - h, 0)] / level (Rockafellar and Uryasev, 2002); a maximum lies at one of the h."""
    return max(c - np.mean(np.maximum(c - h, 0.0)) / level for c in h)


@given(qualities, st.floats(0.01, 1.0))
def test_cvar_is_the_maximum_of_rockafellar_and_uryasev(h, level):
    assert CVaR(level)(h) == pytest.approx(cvar_by_definition(h, level), abs=1e-9)


@given(qualities, st.floats(0.01, 1.0))
def test_all_but_a_share_reach_the_quantile(h, level):
    value = Quantile(level)(h)
    assert value in h
    assert np.mean(h < value) < level
    assert np.mean(h <= value) >= level - 1e-12


def test_mean_and_worst():
    h = np.array([0.5, 0.25, 1.0])
    assert (Mean()(h), Worst()(h)) == (h.sum() / 3, 0.25)
    assert CVaR(1.0)(h) == Mean()(h)
    assert CVaR(1e-6)(h) == pytest.approx(Worst()(h))


@given(qualities, risks, st.data())
def test_no_risk_falls_when_a_quality_rises(h, risk, data):
    which = data.draw(st.integers(0, h.size - 1))
    higher = h.copy()
    higher[which] += data.draw(st.floats(0.0, 1.0))
    assert risk(higher) >= risk(h) - 1e-12


@pytest.mark.parametrize("make", [lambda: CVaR(0.0), lambda: Quantile(1.5)])
def test_a_level_beyond_its_range_is_refused(make):
    with pytest.raises(ValueError, match=r"lies in \(0, 1\], unlike"):
        make()


# -- racing, on tables of qualities


def problem(conditions: int, risk, *, quality=None, constraints=()):
    """A problem with so many conditions; its rollouts are not run here, a table has their outcomes."""
    return Problem(
        scenario=PendulumScenario(),
        parameters=[Parameter(THETA, 0.0, 1.0)],
        quality=quality or Quality(abs, THETA, upper=1.0),
        horizon=1.0,
        conditions=[{DAMPING: 0.01 * i} for i in range(conditions)],
        risk=risk,
        constraints=constraints,
    )


def outcome(value: float, violation: float | None = None, end: str = "horizon") -> Outcome:
    return Outcome(value, value, () if violation is None else (violation,), 0.0, end, "", 0.0)


def judged(stated: Problem, table: dict, batches, *, racing: bool, budget: float = np.inf):
    """(evaluations by point, rollouts run)."""
    known: dict = {}
    judge = Judge(
        stated, known, lambda rows: known.update({row: table[row] for row in rows}), racing=racing, budget=budget
    )
    evaluations = {e.point: e for batch in batches for e in judge.judge(batch)}
    return evaluations, len(known)


@given(st.integers(0, 10_000), risks, st.booleans(), st.sampled_from([10, 60, np.inf]))
def test_racing_finds_the_winner_of_brute_force_with_no_more_rollouts(seed, risk, minimize, budget):
    rng = np.random.default_rng(seed)
    conditions = int(rng.integers(2, 8))
    stated = STATED[conditions, minimize]
    stated.risk = risk
    points = [(float(p),) for p in rng.permutation(24) / 24.0]
    table = {(p, c): outcome(float(rng.random())) for p in points for c in range(conditions)}
    batches = [points[i : i + 6] for i in range(0, 24, 6)]
    raced, run = judged(stated, table, batches, racing=True, budget=budget)
    brute, all_run = judged(stated, table, batches, racing=False)
    assert all_run == 24 * conditions >= run
    winner = max(brute.values(), key=lambda e: e.values[0])
    best = max((e for e in raced.values() if e.exact), key=lambda e: e.values[0])
    assert best == winner
    assert all(e.values[0] >= brute[p].values[0] - 1e-12 for p, e in raced.items()), "a dropped point has a bound"
    assert all(e.values[0] <= winner.values[0] for e in raced.values() if not e.exact)


STATED = {
    (n, minimize): problem(n, "worst", quality=Quality(abs, THETA, minimize=True) if minimize else None)
    for n in range(2, 8)
    for minimize in (False, True)
}


def test_racing_saves_what_the_worst_condition_tells():
    points = [(i / 16.0,) for i in range(1, 16)]
    # The first is the best; of the others, condition 3 alone says that they are worse.
    table = {(p, c): outcome(0.9 if c != 3 or p == points[0] else 0.1) for p in points for c in range(8)}
    table[points[0], 3] = outcome(0.5)
    _, run = judged(problem(8, "worst"), table, [points[:1], *[[p] * 1 for p in points[1:]]], racing=True)
    assert run == 8 * 15, "alone, a point meets all conditions in one round of eight"
    _, run = judged(problem(8, "worst"), table, [points[:1], points[1:]], racing=True)
    assert run == 8 + 14, "together, each meets the condition in which the best fares worst, and is dropped"


@pytest.mark.parametrize("budget", [4, 10, 23, 40])
def test_racing_finishes_points_within_a_budget_that_is_too_small_for_all(budget):
    class SpentError(Exception):
        pass

    known: dict = {}

    def run(rows):
        known.update({row: outcome(row[0][0]) for row in rows[: budget - len(known)]})
        if len(known) == budget:
            raise SpentError

    judge = Judge(problem(4, "mean"), known, run, racing=True, budget=budget)
    points = [(i / 64.0,) for i in range(1, 41)]
    with pytest.raises(SpentError):
        judge.judge(points)
    assert sum(judge.evaluation(point).exact for point in points) >= 1


def test_a_point_that_breaks_a_constraint_is_dropped():
    stated = problem(4, "mean", constraints=[Constraint(abs, THETA, at_most=1.0)])
    a, b = (0.1,), (0.2,)
    table = {(a, c): outcome(0.2, -1.0) for c in range(4)} | {(b, c): outcome(0.9, c - 0.5) for c in range(4)}
    evaluations, _ = judged(stated, table, [[a], [b]], racing=False)
    assert evaluations[b].violations == (2.5,) and not evaluations[b].feasible
    assert evaluations[a].feasible


def test_one_failed_simulation_leaves_a_point_without_value():
    a = (0.1,)
    table = {(a, 0): outcome(0.2), (a, 1): outcome(np.nan, end="failed"), (a, 2): outcome(0.4)}
    evaluations, _ = judged(problem(3, "mean"), table, [[a]], racing=False)
    assert evaluations[a].failed and not evaluations[a].feasible


def test_equal_points_are_judged_once():
    a = (0.25,)
    runs: list = []
    known: dict = {}

    def run(rows):
        runs.extend(rows)
        known.update({row: outcome(0.5) for row in rows})

    judge = Judge(problem(2, "mean"), known, run)
    first, second = judge.judge([a, a])
    assert first == second and runs == [(a, 0), (a, 1)]
    judge.judge([a])
    assert len(runs) == 2
