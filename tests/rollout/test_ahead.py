"""Workers that are given their next rollout ahead: it is not bound to the fate of the one before it."""

import os
import signal
import time
from dataclasses import dataclass
from math import inf

import numpy as np
import pytest

from tests.rollout.scenarios import HANG, KILL, TreacherousScenario, child_pids
from tests.testbeds import PendulumScenario
from vtbdrake.rollout import Cutoff, ProcessExecutor, Quality, RolloutTask, SerialExecutor, worker_processes

THETA = "sim.sys.Pendulum.theta.position"
SHOULDER = "sim.sys.Acrobot.shoulder.position"
GAIN = "dps.gain[0]"
TASK = RolloutTask(PendulumScenario(), 0.3, Quality(abs, THETA))


@pytest.fixture(scope="module")
def one():
    """A worker process that several tests share."""
    with ProcessExecutor(1) as executor:
        yield executor


@pytest.fixture
def always(monkeypatch):
    """However long rollouts take on this computer."""
    monkeypatch.setattr(worker_processes, "BRIEF", inf)


@pytest.fixture
def treacherous(tmp_path):
    """A task whose points may have a worker killed, or hang, once."""
    fuse = tmp_path / "fuse"
    fuse.touch()
    return RolloutTask(TreacherousScenario(fuse=str(fuse)), 0.3, Quality(abs, SHOULDER))


def _watched(executor, task, points):
    """The results, by index, and the most rollouts that a worker had at a time."""
    results, most = {}, 0
    for index, result in executor.run(task, points):
        assert index not in results
        results[index] = result
        most = max(most, *executor.rollouts_of_workers)
    return results, most


def _points(count):
    return [{THETA: 0.1 * i} for i in range(count)]


def test_a_worker_has_its_next_rollout_before_it_finishes(one, always):
    results, most = _watched(one, TASK, _points(5))
    assert most == 2
    expected = dict(SerialExecutor().run(TASK, _points(5)))
    assert all(results[i].identical(expected[i]) for i in range(5))


def test_long_rollouts_go_to_whoever_is_free(one, monkeypatch):
    monkeypatch.setattr(worker_processes, "BRIEF", 0.0)
    assert _watched(one, TASK, _points(5))[1] == 1


def test_the_last_rollouts_go_to_whoever_is_free(always):
    with ProcessExecutor(2) as executor:
        # When the first one is back, one waits for two workers.
        assert _watched(executor, TASK, _points(4))[1] == 1
        assert _watched(executor, TASK, _points(9))[1] == 2


def test_what_would_fill_the_socket_is_not_given_ahead(one, always):
    # Both sides would wait for the other to read: the worker sends a result that repeats its point.
    points = [{THETA: np.full(200_000, 0.1 * i)} for i in range(4)]
    results, most = _watched(one, TASK, points)
    assert most == 1
    assert all(results[i].failed and "200000" in results[i].message for i in range(4))


@pytest.mark.parametrize(("how", "time_limit"), [(KILL, inf), pytest.param(HANG, 2.0, marks=pytest.mark.slow)])
def test_a_lost_worker_has_not_tried_what_it_was_given_ahead(how, time_limit, always, treacherous, caplog):
    points = [{SHOULDER: 0.1 * i, GAIN: 0.0} for i in range(6)]
    with SerialExecutor() as serial:
        expected = dict(serial.run(treacherous, points))
    points[1][GAIN] = how
    with ProcessExecutor(1, time_limit=time_limit) as executor:
        results, most = _watched(executor, treacherous, points)
    assert most == 2
    # One try too many, its own, and none of the one behind it.
    (record,) = caplog.records
    assert record.getMessage().startswith("rollout 1 is tried again")
    assert not results[1].failed
    assert all(results[i].identical(expected[i]) for i in (0, 2, 3, 4, 5))


@pytest.mark.slow
def test_a_worker_that_dies_within_its_share_loses_one_rollout(always, treacherous, caplog):
    points = [{SHOULDER: 0.01 * i, GAIN: 0.0} for i in range(24)]
    with SerialExecutor() as serial:
        expected = dict(serial.run(treacherous, points))
    points[5][GAIN] = KILL
    with ProcessExecutor(1) as executor:
        results, most = _watched(executor, treacherous, points)
    assert most > 5
    (record,) = caplog.records
    assert record.getMessage().startswith("rollout 5 is tried again")
    assert len(results) == 24
    assert all(results[i].identical(expected[i]) for i in range(24) if i != 5)


@pytest.mark.slow
def test_rollouts_that_kill_their_workers_have_two_tries_each(always, treacherous):
    points = [{GAIN: gain} for gain in (0.0, -KILL, -KILL, 0.0)]
    with ProcessExecutor(1) as executor:
        results, most = _watched(executor, treacherous, points)
    assert most == 2
    assert [results[i].failed for i in range(4)] == [False, True, True, False]
    assert all(results[i].message.count("died (exit code -9)") == 2 for i in (1, 2))


def _slow(theta):
    time.sleep(1.5)
    return abs(theta)


@pytest.mark.slow
def test_the_time_limit_counts_from_where_a_rollout_begins(always, caplog):
    # Each has two samples, of 3 s together, and has stood behind another one.
    task = RolloutTask(PendulumScenario(), 0.5, Quality(_slow, THETA), sample_period=0.5)
    with ProcessExecutor(1, time_limit=5.9) as executor:
        list(executor.run(TASK, _points(1)))
        assert _watched(executor, task, _points(3))[1] == 2
    assert caplog.text == ""


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [inf, 0.2])
def test_a_worker_that_is_stopped_between_rollouts_is_replaced(seconds, caplog):
    others = set(child_pids())
    with ProcessExecutor(1, time_limit=2.0 if seconds == inf else inf) as executor:
        list(executor.run(TASK, _points(1)))
        (worker,) = set(child_pids()) - others
        os.kill(worker, signal.SIGSTOP)
        results = dict(executor.run(TASK, _points(2), cutoff=Cutoff(deadline=time.monotonic() + seconds)))
        assert len(results) == (2 if seconds == inf else 0)
        assert not any(result.failed for result in results.values())
        assert ("longer than its time limit" in caplog.text) == (seconds == inf)
        assert len(dict(executor.run(TASK, _points(2)))) == 2


@dataclass
class _SlowToBuild(PendulumScenario):
    seconds: float = 0.0

    def make_dps(self):
        time.sleep(self.seconds)
        return super().make_dps()


def test_a_warm_worker_has_time_to_build_another_testbed(caplog):
    task = RolloutTask(_SlowToBuild(), 0.1, Quality(abs, THETA))
    with ProcessExecutor(1, time_limit=2.0) as executor:
        list(executor.run(task, _points(1)))
        ((_, result),) = executor.run(task, [{"scenario.seconds": 2.2}])
    assert not result.failed
    assert caplog.text == ""
