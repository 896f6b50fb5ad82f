"""Make environments for reinforcement learning from a problem or a scenario."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

from vtbdrake.compiled import CompilerError
from vtbdrake.environments.episodes import episodes_of
from vtbdrake.environments.rewards import Reward
from vtbdrake.environments.spaces import Action
from vtbdrake.optimization import Problem
from vtbdrake.optimization.parameter import Dimension
from vtbdrake.rollout import Quality
from vtbdrake.testbed import Scenario

if TYPE_CHECKING:
    from vtbdrake.environments.env import TestbedEnv
    from vtbdrake.environments.vector import TestbedVectorEnv

_log = logging.getLogger(__name__)

EXECUTORS = ("auto", "compiled", "processes")


def gymnasium_env(
    problem: Problem | Scenario,
    *,
    action: Action,
    observation: Sequence[str],
    reward: Quality | Reward | None = None,
    period: float | None = None,
    horizon: float | None = None,
    parameters: Sequence[Dimension] = (),
    failure_reward: float | None = None,
) -> TestbedEnv:
    """Return a testbed as an environment of Gymnasium (extra ``gymnasium``), for reinforcement learning.

    Each reset draws one of the problem's conditions, each parameter within its range, and the seed of all sensors. The
    sum of the rewards of an episode is what the quality of the same rollout has gained since its first sample (of a
    cost, what it has lost). The threshold terminates an episode, as does a constraint that is broken and must hold at
    each sample; the horizon truncates it.

    Args:
        problem: The problem; or a scenario, with ``reward``, ``period`` and ``horizon``.
        action: What the agent acts on: names of actuator signals (it takes the place of the DPS), of commands u, or
            addresses of variables, which hold for a step; their limits are the space. Or name -> (lower, upper).
        observation: What it observes: names of sensor signals or commands, or addresses of variables or vector output
            ports; their limits are the space, in which what has none is unbounded.
        reward: The quality whose increase over a step is the reward (of a cost, the decrease), by default the
            problem's; or a `Reward`, a function of the state at the end of a step.
        period: The time of a step, in seconds: a multiple of the problem's sample period, and by default that.
        horizon: The duration of an episode of a scenario, in seconds: a multiple of ``period``.
        parameters: What each reset of a scenario draws; uniformly within their ranges.
        failure_reward: The reward of a step whose simulation fails, which terminates the episode; None: that is an
            error, because no number that was chosen here would be neutral.

    Raises:
        ValueError: An argument is missing or does not fit, a name is no signal and no address, or an action has no
            limits.
        ModuleNotFoundError: gymnasium is not installed.
    """
    episodes = episodes_of(
        problem,
        action=action,
        observation=observation,
        reward=reward,
        period=period,
        horizon=horizon,
        parameters=parameters,
        failure_reward=failure_reward,
    )
    from vtbdrake.environments.env import TestbedEnv

    return TestbedEnv(episodes, problem.testbed if isinstance(problem, Problem) else None)


def gymnasium_vector_env(
    problem: Problem | Scenario,
    *,
    num_envs: int,
    action: Action,
    observation: Sequence[str],
    reward: Quality | Reward | None = None,
    period: float | None = None,
    horizon: float | None = None,
    parameters: Sequence[Dimension] = (),
    failure_reward: float | None = None,
    executor: str = "auto",
    workers: int | None = None,
) -> TestbedVectorEnv:
    """Return many environments of a testbed as a vector environment of Gymnasium, for fast reinforcement learning.

    Args:
        problem: See `gymnasium_env`.
        num_envs: The number of environments.
        action: See `gymnasium_env`.
        observation: See `gymnasium_env`.
        reward: See `gymnasium_env`.
        period: See `gymnasium_env`.
        horizon: See `gymnasium_env`.
        parameters: See `gymnasium_env`.
        failure_reward: See `gymnasium_env`.
        executor: ``compiled``: all environments step in machine code, in this thread; ``processes``: in Drake, on
            worker processes; ``auto``: compiled if that is possible, and the log tells why it is not.
        workers: The number of processes; by default the number of cores.

    Raises:
        ValueError: As `gymnasium_env`, or there is no such executor; with ``compiled``, an `UnsupportedTestbedError`
            if the testbed cannot be compiled.
        CompiledDifferenceError: The compiled testbed differs from Drake's, with ``compiled``.
        WorkerError: A worker process does not start.
        ModuleNotFoundError: gymnasium is not installed.
    """
    if executor not in EXECUTORS:
        raise ValueError(f"executor is one of {', '.join(EXECUTORS)}, not {executor!r}")
    episodes = episodes_of(
        problem,
        action=action,
        observation=observation,
        reward=reward,
        period=period,
        horizon=horizon,
        parameters=parameters,
        failure_reward=failure_reward,
    )
    from vtbdrake.environments.compiled_vector import CompiledVectorEnv
    from vtbdrake.environments.process_vector import ProcessVectorEnv

    if executor == "compiled":
        return CompiledVectorEnv(episodes, num_envs)
    if executor == "auto":
        try:
            return CompiledVectorEnv(episodes, num_envs, compile=True)
        except (ValueError, ArithmeticError, CompilerError) as error:
            # What else is wrong with the arguments is raised below.
            _log.info("the environments are simulated in Drake: %s", error)
    return ProcessVectorEnv(episodes, num_envs, workers=workers)
