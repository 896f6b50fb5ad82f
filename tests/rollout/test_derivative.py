"""Derivatives by AutoDiff through the simulation, against closed forms and central differences of rollouts."""

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig

from tests.optimization.studies import DoubleIntegratorScenario
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.rollout import Quality, RolloutRunner, RolloutTask
from vtbdrake.rollout.derivative import DerivativeError, DerivativeRunner

THETA, RATE = "sim.sys.Pendulum.theta.position", "sim.sys.Pendulum.theta.velocity"
DAMPING, MASS = "sim.sys.Pendulum.theta.damping", "sim.sys.Pendulum.arm_point_mass.mass"
FIXED = SimulatorConfig(max_step_size=0.005, accuracy=1e-3, use_error_control=False)
POINT = {THETA: 0.7, RATE: -0.4, DAMPING: 0.2, "u.angle": 0.3}


def task(quality, **scenario):
    return RolloutTask(PendulumScenario(simulator_config=FIXED, **scenario), 1.0, quality, sample_period=0.05)


def differences(stated, point, by, step=1e-4):
    """Central differences of plain rollouts; the steps are fixed, so that they are smooth."""
    runner = RolloutRunner(stated)

    def value(address, change):
        return runner.run({**point, address: point[address] + change}).value

    return np.array([(value(a, step) - value(a, -step)) / (2.0 * step) for a in by])


@pytest.mark.slow_cases
@pytest.mark.parametrize("reading", ["best", "worst", "end", "integral"])
@pytest.mark.parametrize("minimize", [False, True])
def test_derivatives_are_those_of_central_differences(reading, minimize):
    def f(theta, rate):
        return 2.0 + np.sin(theta) + 0.1 * rate**2

    stated = task(Quality(f, [THETA, RATE], reading=reading, minimize=minimize), stiffness=1.5, damping=0.1)
    by = list(POINT)
    value, gradient = DerivativeRunner(stated, stated.scenario.build()).run(POINT, by)
    assert value == pytest.approx(RolloutRunner(stated).run(POINT).value, rel=1e-9)
    assert gradient == pytest.approx(differences(stated, POINT, by), abs=2e-5)


def test_the_derivative_of_free_motion_is_known():
    # x'' = 0 without gains: x(T) = x0 + v0 T, and (x(T)^2)' = 2 x(T) (1, T).
    scenario = DoubleIntegratorScenario(simulator_config=FIXED, stiffness=0.0, damping=0.0)
    x, v = "sim.sys.mass.continuous_state[0]", "sim.sys.mass.continuous_state[1]"
    stated = RolloutTask(scenario, 2.0, Quality(lambda y: y[0] ** 2, "sim.sys.mass.y0", reading="end"))
    value, gradient = DerivativeRunner(stated, scenario.build()).run({x: 1.0, v: -0.2}, [x, v])
    assert value == pytest.approx(0.36)
    assert gradient == pytest.approx([1.2, 2.4], rel=1e-8)


def test_error_control_is_refused():
    stated = RolloutTask(PendulumScenario(), 1.0, Quality(abs, THETA))
    with pytest.raises(DerivativeError, match="set simulator_config.use_error_control to false"):
        DerivativeRunner(stated, stated.scenario.build())


def test_a_python_system_that_does_not_convert_is_named():
    stated = RolloutTask(AcrobotScenario(simulator_config=FIXED), 1.0, Quality(abs, "time"))
    with pytest.raises(DerivativeError, match="SampledFeedback"):
        DerivativeRunner(stated, stated.scenario.build())


def test_what_lies_outside_the_numeric_groups_is_refused():
    friction = "sim.sys.Pendulum.arm.friction"
    stated = task(Quality(abs, THETA))
    runner = DerivativeRunner(stated, stated.scenario.build())
    with pytest.raises(DerivativeError, match="friction does not lie in the numeric groups.*gradient='central'"):
        runner.run({**POINT, friction: 0.5}, [friction])
