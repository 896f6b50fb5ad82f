"""Episodes of an environment: where they begin, their steps, what they are worth, and when they end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any

import numpy as np

from vtbdrake.common.argument_checks import all_of, as_number
from vtbdrake.common.extras import extra_module
from vtbdrake.common.suggestions import did_you_mean
from vtbdrake.environments.rewards import Reward, violates
from vtbdrake.environments.spaces import Action
from vtbdrake.optimization import Problem
from vtbdrake.optimization.parameter import Dimension
from vtbdrake.rollout import Constraint, Quality, RolloutTask
from vtbdrake.rollout.testbeds import FIELD, split
from vtbdrake.state import Snapshot, Variables
from vtbdrake.testbed import Scenario, VirtualTestbed

# The options of `reset`, and the largest seed of a sensor, which a float holds exactly.
OPTIONS = ("condition", "values", "start")
_LARGEST_SEED = 2**53


class FailedEpisodeError(RuntimeError):
    """The simulation of an episode has failed, and no ``failure_reward`` says what that is worth."""


@dataclass(frozen=True)
class Beginning:
    """Where an episode begins.

    Attributes:
        values: Values that are set in s0, by address.
        start: The snapshot from which it begins; None: the problem's s0.
    """

    values: Mapping[str, Any]
    start: Snapshot | None = None


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """The episodes of an environment.

    Attributes:
        task: The rollout that an episode is; its measures are the reward, if that is no quality of the rollout, and the
            constraints that end an episode.
        reward: The quality whose increase is the reward, or the reward.
        parameters: What is drawn at each reset.
        conditions: One of these is drawn at each reset.
        action: What the agent acts on, see `spaces.action_channels`.
        observation: What it observes, see `spaces.observation_channels`.
        every: The number of samples of a step.
        steps: The number of steps after which an episode is truncated.
        failure_reward: The reward of a step whose simulation fails; None: that is an error.
    """

    task: RolloutTask
    reward: Quality | Reward
    parameters: tuple[Dimension, ...]
    conditions: tuple[Mapping[str, Any], ...]
    action: Action
    observation: Sequence[str]
    every: int
    steps: int
    failure_reward: float | None

    @property
    def period(self) -> float:
        """Return the duration of a step, in seconds."""
        return self.every * self.task.sample_period

    @property
    def measures(self) -> tuple[Quality | Reward | Constraint, ...]:
        """Return the functions that are sampled, in the order of `RolloutRunner.measured`."""
        measures: Any = self.task.measures if self.task.quality is None else (self.task.quality, *self.task.measures)
        return tuple(measures)

    @property
    def reward_index(self) -> int:
        """Return the number of the reward among the measures."""
        return next(k for k, measure in enumerate(self.measures) if measure is self.reward)

    def terminates(self, samples: Sequence[Any]) -> Any:
        """Return whether an episode terminates at a sample: the threshold is exceeded, or a constraint broken.

        Args:
            samples: The samples of the measures, in their order: floats, or arrays of shape (n,) of n episodes.
        """
        task, ends = self.task, np.zeros(np.shape(samples[0]), dtype=bool)
        if task.quality is not None and task.threshold is not None:
            ends = ends | (samples[0] < task.threshold if task.minimize else samples[0] > task.threshold)
        for measure, sample in zip(self.measures, samples, strict=True):
            if isinstance(measure, Constraint):
                ends = ends | violates(measure, sample)
        return ends

    def check(self, testbed: VirtualTestbed) -> None:
        """Check the addresses and the values of what varies.

        Raises:
            ValueError: There is no such variable, or it does not take a value.
        """
        variables = testbed.variables()
        for parameter in self.parameters:
            parameter.find(variables)
        for condition in self.conditions:
            for address, value in condition.items():
                variables[address].check(value)

    def drawn(
        self,
        random: np.random.Generator,
        options: Mapping[str, Any] | None,
        variables: Variables,
        seeds: Sequence[str],
    ) -> Beginning:
        """Draw where an episode begins: a condition, the parameters, and the seeds of sensors.

        Args:
            random: The source of random numbers.
            options: What is given instead of drawn, by the names of `OPTIONS`; None: nothing.
            variables: The variables of the testbed.
            seeds: The addresses of the seeds, see `seed_addresses`.

        Raises:
            ValueError: There is no such option, or it does not take the value.
        """
        options = {} if options is None else dict(options)
        for name in options:
            if name not in OPTIONS:
                raise ValueError(
                    f"reset has no option {name!r}{did_you_mean(name, OPTIONS)}; it takes {', '.join(OPTIONS)}"
                )
        # Everything is drawn each time: what is given does not change what follows.
        number = int(random.integers(len(self.conditions)))
        values: dict[str, Any] = dict.fromkeys(seeds, float(random.integers(_LARGEST_SEED)))
        values |= self.conditions[self._condition(options.get("condition", number))]
        values |= {parameter.address: parameter.from_unit(random.random()) for parameter in self.parameters}
        set_values = options.get("values", {})
        if not isinstance(set_values, Mapping):
            raise ValueError(f"the option 'values' of reset is {{address: value, ...}}, not {set_values!r}")
        start = options.get("start")
        if start is not None and not isinstance(start, Snapshot):
            raise ValueError(
                f"the option 'start' of reset is a Snapshot, such as testbed.snapshot(context), not {start!r}"
            )
        if start is not None:
            values = {}  # The snapshot has them all.
        for address, value in set_values.items():
            values[address] = variables[address].check(value)
        return Beginning(values, start)

    def _condition(self, number: Any) -> int:
        count = len(self.conditions)
        if isinstance(number, bool) or not isinstance(number, int | np.integer) or not 0 <= number < count:
            raise ValueError(f"the option 'condition' of reset is a number from 0 to {count - 1}, not {number!r}")
        return int(number)


def seed_addresses(variables: Variables) -> list[str]:
    """Return the addresses of the seeds of simulated sensors and of other random errors."""
    return [a for a, v in variables.items() if a.startswith("sim.") and a.endswith(".seed") and not v.derived]


def episodes_of(
    problem: Problem | Scenario,
    *,
    action: Action,
    observation: Sequence[str],
    reward: Quality | Reward | None,
    period: float | None,
    horizon: float | None,
    parameters: Sequence[Dimension],
    failure_reward: float | None,
) -> Episodes:
    """Return the episodes of a problem, or of a scenario; see `gymnasium_env`.

    Args:
        problem: The problem or the scenario.
        action: Names of the variables that the agent sets.
        observation: Names of the variables and ports that it observes.
        reward: The quality whose increase is the reward, or the reward; None: the problem's quality.
        period: The time of a step, in s; None: the problem's sample period.
        horizon: The duration of an episode of a scenario, in s.
        parameters: The parameters that each reset of a scenario draws.
        failure_reward: The reward of a step whose simulation fails; None: that is an error.

    Raises:
        ValueError: An argument is missing, of another type, or does not fit the others.
        ModuleNotFoundError: gymnasium is not installed.
    """
    extra_module("gymnasium", purpose="an environment for reinforcement learning", extra="gymnasium")
    if isinstance(problem, Problem):
        if horizon is not None or parameters:
            raise ValueError("horizon and parameters are part of the problem: leave them out, or give the scenario")
        task, parameters, conditions = problem.task, problem.parameters, problem.conditions
        if reward is None and len(problem.objectives) > 1:
            raise ValueError(
                f"the problem has {len(problem.objectives)} qualities, and a step one reward: give reward=, such as "
                "problem.objectives[0]"
            )
        reward = problem.objectives[0] if reward is None else reward
        constraints = tuple(c for c in problem.constraints if c.reading == "worst")
    elif isinstance(problem, Scenario):
        for name, value in {"reward": reward, "horizon": horizon, "period": period}.items():
            if value is None:
                raise ValueError(f"an environment of a scenario needs {name}=; or give a Problem, which states more")
        task = RolloutTask(problem, as_number("horizon", horizon), sample_period=as_number("period", period))
        conditions, constraints = ({},), ()
    else:
        raise ValueError(f"an environment is of a Problem or of a Scenario, not of {problem!r}")
    if not isinstance(reward, Quality | Reward):
        raise ValueError(
            f"reward is a Quality, whose increase it is, or a Reward(f, of=[address, ...]), not {reward!r}"
        )
    every, steps = _steps(task, period)
    return Episodes(
        task=_sampling(task, reward, constraints),
        reward=reward,
        parameters=_without_fields(parameters, conditions),
        conditions=tuple(conditions),
        action=action,
        observation=observation,
        every=every,
        steps=steps,
        failure_reward=None if failure_reward is None else _finite("failure_reward", failure_reward),
    )


def _steps(task: RolloutTask, period: float | None) -> tuple[int, int]:
    """Return the number of samples of a step, and of steps of an episode."""
    sample_period = task.sample_period
    period = sample_period if period is None else _finite("period", period)
    every = round(period / sample_period)
    if every < 1 or abs(every * sample_period - period) > 1e-9 * period:
        raise ValueError(
            f"period, the time of a step, is a multiple of the problem's sample period of {sample_period:g} s, not "
            f"{period:g} s: change one of them"
        )
    steps = round(task.horizon / (every * sample_period))
    if steps < 1 or abs(steps * every * sample_period - task.horizon) > 1e-9 * task.horizon:
        raise ValueError(
            f"the horizon of {task.horizon:g} s must be a multiple of period, the time of a step of {period:g} s: "
            "change one of them"
        )
    return every, steps


def _sampling(task: RolloutTask, reward: Quality | Reward, constraints: tuple[Constraint, ...]) -> RolloutTask:
    """Return the task that samples the reward, what the threshold is compared with, and the constraints, no more."""
    quality = task.quality if task.threshold is not None else None
    if isinstance(reward, Quality) and quality is None:
        quality = reward
    measures = constraints if reward is quality else (reward, *constraints)
    return replace(task, quality=quality, measures=measures, motion=None, pruning=None)


def _without_fields(parameters: Sequence[Dimension], conditions: Sequence[Mapping[str, Any]]) -> tuple[Dimension, ...]:
    checked: tuple[Dimension, ...] = all_of(
        Dimension, parameters, name="parameters", form="[Parameter(address, lower, upper), ...]"
    )
    fields = [parameter.address for parameter in checked if parameter.is_field]
    fields += [f"{FIELD}{name}" for condition in conditions for name in split(condition)[0]]
    if fields:
        raise ValueError(
            f"{fields[0]} takes another testbed for each value, which no reset builds: make one environment per value"
        )
    return checked


def _finite(name: str, value: Any) -> float:
    number = as_number(name, value)
    if not isfinite(number):
        raise ValueError(f"{name} must be finite, not {number}")
    return number
