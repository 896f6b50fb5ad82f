"""Executors over several tasks, after errors, and after the loss of workers."""

import gc
import os
import select
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from textwrap import dedent

import numpy as np
import pytest

from tests.rollout.scenarios import HANG, GreedyScenario, RecordedScenario, TreacherousScenario, child_pids
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.rollout import (
    ProcessExecutor,
    Quality,
    QualityError,
    RolloutTask,
    SerialExecutor,
    ThreadExecutor,
    WorkerError,
)

SHOULDER = "sim.sys.Acrobot.shoulder.position"
ELBOW = "sim.sys.Acrobot.elbow.position"
THETA = "sim.sys.Pendulum.theta.position"


def _angle(theta):
    return abs(theta)


def _square(theta):
    return theta**2


ANGLE = RolloutTask(AcrobotScenario(), 0.5, Quality(_angle, SHOULDER))
# All that a task has is different: the testbed, the quality, the horizon and the sample times.
OTHER = RolloutTask(AcrobotScenario(period=0.04), 0.8, Quality(_square, ELBOW), sample_period=0.1, record=(SHOULDER,))
POINTS = [{SHOULDER: value} for value in (0.2, 0.9, 1.6)]


def _results(executor, task, points):
    """One result per point; each has been yielded exactly once."""
    found = list(executor.run(task, points))
    assert sorted(index for index, _ in found) == list(range(len(points)))
    return [result for _, result in sorted(found, key=lambda item: item[0])]


def _assert_right(executor, task, points):
    expected = _results(SerialExecutor(), task, points)
    results = _results(executor, task, points)
    assert all(a.identical(b) for a, b in zip(results, expected, strict=True))
    assert not any(result.failed for result in results)


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    "make",
    [SerialExecutor, lambda: ThreadExecutor(2), pytest.param(lambda: ProcessExecutor(2), marks=pytest.mark.slow)],
)
def test_second_task_gets_its_own_results(make):
    with make() as executor:
        _assert_right(executor, ANGLE, POINTS)
        _assert_right(executor, OTHER, POINTS)
        _assert_right(executor, ANGLE, POINTS)


@pytest.mark.parametrize(
    "make", [lambda: ThreadExecutor(2), pytest.param(lambda: ProcessExecutor(2), marks=pytest.mark.slow)]
)
def test_executor_works_after_a_quality_error(make, tmp_path):
    samples = tmp_path / "samples"

    def _slow_and_refuses_large_angles(theta):
        if theta > 3.0:
            raise RuntimeError("too large")
        with samples.open("a") as file:
            file.write("x")
        time.sleep(0.1)
        return abs(theta)

    # The first point is refused at once, while the second one is on its way for a minute.
    troubled = RolloutTask(
        AcrobotScenario(), 6.0, Quality(_slow_and_refuses_large_angles, SHOULDER), sample_period=0.01
    )
    with make() as executor:
        _assert_right(executor, ANGLE, POINTS[:2])
        with pytest.raises(QualityError, match="_large_angles at t = 0 s, .* raises RuntimeError: too large"):
            list(executor.run(troubled, [{SHOULDER: 3.1}, {SHOULDER: 0.1}]))
        assert not any(getattr(executor, "rollouts_of_workers", ()))
        assert not samples.exists() or samples.stat().st_size < 600
        _assert_right(executor, OTHER, POINTS)


@pytest.mark.slow
def test_worker_that_died_while_idle_costs_nothing(caplog):
    others = set(child_pids())
    with ProcessExecutor(2) as executor:
        _assert_right(executor, ANGLE, POINTS)
        killed, kept = set(child_pids()) - others
        os.kill(killed, signal.SIGKILL)
        os.waitid(os.P_PID, killed, os.WEXITED | os.WNOWAIT)
        _assert_right(executor, OTHER, POINTS)
        alive = set(child_pids()) - others
        assert len(alive) == 2 and kept in alive and killed not in alive
    # No rollout was lost with it.
    assert caplog.text == ""


@pytest.mark.slow
def test_worker_killed_while_starting_costs_nothing():
    others = set(child_pids())
    with ProcessExecutor(2) as executor:
        executor.start_workers(2)
        for pid in set(child_pids()) - others:
            os.kill(pid, signal.SIGKILL)
        _assert_right(executor, ANGLE, POINTS)


def test_all_workers_killed_while_starting_is_an_error(monkeypatch, tmp_path):
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\nkill -9 $$\n")
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    with ProcessExecutor(2) as executor, pytest.raises(WorkerError, match=r"did not start \(exit code -9\)"):
        list(executor.run(ANGLE, POINTS))


def test_closed_executor_leaves_no_processes():
    others = set(child_pids())
    executor = ProcessExecutor(1)
    _assert_right(executor, ANGLE, POINTS[:2])
    workers = set(child_pids()) - others
    assert len(workers) == 1
    executor.close()
    assert not workers & set(child_pids())


def test_error_in_a_thread_stops_the_others():
    calls = []
    both = threading.Barrier(2)

    def f(theta):
        if not calls:
            calls.append(theta)
            both.wait(timeout=60.0)
            raise RuntimeError("too large")
        if len(calls) == 1:
            both.wait(timeout=60.0)
        calls.append(theta)
        time.sleep(0.2)
        return abs(theta)

    task = RolloutTask(PendulumScenario(stiffness=1.0), 1.0, Quality(f, THETA))
    with ThreadExecutor(2) as executor, pytest.raises(QualityError, match="too large"):
        list(executor.run(task, [{THETA: value} for value in np.linspace(0.1, 1.0, 4)]))
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("rollout-")]
    # The other thread was in its first sample, and has neither gone on nor begun another rollout.
    assert len(calls) <= 3


@pytest.mark.slow_cases
@pytest.mark.parametrize("make", [SerialExecutor, lambda: ThreadExecutor(2), lambda: ProcessExecutor(1)])
def test_testbed_is_built_once(make, tmp_path):
    file = tmp_path / "built"
    task = RolloutTask(RecordedScenario(file=str(file)), 0.1, Quality(_angle, THETA))
    with make() as executor:
        for count in (1, 4, 1, 2):
            _assert_right(executor, task, [{THETA: 0.1 * i} for i in range(count)])
        # The other times, one after another, to be compared with.
        assert len(file.read_text().split()) == 1 + 4


@pytest.mark.slow
def test_worker_that_has_grown_is_replaced(tmp_path):
    file = tmp_path / "built"
    task = RolloutTask(GreedyScenario(file=str(file)), 0.1, Quality(_angle, THETA))
    points = [{"scenario.stiffness": 0.1 * i, THETA: 0.1} for i in range(12)]
    # What the main process holds, or held, is not the worker's.
    ballast = b"x" * 600_000_000
    del ballast
    with ProcessExecutor(1, growth=120e6) as executor:
        results = dict(executor.run(task, points))
    assert sorted(results) == list(range(12)) and not any(result.failed for result in results.values())
    builders = file.read_text().split()
    # One more than fits, and one that was given ahead.
    assert all(3 <= builders.count(process) <= 5 for process in set(builders[:-5]))
    assert len(builders) == 12


@pytest.mark.parametrize("growth", [0.0, -1.0, "much"])
def test_impossible_growth_is_refused(growth):
    with pytest.raises(ValueError, match="the growth of a worker's memory"):
        ProcessExecutor(1, growth=growth)


@pytest.mark.slow_cases
@pytest.mark.parametrize("finished", [1, 2])
def test_closing_during_a_call_is_an_error(finished):
    with ProcessExecutor(1) as executor:
        rollouts = executor.run(ANGLE, POINTS)
        for _ in range(finished):
            next(rollouts)
    with pytest.raises(WorkerError, match="closed while it had rollouts to run"):
        list(rollouts)


@pytest.mark.slow
def test_closing_from_another_thread_loses_no_worker(tmp_path, caplog):
    others, fuse = set(child_pids()), tmp_path / "fuse"
    fuse.touch()
    task = RolloutTask(TreacherousScenario(fuse=str(fuse)), 0.3, Quality(_angle, SHOULDER))
    points = [{SHOULDER: 0.1, "dps.gain[0]": gain} for gain in (HANG, 0.0, 0.0)]
    executor = ProcessExecutor(3)
    executor.start_workers(3)  # Here, as another thread's are not among `child_pids`.
    with ThreadPoolExecutor(1) as pool:
        call = pool.submit(lambda: list(executor.run(task, points)))
        while fuse.exists():  # Until the first one hangs.
            select.select([], [], [], 0.01)
        executor.close()
        with pytest.raises(WorkerError, match="closed while it had rollouts to run"):
            call.result()
    assert caplog.text == "" and set(child_pids()) == others


@pytest.mark.slow
def test_second_call_during_a_call_is_refused():
    with ProcessExecutor(1) as executor:
        first = executor.run(ANGLE, POINTS)
        next(first)
        with pytest.raises(WorkerError, match="finish or close what that call returned"):
            next(executor.run(OTHER, POINTS))
        first.close()
        _assert_right(executor, OTHER, POINTS)


def test_workers_end_with_a_killed_main_process(tmp_path):
    """Also one whose rollout hangs, and so never looks whether there is anyone left to answer to."""
    fuse = tmp_path / "fuse"
    fuse.touch()
    script = f"""
        from tests.rollout.scenarios import HANG, TreacherousScenario, child_pids
        from vtbdrake.rollout import ProcessExecutor, Quality, RolloutTask
        executor = ProcessExecutor(1)
        task = RolloutTask(TreacherousScenario(fuse={str(fuse)!r}), 0.5, Quality(abs, {SHOULDER!r}))
        list(executor.run(task, [{{}}]))
        print(*child_pids(), flush=True)
        list(executor.run(task, [{{"dps.gain[0]": HANG}}]))
    """
    with subprocess.Popen([sys.executable, "-c", dedent(script)], stdout=subprocess.PIPE, text=True) as main:
        worker = int(main.stdout.readline())
        while fuse.exists():
            assert main.poll() is None
        ended = os.pidfd_open(worker)
        main.kill()
        assert select.select([ended], [], [], 60.0)[0], "the worker goes on"
        os.close(ended)


def test_threads_are_kept_between_calls():
    seen = set()

    def f(theta):
        seen.add(threading.get_ident())
        return abs(theta)

    task = RolloutTask(PendulumScenario(), 0.1, Quality(f, THETA))
    with ThreadExecutor(2) as executor:
        for _ in range(5):
            list(executor.run(task, [{THETA: 0.1}] * 8))
    assert len(seen) <= 2
    assert threading.get_ident() not in seen


def test_forgotten_executor_leaves_no_threads():
    task = RolloutTask(PendulumScenario(), 0.1, Quality(_angle, THETA))
    executor = ThreadExecutor(2)
    list(executor.run(task, [{THETA: 0.1}] * 4))
    threads = [thread for thread in threading.enumerate() if thread.name.startswith("rollout-")]
    assert len(threads) == 2
    del executor
    gc.collect()
    for thread in threads:
        thread.join(timeout=60.0)
    assert not any(thread.is_alive() for thread in threads)


def test_two_runs_of_one_executor_do_not_mix():
    tasks = [RolloutTask(PendulumScenario(stiffness=k), 0.2, Quality(_angle, THETA)) for k in (0.0, 5.0)]
    points = [{THETA: 0.1 * i} for i in range(6)]
    expected = [dict(SerialExecutor().run(task, points)) for task in tasks]
    with ThreadExecutor(2) as executor:
        pairs = zip(*(executor.run(task, points) for task in tasks), strict=True)
        for found in pairs:
            for (index, result), right in zip(found, expected, strict=True):
                assert result.identical(right[index])


class PickledScenario(PendulumScenario):
    """Counts how often it is pickled."""

    count = 0

    def __reduce_ex__(self, protocol):
        PickledScenario.count += 1
        return super().__reduce_ex__(protocol)


def test_task_is_pickled_once():
    task = RolloutTask(PickledScenario(), 0.1, Quality(_angle, THETA))
    PickledScenario.count = 0
    with ProcessExecutor(1) as executor:
        for _ in range(3):
            list(executor.run(task, [{THETA: 0.1}] * 2))
    assert PickledScenario.count == 1
