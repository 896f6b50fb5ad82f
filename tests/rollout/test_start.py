"""Rollouts that begin at a start: they are the true future, in every executor, and what does not fit is refused."""

import concurrent.futures
import pickle
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig

from tests.rollout.scenarios import KILL, TreacherousScenario
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.rollout import (
    FuturesExecutor,
    ProcessExecutor,
    Quality,
    RolloutRunner,
    RolloutTask,
    SerialExecutor,
    Start,
    StartError,
    ThreadExecutor,
)
from vtbdrake.state import Snapshot
from vtbdrake.state.layout import FlatState
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

ELBOW = "sim.sys.Acrobot.elbow.position"
DISCRETE = AcrobotScenario(time_step=0.01)
EXECUTORS = {
    "serial": lambda get: SerialExecutor(),
    "threads": lambda get: ThreadExecutor(2),
    "processes": lambda get: nullcontext(get("processes")),
}
# That decisions in processes begin where they should is a quick test of the reasoner.
CASES = [pytest.param(name, marks=[pytest.mark.slow] if name == "processes" else []) for name in EXECUTORS]


def _running(scenario, seconds, values=None):
    """Return a testbed and its simulator after a while."""
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, values or {"sim.sys.Acrobot.shoulder.position": 0.8})
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(seconds)
    return testbed, simulator


def _future(task, testbed, simulator, address):
    """Return the values at the sample times, as the running simulation goes on."""
    context = simulator.get_mutable_context()
    found = [testbed.read(context, address)]
    for instant in task.instants(context.get_time(), testbed.event_timings())[1:]:
        simulator.AdvanceTo(instant)
        found.append(testbed.read(context, address))
    return np.array(found)


@pytest.mark.parametrize("executor", CASES)
def test_rollouts_from_two_starts_equal_the_true_future(executor, request):
    testbed, simulator = _running(DISCRETE, 0.5)
    task = RolloutTask(DISCRETE, 0.5, record=[ELBOW])
    starts, futures = [], []
    for _ in range(2):
        starts.append(Start.of(testbed, simulator.get_context()))
        futures.append(_future(task, testbed, simulator, ELBOW))
    assert starts[1].time == 1.0
    with EXECUTORS[executor](request.getfixturevalue) as workers:
        found = dict(workers.run(task, [{}] * 4, start=[starts[0], starts[1], starts[0], starts[1]]))
        again = dict(workers.run(task, [{}], start=starts[0]))
        default = dict(workers.run(task, [{}]))
    for index, result in found.items():
        np.testing.assert_array_equal(result.record[ELBOW], futures[index % 2])
    assert again[0].identical(found[0])
    assert default[0].identical(RolloutRunner(task).run({}))


def test_starts_reach_pools_and_the_processes_that_replace_a_broken_one():
    testbed, simulator = _running(DISCRETE, 0.5)
    task = RolloutTask(DISCRETE, 0.2, record=[ELBOW])
    start = Start.of(testbed, simulator.get_context())
    expected = RolloutRunner(task).run({}, start=start)
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        results = dict(FuturesExecutor(pool).run(task, [{}] * 3, start=start))
    assert all(result.identical(expected) for result in results.values())


@pytest.mark.slow
def test_a_worker_in_the_place_of_a_lost_one_begins_there(tmp_path):
    fuse = tmp_path / "fuse"
    fuse.touch()
    scenario = TreacherousScenario(fuse=str(fuse))
    testbed, simulator = _running(scenario, 0.52)
    task = RolloutTask(scenario, 0.3, record=[ELBOW])
    start = Start.of(testbed, simulator.get_context())
    expected = RolloutRunner(task).run({}, start=start)
    with ProcessExecutor(1) as executor:
        results = dict(executor.run(task, [{}, {"dps.gain[0]": KILL}, {}], start=start))
    assert not fuse.exists()
    assert results[0].identical(expected) and results[2].identical(expected)
    assert results[1].end == "horizon"


def test_with_error_control_both_sides_take_a_new_integrator():
    scenario = SpaceClimberScenario()
    testbed, simulator = _running(scenario, 0.61, {"u.walk": 0.7})
    task = RolloutTask(scenario, 0.6, record=["sim.sys.climber.base.pose", "u.walk"], sample_period=0.15)
    start = Start.of(testbed, simulator.get_context())
    testbed.fork(simulator)
    found = RolloutRunner(task).run({}, start=pickle.loads(pickle.dumps(start))).record
    future = _future(task, testbed, simulator, "sim.sys.climber.base.pose")
    np.testing.assert_array_equal(found["sim.sys.climber.base.pose"], future)
    np.testing.assert_array_equal(found["u.walk"], 0.7)


def test_a_start_and_its_snapshot_give_the_same_rollout():
    testbed, simulator = _running(DISCRETE, 0.53)
    context = simulator.get_mutable_context()
    testbed.write(context, {"sim.sys.Acrobot.elbow.locked": 1.0, "sim.sys.Acrobot.upper_link.mass": 1.25})
    task = RolloutTask(DISCRETE, 0.5, Quality(np.abs, "sim.sys.Acrobot.shoulder.position"), keep_state=True)
    restored = RolloutRunner(replace(task, start=testbed.snapshot(context)))
    runner = RolloutRunner(task)
    free = runner.run({})
    found = runner.run({}, start=Start.of(testbed, context))
    assert found.identical(restored.run({}))
    assert found.state["sim.sys.Acrobot.elbow.locked"] == 1.0
    # The lock is hidden: it must not stay in the context of the runner.
    assert runner.run({}).identical(free)
    assert not free.identical(found)


def test_parameters_of_a_rollout_are_set_on_top_of_its_start():
    testbed, simulator = _running(DISCRETE, 0.5)
    task = RolloutTask(DISCRETE, 0.2, record=[ELBOW])
    start = Start.of(testbed, simulator.get_context())
    runner = RolloutRunner(task)
    assert runner.run({ELBOW: 0.25}, start=start).record[ELBOW][0] == 0.25
    assert runner.run({}, start=start).record[ELBOW][0] == testbed.read(simulator.get_context(), ELBOW)


def test_what_a_start_does_not_hold_is_as_in_the_task():
    testbed, simulator = _running(DISCRETE, 0.5)
    contents = testbed.dps_layout.take(simulator.get_context())
    runner = RolloutRunner(RolloutTask(DISCRETE, 0.2, record=[ELBOW, "dps.ticks"]))
    record = runner.run({}, start=Start(0.5, contents)).record
    assert (record[ELBOW][0], record["dps.ticks"][0]) == (0.0, 25.0)


def test_samples_of_a_start_lie_at_the_testbeds_events():
    # 0.3 + 3 * 0.1 and 30 * 0.02 differ in the last bit: another step would be taken between them.
    testbed, simulator = _running(DISCRETE, 0.3)
    start = Start.of(testbed, simulator.get_context())
    runner = RolloutRunner(RolloutTask(DISCRETE, 0.3, record=["time"], sample_period=0.1))
    assert runner.run({}, start=start).record["time"][-1] == 30 * 0.02


@pytest.mark.parametrize("executor", CASES)
def test_a_start_of_another_testbed_is_refused_by_name(executor, request):
    testbed = AcrobotScenario().build()
    start = Start.of(testbed, testbed.default_context())
    with (
        EXECUTORS[executor](request.getfixturevalue) as workers,
        pytest.raises(StartError, match=r"it lacks .*plant/discrete/0"),
    ):
        list(workers.run(RolloutTask(DISCRETE, 0.1), [{}, {}], start=start))


def test_a_runner_that_refused_a_start_still_gives_the_same_rollouts():
    testbed, simulator = _running(DISCRETE, 0.5)
    good = Start.of(testbed, simulator.get_context())
    runner = RolloutRunner(RolloutTask(DISCRETE, 0.2, record=[ELBOW]))
    default, expected = runner.run({}), runner.run({}, start=good)
    for address, value in (("sim.sys.Acrobot.elbow.locked", 0.5), ("dps.gian", 0.0), ("dps.gain", np.full(4, np.nan))):
        with pytest.raises(StartError, match=address):
            runner.run({}, start=replace(good, values={**good.values, address: value}))
        assert runner.run({}, start=good).identical(expected)
    assert runner.run({}).identical(default)


def test_starts_that_are_none_are_refused():
    task, contents = RolloutTask(PendulumScenario(), 0.1), FlatState((), np.zeros(0), {})
    with pytest.raises(StartError, match=r"begins at a Start, .* not at 'now'"):
        list(SerialExecutor().run(task, [{}], start=["now"]))
    with pytest.raises(StartError, match=r"not at Snapshot"):
        list(SerialExecutor().run(task, [{}], start=Snapshot(0.0, {}, {})))
    with pytest.raises(StartError, match="one for each of the 3, not 2"):
        list(SerialExecutor().run(task, [{}] * 3, start=[Start(0.0, contents)] * 2))
    with pytest.raises(StartError, match="finite time, not at nan"):
        Start(np.nan, contents)
    with pytest.raises(StartError, match="not 3"):
        Start(0.0, 3)


def test_the_largest_step_does_not_matter_to_where_a_start_begins():
    # Another integrator in the rollouts than in the running simulation: the contents fit all the same.
    testbed, simulator = _running(AcrobotScenario(), 0.5)
    other = AcrobotScenario(simulator_config=SimulatorConfig(max_step_size=0.01, accuracy=1e-3))
    task = RolloutTask(other, 0.1, record=[ELBOW])
    context = simulator.get_context()
    result = RolloutRunner(task).run({}, start=Start.of(testbed, context))
    assert result.record[ELBOW][0] == testbed.read(context, ELBOW)
