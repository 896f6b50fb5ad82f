"""All executors give the same results, in threads and processes."""

import copy
import os
import pickle
import signal
import subprocess
import sys
import textwrap
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from io import StringIO
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.rollout.scenarios import KILL, STOP, TreacherousScenario
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.rollout import (
    FuturesExecutor,
    ProcessExecutor,
    Quality,
    QualityError,
    RolloutTask,
    SerialExecutor,
    ThreadExecutor,
    WorkerError,
)
from vtbdrake.rollout.cluster import DaskExecutor
from vtbdrake.rollout.compiled_executor import CompiledExecutor
from vtbdrake.rollout.executor import run_rollouts, watched

ROOT = Path(__file__).resolve().parents[2]
SHOULDER = "sim.sys.Acrobot.shoulder.position"


def _angle(theta):
    return abs(theta)


def _bad_at_half(t):
    return -1.0 if t > 0.5 else 0.0


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", ["serial", "threads", "processes"])
def test_an_error_in_the_quality_reaches_the_user_as_itself(name, request):
    task = RolloutTask(AcrobotScenario(), 1.0, Quality(_bad_at_half, "time"))
    with (
        EXECUTORS[name](request.getfixturevalue) as executor,
        pytest.raises(QualityError, match="_bad_at_half at t = 0.55 s"),
    ):
        run_rollouts(executor, task, [{}] * 4, progress=False)


def test_what_cannot_travel_is_an_error_with_the_remedy(processes):
    lock = threading.Lock()
    task = RolloutTask(AcrobotScenario(), 1.0, Quality(lambda t: float(lock.locked()), "time"))
    with pytest.raises(WorkerError, match="use executor='threads' or 'serial'"):
        run_rollouts(processes, task, [{}], progress=False)


def test_a_value_that_cannot_travel_is_named(processes):
    task = RolloutTask(AcrobotScenario(), 0.1, Quality(_angle, SHOULDER))
    points = [{SHOULDER: 0.1, "dps.gain": threading.Lock()}]
    with pytest.raises(WorkerError, match="dps.gain = <unlocked .* cannot be sent"):
        list(processes.run(task, points))


def test_a_module_that_workers_do_not_have_is_named(monkeypatch, processes):
    module = ModuleType("only_here")
    exec("def f(theta):\n    return theta ** 2", module.__dict__)
    monkeypatch.setitem(sys.modules, "only_here", module)
    task = RolloutTask(AcrobotScenario(), 0.1, Quality(module.f, SHOULDER))
    with pytest.raises(WorkerError, match="No module named 'only_here'"):
        list(processes.run(task, [{}]))


@pytest.mark.parametrize(
    "make", [SerialExecutor, lambda: ThreadExecutor(1), lambda: ProcessExecutor(1), CompiledExecutor]
)
@pytest.mark.parametrize("copied", [pickle.dumps, copy.copy])
def test_an_executor_cannot_be_copied_to_another_process(make, copied):
    with (
        make() as executor,
        pytest.raises(TypeError, match=r"a \w+Executor cannot be pickled or copied: send the task"),
    ):
        copied(executor)


def test_progress_is_shown_in_a_kernel_only(monkeypatch):
    monkeypatch.setattr(sys, "stderr", StringIO())
    pytest.importorskip("ipykernel.zmqshell")
    assert not watched()
    shell = sys.modules["ipykernel.zmqshell"].ZMQInteractiveShell
    monkeypatch.setattr("IPython.get_ipython", lambda: shell)
    assert watched()


@pytest.mark.slow
@pytest.mark.parametrize(("how", "kind"), [(KILL, "died"), (STOP, "time limit")])
def test_a_lost_worker_costs_its_own_rollout_which_is_tried_again(how, kind, tmp_path, caplog):
    fuse = tmp_path / "fuse"
    fuse.touch()
    task = RolloutTask(TreacherousScenario(fuse=str(fuse)), 0.5, Quality(_angle, SHOULDER))
    points = [{SHOULDER: value, "dps.gain[0]": 0.0} for value in np.linspace(0.1, 0.8, 8)]
    with SerialExecutor() as executor:
        expected = run_rollouts(executor, task, points, progress=False)
    points[3]["dps.gain[0]"] = how
    with ProcessExecutor(2, time_limit=10.0 if how == KILL else 3.0) as executor:
        results = run_rollouts(executor, task, points, progress=False)
    assert kind in caplog.text
    assert not any(result.failed for result in results)
    assert all(a.identical(b) for i, (a, b) in enumerate(zip(results, expected, strict=True)) if i != 3)


@pytest.mark.slow
def test_a_rollout_that_kills_every_worker_fails_alone(tmp_path):
    fuse = tmp_path / "fuse"
    fuse.touch()
    task = RolloutTask(TreacherousScenario(fuse=str(fuse)), 0.5, Quality(_angle, SHOULDER))
    points = [{"dps.gain[0]": 0.0}, {"dps.gain[0]": -KILL}, {"dps.gain[0]": 0.0}]
    with ProcessExecutor(2) as executor:
        results = run_rollouts(executor, task, points, progress=False)
    assert [result.failed for result in results] == [False, True, False]
    assert results[1].message.count("died (exit code -9)") == 2


@pytest.mark.slow
def test_unguarded_script_uses_processes(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        textwrap.dedent("""
            from dataclasses import dataclass
            from tests.testbeds import AcrobotScenario
            from vtbdrake.rollout import ProcessExecutor, Quality, RolloutTask
            from vtbdrake.rollout.executor import run_rollouts, watched

            @dataclass
            class Mine(AcrobotScenario):
                period: float = 0.04

            def f(theta):
                return theta ** 2

            task = RolloutTask(Mine(), 0.5, Quality(f, "sim.sys.Acrobot.shoulder.position"))
            with ProcessExecutor(2) as executor:
                points = [{"sim.sys.Acrobot.shoulder.position": x} for x in (0.5, 1.0)]
                print([r.quality[0] for r in run_rollouts(executor, task, points)])
        """)
    )
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert eval(done.stdout.replace("np.float64", "")) == [0.25, 1.0]


@pytest.mark.parametrize(
    ("executor", "workers"),
    [
        pytest.param("serial", None, marks=pytest.mark.slow),
        ("threads", 2),
        pytest.param("processes", 2, marks=pytest.mark.slow),
    ],
)
def test_ctrl_c_keeps_what_is_finished(executor, workers, tmp_path):
    """A real SIGINT to a whole group of processes, as a terminal sends it."""
    script = tmp_path / "sweep.py"
    script.write_text(
        textwrap.dedent(f"""
            import logging
            import signal
            signal.signal(signal.SIGINT, signal.default_int_handler)  # Ignored where the tests run in the background.
            from tests.testbeds import AcrobotScenario
            import vtbdrake as vtb
            from vtbdrake.rollout import make_executor

            logging.basicConfig()
            shoulder = "sim.sys.Acrobot.shoulder.position"
            problem = vtb.Problem(
                scenario=AcrobotScenario(),
                parameters=[vtb.Parameter(shoulder, 0.0, 1.0)],
                quality=vtb.Quality(abs, shoulder),
                horizon=5.0,
            )

            class Telling:
                def __init__(self, inner):
                    self.inner = inner
                def run(self, task, points):
                    for i, item in enumerate(self.inner.run(task, points)):
                        print("finished", i, flush=True)
                        yield item

            from vtbdrake.rollout import Executor
            Executor.register(Telling)
            inner = make_executor({executor!r}, testbed=problem.testbed, rollouts=1000, workers={workers})
            sweep = problem.sweep(points=1000, executor=Telling(inner))
            inner.close()
            print("kept", len(sweep), sweep.complete, sweep.h[0] >= 0.0, flush=True)
        """)
    )
    with subprocess.Popen(
        [sys.executable, str(script)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        for _ in range(4):
            assert process.stdout.readline().startswith("finished")
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    kept, count, complete, positive = out.splitlines()[-1].split()
    assert (kept, complete, positive) == ("kept", "False", "True")
    # The fourth may have been on its way from the executor to the sweep.
    assert 3 <= int(count) < 1000
    assert "interrupted" in err


THETA = "sim.sys.Pendulum.theta.position"

EXECUTORS = {
    "serial": lambda get: SerialExecutor(),
    "threads": lambda get: ThreadExecutor(2),
    "processes": lambda get: nullcontext(get("processes")),
    "thread pool": lambda get: FuturesExecutor(ThreadPoolExecutor(2)),
    "process pool": lambda get: FuturesExecutor(get("process_pool")),
    "loky": lambda get: FuturesExecutor(get("loky_pool")),
    "own pool": lambda get: FuturesExecutor(get("own_pool")),
    "dask": lambda get: DaskExecutor(get("cluster").client),
}

# A testbed of Drake's systems only, and one with a DPS in Python; the variable and the fields that are varied.
TESTBEDS = {
    "cpp": (PendulumScenario(stiffness=1.0), THETA, "scenario.damping", (0.0, 0.5)),
    "python": (AcrobotScenario(), SHOULDER, "scenario.period", (0.02, 0.05)),
}


@pytest.fixture(scope="module", params=TESTBEDS)
def case(request):
    """A task, points, and the results of one rollout after another."""
    scenario, address, field, values = TESTBEDS[request.param]
    task = RolloutTask(scenario, 1.0, Quality(_angle, address), threshold=2.0, record=("plant.state",), keep_state=True)
    points = [{address: 0.1 + 0.5 * i} for i in range(5)]
    points += [{address: 0.5, field: value, "scenario.simulator_config.accuracy": 1e-3} for value in values]
    with SerialExecutor() as serial:
        expected = run_rollouts(serial, task, points, progress=False)
    assert {result.end for result in expected} == {"horizon", "threshold"}
    return task, points, expected


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in ("loky", "dask") else []) for name in EXECUTORS]
)
def test_all_executors_give_identical_results(name, case, request):
    task, points, expected = case
    with EXECUTORS[name](request.getfixturevalue) as executor:
        # Used a second time, it gives the same.
        for _ in range(2):
            results = run_rollouts(executor, task, points, progress=False)
            assert all(a.identical(b) for a, b in zip(results, expected, strict=True))
