"""Ctrl-C at every place of every executor's loop: it ends, and the executor works on."""

import gc
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.interruptions import hanging_fails, interrupt, places
from tests.rollout.scenarios import child_pids
from tests.testbeds import PendulumScenario
from vtbdrake.common import child_process
from vtbdrake.rollout import (
    FuturesExecutor,
    ProcessExecutor,
    Quality,
    RolloutTask,
    SerialExecutor,
    Start,
    ThreadExecutor,
    executor,
    futures,
    pickled_task,
    runner,
    start,
    testbeds,
    worker_processes,
)
from vtbdrake.rollout import cluster as dask

THETA = "sim.sys.Pendulum.theta.position"
TASK = RolloutTask(PendulumScenario(), 0.1, Quality(abs, THETA))
POINTS = [{THETA: 0.1 * i} for i in range(1, 4)]


@pytest.fixture(scope="module")
def expected():
    """The results of a serial executor that nothing interrupts, by their points' indices."""
    return dict(SerialExecutor().run(TASK, POINTS))


def survives(make, expected, *modules, lines=False, every=1, warm=(False, True), begins=None):
    """Interrupt rollouts of an executor, the first ones and later ones, at every place; return the number of places.

    Args:
        make: Makes the executor.
        expected: The results of the rollouts.
        modules: Whose code is interrupted.
        lines: Whether each line is interrupted once, instead of each place twice.
        every: 3 interrupts only every third of them.
        warm: Whether the executor has been used before.
        begins: Where the rollouts begin.
    """
    interrupted = 0
    for used in warm:
        one = make()

        def roll():
            return dict(one.run(TASK, POINTS, start=begins))  # noqa: B023

        if used:
            roll()
        for place in places(roll, *modules, lines=lines)[::every]:
            if not used:
                one.close()
                one = make()
            # The exception is held, as a notebook does: what its frames hold is not freed.
            error = interrupt(roll, *modules, at=place)
            interrupted += error is not None
            with hanging_fails(place):
                results = roll()
            assert sorted(results) == sorted(expected), place
            assert all(results[index].identical(expected[index]) for index in expected), place
            del error
        with hanging_fails("close"):
            one.close()
    return interrupted


@pytest.mark.parametrize("every", [8, pytest.param(3, marks=pytest.mark.slow)])
def test_ctrl_c_in_many_lines_of_a_serial_executor(expected, every):
    assert survives(SerialExecutor, expected, executor, testbeds, runner, lines=True, every=every) > 80 / every


@pytest.mark.slow
def test_ctrl_c_in_many_lines_while_rollouts_begin_elsewhere():
    testbed = TASK.scenario.build()
    context = testbed.default_context()
    testbed.write(context, {"sim.sys.Pendulum.theta.velocity": 2.0})
    context.SetTime(0.5)
    begins = Start.of(testbed, context)
    expected = dict(SerialExecutor().run(TASK, POINTS, start=begins))
    assert survives(SerialExecutor, expected, testbeds, runner, start, lines=True, every=5, begins=begins) > 15


@pytest.mark.slow
def test_ctrl_c_anywhere_in_threads(expected):
    before = threading.active_count()
    assert survives(lambda: ThreadExecutor(2), expected, executor, testbeds, runner, every=3) > 15
    assert threading.active_count() == before


@pytest.mark.slow
def test_ctrl_c_anywhere_in_a_pool(expected):
    with ThreadPoolExecutor(2) as pool:
        assert survives(lambda: FuturesExecutor(pool), expected, futures, pickled_task, executor, every=3) > 15


@pytest.mark.slow
@pytest.mark.one_python
def test_ctrl_c_in_many_lines_of_processes(expected):
    """Each costs a worker, which takes a second: so every ninth line is interrupted."""
    before = set(child_pids())
    modules = worker_processes, child_process, pickled_task
    options = {"lines": True, "every": 9, "warm": (True,)}
    assert survives(lambda: ProcessExecutor(1), expected, *modules, **options) > 4
    gc.collect()
    assert set(child_pids()) <= before  # Another test's may have ended meanwhile.


@pytest.mark.slow
@pytest.mark.one_python
def test_ctrl_c_in_many_lines_of_dask(cluster, expected):
    options = {"lines": True, "every": 3, "warm": (True,)}
    assert survives(lambda: dask.DaskExecutor(cluster.client), expected, dask, futures, **options) > 6
