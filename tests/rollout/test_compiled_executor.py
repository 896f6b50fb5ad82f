"""Rollouts in the compiled testbed: the same outcomes as in Drake."""

from __future__ import annotations

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from math import inf
from operator import itemgetter
from pathlib import Path

import numpy as np
import pytest

from vtbdrake.compiled import UnsupportedTestbedError
from vtbdrake.compiled.tracing import traced
from vtbdrake.components.casadi_system.kernel import TRANSLATIONS
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.optimization import Parameter, Problem
from vtbdrake.reasoning import Belief, BeliefConfig, Budget, Reasoner, SearchConfig
from vtbdrake.rollout import (
    Constraint,
    Cutoff,
    Executor,
    Pruning,
    Quality,
    RolloutResult,
    RolloutTask,
    SerialExecutor,
    ThreadExecutor,
    make_executor,
)
from vtbdrake.rollout.compiled_executor import CompiledExecutor
from vtbdrake.rollout.executor import run_rollouts
from vtbdrake.rollout.executor_choice import COMPILE_FROM
from vtbdrake.rollout.start import Start
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cart_pole.decision import reasoning
from vtbdrake_diagrams.cart_pole.swing_up import make_reasoner
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

SCENARIO = CartPoleScenario()
PLAN, MASS, ANGLE, NOISE = (
    "u.plan",
    "sim.sys.cart_pole.pole.mass",
    "sim.sys.cart_pole.pole_pin.position",
    "sim.sense.joint_position.noise",
)


def height(state: np.ndarray) -> float:
    return 1.0 - np.cos(state[1])


def with_branch(state: np.ndarray) -> float:
    return float(abs(state[1])) if state[0] > -1.0 else 0.0


def points(n: int) -> list[dict]:
    random = np.random.default_rng(0)
    return [{PLAN: np.append(0.0, random.uniform(-60.0, 60.0, 10)), MASS: 0.5 + 0.1 * i} for i in range(n)]


def outcomes(task: RolloutTask, rollouts: list[dict], executor) -> list[RolloutResult]:
    with executor:
        return run_rollouts(executor, task, rollouts, progress=False)


def assert_same(results: list[RolloutResult], expected: list[RolloutResult]) -> None:
    for a, b in zip(results, expected, strict=True):
        assert (a.end, [*a.parameters]) == (b.end, [*b.parameters])
        np.testing.assert_allclose([a.t_star, a.h, a.value], [b.t_star, b.h, b.value], rtol=1e-11)
        np.testing.assert_allclose(a.measures, b.measures, rtol=1e-11)
        np.testing.assert_allclose(a.times, b.times, rtol=0, atol=0)
        np.testing.assert_allclose(a.quality, b.quality, rtol=1e-11, atol=1e-13)
        np.testing.assert_allclose(a.exceedances, b.exceedances)
        for address, values in b.record.items():
            np.testing.assert_allclose(a.record[address], values, rtol=1e-11, atol=1e-11)


QUALITIES = {
    "integral": (Quality(height, "plant.state", reading="integral", minimize=True), None),
    "threshold": (Quality(height, "plant.state"), 0.3),
    "branch": (Quality(with_branch, "plant.state"), 0.4),
    "cost": (Quality(lambda angle: 2.0 - np.sin(angle), ANGLE, minimize=True, reading="end"), None),
}


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", QUALITIES)
@pytest.mark.parametrize("run_on", [False, True])
def test_outcomes_are_those_of_drake(name: str, run_on: bool) -> None:
    quality, threshold = QUALITIES[name]
    task = RolloutTask(
        SCENARIO,
        0.8,
        quality,
        threshold=threshold,
        record=(ANGLE, "dps.force"),
        run_on=run_on,
        measures=(Constraint(lambda f: f[0], "dps.force", at_most=30.0),),
    )
    expected = outcomes(task, points(5), SerialExecutor())
    results = outcomes(task, points(5), CompiledExecutor(compile=False))
    assert_same(results, expected)
    assert {result.computed for result in results} == {"compiled"}
    assert {result.computed for result in expected} == {"drake"}


def test_fields_of_the_scenario_are_compiled_for_themselves() -> None:
    task = RolloutTask(SCENARIO, 0.4, Quality(height, "plant.state"))
    rollouts = [{**point, "scenario.period": period} for point, period in zip(points(4), 2 * [0.02, 0.05], strict=True)]
    assert_same(outcomes(task, rollouts, CompiledExecutor(compile=False)), outcomes(task, rollouts, SerialExecutor()))


def test_no_points_have_no_results() -> None:
    with CompiledExecutor(compile=False) as executor:
        assert list(executor.run(RolloutTask(SCENARIO, 0.4, Quality(height, "plant.state")), [])) == []


def test_a_function_of_what_is_no_number_is_not_compiled() -> None:
    for argument in ("word", object(), [np.zeros(2), np.zeros(3)]):
        assert traced(lambda value: 1.0, [argument]) is None


# CasADi rounds 2.5 to 3, numpy to 2.
@pytest.mark.parametrize("f", [np.round, lambda x: np.rint(x + 0.5)])
def test_a_quality_that_casadi_computes_otherwise_is_not_compiled(f):
    assert traced(f, [3.1]) is None


@pytest.mark.parametrize("f", [lambda x: np.maximum(x[0], 3.0), lambda x: np.clip(x[0], -1.0, 1.0)])
def test_a_quality_of_what_is_not_finite_is_none(f):
    function = traced(f, [np.array([2.0, 5.0])])
    assert float(function([2.0, np.nan])) == f([2.0, np.nan])
    assert np.isnan(float(function([np.nan, 0.0])))


def test_begins_at_starts() -> None:
    testbed = SCENARIO.build()
    context = testbed.default_context()
    testbed.write(context, points(1)[0])
    testbed.simulator(context).AdvanceTo(0.33)
    start = Start.of(testbed, context)
    task = RolloutTask(SCENARIO, 0.5, Quality(height, "plant.state"))
    rollouts = [{PLAN: point[PLAN]} for point in points(3)]
    with SerialExecutor() as serial, CompiledExecutor(compile=False) as compiled:
        expected = [result for _, result in serial.run(task, rollouts, start=start)]
        # The mass of the start differs from s0's, and was not named.
        by_drake = [result for _, result in compiled.run(task, rollouts, start=start)]
        compiled.prepare(task, points(1))
        results = [result for _, result in compiled.run(task, rollouts, start=start)]
    assert_same(by_drake, expected)
    assert {result.computed for result in by_drake} == {"drake"}
    assert_same(results, expected)
    assert {result.computed for result in results} == {"compiled"}


def test_each_thread_gets_the_rollouts_of_its_start() -> None:
    testbed = SCENARIO.build()
    starts = []
    for angle in (0.3, 0.8, 1.3, 1.8):
        context = testbed.default_context()
        testbed.write(context, {ANGLE: angle})
        starts.append(Start.of(testbed, context))
    task = RolloutTask(SCENARIO, 0.1, Quality(lambda angle: angle, ANGLE, reading="end"))
    with SerialExecutor() as serial:
        expected = [next(iter(serial.run(task, [{}], start=start)))[1].h for start in starts]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # s; so that threads take turns in the midst of everything.
    try:
        with CompiledExecutor(testbed, compile=False) as executor, ThreadPoolExecutor(len(starts)) as pool:

            def run_often(start: Start) -> list[float]:
                return [next(iter(executor.run(task, [{}], start=start)))[1].h for _ in range(100)]

            for values, each in zip(pool.map(run_often, starts), expected, strict=True):
                np.testing.assert_allclose(values, each, rtol=1e-11)
    finally:
        sys.setswitchinterval(interval)


def test_what_diverges_is_told_by_drake() -> None:
    task = RolloutTask(SCENARIO, 0.4, Quality(height, "plant.state"))
    rollouts = [*points(2), {PLAN: points(1)[0][PLAN], ANGLE: 1e200}]
    results = outcomes(task, rollouts, CompiledExecutor(compile=False))
    expected = outcomes(task, rollouts, SerialExecutor())
    assert [(result.end, result.message) for result in results] == [(e.end, e.message) for e in expected]
    assert results[0].computed == "compiled"


def test_errors_of_a_quality_are_those_of_drake() -> None:
    task = RolloutTask(SCENARIO, 0.4, Quality(lambda state: 1.0 - state[0] - 100.0, "plant.state"), catch=True)
    results = outcomes(task, points(1), CompiledExecutor(compile=False))
    assert results[0].message == outcomes(task, points(1), SerialExecutor())[0].message
    assert "must be finite" in results[0].message or "not negative" in results[0].message


@pytest.mark.parametrize(
    ("options", "reason"),
    [({"keep_state": True}, "keep_state="), ({"pruning": Pruning()}, "pruning=")],
)
def test_refuses_what_it_cannot_do(options: dict, reason: str) -> None:
    task = RolloutTask(SCENARIO, 0.4, Quality(height, "plant.state"), **options)
    with pytest.raises(ValueError, match=reason):
        outcomes(task, points(1), CompiledExecutor())


def test_refuses_a_world_with_contact() -> None:
    task = RolloutTask(SpaceClimberScenario(), 0.4)
    with pytest.raises(UnsupportedTestbedError, match="the testbed cannot be compiled: "):
        outcomes(task, [{}], CompiledExecutor())


def test_a_deadline_that_has_passed_compiles_and_runs_nothing() -> None:
    task = RolloutTask(SCENARIO, 0.4, Quality(height, "plant.state"))
    with CompiledExecutor(compile=False) as executor:
        assert list(executor.run(task, points(2), cutoff=Cutoff(deadline=-inf))) == []


def test_a_sweep_over_noise_is_the_same() -> None:
    scenario = replace(SCENARIO, position_errors=ErrorModel(seed=3))
    problem = Problem(
        scenario=scenario,
        parameters=[Parameter(NOISE, 0.0, 0.1)],
        quality=Quality(lambda x: x[0] ** 2, "dps.env.discrete_state_0", reading="integral"),
        horizon=0.5,
    )
    expected = problem.sweep(4, executor="serial", progress=False)
    result = problem.sweep(4, executor="compiled", progress=False)
    assert_same(list(result.rollouts), list(expected.rollouts))
    assert {rollout.computed for rollout in result.rollouts} == {"compiled"}


def test_decisions_are_the_same() -> None:
    testbed = SCENARIO.build()
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(0.2)
    decisions = []
    for executor in ("serial", "compiled"):
        with make_reasoner(SCENARIO, rollouts=16, executor=executor) as reasoner:
            decisions.append(reasoner.decide(testbed, context))
    assert decisions[0].chosen == decisions[1].chosen
    assert decisions[0].quality == pytest.approx(decisions[1].quality, rel=1e-11)
    computed = {r.computed for candidate in decisions[1].candidates for r in candidate.rollouts}
    assert computed == {"compiled"}


def test_decisions_of_a_reasoner_on_board_are_the_same() -> None:
    scenario = CartPoleScenario(onboard=True)
    testbed = scenario.build()
    context = testbed.default_context()
    # As the part on board does it at the sample from which it decides.
    testbed.write(context, {"dps.planner.candidate_at": 0.0})
    decisions = []
    for executor in ("serial", "compiled"):
        arguments = reasoning(scenario, "dps.planner.candidate", Budget(rollouts=12), executor=executor)
        with Reasoner(scenario=scenario, **arguments) as reasoner:
            decisions.append(reasoner.decide(testbed, context))
    assert decisions[0].chosen == decisions[1].chosen != 0
    assert decisions[0].quality == pytest.approx(decisions[1].quality, rel=1e-11)
    assert {r.computed for candidate in decisions[1].candidates for r in candidate.rollouts} == {"compiled"}


def test_worlds_drawn_from_a_belief_are_compiled() -> None:
    testbed, decisions = SCENARIO.build(), []
    belief = BeliefConfig(samples=3, uncertainty={MASS: 0.1}, risk="mean")
    for executor in ("serial", "compiled"):
        with make_reasoner(SCENARIO, rollouts=12, executor=executor, belief=belief) as reasoner:
            decisions.append(reasoner.decide(testbed, testbed.default_context()))
    results = [[r for candidate in decision.candidates for r in candidate.rollouts] for decision in decisions]
    assert {result.computed for result in results[1]} == {"compiled"}
    values = [[result.value for result in each] for each in results]
    assert len({*values[0]}) > len(decisions[0].candidates)  # Each world has another mass.
    np.testing.assert_allclose(*values, rtol=1e-11)


def test_warm_reasoner_compiles_nothing_whenever_it_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    translated = []
    monkeypatch.setitem(TRANSLATIONS, None, lambda function: translated.append(function) or function)
    scenario = CartPoleScenario(onboard=True)
    testbed = scenario.build()
    belief = Belief.of(testbed, testbed.default_context())
    arguments = reasoning(scenario, "dps.planner.candidate", Budget(rollouts=4), executor="compiled")
    with Reasoner(scenario=scenario, **arguments) as reasoner:
        reasoner.warm_up()
        compiled = list(translated)
        for time in (0.0, 0.06 - 1e-8, 0.08, 0.0371, 12.34):
            assert reasoner.decide(replace(belief, dps=replace(belief.dps, time=time)))
    assert translated == compiled


def test_auto_compiles_the_mental_testbed() -> None:
    testbed = SCENARIO.build()
    with make_reasoner(SCENARIO, rollouts=4) as reasoner:
        decision = reasoner.decide(testbed, testbed.default_context())
    assert {r.computed for candidate in decision.candidates for r in candidate.rollouts} == {"compiled"}


def test_auto_takes_drake_where_nothing_can_be_compiled(caplog: pytest.LogCaptureFixture) -> None:
    testbed = SCENARIO.build()
    search = SearchConfig(method="random", pruning=Pruning(), workers=1)
    with (
        caplog.at_level("INFO"),
        make_reasoner(SCENARIO, rollouts=4, search=search) as reasoner,
    ):
        decision = reasoner.decide(testbed, testbed.default_context())
    assert {r.computed for candidate in decision.candidates for r in candidate.rollouts} == {"drake"}
    assert "rollouts are simulated in Drake: compiled rollouts cannot do what pruning= asks for" in caplog.text


def test_compiled_is_refused_when_the_reasoner_is_made() -> None:
    search = SearchConfig(method="random", pruning=Pruning(), executor="compiled")
    with pytest.raises(ValueError, match="compiled rollouts cannot do what pruning= asks for"):
        make_reasoner(SCENARIO, rollouts=4, search=search)


def test_a_decision_within_wall_time() -> None:
    testbed = SCENARIO.build()
    context = testbed.default_context()
    with make_reasoner(SCENARIO, executor="compiled", budget=Budget(rollouts=20, seconds=60.0)) as reasoner:
        assert reasoner.decide(testbed, context).health.rollouts == 20


@pytest.mark.slow
def test_studies_and_boundaries_are_the_same() -> None:
    problem = Problem(
        scenario=SCENARIO,
        parameters=[Parameter("u.plan[3]", 0.0, 60.0)],
        quality=Quality(height, "plant.state"),
        horizon=0.6,
        threshold=0.02,
        conditions=[{"sim.sys.cart_pole.pole_pin.velocity": speed} for speed in (0.0, 0.1)],
    )
    studies = {
        executor: problem.study(solver="CEM", seed=1).run(rollouts=24, executor=executor, progress=False)
        for executor in ("serial", "compiled")
    }
    points = [[trial.point for trial in study.trials] for study in studies.values()]
    values = [[trial.values for trial in study.trials] for study in studies.values()]
    np.testing.assert_allclose(points[0], points[1], rtol=1e-9)
    np.testing.assert_allclose(values[0], values[1], rtol=1e-9)
    boundaries = [problem.boundary(resolution=2.0, coarse=20.0, executor=executor) for executor in studies]
    assert str(boundaries[0]) == str(boundaries[1])


def test_a_perfect_belief_is_compiled_unless_the_true_plant_differs(caplog: pytest.LogCaptureFixture) -> None:
    testbed = SCENARIO.build()
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(0.2)
    with (
        make_reasoner(SCENARIO, rollouts=8, executor="compiled") as compiled,
        make_reasoner(SCENARIO, rollouts=8, executor="serial") as serial,
    ):
        for mass, computed in ((1.0, "compiled"), (1.3, "drake")):
            testbed.write(context, {MASS: mass})
            belief = Belief.perfect(testbed, context)
            decision, expected = compiled.decide(belief), serial.decide(belief)
            assert decision.quality == pytest.approx(expected.quality, rel=1e-11)
            assert {r.computed for candidate in decision.candidates for r in candidate.rollouts} == {computed}
            assert (f"{MASS} is 1.3 instead of 1.0" in caplog.text) == (computed == "drake")


def test_at_a_deadline_the_rest_of_the_rollouts_is_left_out() -> None:
    task = RolloutTask(SCENARIO, 0.4, Quality(height, "plant.state"))
    rollouts = points(20) * 1000  # Minutes, without machine code.
    with CompiledExecutor(compile=False) as executor:
        expected = dict(executor.run(task, rollouts[:20]))
        results = dict(executor.run(task, rollouts, cutoff=Cutoff(deadline=time.monotonic() + 0.2)))
    assert len(results) < len(rollouts)
    assert all(result.identical(expected[i % 20]) for i, result in results.items())


def auto(rollouts: int) -> Executor:
    return make_executor("auto", testbed=SCENARIO.build(), rollouts=rollouts, workers=1)


def test_auto_compiles_the_testbed_of_many_rollouts() -> None:
    task = RolloutTask(SCENARIO, 0.4, Quality(height, "plant.state"))
    few, many = (outcomes(task, points(3), auto(rollouts)) for rollouts in (COMPILE_FROM - 1, COMPILE_FROM))
    assert {result.computed for result in few} == {"drake"} != {result.computed for result in many} == {"compiled"}
    assert_same(many, few)


@pytest.mark.parametrize(
    ("options", "point", "reason"),
    [
        ({}, {"scenario.period": 0.02}, "each value of scenario.period would be compiled anew"),
        ({"pruning": Pruning()}, {}, "compiled rollouts cannot do what pruning= asks for"),
    ],
)
def test_auto_tells_once_why_nothing_is_compiled(
    options: dict, point: dict, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    task = replace(RolloutTask(SCENARIO, 0.1, Quality(height, "plant.state")), **options)
    with caplog.at_level("INFO"), auto(COMPILE_FROM) as executor:
        results = [result for _ in range(2) for _, result in executor.run(task, [point, point])]
    assert [result.computed for result in results] == 4 * ["drake"]
    assert caplog.text.count("rollouts are simulated in Drake: ") == 1 and reason in caplog.text


@pytest.mark.parametrize(
    ("compiler", "cache", "reason"),
    [("no-compiler", "cache", "no-compiler"), ("cc", "file", "name another folder in the environment variable XDG_")],
)
def test_auto_takes_drake_if_no_machine_code_can_be_made(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    compiler: str,
    cache: str,
    reason: str,
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("CC", compiler)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / cache))
    task = RolloutTask(SCENARIO, 0.1, Quality(height, "plant.state"))
    with caplog.at_level("INFO"):
        results = outcomes(task, points(2), auto(COMPILE_FROM))
    assert [result.computed for result in results] == 2 * ["drake"]
    assert "rollouts are simulated in Drake: " in caplog.text and reason in caplog.text


def test_what_is_not_compiled_runs_in_the_executor_that_is_given() -> None:
    testbed = SCENARIO.build()
    heavy, usual = testbed.default_context(), testbed.default_context()
    testbed.write(heavy, {MASS: 1.3})
    starts = [Start.of(testbed, context) for context in (heavy, usual, heavy, usual)]
    task = RolloutTask(SCENARIO, 0.4, Quality(height, "plant.state"))
    rollouts = [{PLAN: point[PLAN]} for point in points(4)]
    with SerialExecutor() as serial, CompiledExecutor(compile=False, drake=ThreadExecutor(2)) as compiled:
        expected = [result for _, result in serial.run(task, rollouts, start=starts)]
        results = [result for _, result in sorted(compiled.run(task, rollouts, start=starts), key=itemgetter(0))]
    assert_same(results, expected)
    assert [result.computed for result in results] == 2 * ["drake", "compiled"]


def test_more_rollouts_than_one_call_makes() -> None:
    task = RolloutTask(SCENARIO, 0.05, Quality(height, "plant.state"))
    rollouts = points(50)
    with CompiledExecutor(compile=False) as executor:
        expected = dict(executor.run(task, rollouts))
        results = dict(executor.run(task, rollouts * 50))
    assert len(results) == 2500
    assert all(result.identical(expected[i % 50]) for i, result in results.items())
