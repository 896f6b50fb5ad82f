"""Reinforcement learning: a policy learns to balance the pole, in compiled environments of Gymnasium.

``python -m vtbdrake_diagrams.cart_pole.training trained.onnx`` trains it, and writes the file.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from cmaes import CMA
from numpy.typing import NDArray
from pydrake.systems.framework import Diagram

import vtbdrake as vtb
from vtbdrake.environments import TestbedVectorEnv
from vtbdrake.testbed import Signal
from vtbdrake_diagrams.cart_pole.dps import make_pushed_dps
from vtbdrake_diagrams.cart_pole.policy import UPRIGHT, BalancedCartPole, cost, write

Array = NDArray[np.float64]

GAINS = np.array([100.0, 1000.0, 100.0, 200.0])
"""The scale of the gains that are searched, in N/m, N/rad, N s/m and N s/rad."""
_JOINTS = "sim.sys.cart_pole"
STARTS = [
    vtb.Parameter(f"{_JOINTS}.cart_slider.position", -0.5, 0.5),
    vtb.Parameter(f"{_JOINTS}.cart_slider.velocity", -0.3, 0.3),
    vtb.Parameter(f"{_JOINTS}.pole_pin.position", np.pi - 0.2, np.pi + 0.2),
    vtb.Parameter(f"{_JOINTS}.pole_pin.velocity", -0.3, 0.3),
]
"""Ranges of an episode's start: position (m) and velocity of the cart, angle (rad) and velocity of the pole."""
FORCE_LIMIT = BalancedCartPole().force_limit


@dataclass
class PushedCartPole(BalancedCartPole):
    """The cart-pole whose DPS waits for pushes: in the place of its policy is the command ``u.push``, in N."""

    def _commands(self) -> list[Signal]:
        return [Signal("push", size=1, unit="N", lower=-self.force_limit, upper=self.force_limit)]

    @property
    def force_address(self) -> str:
        return "dps.impl.discrete_state_0"

    def make_dps(self) -> Diagram:
        return make_pushed_dps(period=self.period, force_limit=self.force_limit)


def environments(count: int, *, seconds: float = 4.0) -> TestbedVectorEnv:
    """Return environments of the cart-pole that step together, as machine code.

    Args:
        count: The number of environments.
        seconds: The duration of an episode in seconds.
    """
    return vtb.gymnasium_vector_env(
        PushedCartPole(),
        num_envs=count,
        action=["push"],
        observation=["joint_position", "joint_velocity"],
        reward=vtb.Quality(cost, of="plant.state", reading="integral", minimize=True),
        period=0.02,
        horizon=seconds,
        parameters=STARTS,
    )


def forces(gains: Array, states: Array) -> Array:
    """Return the forces of n policies, force = gains' (state - UPRIGHT) within the limits, shape (n, 1), in N.

    Args:
        gains: The gains of each, shape (n, 4), in N/m, N/rad, N s/m and N s/rad.
        states: The state [x, theta, x', theta'] of each, shape (n, 4), in m and rad.
    """
    return np.clip(np.sum(gains * (states - UPRIGHT), axis=1, keepdims=True), -FORCE_LIMIT, FORCE_LIMIT)


def returns(envs: TestbedVectorEnv, gains: Array, seeds: Sequence[int]) -> Array:
    """Return the sum of the rewards of an episode in each environment, shape (n,).

    Args:
        envs: The environments.
        gains: The gains of the policy in each, shape (n, 4).
        seeds: The seed of each.
    """
    observations, _ = envs.reset(seed=seeds)
    total, ended = np.zeros(envs.num_envs), False
    while not ended:
        observations, rewards, _, truncated, _ = envs.step(forces(gains, observations))
        total, ended = total + rewards, bool(truncated.all())
    return total


def train(*, generations: int = 40, population: int = 32, starts: int = 4, seed: int = 0) -> Array:
    """Return the gains (4,) that CMA-ES finds: all candidates of a generation begin at the same random starts.

    Args:
        generations: The number of generations.
        population: The number of candidates of a generation.
        starts: The number of episodes of each.
        seed: The seed of starts and method.
    """
    envs = environments(population * starts)
    search = CMA(mean=np.zeros(4), sigma=0.5, population_size=population, seed=seed)
    for generation in range(generations):
        candidates = np.array([search.ask() for _ in range(population)])
        seeds = [seed + generation * starts + k for k in range(starts)] * population
        total = returns(envs, np.repeat(candidates * GAINS, starts, axis=0), seeds)
        search.tell(list(zip(candidates, -total.reshape(population, starts).mean(axis=1), strict=True)))
    gains: Array = search.mean * GAINS
    return gains


if __name__ == "__main__":
    write(train(), *(sys.argv[1:] or ["trained.onnx"]))
