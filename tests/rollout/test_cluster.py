"""Rollouts on a Dask cluster: a real scheduler, worker processes that are killed while they work, and its dashboard."""

import logging
import os
import pickle
import queue
import signal
import subprocess
import sys
import time
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import dask
import numpy as np
import pytest
from distributed import Client, LocalCluster, get_task_stream, get_worker

from benchmarks.cluster import Waiting, cost
from benchmarks.dask_cluster import ROOT, dask_cluster
from tests.optimization.studies import StatedExecutor
from tests.rollout.scenarios import HANG, KILL, KILL_PARENT, RecordedScenario, TreacherousScenario
from tests.rollout.waiting_study import ROLLOUTS, SLOTS, waiting_study
from tests.testbeds import PendulumScenario
from vtbdrake.rollout import Quality, QualityError, RolloutTask, SerialExecutor, Start, WorkerError, make_executor
from vtbdrake.rollout import cluster as cluster_module
from vtbdrake.rollout.cluster import ADDRESS, DaskExecutor, run_on_dask
from vtbdrake.rollout.pickled_task import pack

SHOULDER = "sim.sys.Acrobot.shoulder.position"
THETA = "sim.sys.Pendulum.theta.position"
TASK = RolloutTask(PendulumScenario(), 0.3, Quality(abs, THETA))


def _points(count):
    return [{THETA: 0.1 * i} for i in range(count)]


def _assert_right(executor, task, points, start=None):
    found = list(executor.run(task, points, start=start))
    assert sorted(index for index, _ in found) == list(range(len(points)))
    expected = dict(SerialExecutor().run(task, points, start=start))
    assert all(result.identical(expected[index]) for index, result in found)


def test_each_worker_builds_its_testbed_once(cluster, tmp_path):
    file = tmp_path / "built"
    task = RolloutTask(RecordedScenario(file=str(file)), 0.1, Quality(abs, THETA))
    with DaskExecutor(cluster.client) as executor:
        for _ in range(5):
            assert len(list(executor.run(task, _points(4)))) == 4
    processes = [int(line) for line in file.read_text().split()]
    assert len(set(processes)) == len(processes) <= 2
    assert os.getpid() not in processes


def test_rollouts_begin_at_their_starts(cluster):
    testbed = PendulumScenario().build()
    starts = [Start(t0, testbed.dps_layout.take(testbed.default_context()), {THETA: 0.3}) for t0 in (1.0, 2.0)]
    task = RolloutTask(PendulumScenario(), 0.3, Quality(abs, THETA), record=["time", THETA])
    with DaskExecutor(cluster.client) as executor:
        _assert_right(executor, task, [{}, {}], starts)
        _assert_right(executor, task, _points(2), starts[0])


def test_dashboard_shows_the_workers(cluster):
    def page(path):
        with urllib.request.urlopen(cluster.dashboard + path, timeout=60) as response:
            return response.read().decode()

    workers = page("/info/main/workers.html")
    assert "<title> Workers </title>" in workers
    assert all(address in workers for address in cluster.client.scheduler_info()["workers"])
    status = page("/status")
    assert "Dask" in status and "Bokeh" in status, "the charts are there"


def test_close_removes_tasks_from_the_workers(cluster):
    def told():
        plugins = cluster.client.run(lambda dask_worker: [name for name in dask_worker.plugins if "vtbdrake" in name])
        return {name for names in plugins.values() for name in names}

    executor = DaskExecutor(cluster.client)
    list(executor.run(TASK, _points(1)))
    assert len(told()) == 1
    list(executor.run(TASK, _points(1)))
    assert len(told()) == 1
    executor.close()
    assert told() == set()
    # It can be used again, as every executor.
    _assert_right(executor, TASK, _points(2))
    executor.close()


def _bad(theta):
    raise RuntimeError("not today")


def test_cluster_works_after_a_quality_error(cluster):
    with DaskExecutor(cluster.client) as executor:
        with pytest.raises(QualityError, match="_bad at t = 0 s, .* raises RuntimeError: not today"):
            list(executor.run(RolloutTask(PendulumScenario(), 0.3, Quality(_bad, THETA)), _points(6)))
        _assert_right(executor, TASK, _points(3))


def test_interruption_cancels_what_has_not_begun(cluster):
    with DaskExecutor(cluster.client) as executor:
        rollouts = executor.run(TASK, _points(1000))
        next(rollouts)
        rollouts.close()
        _assert_right(executor, TASK, _points(3))


@pytest.mark.parametrize("how", [KILL, KILL_PARENT])
def test_killed_dask_worker_costs_only_time(how, cluster, tmp_path, caplog):
    """Kill -9, in the midst of a simulation, to the process that simulates or to the worker itself."""
    fuse = tmp_path / "fuse"
    fuse.touch()
    task = RolloutTask(TreacherousScenario(fuse=str(fuse)), 0.3, Quality(abs, SHOULDER))
    points = [{SHOULDER: value, "dps.gain[0]": 0.0} for value in np.linspace(0.1, 0.8, 8)]
    points[2]["dps.gain[0]"] = how
    with DaskExecutor(cluster.client) as executor:
        results = dict(executor.run(task, points))
    assert not fuse.exists()
    assert sorted(results) == list(range(8))
    assert not any(result.failed for result in results.values())
    assert ("rollout 2 is tried again, alone" in caplog.text) == (how == KILL_PARENT)


@pytest.mark.parametrize(
    ("how", "time_limit", "reason"),
    [
        (KILL, np.inf, "its worker process died (exit code -9)"),
        (HANG, 2.0, "it took longer than its time limit of 2 s"),
    ],
)
def test_rollout_that_crashes_or_hangs_fails_after_two_tries(how, time_limit, reason, cluster, tmp_path):
    fuse = tmp_path / "fuse"
    fuse.touch()
    task = RolloutTask(TreacherousScenario(fuse=str(fuse)), 0.3, Quality(abs, SHOULDER))
    points = [{"dps.gain[0]": gain} for gain in (0.0, 0.0, -how, 0.0, 0.0)]
    with DaskExecutor(cluster.client, time_limit=time_limit) as executor:
        before = cluster.client.run(os.getpid)
        results = dict(executor.run(task, points))
        assert before.items() <= cluster.client.run(os.getpid).items(), "it has cost a worker of the cluster"
    assert [results[index].failed for index in range(5)] == [False, False, True, False, False]
    assert results[2].message == f"{reason}; then {reason}"
    assert results[2].parameters == points[2]


def test_rollout_that_kills_dask_workers_fails_alone(cluster, tmp_path):
    fuse = tmp_path / "fuse"
    fuse.touch()
    task = RolloutTask(TreacherousScenario(fuse=str(fuse)), 0.3, Quality(abs, SHOULDER))
    points = [{"dps.gain[0]": gain} for gain in (0.0, 0.0, -KILL_PARENT, 0.0, 0.0)]
    with DaskExecutor(cluster.client) as executor:
        results = dict(executor.run(task, points))
    assert [results[index].failed for index in range(5)] == [False, False, True, False, False]
    assert "its workers died again and again" in results[2].message


def test_closed_executor_leaves_no_processes_on_the_workers(cluster):
    executor = DaskExecutor(cluster.client)
    list(executor.run(TASK, _points(4)))
    assert any(cluster.client.run(_children_of_this_process).values())
    executor.close()
    assert not any(cluster.client.run(_children_of_this_process).values())


def _run_after_teardown(points):
    worker = get_worker()
    (name,) = [name for name in worker.plugins if "vtbdrake" in name]
    worker.plugins[name].teardown(worker)
    try:
        return [pickle.loads(answer) for answer in run_on_dask(name, [0, 1], points, [b"", b""], 60.0)]
    finally:
        worker.plugins[name].setup(worker)


def test_worker_that_is_being_closed_does_not_go_on_with_its_chunk(cluster):
    with DaskExecutor(cluster.client) as executor:
        list(executor.run(TASK, _points(1)))
        answers = cluster.client.submit(_run_after_teardown, [pack(point) for point in _points(2)], pure=False).result()
    assert [(index, type(outcome)) for index, outcome in answers] == [(0, WorkerError), (1, WorkerError)]


def _children_of_this_process():
    threads = Path("/proc/self/task").iterdir()
    return [child for thread in threads for child in (thread / "children").read_text().split()]


def _slow(theta):
    time.sleep(0.05)
    return abs(theta)


def test_rollout_beyond_its_time_limit_fails(cluster):
    task = RolloutTask(PendulumScenario(), 100.0, Quality(_slow, THETA), threshold=0.5)
    with DaskExecutor(cluster.client, time_limit=2.0) as executor:
        results = dict(executor.run(task, [{THETA: 1.0}, {THETA: 0.1}, {THETA: 1.0}]))
    assert [results[index].end for index in range(3)] == ["threshold", "failed", "threshold"]
    assert results[1].message.count("it took longer than its time limit of 2 s") == 2


def test_dask_by_name_uses_the_scheduler_in_the_environment(cluster, monkeypatch):
    testbed = PendulumScenario().build()
    monkeypatch.setenv(ADDRESS, cluster.address)
    with make_executor("dask", testbed=testbed, rollouts=3, time_limit=60.0) as executor:
        assert isinstance(executor, DaskExecutor)
        _assert_right(executor, TASK, _points(3))
    monkeypatch.delenv(ADDRESS)
    with pytest.raises(ValueError, match=r"start one with `dask scheduler` .* or give executor=distributed.Client"):
        make_executor("dask", testbed=testbed, rollouts=3)
    with pytest.raises(ValueError, match="a Dask cluster has its own settings: workers=2"):
        make_executor("dask", testbed=testbed, rollouts=3, workers=2)


def test_client_of_the_user_stays_open(cluster):
    with make_executor(cluster.client, testbed=PendulumScenario().build(), rollouts=3) as executor:
        assert isinstance(executor, DaskExecutor)
    assert cluster.client.status == "running"
    own = DaskExecutor(cluster.address)
    client = own.client
    own.close()
    assert client.status == "closed"


def test_workers_may_have_removed_the_task_themselves(cluster):
    def remove(dask_worker):
        for name in [name for name in dask_worker.plugins if "vtbdrake" in name]:
            dask_worker.plugins.pop(name).teardown(dask_worker)

    with DaskExecutor(cluster.client) as executor:
        _assert_right(executor, TASK, _points(2))
        cluster.client.run(remove)  # As a worker that is being closed does.


def test_an_encrypted_scheduler_needs_certificates():
    with pytest.raises(ValueError, match=r"tls://127.0.0.1:9 needs certificates: give executor=Client\("):
        DaskExecutor("tls://127.0.0.1:9")


@pytest.mark.parametrize(("in_flight", "sent"), [(None, False), (2, False), (2, True)])
def test_a_client_that_has_closed_is_named(cluster, in_flight, sent):
    """At each request to the scheduler: the size of the cluster, the task, and a chunk of rollouts."""
    client = Client(cluster.address, set_as_default=False)
    executor = DaskExecutor(client, in_flight=in_flight)
    if sent:
        assert len(list(executor.run(TASK, _points(1)))) == 1
    client.close()
    with pytest.raises(WorkerError, match="the Dask scheduler has given up rollouts, or is gone"):
        list(executor.run(TASK, _points(2)))
    executor.close()


@pytest.mark.slow
def test_a_scheduler_that_is_lost_or_dead_is_named():
    """In the midst of rollouts, and before the task is sent."""
    with (
        dask_cluster(workers=1) as short,
        Client(short.address, timeout="5s", set_as_default=False) as client,
        Client(short.address, timeout="5s", set_as_default=False) as idle,
    ):
        rollouts, executor = DaskExecutor(client).run(TASK, _points(1000)), DaskExecutor(idle)
        next(rollouts)
        short.client.shutdown()
        with pytest.raises(WorkerError, match="the Dask scheduler has given up rollouts, or is gone"):
            list(rollouts)
        with pytest.raises(WorkerError, match="the Dask scheduler has given up rollouts, or is gone"):
            list(executor.run(TASK, _points(2)))
        executor.close()


def test_cluster_without_workers_is_reported_while_it_is_waited_for(monkeypatch):
    monkeypatch.setattr(cluster_module, "NO_WORKERS", 0.2)
    messages = queue.SimpleQueue()
    handler = logging.Handler()
    handler.emit = lambda record: messages.put(record.getMessage())
    log = logging.getLogger(cluster_module.__name__)
    log.addHandler(handler)
    try:
        with (
            LocalCluster(n_workers=0, threads_per_worker=1, processes=False, dashboard_address=None) as empty,
            Client(empty, set_as_default=False) as client,
            ThreadPoolExecutor(1) as pool,
        ):
            waiting = pool.submit(lambda: list(DaskExecutor(client).run(TASK, _points(2))))
            assert "the rollouts wait for one; start `dask worker " in messages.get(timeout=60.0)
            assert not waiting.done()
            empty.scale(1)
            assert len(waiting.result(timeout=60.0)) == 2
    finally:
        log.removeHandler(handler)


@pytest.mark.slow
@pytest.mark.one_python
def test_killed_study_on_many_slots_is_resumed(tmp_path):
    path = tmp_path / "killed.db"
    with LocalCluster(
        n_workers=4,
        threads_per_worker=SLOTS // 4,
        processes=False,
        protocol="tcp://",
        host="127.0.0.1",
        dashboard_address=None,
    ) as many:
        command = [sys.executable, "-m", "tests.rollout.waiting_study", str(path), many.scheduler_address]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as process:
            # It is killed in the midst of its second batch.
            for _ in range(round(1.5 * SLOTS)):
                assert process.stdout.readline(), "the study ended before it could be killed"
            process.send_signal(signal.SIGKILL)
        with waiting_study(path) as study, Waiting(many.scheduler_address, duration=0.0) as executor:
            before = set(study.rollouts)
            assert 1.5 * SLOTS <= len(before) < ROLLOUTS
            study.run(rollouts=ROLLOUTS, executor=executor, progress=False)
            assert before < set(study.rollouts)
            resumed = _table(study)
    # The same study, never interrupted and without a cluster.
    whole = waiting_study().run(
        rollouts=ROLLOUTS, executor=StatedExecutor(lambda point: (cost(point), ())), progress=False
    )
    assert len(whole) == ROLLOUTS
    assert resumed == _table(whole)


def _table(study):
    rollouts = {row: (result.h, result.value, result.end) for row, result in study.rollouts.items()}
    return [(trial.parameters, trial.values, trial.batch) for trial in study.trials], rollouts


def test_missing_scheduler_is_an_error():
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(WorkerError, match="no Dask scheduler answers at tcp://127.0.0.1:9: start one"),
    ):
        DaskExecutor("tcp://127.0.0.1:9")


def test_short_rollouts_travel_together(cluster):
    points = _points(120)
    with DaskExecutor(cluster.client) as executor, get_task_stream(client=cluster.client) as stream:
        _assert_right(executor, TASK, points)
        # One by one until their duration is known; a few milliseconds each.
        tasks = {entry["key"] for entry in stream.data}
        assert len(tasks) < 100
        # Few enough together that no thread has nothing to do.
        _assert_right(executor, TASK, _points(4))
