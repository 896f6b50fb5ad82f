"""Which executor one gets for what one asks."""

import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.rollout.scenarios import child_pids
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.rollout import (
    FuturesExecutor,
    ProcessExecutor,
    SerialExecutor,
    ThreadExecutor,
    choose_executor,
    make_executor,
)


@pytest.fixture(scope="module")
def pendulum():
    return PendulumScenario().build()


@pytest.fixture(scope="module")
def acrobot():
    return AcrobotScenario().build()


def test_threads_suit_drakes_systems_and_processes_suit_python(pendulum, acrobot):
    assert choose_executor(pendulum) == "threads"
    assert choose_executor(acrobot) == "processes"


@pytest.mark.parametrize(
    ("name", "options", "kind"),
    [
        ("serial", {}, SerialExecutor),
        ("threads", {}, ThreadExecutor),
        ("processes", {"time_limit": 10.0}, ProcessExecutor),
        ("auto", {"workers": 2}, ThreadExecutor),
        ("auto", {"workers": 1}, SerialExecutor),
        ("auto", {"workers": 2, "rollouts": 1}, SerialExecutor),
        ("auto", {"workers": 2, "rollouts": 1, "time_limit": 10.0}, ProcessExecutor),
    ],
)
def test_an_executor_by_name(name, options, kind, pendulum):
    with make_executor(name, testbed=pendulum, **{"rollouts": 5, **options}) as executor:
        assert type(executor) is kind


def test_auto_takes_processes_for_python(acrobot):
    with make_executor("auto", testbed=acrobot, rollouts=5, workers=2) as executor:
        assert type(executor) is ProcessExecutor


def test_an_executor_or_a_pool_that_is_there_is_taken(pendulum):
    mine, pool = SerialExecutor(), ThreadPoolExecutor(1)
    assert make_executor(mine, testbed=pendulum, rollouts=5) is mine
    assert isinstance(make_executor(pool, testbed=pendulum, rollouts=5), FuturesExecutor)


@pytest.mark.parametrize(
    ("executor", "options", "message"),
    [
        ("gpu", {}, "one of auto, serial, threads, processes, dask, compiled, an Executor, a concurrent.*, not 'gpu'"),
        (3, {}, "a Dask Client, not 3"),
        ("serial", {"time_limit": 2.0}, "executor='serial' cannot keep a time limit of 2 s"),
        ("threads", {"time_limit": 2.0}, "executor='threads' cannot keep a time limit of 2 s"),
        ("serial", {"workers": 2}, "executor='serial' has no workers, but workers=2 was given"),
        ("auto", {"workers": 0}, "at least one worker, not 0"),
        ("processes", {"time_limit": 0.0}, "time limit must be positive, not 0.0 s"),
        ("processes", {"workers": 0}, "at least one worker, not 0"),
        ("threads", {"workers": 0}, "at least one worker, not 0"),
        (SerialExecutor(), {"time_limit": 2.0}, "an existing Executor has its own settings: time_limit=2.0"),
        (ThreadPoolExecutor(1), {"time_limit": 2.0}, "an existing pool has its own settings: time_limit"),
        (ThreadPoolExecutor(1), {"workers": 2}, "an existing pool has its own settings: workers=2"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(executor, options, message, pendulum):
    with pytest.raises(ValueError, match=message):
        make_executor(executor, testbed=pendulum, rollouts=5, **options)


def test_dask_without_its_package_names_the_extra(pendulum, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.delitem(sys.modules, "vtbdrake.rollout.cluster", raising=False)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'vtbdrake\[cluster\]'"):
        make_executor("dask", testbed=pendulum, rollouts=5)
    # Unknown things are refused all the same.
    with pytest.raises(ValueError, match="not 3"):
        make_executor(3, testbed=pendulum, rollouts=5)


def test_workers_start_with_their_executor_and_end_with_it():
    testbed = PendulumScenario().build()
    others = set(child_pids())
    with make_executor("processes", testbed=testbed, rollouts=3, workers=5):
        workers = set(child_pids()) - others
        assert len(workers) == 3
    assert not workers & set(child_pids())
