"""A DPS written in CasADi: it does what the same DPS in Python does, and travels as testbeds do."""

from dataclasses import dataclass

import casadi
import numpy as np
import pytest

from tests.testbeds import AcrobotScenario
from vtbdrake.components.casadi_system import CasadiSystem
from vtbdrake.rollout import ProcessExecutor, Quality, RolloutTask, SerialExecutor, ThreadExecutor
from vtbdrake.rollout.executor import run_rollouts

SHOULDER = "sim.sys.Acrobot.shoulder.position"


@dataclass
class CasadiAcrobotScenario(AcrobotScenario):
    """The sampled state feedback of `AcrobotScenario`, in CasADi."""

    compile: bool = False

    def make_dps(self):
        s, k, n = casadi.SX.sym("s", 4), casadi.SX.sym("k", 4), casadi.SX.sym("n")
        names = ["joint_state", "gain", "ticks"], ["torque_next", "ticks_next"]
        return CasadiSystem(
            update=casadi.Function("update", [s, k, n], [casadi.dot(k, s), n + 1], *names),
            state={"torque": 0.0, "ticks": 0.0},
            period=self.period,
            parameters={"gain": [0.0, 0.0, -3.0, -1.0]},
            units={"torque": "N m", "gain": "N m/rad, N m s/rad"},
            bounds={"gain": (-1e3, 1e3)},
            compile=self.compile,
        )


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def _angle(theta):
    return abs(theta)


def _run(testbed, context, until):
    testbed.simulator(context).AdvanceTo(until)
    return testbed.snapshot(context)


@pytest.mark.parametrize("compile", [False, True])
def test_it_moves_the_world_as_the_same_dps_in_python_does(compile):
    task = [
        RolloutTask(scenario, 2.0, Quality(_angle, SHOULDER), record=("plant.state", "dps.ticks"))
        for scenario in (CasadiAcrobotScenario(compile=compile), AcrobotScenario())
    ]
    start = {SHOULDER: 0.4, "dps.gain": [0.0, 0.5, -4.0, -1.0]}
    ours, theirs = (run_rollouts(SerialExecutor(), t, [start], progress=False)[0] for t in task)
    np.testing.assert_allclose(ours.record["plant.state"], theirs.record["plant.state"], atol=1e-9)
    np.testing.assert_array_equal(ours.record["dps.ticks"], theirs.record["dps.ticks"])
    assert np.ptp(ours.record["plant.state"], axis=0).min() > 0.1


def test_its_state_and_parameters_are_listed_with_units_and_bounds():
    variables = CasadiAcrobotScenario().build().variables()
    assert {name: variables[name].kind for name in ("dps.gain", "dps.torque", "dps.ticks")} == {
        "dps.gain": "a",
        "dps.torque": "x",
        "dps.ticks": "x",
    }
    assert (variables["dps.gain"].unit, variables["dps.gain"].bounds) == ("N m/rad, N m s/rad", (-1e3, 1e3))


@pytest.mark.parametrize("compile", [False, True])
def test_original_and_copy_continue_alike_in_another_build(compile):
    original = CasadiAcrobotScenario(compile=compile).build()
    context = original.default_context()
    original.write(context, {SHOULDER: 0.5, "dps.gain": [0.0, 0.1, -2.0, -1.0]})
    at_fork = _run(original, context, 0.413)
    copy = CasadiAcrobotScenario(compile=compile).build()
    copied = copy.default_context()
    copy.restore(copied, at_fork)
    assert copy.read(copied, "dps.gain").tolist() == [0.0, 0.1, -2.0, -1.0]
    assert not copy.snapshot(copied).compare(at_fork)
    assert not _run(original, context, 1.1).compare(_run(copy, copied, 1.1))


@pytest.mark.slow_cases
@pytest.mark.parametrize("compile", [False, True])
def test_all_executors_give_identical_results(compile):
    task = RolloutTask(
        CasadiAcrobotScenario(compile=compile), 0.3, Quality(_angle, SHOULDER), record=("plant.state",), keep_state=True
    )
    points = [{SHOULDER: value} for value in np.linspace(0.1, 2.5, 3)]
    results = []
    for executor in (SerialExecutor(), ThreadExecutor(2), ProcessExecutor(1)):
        with executor:
            results.append(run_rollouts(executor, task, points, progress=False))
    serial, threads, processes = results
    assert not any(result.failed for result in serial)
    assert all(a.identical(b) and a.identical(c) for a, b, c in zip(serial, threads, processes, strict=True))
