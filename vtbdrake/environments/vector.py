"""Many environments of one testbed at once, as Gymnasium's vector environments: what all kinds have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from vtbdrake.common.argument_checks import as_whole
from vtbdrake.common.arrays import Array
from vtbdrake.environments.env import action_box, observation_box
from vtbdrake.environments.episodes import Episodes
from vtbdrake.environments.spaces import action_channels, observation_channels
from vtbdrake.testbed import VirtualTestbed

Flags = NDArray[np.bool_]
Rows = NDArray[np.intp]
Step = tuple[Array, Array, Flags, Flags, dict[str, Any]]


class TestbedVectorEnv(gymnasium.vector.VectorEnv[Array, Array, Array]):
    """Many environments of one testbed; make one by `gymnasium_vector_env`.

    An environment whose episode has ended is reset by the next call of `step`, which ignores its action
    (``AutoresetMode.NEXT_STEP``, Gymnasium's default). With seed s, environment i is the single one with seed s + i.

    Args:
        episodes: What an episode is.
        num_envs: The number of environments.
        testbed: A testbed of the scenario.

    Attributes:
        episodes: What an episode is.

    Raises:
        ValueError: As `TestbedEnv`, or the number is not positive.
    """

    __test__ = False  # It is no class of tests, though its name begins like one.

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012  As Gymnasium declares it.

    def __init__(self, episodes: Episodes, num_envs: int, testbed: VirtualTestbed) -> None:
        self.num_envs = checked_count(num_envs)
        self.episodes = episodes
        episodes.check(testbed)
        self._actions = action_channels(testbed, episodes.action)
        self._observations = observation_channels(testbed, episodes.observation)
        self.single_action_space = action_box(self._actions)
        self.single_observation_space = observation_box(self._observations)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(  # As in Gymnasium's own, each environment may have a seed.
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode in every environment.

        Args:
            seed: Environment i gets seed + i, or the i-th of several; None: all go on with their random numbers.
            options: Options for all environments, see `TestbedEnv.reset`.

        Returns:
            The observations, shape (num_envs, size), and what `TestbedEnv.reset` tells of each.
        """
        seeds: Sequence[int | None]
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"give one seed, or one for each of the {self.num_envs} environments, not {len(seeds)}")
        return self._reset(seeds, options)

    def _reset(self, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> tuple[Array, dict[str, Any]]:
        raise NotImplementedError

    def _checked(self, actions: Any) -> Array:
        """Return the actions of all environments, shape (num_envs, size)."""
        return self._actions.checked(actions, count=self.num_envs)


def checked_count(num_envs: int) -> int:
    """Return the number of environments.

    Raises:
        ValueError: It is no whole number above 0.
    """
    if as_whole("num_envs", num_envs) < 1:
        raise ValueError(f"a vector environment has at least one environment, not num_envs={num_envs}")
    return int(num_envs)
