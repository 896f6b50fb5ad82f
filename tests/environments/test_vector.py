"""Many environments at once: on worker processes and compiled, each equal to a single one."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import vtbdrake as vtb
from tests.environments.scenarios import BALANCING, POLE, SIGNALS, START, SliderScenario, falling
from tests.rollout.nonfinite import NonfiniteScenario
from tests.rollout.scenarios import child_pids
from tests.testbeds import AcrobotScenario
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.environments import ActionError, CompiledVectorEnv, FailedEpisodeError, ProcessVectorEnv
from vtbdrake.rollout import QualityError, WorkerError
from vtbdrake_diagrams.cart_pole import CartPoleScenario

NOISE = ErrorModel(noise=0.01, dropout=0.1, latency=1)


@cache
def of_problem() -> dict[str, Any]:
    """Return the pole that falls early or late, under noise: its episodes end at different steps."""
    scenario = CartPoleScenario(position_errors=NOISE, velocity_errors=NOISE)
    masses = [{"sim.sys.cart_pole.pole.mass": mass} for mass in (0.5, 2.0)]
    observation = ["joint_position", "joint_velocity", "plant.state"]
    problem = falling(scenario=scenario, conditions=masses)
    return {"problem": problem, **SIGNALS, "observation": observation, "period": 0.05}


def of_noise() -> dict[str, Any]:
    """Return episodes with more steps than those for which random numbers are drawn at once."""
    return {"problem": CartPoleScenario(position_errors=NOISE), **BALANCING, "horizon": 1.4}


def of_reward() -> dict[str, Any]:
    """Return a reward that CasADi's symbols do not pass."""
    reward = vtb.Reward(lambda angle: 1.0 if abs(angle - np.pi) < 0.2 else -0.5, of=POLE)
    return {"problem": CartPoleScenario(), **BALANCING, "horizon": 0.2, "reward": reward}


def of_slider() -> dict[str, Any]:
    """Return a mass that meets its stops, which are compiled in machine code alone."""
    reward = vtb.Reward(lambda state: state[0] + 0.1 * state[1], of="plant.state")
    parameters = [vtb.Parameter("sim.sys.slider.position", -0.03, 0.03)]
    names: dict[str, Any] = {"action": ["force"], "observation": ["state", "plant.state"], "parameters": parameters}
    return {"problem": SliderScenario(), **names, "reward": reward, "period": 0.05, "horizon": 1.0}


def history(envs: Any, count: int, *, seed: int = 5) -> list[np.ndarray]:
    """Return all observations, rewards, terminations and truncations of some random steps, each of them stacked."""
    random = np.random.default_rng(seed)
    begin, _ = envs.reset(seed=seed)
    low, high = envs.action_space.low, envs.action_space.high
    results = [envs.step(random.uniform(low, high))[:4] for _ in range(count)]
    return [begin, *(np.array([np.array(result[k]) for result in results]) for k in range(4))]


@pytest.mark.parametrize(
    "statement", [of_problem, of_slider, *(pytest.param(of, marks=pytest.mark.slow) for of in (of_noise, of_reward))]
)
def test_compiled_environments_equal_single_ones(statement: Callable[[], dict[str, Any]]) -> None:
    arguments = statement()
    single = SyncVectorEnv([partial(vtb.gymnasium_env, **arguments)] * 3)
    expected = history(single, 80)
    compiled = vtb.gymnasium_vector_env(**arguments, num_envs=3, executor="compiled")
    assert isinstance(compiled, CompiledVectorEnv)
    assert compiled.metadata["autoreset_mode"] is single.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert (compiled.action_space, compiled.observation_space) == (single.action_space, single.observation_space)
    for one, other in zip(history(compiled, 80), expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-9)
    ended = expected[3] | expected[4]
    assert ended.any(axis=0).all() and (statement is not of_problem or expected[3].any())
    # Here, the environments are at different steps.
    assert statement is not of_problem or (ended.any(axis=1) & ~ended.all(axis=1)).any()


def test_a_step_that_cannot_be_compiled_is_made_in_drake(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    single = SyncVectorEnv([partial(vtb.gymnasium_env, **of_slider())] * 3)
    expected = history(single, 45)
    interpreted = CompiledVectorEnv(vtb.gymnasium_env(**of_slider()).episodes, 3, compile=False)
    for one, other in zip(history(interpreted, 45), expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-9)


@pytest.mark.slow
def test_environments_on_worker_processes_equal_single_ones_bit_for_bit() -> None:
    arguments = of_problem()
    expected = history(SyncVectorEnv([partial(vtb.gymnasium_env, **arguments)] * 3), 30)
    envs = vtb.gymnasium_vector_env(**arguments, num_envs=3, executor="processes", workers=2)
    for one, other in zip(history(envs, 30), expected, strict=True):
        assert one.tobytes() == other.tobytes()
    envs.close()
    with pytest.raises(
        WorkerError, match=r"the environments are closed, by close\(\) or by an interruption: make new ones"
    ):
        envs.reset()


@pytest.mark.slow
def test_the_same_is_told_of_compiled_environments_and_of_those_on_processes() -> None:
    options = {"condition": 1, "values": {POLE: 3.0}}
    kinds = ("compiled", "processes")
    envs = [vtb.gymnasium_vector_env(**of_problem(), num_envs=2, executor=kind, workers=1) for kind in kinds]
    infos = [each.reset(seed=[1, None], options=options)[1] for each in envs]
    for told in infos:
        assert told["values"][POLE].tolist() == [3.0, 3.0]
        assert told["values"]["sim.sys.cart_pole.pole.mass"].tolist() == [2.0, 2.0]
        assert told["quality"].tolist() == [0.0, 0.0]
    seeds = [told["values"]["sim.sense.joint_position.seed"] for told in infos]
    assert seeds[0][0] == seeds[1][0] != seeds[0][1]
    qualities = [each.step(np.full((2, 1), 5.0))[4]["quality"] for each in envs]
    np.testing.assert_allclose(qualities[0], qualities[1], rtol=1e-9)
    envs[1].close()


def test_is_made_by_gymnasium_from_what_is_registered() -> None:
    name = "vtbdrake_tests/Vector-v0"
    gymnasium.register(name, vector_entry_point=vtb.gymnasium_vector_env, kwargs=of_reward())
    try:
        envs = gymnasium.make_vec(name, num_envs=2, vectorization_mode="vector_entry_point", executor="compiled")
        assert envs.reset(seed=0)[0].shape == (2, 4)
    finally:
        del gymnasium.registry[name]


@pytest.mark.slow
def test_auto_simulates_in_drake_what_cannot_be_compiled(caplog: pytest.LogCaptureFixture) -> None:
    reward = vtb.Reward(lambda state: -abs(state[0]), of="plant.state")
    arguments: dict[str, Any] = {"action": ["torque"], "observation": ["joint_state"], "reward": reward}
    with caplog.at_level(logging.INFO, logger="vtbdrake"):
        envs = vtb.gymnasium_vector_env(
            AcrobotScenario(), num_envs=1, **arguments, period=0.1, horizon=1.0, executor="auto"
        )
    assert isinstance(envs, ProcessVectorEnv)
    assert "the environments are simulated in Drake: the testbed cannot be compiled: " in caplog.text
    envs.close()


def failing(**options: Any) -> Any:
    scenario = NonfiniteScenario(plant=True, time_step=0.01, root="of state")
    arguments: dict[str, Any] = {
        "action": {"force": (-1, 1)},
        "observation": ["state"],
        "reward": vtb.Reward(lambda state: 1.0, of="plant.state"),
        "period": 0.1,
        "horizon": 1.0,
    }
    arguments |= options
    return vtb.gymnasium_vector_env(scenario, num_envs=3, **arguments, executor="processes", workers=2)


def test_a_failure_of_compiled_environments_is_that_of_single_ones() -> None:
    reward = vtb.Reward(lambda state: 1.0 if state[0] >= 0.0 else 2.0, of="plant.state")
    scenario = SliderScenario(bursts=True)
    arguments = {**of_slider(), "problem": scenario, "reward": reward}
    worth = {**arguments, "failure_reward": -1.0}
    single = vtb.gymnasium_env(**worth)
    envs, strict = (vtb.gymnasium_vector_env(**each, num_envs=2, executor="compiled") for each in (worth, arguments))
    for each in (single, envs, strict):
        each.reset(seed=0)
    forces = np.array([[5.0], [0.0]])
    before, *_ = envs.step(0.0 * forces)
    single.step(0.0 * forces[0])
    _, expected, *ends, info = single.step(forces[0])
    observed, rewards, terminated, truncated, infos = envs.step(forces)
    assert (expected, ends) == (rewards[0], [terminated[0], truncated[0]]) == (-1.0, [True, False])
    assert infos["failure"][0] == info["failure"] and infos["failure"][1] is None
    assert observed[0].tolist() == before[0].tolist() and rewards[1] in (1.0, 2.0) and not terminated[1]
    with pytest.raises(
        FailedEpisodeError, match=r"environment 0: the simulation fails in step 1, after the action \[5"
    ):
        strict.step(forces)
    with pytest.raises(ResetNeeded, match="a simulation has failed: call reset"):
        strict.step(forces)


def test_a_start_whose_quality_is_none_is_told_by_drake() -> None:
    quality = vtb.Quality(lambda state: state[0] - 1.0, of="plant.state", reading="integral")
    envs = vtb.gymnasium_vector_env(**{**of_slider(), "reward": quality}, num_envs=2, executor="compiled")
    with pytest.raises(QualityError, match="but a quality is finite and not negative"):
        envs.reset(seed=0)


@pytest.mark.slow
def test_a_failure_on_a_worker_process_names_the_environment_or_terminates_it() -> None:
    envs = failing()
    envs.reset()
    with pytest.raises(FailedEpisodeError, match="the simulation fails in step") as error:
        for _ in range(10):
            envs.step(np.zeros((3, 1)))
    assert error.value.__notes__ == ["in environment 0"]
    envs.reset()  # They can be used again.
    envs.close()
    envs = failing(failure_reward=-5.0)
    envs.reset()
    terminated = np.zeros(3, dtype=bool)
    while not terminated.any():
        _, rewards, terminated, _, infos = envs.step(np.zeros((3, 1)))
    assert terminated.all() and (rewards == -5.0).all() and "finite" in infos["failure"][2]
    envs.close()


@pytest.mark.slow
def test_a_worker_process_that_dies_is_an_error() -> None:
    others = set(child_pids())
    envs = failing()
    envs.reset()
    killed, *_ = set(child_pids()) - others
    os.kill(killed, signal.SIGKILL)
    with pytest.raises(WorkerError, match=r"a worker process of environments was lost .*make new environments"):
        for _ in range(2):
            envs.step(np.zeros((3, 1)))
    assert not set(child_pids()) - others


@pytest.mark.slow
def test_an_interrupted_call_leaves_no_answers_for_the_next(tmp_path: Path) -> None:
    fuse = tmp_path / "fuse"

    def interrupting(state: np.ndarray) -> float:
        if fuse.exists():
            fuse.unlink()
            os.kill(os.getppid(), signal.SIGINT)
        return 0.0

    envs = failing(reward=vtb.Reward(interrupting, of="plant.state"))
    envs.reset()
    fuse.touch()
    with pytest.raises(KeyboardInterrupt):
        envs.step(np.zeros((3, 1)))
    with pytest.raises(WorkerError, match="the environments are closed, .*by an interruption"):
        envs.reset()


@pytest.fixture(scope="module")
def compiled() -> Any:
    return vtb.gymnasium_vector_env(CartPoleScenario(), num_envs=3, **BALANCING, executor="compiled")


def test_wrong_calls_are_refused(compiled: Any) -> None:
    with pytest.raises(ResetNeeded, match="the environments are new: call reset"):
        compiled.step(np.zeros((3, 1)))
    compiled.reset(seed=0)
    wrong = np.zeros((3, 1))
    wrong[1] = np.nan
    with pytest.raises(ActionError, match=r"environment 1: the action's entry force is nan, not in \[-60, 60\] N"):
        compiled.step(wrong)
    with pytest.raises(ValueError, match=r"3 environments take numbers for force, in the shape \(3, 1\), not \(2, 1\)"):
        compiled.step(np.zeros((2, 1)))
    with pytest.raises(ValueError, match="give one seed, or one for each of the 3 environments, not 2"):
        compiled.reset(seed=[1, 2])
    with pytest.raises(ValueError, match="reset has no option 'value'; did you mean values"):
        compiled.reset(options={"value": 1})
    testbed = CartPoleScenario().build()
    start = testbed.snapshot(testbed.default_context())
    with pytest.raises(ValueError, match=r"compiled environments begin at the problem's s0: .*Problem\(start=snapshot"):
        compiled.reset(options={"start": start})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_envs": 0}, "at least one environment, not num_envs=0"),
        ({"executor": "threads"}, "executor is one of auto, compiled, processes, not 'threads'"),
        ({"action": ["forc"]}, "there is nothing to act on named 'forc'"),
        (
            {"parameters": [START, vtb.Parameter("sim.sense.joint_position.noise", 0, 1)], "period": 0.0},
            "the sample per",
        ),
    ],
)
def test_arguments_that_do_not_fit_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        vtb.gymnasium_vector_env(**{"problem": CartPoleScenario(), "num_envs": 2, **BALANCING, **changes})
