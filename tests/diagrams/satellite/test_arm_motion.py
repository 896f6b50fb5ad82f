"""The arm's motion in the full testbed, and the decision on board about it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vtbdrake.compiled import UnsupportedTestbedError
from vtbdrake.rollout import RolloutTask, SerialExecutor
from vtbdrake.rollout.compiled_executor import CompiledExecutor
from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.satellite.plant import plant_config
from vtbdrake_diagrams.satellite.studies.arm_motion import BASE, DEVIATION, PLAN, ArmMotionScenario, deviation, limits
from vtbdrake_diagrams.satellite.studies.trajectory import (
    Comparison,
    Course,
    Outcome,
    Pair,
    Survey,
    TrajectoryAnswer,
    compare_pair,
    kept_comparisons,
    plot,
    random_pairs,
    random_scenarios,
    search_problem,
    simulate,
    verdicts,
)


def bent(scenario: ArmMotionScenario) -> np.ndarray:
    knots = scenario.move().straight.copy()
    knots[2:-2] += 0.2 * np.random.default_rng(0).standard_normal(knots[2:-2].shape)
    return knots


@pytest.mark.slow
def test_full_testbed_tends_to_the_momentum_model():
    """The difference comes from the plant's time step: half of it with half of the step."""
    errors = []
    for step in (0.01, 0.005):
        config = plant_config()
        config.time_step = step
        scenario = ArmMotionScenario(thinking_time=0.2, plant_config=config)
        knots = bent(scenario)
        errors.append(simulate(scenario, knots).outcome.end - scenario.move().motion(knots).angle[-1])
    assert abs(errors[0]) < np.radians(0.05)
    assert errors[1] / errors[0] == pytest.approx(0.5, abs=0.1)


@pytest.mark.slow
def test_mental_testbed_has_no_forces_and_the_same_addresses():
    scenario = ArmMotionScenario(thinking_time=0.2).mental()
    testbed = scenario.build()
    simulator = testbed.simulator()
    context = simulator.get_mutable_context()
    knots = bent(scenario)
    testbed.write(context, {PLAN: scenario.plan(knots)})
    simulator.AdvanceTo(scenario.horizon)
    expected = scenario.move().motion(knots).angle[-1]
    assert deviation(testbed.read(context, BASE)) == pytest.approx(expected, abs=1e-5)
    joints = [testbed.read(context, f"sim.sys.servicer.joint_{k}.position") for k in range(1, 8)]
    np.testing.assert_allclose(joints, scenario.goal, atol=1e-12)


@pytest.mark.slow
def test_mental_testbed_is_compiled_to_the_same_outcomes():
    scenario = ArmMotionScenario(thinking_time=0.2).mental()
    task = RolloutTask(scenario, scenario.horizon, DEVIATION, measures=tuple(limits(scenario, PLAN)))
    straight, bends = scenario.move().straight, bent(scenario) - scenario.move().straight
    points = [{PLAN: scenario.plan(straight + share * bends)} for share in (0.0, 0.5, 1.0)]
    with SerialExecutor() as serial, CompiledExecutor(compile=False) as compiled:
        expected, results = ([result for _, result in executor.run(task, points)] for executor in (serial, compiled))
    assert {result.computed for result in results} == {"compiled"}
    np.testing.assert_allclose([r.h for r in results], [r.h for r in expected], rtol=1e-9)
    np.testing.assert_allclose([r.measures for r in results], [r.measures for r in expected], rtol=1e-9, atol=1e-12)
    assert np.ptp([result.h for result in results]) > 1e-4


def test_fingers_that_can_touch_are_not_compiled():
    with pytest.raises(UnsupportedTestbedError, match="contact of .*finger_left .*and .*finger_right"):
        ArmMotionScenario(thinking_time=0.2).build().compiled(horizon=1.0, compile=False)


@pytest.mark.slow
@pytest.mark.one_python
def test_the_decision_on_board_turns_the_base_ten_times_less():
    straight, best = (simulate(ArmMotionScenario(onboard=onboard)) for onboard in (False, True))
    comparison = Comparison(straight.outcome, best.outcome)
    assert comparison.factor > 10.0
    assert comparison.within_limits
    assert np.all(best.deviations[best.times < 10.0] < 1e-9)  # It thinks for 10 s.
    assert plot({"straight": straight, "best": best}).axes[0].get_lines()


def test_a_plan_beyond_a_limit_violates_a_constraint():
    scenario = ArmMotionScenario(thinking_time=0.2)
    _, excess = limits(scenario, PLAN)
    knots = scenario.move().straight.copy()
    assert excess([scenario.plan(knots)], time=0.0) == 0.0
    knots[3:5, 0] = -2.0, 2.0
    expected = scenario.move().excess(knots)["rate"]
    assert excess([scenario.plan(knots)], time=0.0) == pytest.approx(expected)


@pytest.mark.slow
def test_search_in_the_full_testbed_starts_from_the_straight_path():
    scenario = ArmMotionScenario(thinking_time=0.2)
    problem = search_problem(scenario)
    straight = scenario.move().straight[2:-2].ravel()
    result = problem.rollout({p.address: value for p, value in zip(problem.parameters, straight, strict=True)})
    assert result.value == pytest.approx(simulate(scenario).outcome.end, abs=1e-9)
    assert max(result.measures) <= 0.0
    assert problem.objectives[0] is DEVIATION


def test_an_arm_whose_straight_path_is_blocked_stays():
    scenario = ArmMotionScenario(
        start=[-1.6, -1.2, 0.4, 2.1, -0.8, 0.4, 1.5], goal=[1.6, -0.2, 0.7, 2.2, 1.5, -1.0, 1.9], thinking_time=0.2
    )
    assert "clearance" in scenario.move().excess(scenario.move().straight)
    (plan,) = scenario.interface().commands
    np.testing.assert_array_equal(np.reshape(plan.default[1:], (scenario.knots, 7)), [scenario.start] * scenario.knots)
    clear = ArmMotionScenario(thinking_time=0.2)
    np.testing.assert_array_equal(clear.initial_plan(), clear.plan(clear.move().straight))


def test_random_motions_repeat_and_keep_the_limits():
    first, second = (random_scenarios(2, seed=5) for _ in range(2))
    assert first == second
    assert not any(scenario.move().excess(scenario.move().straight) for scenario in first)


@pytest.fixture(scope="module")
def course() -> Course:
    """The straight path, at every fiftieth instant."""
    found = simulate(ArmMotionScenario(thinking_time=0.2))
    series = {name: getattr(found, name)[::50] for name in ("times", "deviations", "positions")}
    return replace(found, **series)


@pytest.fixture(scope="module")
def outcome(course: Course) -> Outcome:
    return course.outcome


def turned_less(outcome: Outcome, factor: float) -> Outcome:
    """Return an outcome whose deviations are smaller by a factor."""
    smaller = {name: getattr(outcome, name) / factor for name in ("end", "largest", "integral")}
    return replace(outcome, **smaller)


def test_a_comparison_tells_what_exceeds_a_limit(outcome):
    assert Comparison(outcome, outcome).within_limits
    half = turned_less(outcome, 2.0)
    assert not Comparison(half, outcome).within_limits
    assert Comparison(outcome, half).factor == pytest.approx(2.0)


@pytest.mark.parametrize("change", [{"rate": 1.2}, {"torque": 1.2}, {"miss": 0.01}, {"clearance": 0.005}])
def test_each_limit_of_a_plan_counts(change, outcome):
    assert not Comparison(outcome, replace(outcome, **change)).within_limits


def test_a_motion_through_the_panel_is_not_within_the_limits(course):
    positions = course.positions.copy()
    positions[10] = 2.2, 1.0, 2.8, 1.8, 0.9, 0.1, -2.4
    colliding = replace(course, positions=positions).outcome
    assert course.outcome.clearance > 0.02
    assert colliding.clearance < 0.0
    assert "panel" in colliding.nearest
    assert not Comparison(course.outcome, colliding).within_limits


def test_outcome_reads_the_course(course):
    short = replace(
        course,
        times=np.array([0.0, 1.0, 3.0]),
        deviations=np.array([0.0, 0.4, 0.2]),
        rates=np.array([0.1, 0.5]),
        torques=np.array([0.7, 0.2]),
        goal=course.positions[-1] + [0.0, 0.0, -0.03, 0.0, 0.0, 0.0, 0.02],
    ).outcome
    assert (short.end, short.largest, short.rate, short.torque) == (0.2, 0.4, 0.5, 0.7)
    assert short.integral == pytest.approx(0.8)
    assert short.miss == pytest.approx(0.03)


@pytest.mark.parametrize(
    ("factors", "holds"),
    [
        ([30.0] * 20, True),
        ([30.0] * 15 + [5.0] * 5, True),
        # Eleven of 20 may be chance.
        ([30.0] * 11 + [5.0] * 9, False),
        ([5.0] * 20, False),
    ],
)
def test_the_answer_can_be_no(factors, holds, outcome):
    comparisons = [Comparison(outcome, turned_less(outcome, factor)) for factor in factors]
    survey = Survey(tuple(comparisons))
    assert survey.holds == holds
    assert survey.median == pytest.approx(np.median(factors))
    assert survey.successes == sum(factor > 10.0 for factor in factors)
    assert f"{survey.successes} reach 10" in str(survey)
    # One plan beyond a limit is enough.
    fast = replace(comparisons[0].best, rate=1.2)
    assert not Survey((*comparisons[1:], Comparison(outcome, fast))).holds


@pytest.mark.parametrize(
    ("reaching", "anywhere", "onboard", "holds"),
    [
        (30.0, 8.0, 20.0, True),
        (8.0, 30.0, 20.0, False),
        (30.0, 0.9, 20.0, False),
        (30.0, 8.0, 9.0, False),
    ],
)
def test_each_kind_of_motion_has_a_verdict(reaching, anywhere, onboard, holds, outcome):
    def turned(factor):
        # A worse plan has to be judged by its end alone.
        return Comparison(outcome, replace(outcome, end=outcome.end / factor))

    factors = reaching, anywhere
    pairs = {Pair(k, (), ()): turned(factors[k % 2]) for k in range(40)}
    answer = TrajectoryAnswer.of(pairs, turned(onboard))
    assert answer.holds == holds
    shown = "a factor of 10 holds" if anywhere > 10.0 else "a factor of 10 is NOT shown"
    assert f"From any pose to any ({shown})" in verdicts(answer.reaching, answer.anywhere)
    fast = Comparison(outcome, replace(outcome, rate=1.2))
    assert not replace(answer, onboard=fast).holds
    assert not replace(answer, anywhere=Survey((*answer.anywhere.comparisons, fast))).holds


def test_largest_deviation_and_integral_are_ratios_to_the_straight_path(outcome):
    survey = Survey((Comparison(outcome, turned_less(outcome, 2.0)),) * 3)
    assert survey.disturbance == pytest.approx({"largest": 0.5, "integral": 0.5})


def test_comparisons_agree_within_a_twentieth_or_a_hundredth_of_a_degree(outcome):
    comparison = Comparison(outcome, turned_less(outcome, 50.0))
    worse = replace(comparison.best, end=comparison.best.end + 1e-4)
    assert comparison.agrees(replace(comparison, best=worse))
    assert not comparison.agrees(replace(comparison, best=turned_less(outcome, 30.0)))
    assert not comparison.agrees(replace(comparison, straight=turned_less(outcome, 1.1)))
    assert not comparison.agrees(replace(comparison, best=replace(comparison.best, rate=1.2)))


def test_kept_pairs_are_the_first_random_ones():
    kept = kept_comparisons()
    assert len(kept) >= 100
    assert random_pairs(3) == list(kept)[:3]
    assert [pair.number for pair in kept] == list(range(len(kept)))


@pytest.mark.slow
def test_kept_pair_comes_out_again():
    pair, comparison = next(iter(kept_comparisons().items()))
    assert comparison.agrees(compare_pair(pair))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"start": (0.0,) * 6}, "7 positions within"),
        ({"goal": (0.0, 0.0, 0.0, 9.0, 0.0, 0.0, 0.0)}, "7 positions within"),
        ({"thinking_time": 0.0}, "more than 0.1 s"),
        ({"knots": 4}, "more than 4 knots"),
    ],
)
def test_impossible_motions_are_refused(fields, message):
    with pytest.raises(ScenarioError, match=message):
        ArmMotionScenario(**fields).build()
