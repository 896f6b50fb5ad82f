"""A testbed as an environment of Gymnasium: one step is one call of Drake's Simulator."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array
from vtbdrake.environments.episodes import Episodes, FailedEpisodeError, seed_addresses
from vtbdrake.environments.rewards import first_score, next_score, step_reward
from vtbdrake.environments.spaces import (
    Channels,
    action_channels,
    observation_channels,
    reader_into,
    switch_values,
    writer_into,
)
from vtbdrake.rollout import Quality
from vtbdrake.rollout.runner import RolloutRunner, SimulationError
from vtbdrake.rollout.start import Start
from vtbdrake.state import Snapshot, SnapshotError
from vtbdrake.testbed import VirtualTestbed

_NOTE = "episode"


def action_box(channels: Channels) -> Box[np.float32]:
    """Return the space of an action: its limits in single precision, as trainers compute; doubles are taken, too."""
    return Box(channels.lower.astype(np.float32), channels.upper.astype(np.float32), dtype=np.float32)


def observation_box(channels: Channels) -> Box[np.float64]:
    """Return the space of an observation: its limits, in double precision."""
    return Box(channels.lower, channels.upper, dtype=np.float64)


class TestbedEnv(gymnasium.Env[NDArray[np.float64], NDArray[np.float32]]):
    """A testbed as an environment for reinforcement learning; make one by `gymnasium_env`.

    Equal seeds and actions give equal episodes, bit for bit.

    Args:
        episodes: What an episode is.
        testbed: A testbed of the scenario, which several environments of one thread may share; None: a new one.

    Attributes:
        episodes: What an episode is.
        testbed: The testbed.

    Raises:
        ValueError: A name is no signal and no address, or an action has no limits.
    """

    __test__ = False  # It is no class of tests, though its name begins like one.

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  As Gymnasium declares it.

    def __init__(self, episodes: Episodes, testbed: VirtualTestbed | None = None) -> None:
        self.episodes = episodes
        self._runner = RolloutRunner(episodes.task, testbed)
        self.testbed = self._runner.testbed
        episodes.check(self.testbed)
        self._actions = action_channels(self.testbed, episodes.action)
        observations = observation_channels(self.testbed, episodes.observation)
        self._switches = switch_values(self.testbed, self._actions)
        self.action_space, self.observation_space = action_box(self._actions), observation_box(observations)
        self._write = writer_into(self.testbed, self._actions, self._runner.context)
        self._read = reader_into(self.testbed, observations, self._runner.context)
        self._reward, self._place = episodes.reward, episodes.reward_index
        self._can_terminate = len(episodes.measures) > 1 or episodes.task.threshold is not None
        self._variables = self.testbed.variables()
        self._seeds = seed_addresses(self._variables)
        self._samples: Iterator[float] = iter(())
        self._needs_reset = "the environment is new"
        self._step, self._begun = 0, 0.0
        self._score, self._last, self._time = 0.0, 0.0, 0.0
        self._observed = np.empty(0)

    @property
    def context(self) -> Any:
        """Return the root context of the episode, which `testbed.read` and others take."""
        return self._runner.context

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: The seed of all that is drawn at this reset and the next ones; None: they go on as before.
            options: What is given instead of drawn: ``condition``, the number of one of the problem's conditions;
                ``values``, address -> value, of any variables of s0; ``start``, a `Snapshot` from which to begin, of
                which nothing but ``values`` is changed.

        Returns:
            The observation, and {"values": what was set in s0, by address; "quality": the quality of the first sample}.

        Raises:
            ValueError: There is no such option, or it does not take the value.
            FailedEpisodeError: The simulation fails at its start.
        """
        super().reset(seed=seed)
        beginning = self.episodes.drawn(self.np_random, options, self._variables, self._seeds)
        start, begin_values = (None, {}) if beginning.start is None else self._start_at(beginning.start)
        self._needs_reset = "its reset has failed"
        self._samples = self._runner.simulate({**begin_values, **beginning.values, **self._switches}, start=start)
        self._last = self._first_sample()
        self._begun, self._step = self._runner.context.get_time(), 0
        self._score = float(first_score(self._reward, self._last))
        self._needs_reset = ""
        return self._observation(), {"values": dict(beginning.values), **self._quality()}

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Set the action, and simulate until the end of the step.

        Args:
            action: Numbers within the limits of ``action_space``, shape (size,).

        Returns:
            The observation; the reward; whether the episode has terminated (the threshold is exceeded, a constraint
            broken, a system ends the simulation, or it fails); whether it is truncated, at the horizon; and
            {"quality": the quality of all samples so far, "message": why a system has ended the simulation, "failure":
            why it has failed}.

        Raises:
            ActionError: The action has another shape, is not finite, or lies beyond the limits; nothing happened.
            FailedEpisodeError: The simulation fails, and there is no ``failure_reward``, or it fails by a TypeError.
            ResetNeeded: The episode has ended, or none has begun.
        """
        if self._needs_reset:
            raise ResetNeeded(f"{self._needs_reset}: call reset() before step()")
        self._write(self._actions.checked(action))
        score, self._step = self._score, self._step + 1
        terminated, info = False, {}
        try:
            terminated = self._advance()
        except SimulationError as failure:
            return self._failed(action, failure)
        except BaseException:
            self._needs_reset = "a step was interrupted"
            raise
        if self._runner.termination:
            terminated, info = True, {"message": self._runner.termination}
        truncated = not terminated and self._step == self.episodes.steps
        if terminated or truncated:
            self._needs_reset = f"the episode has {'terminated' if terminated else 'been truncated'}"
        reward = step_reward(self._reward, score, self._score, self._last)
        return self._observation(), reward, terminated, truncated, {**self._quality(), **info}

    def state(self) -> Snapshot:
        """Return the state of the episode, from which `restore` goes on, also in another process.

        It is a `Snapshot` of the testbed, with the place in the episode among its notes. An integrator with error
        control begins anew here, as it does after `restore`, so that both go on alike.

        Raises:
            ResetNeeded: The episode has ended, or none has begun.
        """
        if self._needs_reset:
            raise ResetNeeded(f"{self._needs_reset}: call reset() before state()")
        names = ("_step", "_begun", "_score", "_last", "_time")
        note = {name.strip("_"): getattr(self, name) for name in names}
        note["random"] = self.np_random.bit_generator.state
        return replace(self._runner.fork(), notes={_NOTE: note})

    def restore(self, state: Snapshot) -> tuple[Array, dict[str, Any]]:
        """Go on where `state` was called; equal actions then give equal bits.

        Args:
            state: What `state` has returned, here or in another environment of the same problem.

        Returns:
            The observation, and {"quality": the quality of all samples so far}.

        Raises:
            SnapshotError: It is no state of an episode, or one of another scenario.
        """
        note = state.notes.get(_NOTE) if isinstance(state, Snapshot) else None
        if note is None:
            raise SnapshotError(
                "restore takes what state() has returned; an episode begins at another snapshot by "
                "reset(options={'start': snapshot})"
            )
        start, values = self._start_at(state)
        self._needs_reset = "its restore has failed"
        self._samples = self._runner.simulate({**values, **self._switches}, start=start, begun=note["begun"])
        self._first_sample()
        for name in ("step", "begun", "score", "last", "time"):
            setattr(self, f"_{name}", note[name])
        self.np_random.bit_generator.state = note["random"]
        self._needs_reset = ""
        return self._observation(), self._quality()

    # -- how it is done

    def _start_at(self, snapshot: Snapshot) -> tuple[Start, dict[str, Any]]:
        """Return a snapshot as a start, and the values of the action's variables in it, which a start leaves out."""
        context = self.testbed.default_context()
        self.testbed.restore(context, snapshot)
        values = {address: self.testbed.read(context, address) for address in self._actions.addresses}
        return Start.of(self.testbed, context), values

    def _first_sample(self) -> float:
        try:
            self._time = next(self._samples)
            return self._runner.measured(self._time)[self._place]
        except SimulationError as failure:
            raise FailedEpisodeError(f"the simulation fails at the start of an episode: {failure}") from failure

    def _advance(self) -> bool:
        """Simulate until the end of the step; return whether the episode terminates, which ends it early."""
        return any(self._take(next(self._samples)) for _ in range(self.episodes.every))

    def _take(self, time: float) -> bool:
        """Take a sample; return whether the episode terminates at it."""
        if self._runner.termination:
            time = self._runner.context.get_time() - self._begun
        samples = self._runner.measured(time)
        sample = samples[self._place]
        self._score = float(next_score(self._reward, self._score, self._last, sample, time - self._time))
        self._last, self._time = sample, time
        return self._can_terminate and bool(self.episodes.terminates(samples))

    def _quality(self) -> dict[str, Any]:
        return {"quality": self._score} if isinstance(self._reward, Quality) else {}

    def _observation(self) -> Array:
        self._observed = self._read()
        return self._observed

    def _failed(self, action: Any, failure: SimulationError) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        self._needs_reset = "the simulation has failed"
        # While a system in Python runs, pydrake may make a TypeError of a Ctrl-C (`drake_workarounds.lost_interrupts`):
        # that is no outcome.
        if self.episodes.failure_reward is None or isinstance(failure.__cause__, TypeError):
            raise FailedEpisodeError(
                f"the simulation fails in step {self._step}, after the action {np.asarray(action).tolist()}: {failure}"
                "; or say what that is worth, failure_reward=number, and the episode terminates"
            ) from failure
        info = {**self._quality(), "failure": str(failure)}
        return self._observed, self.episodes.failure_reward, True, False, info
