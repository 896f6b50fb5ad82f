"""A rollout starts from s0 and nothing else, ends where the plant does, and its result is compared as a whole."""

from dataclasses import replace

import numpy as np
import pytest

from tests.rollout.test_runner import SelfWilledScenario
from tests.testbeds import AcrobotScenario
from vtbdrake.rollout import Quality, RolloutResult, RolloutRunner, RolloutTask
from vtbdrake.state import Snapshot

SHOULDER = "sim.sys.Acrobot.shoulder.position"
VELOCITY = "sim.sys.Acrobot.shoulder.velocity"
FRICTION = "sim.sys.Acrobot.lower_link.friction"


def test_initialization_events_do_not_touch_a_restored_s0():
    scenario = SelfWilledScenario()
    task = RolloutTask(scenario, 0.1, record=("dps.torque",))
    fresh = RolloutRunner(task)
    assert fresh.run({}).record["dps.torque"][0] == 7.0
    start = fresh.state({SHOULDER: 0.3}, 0.05)
    assert start["dps.torque"] != 7.0
    result = RolloutRunner(replace(task, start=start)).run({})
    assert result.record["dps.torque"][0] == start["dps.torque"]


def test_what_is_set_in_a_restored_s0_is_not_initialized_away():
    scenario = SelfWilledScenario()
    task = RolloutTask(scenario, 0.1, record=("dps.torque",))
    start = RolloutRunner(task).state({}, 0.05)
    result = RolloutRunner(replace(task, start=start)).run({"dps.torque": 2.5})
    assert result.record["dps.torque"][0] == 2.5


@pytest.mark.parametrize("time_step", [0.0, 0.005])
def test_hidden_variables_of_the_start_are_in_force_from_the_first_rollout(time_step):
    scenario = AcrobotScenario(time_step=time_step)
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {FRICTION: 0.123})
    task = RolloutTask(scenario, 0.1, record=(FRICTION,), start=testbed.snapshot(context))
    runner = RolloutRunner(task)
    assert runner.run({}).record[FRICTION].tolist() == [0.123] * 3
    assert runner.run({FRICTION: 0.5}).record[FRICTION].tolist() == [0.5] * 3
    assert runner.run({}).record[FRICTION].tolist() == [0.123] * 3


def test_a_discrete_plant_that_is_no_longer_finite_is_a_failed_outcome():
    # Neither the quality nor the recording would notice: they do not look at the plant.
    task = RolloutTask(
        AcrobotScenario(time_step=0.005), 0.015, Quality(lambda t: t, "time"), sample_period=0.005, record=("time",)
    )
    runner = RolloutRunner(task)
    result = runner.run({VELOCITY: 1e200})
    assert result.failed
    assert "the state is not finite at t = 0.005 s" in result.message
    assert result.times.tolist() == [0.0]
    assert np.isnan(result.h)
    # The next one is not touched by it.
    assert runner.run({}).identical(RolloutRunner(task).run({}))


def _snapshot(value=1.0):
    return Snapshot(0.05, {"a": np.array(value)}, {"s/discrete_state/0": np.array([2.0])})


RESULT = RolloutResult(
    parameters={"a": 1.0, "b": np.array([1.0, 2.0])},
    end="horizon",
    message="",
    times=np.array([0.0, 0.05]),
    quality=np.array([0.5, np.nan]),
    t_star=0.0,
    h=0.5,
    record={"x": np.array([[1.0], [np.nan]]), "port": ["up", "down"]},
    state=_snapshot(),
    wall_time=1.0,
)


def test_a_copy_is_identical_whatever_time_it_took():
    copy = replace(
        RESULT,
        parameters={"b": np.array([1.0, 2.0]), "a": 1.0},
        times=RESULT.times.copy(),
        quality=RESULT.quality.copy(),
        record={"x": RESULT.record["x"].copy(), "port": ["up", "down"]},
        state=_snapshot(),
        wall_time=2.0,
    )
    assert RESULT.identical(copy)
    failed = replace(RESULT, t_star=np.nan, h=np.nan)
    assert failed.identical(replace(failed, wall_time=np.nan))


@pytest.mark.parametrize(
    "change",
    [
        {"parameters": {"a": 1.0 + 1e-15, "b": np.array([1.0, 2.0])}},
        {"parameters": {"a": 1.0, "b": np.array([1.0, 3.0])}},
        {"parameters": {"a": 1.0}},
        {"parameters": {**RESULT.parameters, "c": 1.0}},
        {"end": "terminated"},
        {"message": "had enough"},
        {"times": np.array([0.0, 0.05 + 1e-15])},
        {"times": np.array([0.0])},
        {"quality": np.array([0.5, 0.5])},
        {"quality": np.array([0.5 + 1e-15, np.nan])},
        {"t_star": 0.05},
        {"t_star": np.nan},
        {"h": 0.5 + 1e-15},
        {"h": np.nan},
        {"record": {**RESULT.record, "x": np.array([[1.0 + 1e-15], [np.nan]])}},
        {"record": {**RESULT.record, "x": np.array([[1.0], [1.0]])}},
        {"record": {**RESULT.record, "port": ["up", "up"]}},
        {"record": {"port": ["up", "down"]}},
        {"record": {**RESULT.record, "y": np.array([1.0])}},
        {"state": None},
        {"state": _snapshot(1.0 + 1e-15)},
    ],
    ids=lambda change: "-".join(change),
)
def test_whatever_else_differs_is_not_identical(change):
    other = replace(RESULT, **change)
    assert not RESULT.identical(other)
    assert not other.identical(RESULT)
