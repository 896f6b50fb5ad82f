"""Results are of what was asked: scenario, snapshot, time."""

from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.common import RandomDistribution
from pydrake.systems.primitives import RandomSource

import vtbdrake as vtb
from tests.rollout.test_runner import BrokenScenario, TerminatingScenario
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.rollout import ProcessExecutor, Quality, RolloutRunner, RolloutTask, SerialExecutor, ThreadExecutor
from vtbdrake.rollout.executor import run_rollouts

THETA = "sim.sys.Pendulum.theta.position"
SHOULDER = "sim.sys.Acrobot.shoulder.position"


def _amplitude(scenario):
    return RolloutTask(scenario, 1.0, Quality(abs, THETA))


@pytest.mark.parametrize("make", [SerialExecutor, ThreadExecutor])
def test_an_executor_with_a_testbed_runs_the_scenario_of_its_task(make):
    soft, stiff = PendulumScenario(stiffness=0.0), PendulumScenario(stiffness=50.0)
    point = [{THETA: 0.5, "u.angle": 3.0}]
    with make(testbed=soft.build()) as executor:
        results = [run_rollouts(executor, _amplitude(s), point, progress=False)[0] for s in (soft, stiff)]
    expected = [RolloutRunner(_amplitude(s)).run(point[0]) for s in (soft, stiff)]
    assert all(a.identical(b) for a, b in zip(results, expected, strict=True))
    assert results[0].h != results[1].h


def test_a_runner_refuses_the_testbed_of_another_scenario():
    with pytest.raises(ValueError, match="another scenario"):
        RolloutRunner(_amplitude(PendulumScenario()), PendulumScenario(stiffness=1.0).build())


def test_a_scenario_that_is_changed_afterwards_changes_nothing():
    scenario = PendulumScenario(stiffness=0.0)
    problem = vtb.Problem(
        scenario=scenario,
        parameters=[vtb.Parameter(THETA, 0, 1)],
        quality=vtb.Quality(abs, THETA),
        horizon=1.0,
        conditions=[{"u.angle": 3.0}],
    )
    before = problem.rollout([0.5])
    scenario.stiffness = 50.0
    assert problem.rollout([0.5]).identical(before)
    sweep = problem.sweep(values=[0.5], executor=ProcessExecutor(1), progress=False)
    assert sweep.h[0] == before.h
    assert sweep.scenario["stiffness"] == 0.0


def test_integers_are_numbers():
    problem = vtb.Problem(
        scenario=PendulumScenario(),
        parameters=[vtb.Parameter("sim.sys.Pendulum.theta.velocity", 0, 8)],
        quality=vtb.Quality(abs, THETA),
        horizon=1,
        threshold=1,
    )
    boundary = problem.boundary(resolution=1, coarse=2, executor="serial", progress=False)
    assert boundary.upper - boundary.lower == 1.0


def test_a_snapshot_of_the_running_robot_is_simulated():
    scenario = AcrobotScenario()
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.diagram.GetInputPort("real.sense.joint_state").FixValue(context, np.zeros(4))
    testbed.switch(context, "real")
    task = RolloutTask(scenario, 0.5, Quality(abs, SHOULDER), start=testbed.snapshot(context))
    assert RolloutRunner(task).run({SHOULDER: 0.3}).end == "horizon"


def test_state_at_t_star_is_right_although_the_simulation_failed_later():
    task = RolloutTask(
        BrokenScenario(kind="raises"), 2.0, Quality(lambda t: t, "time"), threshold=0.49, run_on=True, keep_state=True
    )
    result = RolloutRunner(task).run({})
    assert result.state.time == result.t_star == pytest.approx(0.5)


def test_a_terminated_rollout_ends_when_it_was_terminated():
    task = RolloutTask(TerminatingScenario(), 2.0, Quality(lambda t: t, "time"), sample_period=0.2, keep_state=True)
    runner = RolloutRunner(task)
    result = runner.run({})
    assert result.t_star == result.h == result.state.time == result.times[-1] == pytest.approx(0.55)
    with pytest.raises(RuntimeError, match="had enough"):
        runner.state({}, 1.0)


@dataclass
class WithGusts(AcrobotScenario):
    def add_world(self, builder):
        super().add_world(builder)
        builder.add("env", "gusts", RandomSource(RandomDistribution.kGaussian, 1, 0.1))


def test_what_no_copy_can_repeat_is_refused():
    with pytest.raises(ValueError, match="no copy can continue"):
        WithGusts().build()
