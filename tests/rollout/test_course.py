"""Tests of courses: driven rollouts against plain simulations, and computed again."""

from __future__ import annotations

import json
from math import isnan

import numpy as np
import pytest

from tests.testbeds import PendulumScenario
from vtbdrake.rollout import Quality, RolloutRunner, RolloutTask
from vtbdrake.rollout.course import Course, CourseError, DrivenRollout, task_without_problem
from vtbdrake.rollout.named_function import magnitude
from vtbdrake.state import VariableError
from vtbdrake.testbed.switch import Position
from vtbdrake_diagrams.double_pendulum import DoublePendulumScenario

ANGLE = "sim.sys.Pendulum.theta.position"
HELD = PendulumScenario(stiffness=30.0, damping=3.0)
STEP = 0.03125


def task(horizon: float = 1.0, *, threshold: float | None = None) -> RolloutTask:
    return RolloutTask(
        HELD, horizon=horizon, quality=Quality(magnitude, of=ANGLE), threshold=threshold, sample_period=0.1
    )


def driven(stated: RolloutTask, writes: dict[int, dict[str, float]], steps: int) -> DrivenRollout:
    testbed = stated.scenario.build()
    rollout = DrivenRollout(stated, testbed.snapshot(testbed.default_context()), step=STEP, testbed=testbed)
    for step in range(steps):
        rollout.advance(writes.get(step, {}))
    return rollout


def test_driven_rollout_is_a_simulation_with_the_same_writes() -> None:
    rollout = driven(task(), {3: {"u.angle": 0.5}, 20: {"u.angle": -0.2}}, 30)
    testbed = HELD.build()
    context = testbed.default_context()
    simulator = testbed.simulator(context, restored=True)
    simulator.Initialize()
    for k in range(30):
        testbed.write(context, {3: {"u.angle": 0.5}, 20: {"u.angle": -0.2}}.get(k, {}))
        for instant in sorted({(k + 1) * STEP, *(t for t in 0.1 * np.arange(11.0) if k * STEP < t < (k + 1) * STEP)}):
            simulator.AdvanceTo(instant)
    states = [each.get_continuous_state_vector().CopyToVector() for each in (rollout.context, context)]
    assert np.array_equal(*states)
    assert rollout.value == abs(testbed.read(context, ANGLE))
    result = rollout.end()
    assert (result.end, result.message) == ("terminated", "ended by hand")
    assert result.times.tolist() == pytest.approx([0.1 * k for k in range(10)])  # 30 steps are 0.9375 s
    assert result.h == max(result.quality)


def _small(theta: float) -> float:
    if abs(theta) > 0.2:
        raise RuntimeError("too large")
    return abs(theta)


def test_failing_quality_ends_a_driven_rollout() -> None:
    stated = RolloutTask(HELD, horizon=1.0, quality=Quality(_small, of=ANGLE), sample_period=0.1)
    rollout = driven(stated, {}, 3)
    while rollout.result is None and rollout.steps < 30:
        rollout.advance({"u.angle": 1.0})
    assert rollout.result is not None
    assert rollout.result.end == "failed" and isnan(rollout.result.h)
    assert "raises RuntimeError: too large" in rollout.result.message
    assert rollout.course.rollout(stated).identical(rollout.result)


def test_course_without_writes_is_the_rollout_of_the_task() -> None:
    stated = RolloutTask(
        DoublePendulumScenario(),
        horizon=0.5,
        quality=Quality(magnitude, of="sim.sys.pendulum.elbow.position"),
        sample_period=0.1,
    )
    testbed = stated.scenario.build()
    start = testbed.snapshot(testbed.default_context())
    plain = RolloutRunner(stated).run({})
    again = Course(start, 0.05).rollout(stated)
    assert (again.end, again.h, again.t_star) == (plain.end, plain.h, plain.t_star)
    assert np.array_equal(again.quality, plain.quality)


def test_course_is_computed_again_bit_for_bit() -> None:
    rollout = driven(task(), {0: {"u.angle": 0.7}, 9: {"u.angle": 0.1}}, 25)
    ended = rollout.end()
    course = Course.from_dict(json.loads(json.dumps(rollout.course.to_dict())))
    assert course.rollout(task()).identical(ended)
    assert course.rollout(task(), testbed=HELD.build()).identical(ended)
    other = Course(course.start, course.step, ((0, {"u.angle": 0.7000001}), *course.writes[1:]), course.steps)
    assert not other.rollout(task()).identical(ended)


def test_driven_rollout_ends_at_threshold_and_horizon() -> None:
    rollout = driven(task(threshold=0.2), {0: {"u.angle": 0.7}}, 1)
    while rollout.result is None:
        rollout.advance({})
    assert rollout.result.end == "threshold" and rollout.result.value > 0.2
    assert rollout.course.steps is None
    assert rollout.course.rollout(task(threshold=0.2)).identical(rollout.result)
    with pytest.raises(CourseError, match="the driven rollout has ended: threshold"):
        rollout.advance({})
    assert Course(rollout.course.start, STEP).rollout(task(0.3)).end == "horizon"


def test_actuator_is_driven_by_hand() -> None:
    testbed = PendulumScenario().build()
    start = testbed.snapshot(testbed.default_context())
    by_hand = {"T_act.torque": Position.REAL.number, "T_act.torque.idle": 0.4}
    rollout = DrivenRollout(task_without_problem(PendulumScenario()), start, step=STEP, testbed=testbed)
    for k in range(32):
        rollout.advance(by_hand if k == 0 else {})
    other = PendulumScenario(idle=0.4).build()
    context = other.default_context()
    other.switch(context, act="real")
    simulator = other.simulator(context)
    for k in range(32):
        simulator.AdvanceTo((k + 1) * STEP)
    assert testbed.read(rollout.context, ANGLE) == other.read(context, ANGLE) != 0.0


def test_bad_data_and_values_are_refused() -> None:
    rollout = driven(task(), {}, 1)
    with pytest.raises(VariableError, match="must lie in"):
        rollout.advance({"u.angle": 4.0})
    assert rollout.steps == 1 and not rollout.course.writes and not isnan(rollout.value)
    with pytest.raises(CourseError, match="no course"):
        Course.from_dict({"start": "!", "step": 1.0, "steps": 1, "writes": []})
    with pytest.raises(CourseError, match="no course"):
        Course.from_dict({"step": 1.0})
    assert isnan(driven(task_without_problem(HELD), {}, 1).value)
