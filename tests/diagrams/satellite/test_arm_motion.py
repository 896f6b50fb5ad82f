"""The arm's motion in the full testbed, and the decision on board about it."""

from __future__ import annotations

import numpy as np
import pytest

from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.satellite.arm_motion import BASE, DEVIATION, PLAN, ArmMotionScenario, deviation, limits
from vtbdrake_diagrams.satellite.plant import plant_config
from vtbdrake_diagrams.satellite.trajectory import Comparison, compare, plot, random_scenarios, search_problem, simulate


def bent(scenario: ArmMotionScenario) -> np.ndarray:
    knots = scenario.move().straight.copy()
    knots[2:-2] += 0.2 * np.random.default_rng(0).standard_normal(knots[2:-2].shape)
    return knots


def test_full_testbed_tends_to_the_momentum_model():
    """The difference is that of the plant's time step: half of it with half of the step."""
    errors = []
    for step in (0.01, 0.005):
        config = plant_config()
        config.time_step = step
        scenario = ArmMotionScenario(thinking_time=0.2, plant_config=config)
        knots = bent(scenario)
        errors.append(simulate(scenario, knots).end - scenario.move().motion(knots).angle[-1])
    assert abs(errors[0]) < np.radians(0.05)
    assert errors[1] / errors[0] == pytest.approx(0.5, abs=0.1)


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


@pytest.mark.one_python
def test_the_decision_on_board_turns_the_base_ten_times_less():
    comparison = compare(ArmMotionScenario(onboard=True))
    assert comparison.ratio > 10.0
    assert comparison.within_limits
    assert np.all(comparison.best.deviations[:100] < 1e-9)  # It thinks for 10 s.
    assert plot({"straight": comparison.straight, "best": comparison.best}).axes[0].get_lines()


def test_a_plan_beyond_a_limit_violates_a_constraint():
    scenario = ArmMotionScenario(thinking_time=0.2)
    _, excess = limits(scenario, PLAN)
    knots = scenario.move().straight.copy()
    assert excess([scenario.plan(knots)], time=0.0) == 0.0
    knots[3:5, 0] = -2.0, 2.0
    expected = scenario.move().excess(knots)["rate"]
    assert excess([scenario.plan(knots)], time=0.0) == pytest.approx(expected)


def test_search_in_the_full_testbed_starts_from_the_straight_path():
    scenario = ArmMotionScenario(thinking_time=0.2)
    problem = search_problem(scenario)
    straight = scenario.move().straight[2:-2].ravel()
    result = problem.rollout({p.address: value for p, value in zip(problem.parameters, straight, strict=True)})
    assert result.value == pytest.approx(simulate(scenario).end, abs=1e-9)
    assert max(result.measures) <= 0.0
    assert problem.objectives[0] is DEVIATION


def test_random_motions_repeat_and_keep_the_limits():
    first, second = (random_scenarios(2, seed=5) for _ in range(2))
    assert first == second
    assert not any(scenario.move().excess(scenario.move().straight) for scenario in first)


def test_a_comparison_tells_what_exceeds_a_limit():
    course = simulate(ArmMotionScenario(thinking_time=0.2))
    assert Comparison(course, course).within_limits
    half = type(course)(course.times, 0.5 * course.deviations, course.rates, course.torques, course.miss)
    assert not Comparison(half, course).within_limits
    assert Comparison(course, half).ratio == pytest.approx(2.0)


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
