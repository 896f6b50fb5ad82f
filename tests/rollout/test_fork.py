"""The future of a running simulation, and the rollout that forecasts it: equal to the last bit."""

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig

from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.rollout import RolloutRunner, RolloutTask
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

# Name -> (scenario, an address of its state, seconds before the fork, seconds after it)
CASES = {
    "CENIC, walking": (SpaceClimberScenario(), "sim.sys.climber.base.pose", 0.61, 0.6),
    "RK3, sampled": (
        AcrobotScenario(
            simulator_config=SimulatorConfig(max_step_size=0.2, accuracy=1e-3),
            period=0.3,
        ),
        "sim.sys.Acrobot.elbow.position",
        1.13,
        3.0,
    ),
    "RK3, without samples": (
        PendulumScenario(simulator_config=SimulatorConfig(max_step_size=0.5, accuracy=1e-4)),
        "sim.sys.Pendulum.theta.position",
        1.13,
        3.0,
    ),
}


@pytest.fixture(params=CASES)
def running(request):
    """A problem's arguments, and a testbed that has run for a while."""
    scenario, address, before, after = CASES[request.param]
    testbed = scenario.build()
    context = testbed.default_context()
    if address.endswith("position"):
        testbed.write(context, {address: 0.8})
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(before)
    return scenario, address, after, testbed, simulator


def _forecast(scenario, address, after, start):
    task = RolloutTask(scenario, after, record=[address], sample_period=0.15, start=start)
    return task, RolloutRunner(task).run({}).record[address]


def _future(task, testbed, simulator, address, t0):
    context = simulator.get_mutable_context()
    found = [testbed.read(context, address)]
    for instant in task.instants(t0, testbed.event_timings())[1:]:
        simulator.AdvanceTo(instant)
        found.append(testbed.read(context, address))
    return np.array(found)


def test_after_a_fork_forecast_and_future_are_equal(running):
    scenario, address, after, testbed, simulator = running
    t0 = simulator.get_context().get_time()
    start = testbed.fork(simulator)
    assert simulator.get_context().get_time() == t0
    assert not testbed.snapshot(simulator.get_context()).compare(start)
    task, forecast = _forecast(scenario, address, after, start)
    np.testing.assert_array_equal(forecast, _future(task, testbed, simulator, address, t0))
    assert np.ptp(forecast, axis=0).max() > 1e-2, "nothing has moved"


def test_without_it_the_integrators_memory_makes_a_difference(running):
    scenario, address, after, testbed, simulator = running
    t0 = simulator.get_context().get_time()
    start = testbed.snapshot(simulator.get_context())
    task, forecast = _forecast(scenario, address, after, start)
    future = _future(task, testbed, simulator, address, t0)
    assert not np.array_equal(forecast, future)
    np.testing.assert_allclose(forecast, future, atol=0.05)


def test_a_simulator_of_another_testbed_is_refused():
    testbed, other = PendulumScenario().build(), PendulumScenario().build()
    with pytest.raises(ValueError, match=r"make it by testbed.simulator\(\)"):
        testbed.fork(other.simulator())
    with pytest.raises(ValueError, match="fork a simulator made by .* not None"):
        testbed.fork(None)
