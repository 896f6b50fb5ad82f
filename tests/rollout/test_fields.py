"""Scenario fields in a point: another testbed each, built once and kept, a few at a time."""

import contextlib
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from tests.testbeds import PendulumScenario
from vtbdrake.rollout import (
    FuturesExecutor,
    ProcessExecutor,
    Quality,
    RolloutRunner,
    RolloutTask,
    SerialExecutor,
    ThreadExecutor,
)
from vtbdrake.rollout import testbeds as cache
from vtbdrake.state import SnapshotError
from vtbdrake.testbed import ScenarioError

THETA = "sim.sys.Pendulum.theta.position"
STIFFNESS = "scenario.stiffness"


@dataclass
class CountedScenario(PendulumScenario):
    """A pendulum that counts how often it is built, and that Drake refuses at a damping of 13."""

    built: ClassVar[list[float]] = []

    def validate(self):
        super().validate()
        if self.stiffness < 0.0:
            raise ScenarioError(f"CountedScenario.stiffness must not be negative, not {self.stiffness}")

    def make_dps(self):
        self.built.append(self.stiffness)
        if self.damping == 13.0:
            raise RuntimeError("no pendulum can be\ndamped so")
        return super().make_dps()


@pytest.fixture
def built():
    CountedScenario.built.clear()
    return CountedScenario.built


def _task(scenario=None):
    return RolloutTask(scenario or CountedScenario(), 0.3, Quality(abs, THETA), sample_period=0.1)


def _results(executor, task, points):
    return [result for _, result in sorted(executor.run(task, points), key=lambda item: item[0])]


def test_a_field_gives_what_a_scenario_of_that_value_gives():
    points = [{THETA: 0.5}, {THETA: 0.5, STIFFNESS: 2.0}, {STIFFNESS: 2.0, "scenario.simulator_config.accuracy": 1e-2}]
    with SerialExecutor() as executor:
        plain, stiff, coarse = _results(executor, _task(), points)
    expected = RolloutRunner(_task(CountedScenario(stiffness=2.0))).run({THETA: 0.5})
    assert np.array_equal(stiff.quality, expected.quality)
    assert not np.array_equal(stiff.quality, plain.quality)
    assert [result.parameters for result in (plain, stiff, coarse)] == points


def test_a_testbed_is_built_once_per_value(built):
    points = [{STIFFNESS: value, THETA: theta} for theta in (0.1, 0.2) for value in (1.0, 2.0, 1, np.float64(2.0))]
    with SerialExecutor() as executor:
        for _ in range(2):
            _results(executor, _task(), points)
    assert built == [1.0, 2.0]


def test_a_given_testbed_serves_points_with_its_own_values(built):
    testbed = CountedScenario(stiffness=1.0).build()
    with SerialExecutor(testbed) as executor:
        _results(executor, _task(CountedScenario(stiffness=1.0)), [{THETA: 0.1}, {STIFFNESS: 1.0}])
    assert built == [1.0]


def test_the_testbed_not_used_for_longest_goes_first(built):
    with SerialExecutor(max_testbeds=2) as executor:
        _results(executor, _task(), [{STIFFNESS: value} for value in (1.0, 2.0, 1.0, 3.0, 1.0, 2.0)])
    assert built == [1.0, 2.0, 3.0, 2.0]


def test_runners_do_not_hold_testbeds_that_have_gone():
    testbeds = cache.Testbeds(max_testbeds=2)
    runners, task = cache.Runners(testbeds), _task()
    kept = [runners.get(task, {"stiffness": value}) for value in (1.0, 2.0, 3.0)]
    assert len(testbeds) == 2
    assert [runner.testbed in testbeds for runner in kept] == [False, True, True]
    assert runners.get(task, {"stiffness": 3.0}) is kept[2]
    assert runners.get(task, {"stiffness": 1.0}) is not kept[0]


def test_threads_that_want_the_same_new_testbed_build_it_once(built):
    testbeds, both = cache.Testbeds(), threading.Barrier(4)

    def get(_):
        both.wait(timeout=60.0)
        return testbeds.get(CountedScenario(stiffness=5.0))

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(get, range(4)))
    assert built == [5.0]
    assert all(testbed is found[0] for testbed in found)


@dataclass
class WatchedScenario(PendulumScenario):
    """A pendulum that notes whether two testbeds are built at once."""

    building: ClassVar[threading.Lock] = threading.Lock()
    overlap: ClassVar[threading.Event] = threading.Event()

    def make_dps(self):
        if not self.building.acquire(blocking=False):
            self.overlap.set()
            return super().make_dps()
        with contextlib.ExitStack() as stack:
            stack.callback(self.building.release)
            self.overlap.wait(0.1)  # Another thread has this long to come.
            return super().make_dps()


def test_threads_build_their_testbeds_one_after_another():
    WatchedScenario.overlap.clear()
    with ThreadExecutor(4) as executor:
        results = _results(executor, _task(WatchedScenario()), [{STIFFNESS: float(k)} for k in range(4)])
    assert not any(result.failed for result in results)
    assert not WatchedScenario.overlap.is_set()


@pytest.mark.slow
def test_more_threads_than_testbeds_are_kept_take_them_from_each_other():
    points = [{STIFFNESS: float(k), THETA: 0.5} for k in range(24)]
    with ThreadExecutor(4, max_testbeds=1) as threads, SerialExecutor(max_testbeds=1) as serial:
        results, expected = (_results(executor, _task(), points) for executor in (threads, serial))
    assert all(ours.identical(theirs) for ours, theirs in zip(results, expected, strict=True))


def test_a_testbed_whose_build_failed_is_tried_again(built):
    testbeds = cache.Testbeds()
    for _ in range(2):
        with pytest.raises(RuntimeError, match="damped so"):
            testbeds.get(CountedScenario(damping=13.0))
    assert len(built) == 2
    assert len(testbeds) == 0


EXECUTORS = {
    "serial": SerialExecutor,
    "threads": lambda: ThreadExecutor(2),
    "processes": lambda: ProcessExecutor(1),
    "futures": lambda: FuturesExecutor(ThreadPoolExecutor(1)),
}


@pytest.mark.parametrize("make", EXECUTORS.values(), ids=EXECUTORS)
def test_what_cannot_be_built_is_a_failed_rollout(make):
    points = [{STIFFNESS: 1.0}, {STIFFNESS: 1.0, "scenario.damping": 13.0}, {STIFFNESS: 2.0}]
    with make() as executor:
        results = _results(executor, _task(), points)
    assert [result.failed for result in results] == [False, True, False]
    assert results[1].parameters == points[1]
    assert results[1].message.startswith(
        "no testbed can be built with scenario.stiffness = 1.0, scenario.damping = 13.0: "
        "RuntimeError: no pendulum can be damped so (test_fields.py, line "
    )


@pytest.mark.slow_cases
@pytest.mark.parametrize("make", EXECUTORS.values(), ids=EXECUTORS)
@pytest.mark.parametrize(
    ("point", "message"),
    [
        ({"scenario.stifness": 1.0}, "no field 'stifness' .*did you mean stiffness"),
        ({STIFFNESS: "high"}, "must be a finite number, not 'high'"),
        ({STIFFNESS: -1.0}, "must not be negative, not -1.0"),
    ],
)
def test_what_the_scenario_refuses_is_an_error_that_the_executor_survives(make, point, message):
    task = _task()
    with make() as executor:
        with pytest.raises(ScenarioError, match=message):
            _results(executor, task, [point])
        assert not _results(executor, task, [{STIFFNESS: 1.0}])[0].failed


def test_a_snapshot_is_of_its_own_scenario():
    testbed = CountedScenario(stiffness=1.0).build()
    start = testbed.snapshot(testbed.default_context())
    task = RolloutTask(CountedScenario(stiffness=1.0), 0.3, Quality(abs, THETA), start=start)
    with SerialExecutor() as executor, pytest.raises(SnapshotError, match="stiffness"):
        _results(executor, task, [{STIFFNESS: 2.0}])


def test_at_least_one_testbed_is_kept():
    for make in (SerialExecutor, ThreadExecutor, ProcessExecutor):
        with pytest.raises(ValueError, match="at least one testbed must be kept, not 0"):
            make(max_testbeds=0)
