"""Rollouts repeat, stop at t*, and report failures as outcomes."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from pydrake.common import RandomDistribution
from pydrake.geometry import DrakeVisualizer
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import EventStatus, LeafSystem
from pydrake.systems.primitives import RandomSource
from scipy.special import ellipk

import vtbdrake as vtb
from tests.testbeds import AcrobotScenario, PendulumScenario, SampledFeedback
from vtbdrake.rollout import (
    ProcessExecutor,
    Quality,
    RolloutResult,
    RolloutRunner,
    RolloutTask,
    SerialExecutor,
    ThreadExecutor,
)
from vtbdrake.rollout.executor import run_rollouts
from vtbdrake.state import Snapshot

THETA = "sim.sys.Pendulum.theta.position"
DAMPING = "sim.sys.Pendulum.theta.damping"
SHOULDER = "sim.sys.Acrobot.shoulder.position"
CENIC = SimulatorConfig(integration_scheme="cenic", accuracy=1e-4, max_step_size=0.05)


def _angle(theta):
    return abs(theta)


TASKS = {
    # Error control, and a DPS that does not sample: the steps are the integrator's own.
    "pendulum": (RolloutTask(PendulumScenario(stiffness=2.0), 2.0, Quality(_angle, THETA)), THETA),
    "acrobot": (RolloutTask(AcrobotScenario(), 2.0, Quality(_angle, SHOULDER)), SHOULDER),
    "cenic": (RolloutTask(AcrobotScenario(simulator_config=CENIC), 2.0, Quality(_angle, SHOULDER)), SHOULDER),
    "discrete": (RolloutTask(AcrobotScenario(time_step=0.005), 2.0, Quality(_angle, SHOULDER)), SHOULDER),
}


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", TASKS)
def test_a_used_runner_repeats_a_new_one_bit_for_bit(name):
    task, address = TASKS[name]
    task = RolloutTask(task.scenario, task.horizon, task.quality, keep_state=True)
    new, used = RolloutRunner(task), RolloutRunner(task)
    friction = next(a for a in used.testbed.variables() if a.endswith(".friction"))
    # Rollouts that leave traces: other state, other parameters, hidden ones, and one that fails.
    used.run({address: 2.9, friction: 0.1})
    used.run({address: 1.0, next(a for a in used.testbed.variables() if a.endswith(".mass")): 40.0})
    first, second = new.run({address: 0.3}), used.run({address: 0.3})
    assert first.identical(second)
    assert not first.identical(used.run({address: 0.3001}))


@pytest.mark.parametrize("name", TASKS)
def test_recording_and_running_on_do_not_change_the_trajectory(name):
    task, address = TASKS[name]
    plain = RolloutRunner(task).run({address: 0.3})
    recorded = RolloutRunner(RolloutTask(task.scenario, task.horizon, task.quality, record=(address, "plant.state")))
    result = recorded.run({address: 0.3})
    np.testing.assert_array_equal(plain.quality, result.quality)
    np.testing.assert_array_equal(np.abs(result.record[address]), plain.quality)
    assert result.record["plant.state"].shape[0] == plain.times.size


def test_it_is_the_simulation_that_drake_would_do():
    task, address = TASKS["acrobot"]
    testbed = AcrobotScenario().build()
    context = testbed.default_context()
    testbed.write(context, {address: 0.3})
    simulator = testbed.simulator(context)
    expected = [0.3]
    # The DPS samples at multiples of 0.02 s: of two instants that differ in the last bit, the event's counts.
    for t in task.sample_times()[1:]:
        event = round(t / 0.02) * 0.02
        simulator.AdvanceTo(event if abs(event - t) < 1e-9 else t)
        expected.append(abs(testbed.read(context, address)))
    np.testing.assert_array_equal(RolloutRunner(task).run({address: 0.3}).quality, expected)


@pytest.mark.slow
def test_an_undamped_pendulum_has_the_period_of_theory():
    accurate = SimulatorConfig(accuracy=1e-9, max_step_size=0.05)
    task = RolloutTask(PendulumScenario(simulator_config=accurate), 4.0, sample_period=0.005, record=(THETA,))
    runner = RolloutRunner(task)
    testbed = runner.testbed
    amplitude = 2.0
    result = runner.run({THETA: amplitude, DAMPING: 0.0})
    # The frequency of the linearized pendulum about its rest, from the plant: I qddot = -k q.
    context = testbed.default_context()
    plant_context = testbed.plant.GetMyContextFromRoot(context)
    inertia = testbed.plant.CalcMassMatrix(plant_context)[0, 0]
    testbed.write(context, {THETA: np.pi / 2})
    gravity = -testbed.plant.CalcGravityGeneralizedForces(plant_context)[0]
    period = 4.0 * np.sqrt(inertia / gravity) * ellipk(np.sin(amplitude / 2) ** 2)
    angle = result.record[THETA]
    falling = np.flatnonzero((angle[:-1] > 0) & (angle[1:] <= 0))
    crossings = result.times[falling] + 0.005 * angle[falling] / (angle[falling] - angle[falling + 1])
    assert crossings[1] - crossings[0] == pytest.approx(period, rel=1e-5)


def test_state_at_t_star_is_the_state_at_t_star():
    task = RolloutTask(PendulumScenario(), 2.0, Quality(lambda q: max(0.0, -q), THETA), keep_state=True)
    runner = RolloutRunner(task)
    result = runner.run({THETA: 1.0, DAMPING: 0.0})
    assert 0.0 < result.t_star < 2.0
    assert result.state.time == result.t_star
    assert -result.state[THETA] == result.h
    assert not runner.state({THETA: 1.0, DAMPING: 0.0}, result.t_star).compare(result.state)
    with pytest.raises(ValueError, match="not a sample time; the nearest is 0.3 s"):
        runner.state({THETA: 1.0}, 0.31)


def test_a_rollout_from_a_snapshot_continues_the_original_bit_for_bit():
    scenario = AcrobotScenario()
    long = RolloutTask(scenario, 2.0, Quality(_angle, SHOULDER))
    whole = RolloutRunner(long).run({SHOULDER: 0.3})
    start = RolloutRunner(long).state({SHOULDER: 0.3}, 1.0)
    rest = RolloutRunner(RolloutTask(scenario, 1.0, Quality(_angle, SHOULDER), start=start)).run({})
    # Time counts from t0; at the fork both take a new integrator, so the sampled original is met to its accuracy.
    np.testing.assert_allclose(rest.times, whole.times[20:] - 1.0, atol=1e-12)
    np.testing.assert_allclose(rest.quality, whole.quality[20:], atol=1e-4)
    assert rest.identical(RolloutRunner(RolloutTask(scenario, 1.0, Quality(_angle, SHOULDER), start=start)).run({}))


class Exploding(LeafSystem):
    """xdot = x^2 goes to infinity at t = 1 / x(0)."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("joint_state", 4)
        self.DeclareContinuousState(1)
        self.DeclareVectorOutputPort("torque", 1, lambda c, y: y.SetFromVector([0.0]))

    def DoCalcTimeDerivatives(self, context, derivatives):
        x = context.get_continuous_state_vector()[0]
        derivatives.get_mutable_vector().SetFromVector([x * x])


class Raising(SampledFeedback):
    """Raises what it is told to when the clock passes 0.5 s."""

    def __init__(self, error):
        super().__init__(0.02)
        self._error = error
        self.DeclarePeriodicUnrestrictedUpdateEvent(0.1, 0.05, self._maybe)

    def _maybe(self, context, state):
        if context.get_time() > 0.5:
            raise self._error


@dataclass
class BrokenScenario(AcrobotScenario):
    simulator_config: SimulatorConfig = field(
        default_factory=lambda: SimulatorConfig(
            integration_scheme="explicit_euler", max_step_size=0.01, use_error_control=False
        )
    )
    kind: str = "explodes"

    def make_dps(self):
        kinds = {
            "explodes": Exploding,
            "raises": lambda: Raising(RuntimeError("out of cheese")),
            "exits": lambda: Raising(SystemExit("condition 'x > 0' failed")),
        }
        return kinds[self.kind]()


@pytest.mark.parametrize(
    ("kind", "parameters", "message"),
    [
        ("explodes", {"dps.continuous_state[0]": 4.0}, "not finite"),
        ("raises", {}, "RuntimeError: out of cheese"),
        ("exits", {}, "SystemExit: condition 'x > 0' failed"),
    ],
)
def test_a_simulation_that_fails_is_an_outcome(kind, parameters, message):
    task = RolloutTask(BrokenScenario(kind=kind), 2.0, Quality(_angle, SHOULDER))
    runner = RolloutRunner(task)
    result = runner.run(parameters)
    assert result.failed
    assert message in result.message
    assert np.isnan(result.h)
    assert np.isnan(result.t_star)
    assert 0 < result.times.size < task.sample_times().size
    # The next one is not touched by it.
    if kind == "explodes":
        assert runner.run({}).identical(RolloutRunner(task).run({}))


def test_a_failed_assertion_of_drake_is_an_outcome():
    # A mass matrix that is not positive definite.
    task = RolloutTask(AcrobotScenario(), 0.5)
    masses = {a: 0.0 for a in RolloutRunner(task).testbed.variables() if a.endswith(("link.mass",))}
    result = RolloutRunner(task).run(masses)
    assert result.failed
    assert result.message


def test_the_threshold_counts_although_the_simulation_fails_later():
    task = RolloutTask(BrokenScenario(kind="raises"), 2.0, Quality(lambda t: t, "time"), threshold=0.2, run_on=True)
    result = RolloutRunner(task).run({})
    assert (result.end, result.t_star) == ("threshold", pytest.approx(0.25))
    assert "out of cheese" in result.message


class Terminating(SampledFeedback):
    """Ends the simulation when it has had enough."""

    def __init__(self):
        super().__init__(0.02)
        self.DeclarePeriodicUnrestrictedUpdateEvent(0.1, 0.05, self._enough)

    def _enough(self, context, state):
        return (
            EventStatus.ReachedTermination(self, "had enough") if context.get_time() > 0.5 else EventStatus.Succeeded()
        )


@dataclass
class TerminatingScenario(AcrobotScenario):
    def make_dps(self):
        return Terminating()


def test_a_system_may_end_the_rollout():
    result = RolloutRunner(RolloutTask(TerminatingScenario(), 2.0, Quality(lambda t: t, "time"))).run({})
    assert result.end == "terminated"
    assert "had enough" in result.message
    assert 0.5 < result.h < 0.7


class Unwilling(SampledFeedback):
    """Ends the simulation before it begins, when it is initialized or when it publishes at first."""

    def __init__(self, declare):
        super().__init__(0.02)
        getattr(self, declare)(publish=lambda context: EventStatus.ReachedTermination(self, "will not"))


@dataclass
class UnwillingScenario(AcrobotScenario):
    declare: str = "DeclareInitializationPublishEvent"

    def make_dps(self):
        return Unwilling(self.declare)


@pytest.mark.parametrize("declare", ["DeclareInitializationPublishEvent", "DeclarePerStepPublishEvent"])
def test_a_system_may_end_the_rollout_where_it_begins(declare):
    task = RolloutTask(UnwillingScenario(declare=declare), 2.0, Quality(lambda t: 1.0 + t, "time"), keep_state=True)
    runner = RolloutRunner(task)
    result = runner.run({})
    assert (result.end, result.t_star, result.times.tolist()) == ("terminated", 0.0, [0.0])
    assert "will not" in result.message
    simulator = runner.testbed.simulator()
    assert not simulator.Initialize().succeeded()
    assert result.state == runner.state({}, 0.0) == runner.testbed.snapshot(simulator.get_context())


class SelfWilled(SampledFeedback):
    """Its torque is 7 N m once it is initialized, and its law's from the first sample on."""

    def __init__(self):
        super().__init__(0.02)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._initialize)

    def _initialize(self, context, state):
        state.get_mutable_discrete_state(0).SetFromVector([7.0])


@dataclass
class SelfWilledScenario(AcrobotScenario):
    def make_dps(self):
        return SelfWilled()


def test_what_an_initialization_event_overwrites_cannot_be_varied():
    runner = RolloutRunner(RolloutTask(SelfWilledScenario(), 0.1, record=("dps.torque",)))
    assert runner.run({}).record["dps.torque"][0] == 7.0
    with pytest.raises(ValueError, match="dps.torque was set to 1.0, but an initialization event .* has made 7.0"):
        runner.run({"dps.torque": 1.0})


def test_hidden_variables_come_back():
    runner = RolloutRunner(RolloutTask(AcrobotScenario(), 0.1, record=("sim.sys.Acrobot.lower_link.friction",)))
    changed = runner.run({"sim.sys.Acrobot.lower_link.friction": 0.123})
    assert changed.record["sim.sys.Acrobot.lower_link.friction"][-1] == pytest.approx(0.123)
    assert runner.run({}).record["sim.sys.Acrobot.lower_link.friction"][-1] == pytest.approx(1.0)


def test_an_unknown_address_is_an_error_before_anything_runs():
    with pytest.raises(ValueError, match="did you mean"):
        RolloutRunner(RolloutTask(AcrobotScenario(), 0.1, Quality(_angle, "sim.sys.Acrobot.sholder.position")))
    with pytest.raises(ValueError, match="did you mean dps.torque"):
        RolloutRunner(RolloutTask(AcrobotScenario(), 0.1, record=("dps.torqe",)))


VELOCITY = "sim.sys.Acrobot.shoulder.velocity"
FRICTION = "sim.sys.Acrobot.lower_link.friction"


def test_initialization_events_do_not_touch_a_restored_s0():
    scenario = SelfWilledScenario()
    task = RolloutTask(scenario, 0.1, record=("dps.torque",))
    fresh = RolloutRunner(task)
    assert fresh.run({}).record["dps.torque"][0] == 7.0
    start = fresh.state({SHOULDER: 0.3}, 0.05)
    assert start["dps.torque"] != 7.0
    result = RolloutRunner(replace(task, start=start)).run({})
    assert result.record["dps.torque"][0] == start["dps.torque"]


def test_what_is_set_in_a_restored_s0_is_not_initialized_away():
    scenario = SelfWilledScenario()
    task = RolloutTask(scenario, 0.1, record=("dps.torque",))
    start = RolloutRunner(task).state({}, 0.05)
    result = RolloutRunner(replace(task, start=start)).run({"dps.torque": 2.5})
    assert result.record["dps.torque"][0] == 2.5


@pytest.mark.parametrize("time_step", [0.0, 0.005])
def test_hidden_variables_of_the_start_act_from_the_first_rollout(time_step):
    scenario = AcrobotScenario(time_step=time_step)
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {FRICTION: 0.123})
    task = RolloutTask(scenario, 0.1, record=(FRICTION,), start=testbed.snapshot(context))
    runner = RolloutRunner(task)
    assert runner.run({}).record[FRICTION].tolist() == [0.123] * 3
    assert runner.run({FRICTION: 0.5}).record[FRICTION].tolist() == [0.5] * 3
    assert runner.run({}).record[FRICTION].tolist() == [0.123] * 3


def test_a_discrete_plant_gone_infinite_is_a_failed_outcome():
    # Neither the quality nor the recording would notice: they do not look at the plant.
    task = RolloutTask(
        AcrobotScenario(time_step=0.005), 0.015, Quality(lambda t: t, "time"), sample_period=0.005, record=("time",)
    )
    runner = RolloutRunner(task)
    result = runner.run({VELOCITY: 1e200})
    assert result.failed
    assert "the state is not finite at t = 0.005 s" in result.message
    assert result.times.tolist() == [0.0]
    assert np.isnan(result.h)
    # The next one is not touched by it.
    assert runner.run({}).identical(RolloutRunner(task).run({}))


def _snapshot(value=1.0):
    return Snapshot(0.05, {"a": np.array(value)}, {"s/discrete_state/0": np.array([2.0])})


RESULT = RolloutResult(
    parameters={"a": 1.0, "b": np.array([1.0, 2.0])},
    end="horizon",
    message="",
    times=np.array([0.0, 0.05]),
    quality=np.array([0.5, np.nan]),
    t_star=0.0,
    h=0.5,
    record={"x": np.array([[1.0], [np.nan]]), "port": ["up", "down"]},
    state=_snapshot(),
    wall_time=1.0,
)


def test_a_copy_is_identical_whatever_time_it_took():
    copy = replace(
        RESULT,
        parameters={"b": np.array([1.0, 2.0]), "a": 1.0},
        times=RESULT.times.copy(),
        quality=RESULT.quality.copy(),
        record={"x": RESULT.record["x"].copy(), "port": ["up", "down"]},
        state=_snapshot(),
        wall_time=2.0,
    )
    assert RESULT.identical(copy)
    failed = replace(RESULT, t_star=np.nan, h=np.nan)
    assert failed.identical(replace(failed, wall_time=np.nan))


@pytest.mark.parametrize(
    "change",
    [
        {"parameters": {"a": 1.0 + 1e-15, "b": np.array([1.0, 2.0])}},
        {"parameters": {"a": 1.0, "b": np.array([1.0, 3.0])}},
        {"parameters": {"a": 1.0}},
        {"parameters": {**RESULT.parameters, "c": 1.0}},
        {"end": "terminated"},
        {"message": "had enough"},
        {"times": np.array([0.0, 0.05 + 1e-15])},
        {"times": np.array([0.0])},
        {"quality": np.array([0.5, 0.5])},
        {"quality": np.array([0.5 + 1e-15, np.nan])},
        {"t_star": 0.05},
        {"t_star": np.nan},
        {"h": 0.5 + 1e-15},
        {"h": np.nan},
        {"record": {**RESULT.record, "x": np.array([[1.0 + 1e-15], [np.nan]])}},
        {"record": {**RESULT.record, "x": np.array([[1.0], [1.0]])}},
        {"record": {**RESULT.record, "port": ["up", "up"]}},
        {"record": {"port": ["up", "down"]}},
        {"record": {**RESULT.record, "y": np.array([1.0])}},
        {"state": None},
        {"state": _snapshot(1.0 + 1e-15)},
    ],
    ids=lambda change: "-".join(change),
)
def test_whatever_else_differs_is_not_identical(change):
    other = replace(RESULT, **change)
    assert not RESULT.identical(other)
    assert not other.identical(RESULT)


def _amplitude(scenario):
    return RolloutTask(scenario, 1.0, Quality(abs, THETA))


@pytest.mark.slow_cases
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
    with ProcessExecutor(1) as executor:
        sweep = problem.sweep(values=[0.5], executor=executor, progress=False)
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


@dataclass
class DrawingScenario(PendulumScenario):
    def add_world(self, builder):
        super().add_world(builder)
        DrakeVisualizer.AddToBuilder(builder.diagram_builder, builder.scene_graph, DrakeLcm("memq://"))


def test_a_rollout_does_not_draw():
    assert DrawingScenario().build().visualized
    assert not PendulumScenario().build().visualized
    with pytest.raises(ValueError, match="a rollout does not draw: .* without visualizers in its world"):
        RolloutRunner(RolloutTask(DrawingScenario(), 0.1))


def test_a_rollout_does_not_keep_the_pace_of_its_scenario():
    paced = PendulumScenario(simulator_config=SimulatorConfig(accuracy=1e-3, target_realtime_rate=1.0))
    assert RolloutRunner(RolloutTask(paced, 100.0)).run({}).wall_time < 50.0
