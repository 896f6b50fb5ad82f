"""Executors differ in nothing but time: the results are the same to the last bit."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.rollout import FuturesExecutor, ProcessExecutor, Quality, RolloutTask, SerialExecutor, ThreadExecutor
from vtbdrake.rollout.cluster import DaskExecutor
from vtbdrake.rollout.executor import run_rollouts

SHOULDER = "sim.sys.Acrobot.shoulder.position"
THETA = "sim.sys.Pendulum.theta.position"

EXECUTORS = {
    "serial": lambda get: SerialExecutor(),
    "threads": lambda get: ThreadExecutor(2),
    "processes": lambda get: ProcessExecutor(2),
    "thread pool": lambda get: FuturesExecutor(ThreadPoolExecutor(2)),
    "process pool": lambda get: FuturesExecutor(get("process_pool")),
    "loky": lambda get: FuturesExecutor(get("loky_pool")),
    "ray": lambda get: FuturesExecutor(get("ray_pool")),
    "dask": lambda get: DaskExecutor(get("cluster").client),
}

# A testbed of Drake's systems only, and one with a DPS in Python; the variable and the fields that are varied.
TESTBEDS = {
    "cpp": (PendulumScenario(stiffness=1.0), THETA, "scenario.damping", (0.0, 0.5)),
    "python": (AcrobotScenario(), SHOULDER, "scenario.period", (0.02, 0.05)),
}


def _angle(theta):
    return abs(theta)


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


@pytest.mark.parametrize("make", EXECUTORS.values(), ids=EXECUTORS)
def test_all_executors_give_identical_results(make, case, request):
    task, points, expected = case
    with make(request.getfixturevalue) as executor:
        # Used a second time, it gives the same.
        for _ in range(2):
            results = run_rollouts(executor, task, points, progress=False)
            assert all(a.identical(b) for a, b in zip(results, expected, strict=True))
