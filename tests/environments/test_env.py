"""A testbed as an environment of Gymnasium: equal to a loop in plain Drake, with rewards that are the quality."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, DiscreteValues, System

import vtbdrake as vtb
from tests.environments.scenarios import BALANCING, COST, POLE, SIGNALS, START, falling
from tests.rollout.nonfinite import NonfiniteScenario
from tests.testbeds import AcrobotScenario, PendulumScenario, SampledFeedback
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.environments import ActionError, FailedEpisodeError, TestbedEnv
from vtbdrake.state import SnapshotError
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

NOISE = ErrorModel(noise=0.01, drift=0.01)
NOISY = CartPoleScenario(position_errors=NOISE, velocity_errors=NOISE)
FORCES = np.random.default_rng(0).uniform(-60.0, 60.0, (60, 1))
Steps = list[tuple[Any, ...]]


@pytest.fixture(scope="module")
def env() -> TestbedEnv:
    return vtb.gymnasium_env(NOISY, **BALANCING)


@pytest.fixture
def registered() -> Iterator[str]:
    """Register an environment with normalized actions, as Gymnasium's checker recommends them."""
    name = "vtbdrake_tests/CartPole-v0"
    gymnasium.register(
        name,
        entry_point=vtb.gymnasium_env,
        vector_entry_point=vtb.gymnasium_vector_env,
        kwargs={"problem": CartPoleScenario(), **BALANCING, "action": {"force": (-1.0, 1.0)}, "horizon": 0.1},
    )
    yield name
    del gymnasium.registry[name]


def steps(env: TestbedEnv, actions: Any) -> Steps:
    """Return what the steps return, without the dictionaries."""
    return [env.step(action)[:4] for action in actions]


def assert_equal(a: Steps, b: Steps) -> None:
    """Assert that steps are equal, bit for bit."""
    for one, other in zip(a, b, strict=True):
        assert one[0].tobytes() == other[0].tobytes()
        assert one[1:] == other[1:]


def test_the_strict_checker_of_gymnasium_finds_nothing(registered: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(registered, disable_env_checker=True).unwrapped)
        wrapped = gymnasium.make(registered)
        wrapped.reset(seed=0)
        ends = [wrapped.step(wrapped.action_space.sample())[2:4] for _ in range(5)]
    assert ends == [(False, False)] * 4 + [(False, True)]


def test_limits_of_the_signals_are_the_spaces(env: TestbedEnv) -> None:
    assert env.action_space == gymnasium.spaces.Box(-60.0, 60.0, (1,), np.float32)
    limits = [100.0, 1e3, 100.0, 100.0]
    assert env.observation_space == gymnasium.spaces.Box(-np.array(limits), np.array(limits), dtype=np.float64)
    unlimited = vtb.gymnasium_env(CartPoleScenario(), **{**BALANCING, "observation": ["plant.state"]})
    assert unlimited.observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float64)


def test_equals_a_loop_in_plain_drake_bit_for_bit(env: TestbedEnv) -> None:
    first, info = env.reset(seed=3)
    testbed = NOISY.build()
    context = testbed.default_context()
    testbed.write(context, info["values"])
    testbed.switch(context, act={"force": "real"})  # The agent instead of the DPS commands.
    simulator = testbed.simulator(context)
    simulator.Initialize()
    dps_context = testbed.dps.GetMyContextFromRoot(context)
    ports = [testbed.dps.GetInputPort(name) for name in ("joint_position", "joint_velocity")]
    observed = [np.concatenate([port.Eval(dps_context) for port in ports])]
    for k, force in enumerate(FORCES[:50]):
        testbed.write(context, {"T_act.force.idle": force[0]})
        simulator.AdvanceTo((k + 1) * 0.02)
        observed.append(np.concatenate([port.Eval(dps_context) for port in ports]))
    results = steps(env, FORCES[:50])
    assert np.array([first, *(result[0] for result in results)]).tobytes() == np.array(observed).tobytes()
    assert [result[3] for result in results] == [False] * 49 + [True]


@pytest.mark.parametrize("reading", ["integral", "end", "best", "worst"])
@pytest.mark.parametrize("minimize", [True, False])
def test_rewards_add_up_to_the_quality_of_a_rollout(reading: str, minimize: bool) -> None:
    quality = replace(COST, reading=reading, minimize=minimize)
    plan = np.append(0.0, np.linspace(-30.0, 60.0, 10))
    # The pole rises and falls again, so that the best sample is neither the first nor the last.
    condition = {"u.plan": plan, "sim.sys.cart_pole.pole_pin.velocity": 1.0}
    problem = falling(quality=quality, constraints=(), conditions=[condition], horizon=1.0, sample_period=0.05)
    env = vtb.gymnasium_env(problem, action=["plan"], observation=["plant.state"], period=0.1)
    _, info = env.reset(seed=1, options={"values": {POLE: 2.95}})
    rewards = [env.step(plan)[1] for _ in range(10)]
    expected = problem.rollout([2.95])
    gained = expected.value - info["quality"]
    assert sum(rewards) == pytest.approx(-gained if minimize else gained, rel=1e-12)
    assert any(rewards)


def test_a_reward_is_a_function_of_the_end_of_each_step() -> None:
    reward = vtb.Reward(lambda state, force: -state[0] - 0.01 * force, of=["plant.state", "T_act.force.idle"])
    env = vtb.gymnasium_env(CartPoleScenario(), **{**BALANCING, "observation": ["plant.state"], "reward": reward})
    env.reset(seed=0)
    for force in FORCES[:5]:
        observation, got, *_ = env.step(force)
        assert got == -observation[0] - 0.01 * force[0]


def test_threshold_and_constraints_terminate_at_the_sample_and_the_horizon_truncates() -> None:
    leaning = vtb.Quality(lambda angle: abs(angle - np.pi), of=POLE)
    problem = falling(quality=leaning, threshold=0.3, constraints=())
    expected = problem.rollout([2.9])
    for stated in (problem, falling(constraints=[vtb.Constraint(lambda a: abs(a - np.pi), of=POLE, at_most=0.3)])):
        env = vtb.gymnasium_env(stated, action=["force"], observation=["time", POLE], period=0.02)
        env.reset(options={"values": {POLE: 2.9}})
        ends = []
        while not ends or ends[-1][2:4] == (False, False):
            ends.append(env.step([0.0]))
        assert ends[-1][2:4] == (True, False)
        # A sample within a step ends it.
        assert ends[-1][0][0] == pytest.approx(expected.times[-1]) and expected.times[-1] % 0.02 == pytest.approx(0.01)
        assert abs(ends[-1][0][1] - np.pi) > 0.3
        with pytest.raises(ResetNeeded, match=r"the episode has terminated: call reset\(\) before step"):
            env.step([0.0])


def test_seeds_repeat_starts_and_noise_and_the_next_episode_is_another(env: TestbedEnv) -> None:
    def episode(seed: int | None) -> tuple[dict[str, Any], Steps]:
        observation, info = env.reset(seed=seed)
        return info["values"], [(observation,), *steps(env, FORCES[:10])]

    (start, one), (next_start, _), (again, other) = episode(7), episode(None), episode(7)
    assert_equal(one, other)
    assert start == again and set(start) == {POLE, "sim.sense.joint_position.seed", "sim.sense.joint_velocity.seed"}
    assert all(start[address] != next_start[address] for address in start)
    assert START.lower <= start[POLE] <= START.upper


@pytest.mark.parametrize("after", [1, 20])
def test_restored_branches_are_bit_identical(env: TestbedEnv, tmp_path: Path, after: int) -> None:
    env.reset(seed=2)
    steps(env, FORCES[:after])
    state = env.state()
    expected = steps(env, FORCES[after:50])  # To the end.
    following = env.reset()[1]["values"]
    state.save(tmp_path / "state.zip")
    for other in (env, vtb.gymnasium_env(NOISY, **BALANCING)):
        other.restore(vtb.Snapshot.load(tmp_path / "state.zip"))
        assert_equal(steps(other, FORCES[after:50]), expected)
        assert other.reset()[1]["values"] == following


def test_branches_of_an_integrator_with_error_control_are_bit_identical() -> None:
    scenario = PendulumScenario(simulator_config=SimulatorConfig(integration_scheme="runge_kutta3", accuracy=1e-3))
    reward = vtb.Reward(lambda state: state[0], of="plant.state")
    env = vtb.gymnasium_env(
        scenario, action={"torque": (-1, 1)}, observation=["plant.state"], reward=reward, period=0.1, horizon=3.0
    )
    env.reset()
    torques = np.sin(np.arange(30))[:, np.newaxis]
    steps(env, torques[:7])
    state = env.state()
    expected = steps(env, torques[7:])
    env.restore(state)
    assert_equal(steps(env, torques[7:]), expected)


@pytest.mark.slow
def test_branches_of_a_walking_robot_are_bit_identical() -> None:
    pitch = "sim.sys.climber.base.pitch"
    env = vtb.gymnasium_env(
        SpaceClimberScenario(),
        action=["heading", "walk"],
        observation=["imu", "joint_encoders", "foot_contact"],
        reward=vtb.Reward(lambda angle: -abs(angle), of=pitch),
        period=0.1,
        horizon=1.0,
    )
    env.reset(seed=0)
    commands = [[0.05 * k, 1.0] for k in range(10)]
    steps(env, commands[:5])
    state = env.state()
    expected = steps(env, commands[5:])
    assert np.ptp([step[0] for step in expected], axis=0).max() > 0.1  # It moves.
    env.restore(state)
    assert_equal(steps(env, commands[5:]), expected)


def test_reset_takes_a_condition_values_and_a_snapshot() -> None:
    cart = "sim.sys.cart_pole.cart_slider.position"
    env = vtb.gymnasium_env(falling(conditions=[{cart: 0.1}, {cart: 0.2}]), **SIGNALS, period=0.02)
    drawn = {env.reset(seed=seed)[1]["values"][cart] for seed in range(10)}
    assert drawn == {0.1, 0.2}
    values = env.reset(options={"condition": 1, "values": {POLE: 3.25}})[1]["values"]
    assert (values[cart], values[POLE]) == (0.2, 3.25)
    context = env.testbed.default_context()
    context.SetTime(0.04)
    env.testbed.write(context, {POLE: 2.95, cart: -0.3})
    env.reset(options={"start": env.testbed.snapshot(context), "values": {cart: 0.4}})
    assert [env.testbed.read(env.context, address) for address in ("time", POLE, cart)] == [0.04, 2.95, 0.4]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"conditions": 0}, "reset has no option 'conditions'; did you mean condition.*it takes condition, values, st"),
        ({"condition": 2}, "the option 'condition' of reset is a number from 0 to 0, not 2"),
        ({"condition": True}, "a number from 0 to 0, not True"),
        ({"values": 3.0}, "the option 'values' of reset is {address: value, ...}, not 3.0"),
        ({"values": {"sim.sys.cart_pole.pole_pin.positon": 3.0}}, "did you mean sim.sys.cart_pole.pole_pin.position"),
        ({"values": {POLE: np.nan}}, "must be finite"),
        ({"start": "file.zip"}, "the option 'start' of reset is a Snapshot.*not 'file.zip'"),
    ],
)
def test_wrong_options_are_refused(env: TestbedEnv, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([np.nan], r"the action's entry force is nan, not in \[-60, 60\] N: look for what made it so in the policy"),
        ([61.0], r"the action's entry force is 61, not in \[-60, 60\] N: clip it, as gymnasium.wrappers.ClipAction"),
        ([1.0, 2.0], r"an action takes numbers for force, in the shape \(1,\), not \(2,\)"),
        ([[1.0]], r"in the shape \(1,\), not \(1, 1\)"),
        ("left", "an action takes numbers for force, not 'left'"),
        (["1.5"], r"an action takes numbers for force, not \['1.5'\]"),
    ],
)
def test_wrong_actions_are_refused_and_nothing_happens(env: TestbedEnv, action: Any, message: str) -> None:
    env.reset(seed=0)
    with pytest.raises(ActionError, match=message):
        env.step(action)
    expected = env.step(FORCES[0])
    env.reset(seed=0)
    assert_equal(steps(env, FORCES[:1]), [expected[:4]])


def test_the_entry_of_an_action_is_named() -> None:
    env = vtb.gymnasium_env(CartPoleScenario(), **{**BALANCING, "action": ["u.plan", "force"]})
    env.reset()
    action = np.zeros(12)
    action[3] = np.inf
    with pytest.raises(ActionError, match=r"the action's entry u.plan\[3\] \(force 3\) is inf"):
        env.step(action)


def test_a_limit_in_single_precision_is_the_limit() -> None:
    env = vtb.gymnasium_env(CartPoleScenario(), **{**BALANCING, "action": {"force": (-0.1, 0.1)}})
    env.reset()
    assert float(np.float32(0.1)) > 0.1
    env.step(np.float32([0.1]))
    assert env.testbed.read(env.context, "T_act.force.idle") == 0.1


def failing(**options: Any) -> TestbedEnv:
    scenario = NonfiniteScenario(plant=True, time_step=0.01, root="of state")
    reward = vtb.Reward(lambda state: 1.0, of="plant.state")
    return vtb.gymnasium_env(
        scenario, action={"force": (-1, 1)}, observation=["state"], reward=reward, period=0.1, horizon=1.0, **options
    )


def test_a_failed_simulation_is_an_error_or_terminates_with_what_it_is_worth() -> None:
    env = failing()
    env.reset()
    with pytest.raises(
        FailedEpisodeError, match=r"the simulation fails in step \d, after the action \[0.5\]: .*finite"
    ):
        steps(env, [[0.5]] * 10)
    with pytest.raises(ResetNeeded, match="the simulation has failed: call reset"):
        env.step([0.0])
    env = failing(failure_reward=-10.0)
    env.reset()
    ends = []
    while not ends or not ends[-1][2]:
        ends.append(env.step([0.5]))
    observation, reward, terminated, truncated, info = ends[-1]
    assert (reward, terminated, truncated) == (-10.0, True, False) and "finite" in info["failure"]
    assert np.isfinite(observation).all() and [end[1] for end in ends[:-1]] == [1.0] * (len(ends) - 1)


class Interrupted(SampledFeedback):
    """Fails as pydrake lets it fail when it has dropped a Ctrl-C."""

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        if context.get_time() > 0.05:
            raise TypeError("incompatible function arguments")


@dataclass
class InterruptedScenario(AcrobotScenario):
    """An acrobot with such a DPS."""

    def make_dps(self) -> System:
        return Interrupted(self.period)


def test_an_interruption_that_pydrake_drops_is_no_outcome() -> None:
    reward = vtb.Reward(lambda state: 1.0, of="plant.state")
    signals: dict[str, Any] = {"action": ["torque"], "observation": ["joint_state"], "reward": reward}
    env = vtb.gymnasium_env(InterruptedScenario(), **signals, period=0.1, horizon=1.0, failure_reward=-1.0)
    env.reset()
    with pytest.raises(FailedEpisodeError, match="in step 1, after .*TypeError: incompatible function arguments"):
        env.step([0.0])


def test_a_state_of_something_else_is_refused(env: TestbedEnv) -> None:
    snapshot = env.testbed.snapshot(env.testbed.default_context())
    with pytest.raises(SnapshotError, match=r"restore takes what state\(\) has returned.*options={'start': snapshot}"):
        env.restore(snapshot)
    with pytest.raises(ResetNeeded, match="the environment is new"):
        vtb.gymnasium_env(CartPoleScenario(), **BALANCING).state()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"action": ["forc"]},
            "there is nothing to act on named 'forc'; signals and commands are force, plan; did you",
        ),
        ({"action": ["joint_position"]}, "there is nothing to act on named 'joint_position'"),
        ({"action": ["sim.sys.cart_pole.pole.mass"]}, "mass has no limits, which an action needs: declare lower= and"),
        ({"action": []}, "an environment needs at least one action"),
        ({"action": {"force": (-70.0, 0.0)}}, "the limits of force must be lower < upper and lie within"),
        ({"action": {"force": 3.0}}, r"the limits of force are \(lower, upper\), numbers or one per entry, not 3.0"),
        ({"action": ["T_act.force"]}, "T_act.force takes some values only"),
        (
            {"observation": ["joint_positio"]},
            "nothing to observe named 'joint_positio'; signals and commands are joint_",
        ),
        ({"observation": [POLE, POLE]}, "a name is given twice as observation"),
        ({"period": 0.03}, "the horizon of 1 s must be a multiple of period, the time of a step of 0.03 s"),
        ({"period": np.nan}, "the sample period must be positive"),
        ({"horizon": None}, "an environment of a scenario needs horizon=; or give a Problem"),
        ({"reward": None}, "an environment of a scenario needs reward="),
        ({"reward": tuple}, r"reward is a Quality, whose increase it is, or a Reward\(f, of="),
        ({"problem": 3}, "an environment is of a Problem or of a Scenario, not of 3"),
        ({"problem": falling()}, "horizon and parameters are part of the problem"),
        ({"parameters": [vtb.Parameter("scenario.period", 0.01, 0.02)]}, "make one environment per value"),
        ({"parameters": [vtb.Parameter("sim.sys.cart", 0.0, 1.0)]}, "sim.sys.cart"),
        ({"failure_reward": np.nan}, "failure_reward must be finite, not nan"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(changes: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"problem": CartPoleScenario(), **BALANCING, **changes}
    with pytest.raises(ValueError, match=message):
        vtb.gymnasium_env(**arguments)


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(ModuleNotFoundError, match=r"needs gymnasium: pip install 'vtbdrake\[gymnasium\]'"):
        vtb.gymnasium_env(CartPoleScenario(), **BALANCING)
