"""Tests that what is not finite ends a rollout by its name; Drake's integrators would shorten their step for ever."""

import itertools
import os
import re
import signal
import threading
import time
from math import inf
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LinearSystem

from tests.interruptions import hanging_fails
from tests.rollout.nonfinite import NonfiniteScenario, Tank, compiled_law
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.drake_workarounds import step_watch
from vtbdrake.drake_workarounds.step_watch import NoProgressError
from vtbdrake.rollout import (
    ProcessExecutor,
    Quality,
    RolloutTask,
    SerialExecutor,
    ThreadExecutor,
    executor,
    make_executor,
    worker_processes,
)
from vtbdrake.testbed import SignalError
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

SHOULDER = "sim.sys.Acrobot.shoulder.position"
THETA = "sim.sys.Pendulum.theta.position"


@pytest.fixture(scope="module")
def process():
    """A process in which a rollout that never ends costs a few seconds."""
    with ProcessExecutor(1, time_limit=20.0) as made:
        yield made


def result(process, scheme, **fields):
    config = SimulatorConfig(integration_scheme=scheme, max_step_size=0.05, accuracy=1e-3)
    task = RolloutTask(NonfiniteScenario(config, **fields), 1.0, Quality(abs, "time"))
    ((_, only),) = process.run(task, [{}])
    return only


# An explicit integrator with error control, an implicit one, and CENIC, which integrates a plant; the others are slow.
OFTEN = [("runge_kutta3", False), ("implicit_euler", False), ("cenic", True)]
SELDOM = [("runge_kutta5", False), ("bogacki_shampine3", False), ("radau3", False)]
SELDOM += [("runge_kutta3", True), ("implicit_euler", True), ("radau3", True)]
WORLDS = [*OFTEN, *(pytest.param(*world, marks=pytest.mark.slow) for world in SELDOM)]
SLOW_SCHEMES = ("implicit_euler", "runge_kutta5", "bogacki_shampine3", "radau3")
SCHEMES = ["runge_kutta3", *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW_SCHEMES)]


@pytest.mark.parametrize("compiled", [False, True], ids=["python", "compiled"])
@pytest.mark.parametrize(("scheme", "plant"), WORLDS)
def test_command_that_is_not_finite_fails_the_rollout_by_name(process, scheme, plant, compiled):
    for bad, sampled in itertools.product(("nan", "inf", "-inf"), (True, False)):
        failed = result(process, scheme, bad=bad, sampled=sampled, plant=plant, compiled=compiled)
        assert failed.end == "failed"
        assert f"the DPS commands force = [{bad}]" in failed.message
        assert failed.times[-1] == pytest.approx(0.3 if sampled else 0.25)


@pytest.mark.parametrize("compiled", [False, True], ids=["python", "compiled"])
def test_every_executor_says_the_same(process, compiled):
    scenario = NonfiniteScenario(SimulatorConfig(integration_scheme="runge_kutta3"), compiled=compiled)
    task = RolloutTask(scenario, 1.0, Quality(abs, "time"))
    # First where an endless rollout ends.
    messages = [[outcome.message for _, outcome in process.run(task, [{}])]]
    for made in (SerialExecutor(), ThreadExecutor(2)):
        with made:
            messages.append([outcome.message for _, outcome in made.run(task, [{}])])
    assert messages == 3 * [["the DPS commands force = [nan] at t = 0.3 s, which is not finite"]]


@pytest.mark.parametrize("fields", [{"plant": True, "time_step": 0.01}, {}])
def test_command_is_named_where_the_steps_are_fixed(process, fields):
    failed = result(process, "explicit_euler", **fields)
    assert failed.end == "failed"
    assert re.match(r"the DPS commands force = \[nan\] at t = [\d.]+ s, which is not finite; ", failed.message)


@pytest.mark.parametrize("scheme", ["runge_kutta3", "implicit_euler", "cenic"])
@pytest.mark.parametrize("bad", ["nan", "inf"])
def test_world_that_is_not_finite_from_the_beginning_fails(process, scheme, bad):
    failed = result(process, scheme, bad=bad, in_world=True, plant=scheme == "cenic")
    assert failed.end == "failed"
    assert "commands" not in failed.message
    if scheme != "cenic":
        assert failed.message.startswith("the time derivative of sim.sys.mass.")
        assert failed.message.endswith(" is not finite at t = 0 s")


ROOTS = ["of time", "of state", "of input", "of wind"]
NO_STEP = r"the time derivative of sim.env.tank.continuous_state\S* is not finite at t = (0.[\d]+) s"


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("root", ROOTS)
def test_world_that_becomes_nan_in_a_step_fails_with_the_address(process, scheme, root):
    failed = result(process, scheme, root=root)
    assert failed.end == "failed"
    if scheme in ("implicit_euler", "radau3") and root in ("of time", "of state"):  # Drake refuses their short steps.
        assert "step smaller than minimum" in failed.message
    else:
        (t,) = re.fullmatch(NO_STEP, failed.message).groups()
        # With u = sqrt(x), 2 u u' = -u - 1/8: the tank is empty at 2 (u - ln(1 + 8 u) / 8), from u = 1/4 on.
        end = 0.5 - 0.25 * np.log(3.0) if root == "of state" else 0.25
        assert float(t) == pytest.approx(end, rel=2e-3)


@pytest.fixture
def quick_look(monkeypatch):
    monkeypatch.setattr(step_watch, "PERIOD", 0.05)


def test_state_is_named_although_the_integrator_is_held_up_in_the_midst_of_a_step(quick_look, monkeypatch):
    begun, held_up, looks, looked = threading.Event(), threading.Event(), [], threading.Condition()
    state_before_attempts, derivatives_of = step_watch.state_before_attempts, Tank.DoCalcTimeDerivatives

    def look_from_the_midst(integrator, context, **limits):
        begun.set()
        held_up.wait()
        return state_before_attempts(integrator, context, **limits)

    def look_again(seconds):
        with looked:
            looks.append(seconds)
            looked.notify()
        time.sleep(seconds)

    def hold_up(self, context, derivatives):
        x = context.get_continuous_state_vector().CopyToVector()
        if begun.is_set() and not held_up.is_set() and context.get_time() > 0.25 and np.isfinite(x).all():
            with looked:
                held_up.set()
                end = len(looks) + 25
                looked.wait_for(lambda: len(looks) >= end)
        derivatives_of(self, context, derivatives)

    monkeypatch.setattr(step_watch, "time", SimpleNamespace(sleep=look_again))
    monkeypatch.setattr(step_watch, "state_before_attempts", look_from_the_midst)
    monkeypatch.setattr(Tank, "DoCalcTimeDerivatives", hold_up)
    config = SimulatorConfig(integration_scheme="radau3", max_step_size=0.05, accuracy=1e-3)
    task = RolloutTask(NonfiniteScenario(config, root="of input"), 1.0, Quality(abs, "time"))
    ((_, failed),) = SerialExecutor().run(task, [{}])
    (t,) = re.fullmatch(NO_STEP, failed.message).groups()
    assert float(t) == 0.25


@pytest.mark.slow_cases
@pytest.mark.parametrize("executor", [SerialExecutor, lambda: ThreadExecutor(2)], ids=["serial", "threads"])
@pytest.mark.parametrize("root", ROOTS)
def test_world_that_becomes_nan_ends_in_this_process_too(process, quick_look, executor, root):
    task = RolloutTask(NonfiniteScenario(SimulatorConfig(), root=root), 1.0, Quality(abs, "time"))
    messages = [outcome.message for _, outcome in process.run(task, [{}])]  # here it would hang
    with executor() as made:
        for _ in range(2):  # The same testbed goes on.
            messages += [outcome.message for _, outcome in made.run(task, [{}, {}])]
    assert all(re.fullmatch(NO_STEP, message) for message in messages), messages


@pytest.mark.parametrize("compiled", [False, True], ids=["python", "compiled"])
def test_plain_simulation_is_refused_too(process, compiled):
    config = SimulatorConfig(integration_scheme="runge_kutta3")
    assert result(process, "runge_kutta3", compiled=compiled).end == "failed"  # here it would hang
    testbed = NonfiniteScenario(config, compiled=compiled).build()
    context = testbed.default_context()
    with pytest.raises(SignalError, match=r"the DPS commands force = \[nan\] at t = 0.3 s, which is not finite"):
        testbed.simulator(context).AdvanceTo(1.0)


@pytest.mark.parametrize(("scheme", "time_step"), [("runge_kutta3", 0.01), ("cenic", 0.0)])
def test_plain_simulation_of_a_plant_names_the_command(process, scheme, time_step):
    assert result(process, scheme, plant=True, time_step=time_step).end == "failed"  # here it would hang
    config = SimulatorConfig(integration_scheme=scheme)
    simulator = NonfiniteScenario(config, plant=True, time_step=time_step).build().simulator()
    with pytest.raises(SignalError, match=r"the DPS commands force = \[nan\] at t = .* s, which is not finite; "):
        simulator.AdvanceTo(1.0)


def test_ctrl_c_reaches_an_integrator_that_hangs(process, quick_look, monkeypatch):
    task = RolloutTask(NonfiniteScenario(SimulatorConfig(), root="of wind", compiled=True), 1.0, Quality(abs, "time"))
    assert [outcome.end for _, outcome in process.run(task, [{}])] == ["failed"]  # here it would hang
    look = step_watch.StepWatch.look

    def press_and_look(self):
        os.kill(os.getpid(), signal.SIGINT)
        look(self)

    monkeypatch.setattr(step_watch.StepWatch, "look", press_and_look)
    with pytest.raises(KeyboardInterrupt):
        list(SerialExecutor().run(task, [{}]))


@pytest.mark.parametrize("scheme", ["runge_kutta3", "radau3"])
def test_looks_change_no_bit_of_a_simulation(scheme, monkeypatch):
    config = SimulatorConfig(integration_scheme=scheme, max_step_size=0.05, accuracy=1e-8)
    task = RolloutTask(AcrobotScenario(simulator_config=config), 5.0, Quality(abs, SHOULDER))
    with SerialExecutor() as made:
        results = [outcome.quality for _, outcome in made.run(task, [{}])]
        monkeypatch.setattr(step_watch, "PERIOD", 0.0)
        results += [outcome.quality for _, outcome in made.run(task, [{}])]
    assert len(results[0]) > 10 and np.array_equal(*results)


def test_plain_simulation_of_a_world_that_becomes_nan_ends(process, quick_look):
    scenario = NonfiniteScenario(SimulatorConfig(), root="of input")
    assert result(process, "runge_kutta3", root="of input").end == "failed"  # here it would hang
    testbed = scenario.build()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    with pytest.raises(NoProgressError, match=NO_STEP):
        simulator.AdvanceTo(1.0)
    assert context.get_time() == 0.25
    assert np.isfinite(context.get_continuous_state_vector().CopyToVector()).all()


@pytest.mark.parametrize("value", [float("nan"), inf])
def test_value_that_is_not_finite_is_refused(value):
    task = RolloutTask(PendulumScenario(), 0.1, Quality(abs, THETA))
    ((_, only),) = SerialExecutor().run(task, [{THETA: value}])
    assert only.end == "failed"
    assert re.search(f"VariableError: .*{THETA}.* finite", only.message)


def guards(scenario):
    return [s.get_name() for s in scenario.build().diagram.GetSystems() if s.get_name().endswith(".finite")]


def test_guard_is_only_where_a_nan_would_never_end():
    adaptive, fixed = SimulatorConfig(integration_scheme="runge_kutta3"), SimulatorConfig(use_error_control=False)
    assert guards(NonfiniteScenario(adaptive)) == ["T_act.force.finite"]
    assert guards(NonfiniteScenario(adaptive, plant=True)) == ["T_act.force.finite"]
    assert guards(NonfiniteScenario(fixed)) == []
    assert guards(SpaceClimberScenario()) == []
    assert guards(NonfiniteScenario(adaptive, plant=True, time_step=0.01)) == []
    assert guards(NonfiniteScenario(SimulatorConfig(integration_scheme="cenic"), plant=True)) == []


@pytest.mark.parametrize("scheme", ["runge_kutta3", "radau3"])
@pytest.mark.parametrize("sampled", [False, True])
def test_guard_changes_no_bit_of_a_simulation(scheme, sampled):
    config = SimulatorConfig(integration_scheme=scheme, max_step_size=0.05, accuracy=1e-3)
    scenario = NonfiniteScenario(config, bad="-1.7", compiled=True, sampled=sampled)
    simulator = scenario.build().simulator()
    assert guards(scenario) == ["T_act.force.finite"]
    builder = DiagramBuilder()
    system = LinearSystem(np.eye(2, k=1), np.array([[0.0], [1.0]]), np.eye(2), np.zeros((2, 1)))
    mass, law = builder.AddSystem(system), builder.AddSystem(compiled_law(-1.7, sampled=sampled))
    builder.Connect(mass.get_output_port(), law.get_input_port())
    builder.Connect(law.get_output_port(), mass.get_input_port())
    by_hand = Simulator(builder.Build())
    ApplySimulatorConfig(config, by_hand)
    states = []
    for each in (simulator, by_hand):
        each.get_mutable_context().SetAccuracy(config.accuracy)
        each.AdvanceTo(1.0)
        states.append(each.get_context().get_continuous_state_vector().CopyToVector()[:2])
    assert states[0][1] < -1.0
    assert np.array_equal(*states)


def test_processes_have_a_time_limit_by_default():
    testbed = PendulumScenario().build()
    with make_executor("processes", testbed=testbed, rollouts=0) as made:
        assert made.time_limit == ProcessExecutor(1).time_limit == worker_processes.TIME_LIMIT < inf
    with make_executor("processes", testbed=testbed, rollouts=0, time_limit=inf) as made:
        assert made.time_limit == inf


@pytest.mark.slow
def test_thread_that_does_not_stop_is_left_behind(monkeypatch, caplog):
    begun, release = threading.Event(), threading.Event()

    def stuck(theta):
        if theta > 0.5:
            begun.set()
            release.wait()
        return theta

    monkeypatch.setattr(executor, "GRACE", 0.1)
    made = ThreadExecutor(2)
    rollouts = made.run(RolloutTask(PendulumScenario(), 0.1, Quality(stuck, THETA)), [{THETA: 0.1}, {THETA: 1.0}])
    assert next(rollouts)[0] == 0
    begun.wait()  # A rollout that has not begun never does.
    with hanging_fails("what does not stop is not waited for"):
        rollouts.close()
    assert "a rollout does not stop: its thread is left behind" in caplog.text
    release.set()
    made.close()
