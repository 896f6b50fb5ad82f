"""Pools of the user: broken pools lose little, and the user closes them."""

import concurrent.futures
import os
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

from tests.rollout.scenarios import KILL, RecordedScenario, TreacherousScenario
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.rollout import (
    FuturesExecutor,
    Quality,
    QualityError,
    RolloutTask,
    SerialExecutor,
    WorkerError,
    make_executor,
)

SHOULDER = "sim.sys.Acrobot.shoulder.position"
THETA = "sim.sys.Pendulum.theta.position"
TASK = RolloutTask(PendulumScenario(), 0.3, Quality(abs, THETA))
ROOT = Path(__file__).resolve().parents[2]
POOLS = ["process_pool", "loky_pool", "own_pool"]


def _points(count):
    return [{THETA: 0.1 * i} for i in range(count)]


class Counting(concurrent.futures.Executor):
    """A pool of threads that knows how many rollouts it has, and had."""

    def __init__(self, workers):
        self.num_workers = workers
        self.submitted = 0
        self.most = 0
        self.open = 0
        self._lock = threading.Lock()
        self.inner = ThreadPoolExecutor(workers)

    def submit(self, fn, /, *args, **kwargs):
        with self._lock:
            self.submitted += 1
            self.open += 1
            self.most = max(self.most, self.open)
        future = self.inner.submit(fn, *args, **kwargs)
        future.add_done_callback(self._done)
        return future

    def _done(self, future):
        with self._lock:
            self.open -= 1


@pytest.mark.parametrize(("in_flight", "most"), [(None, 4), (3, 3)])
def test_pool_gets_a_few_rollouts_at_a_time(in_flight, most):
    pool = Counting(2)
    with FuturesExecutor(pool, in_flight=in_flight) as executor:
        assert len(list(executor.run(TASK, _points(20)))) == 20
    assert (pool.submitted, pool.most) == (20, most)


def test_interruption_cancels_what_has_not_begun():
    pool = Counting(1)
    rollouts = FuturesExecutor(pool, in_flight=8).run(TASK, _points(100))
    next(rollouts)
    rollouts.close()
    pool.inner.shutdown(wait=True)
    # What was in flight, and what took the place of the one that came back.
    assert pool.submitted <= 9
    assert pool.open == 0


@pytest.mark.parametrize("pool", POOLS)
def test_each_process_builds_its_testbed_once(pool, request, tmp_path):
    file = tmp_path / "built"
    task = RolloutTask(RecordedScenario(file=str(file)), 0.1, Quality(abs, THETA))
    executor = FuturesExecutor(request.getfixturevalue(pool))
    for _ in range(10):
        list(executor.run(task, _points(4)))
    processes = file.read_text().split()
    assert len(set(processes)) == len(processes) <= 2


def test_pool_of_the_user_stays_open(process_pool):
    executor = make_executor(process_pool, testbed=TASK.scenario.build(), rollouts=2)
    with executor:
        assert isinstance(executor, FuturesExecutor)
    assert process_pool.submit(abs, -3).result() == 3


def _bad(theta):
    raise RuntimeError("not today")


@pytest.mark.parametrize("pool", POOLS)
def test_pool_works_after_a_quality_error(pool, request):
    with FuturesExecutor(request.getfixturevalue(pool)) as executor:
        with pytest.raises(QualityError, match="_bad at t = 0 s, .* raises RuntimeError: not today"):
            list(executor.run(RolloutTask(PendulumScenario(), 0.3, Quality(_bad, THETA)), _points(6)))
        assert len(list(executor.run(TASK, _points(3)))) == 3


def test_unpicklable_task_is_an_error_with_a_remedy(process_pool):
    lock = threading.Lock()
    task = RolloutTask(PendulumScenario(), 0.3, Quality(lambda t: float(lock.locked()), THETA))
    with pytest.raises(WorkerError, match="use executor='threads' or 'serial'"):
        list(FuturesExecutor(process_pool).run(task, _points(1)))


def _standard(**options):
    return ProcessPoolExecutor(1, mp_context=get_context("spawn"), **options)


def _loky(**options):
    return pytest.importorskip("loky").ProcessPoolExecutor(1, **options)


@pytest.mark.slow
@pytest.mark.parametrize("make", [_standard, pytest.param(_loky, marks=pytest.mark.slow)])
@pytest.mark.parametrize("how", [KILL, pytest.param(-KILL, marks=pytest.mark.slow)])
def test_killed_process_costs_its_own_rollout(make, how, tmp_path, caplog):
    """Once, and then it is run again; or each time."""
    fuse = tmp_path / "fuse"
    fuse.touch()
    task = RolloutTask(TreacherousScenario(fuse=str(fuse)), 0.5, Quality(abs, SHOULDER))
    points = [{"dps.gain[0]": 0.0, SHOULDER: 0.1 * i} for i in range(10)]
    expected = dict(SerialExecutor().run(task, points))
    points[3]["dps.gain[0]"] = how
    with make() as pool, FuturesExecutor(pool) as executor:
        results = dict(executor.run(task, points))
        # It is used again, although the pool is broken.
        again = dict(executor.run(task, points[:2]))
    assert sorted(results) == list(range(10))
    assert all(results[i].identical(expected[i]) for i in range(10) if i != 3)
    assert all(again[i].identical(expected[i]) for i in range(2))
    assert results[3].failed == (how < 0)
    assert "processes of vtbdrake take its place" in caplog.text


@pytest.mark.slow_cases
@pytest.mark.parametrize(("make", "error"), [(_standard, "BrokenProcessPool"), (_loky, "TerminatedWorkerError")])
def test_broken_pool_without_replacement_loses_its_rollouts(make, error, tmp_path):
    fuse = tmp_path / "fuse"
    fuse.touch()
    task = RolloutTask(TreacherousScenario(fuse=str(fuse)), 0.5, Quality(abs, SHOULDER))
    points = [{"dps.gain[0]": 0.0}] * 2 + [{"dps.gain[0]": KILL}] + [{"dps.gain[0]": 0.0}] * 10
    results = {}
    with make(initializer=os.getpid) as pool:
        executor = FuturesExecutor(pool, in_flight=4)
        with pytest.raises(WorkerError, match="ProcessPoolExecutor takes no more rollouts: .* terminated"):
            for index, result in executor.run(task, points):
                results[index] = result
        with pytest.raises(WorkerError, match="takes no more rollouts"):
            list(executor.run(task, points[:1]))
    assert [results[i].failed for i in range(3)] == [False, False, True]
    assert f"the pool broke while it had this rollout ({error}: " in results[2].message
    assert results[2].parameters == points[2]


def test_pool_after_shutdown_is_an_error():
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    with pytest.raises(WorkerError, match="ThreadPoolExecutor takes no more rollouts: cannot schedule new futures"):
        list(FuturesExecutor(pool).run(TASK, _points(1)))


def test_no_rollouts_in_flight_is_refused():
    with pytest.raises(ValueError, match="at least one rollout must be in flight, not 0"):
        FuturesExecutor(ThreadPoolExecutor(1), in_flight=0)


def test_make_executor_refuses_options_of_the_pool():
    testbed = AcrobotScenario().build()
    with pytest.raises(ValueError, match="an existing pool has its own settings: workers=2"):
        make_executor(ThreadPoolExecutor(1), testbed=testbed, rollouts=2, workers=2)
