"""Steps of environments for reinforcement learning: against Drake's bare loop, and compiled against one in Drake."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator

import vtbdrake as vtb
from benchmarks.measure import HIGHER, LOWER, Benchmark, interleaved_values, processor_time, ratio
from vtbdrake.environments import TestbedEnv
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cart_pole.policy import cost
from vtbdrake_diagrams.manipulator import ManipulatorScenario

PERIOD = 0.02
STATE = "plant.state"
COUNT = 256

CART_POLE: dict[str, Any] = {
    "problem": CartPoleScenario(),
    "action": ["force"],
    "observation": ["joint_position", "joint_velocity"],
    "reward": vtb.Quality(cost, of=STATE, reading="integral", minimize=True),
    "period": PERIOD,
    "horizon": 10.0,
    "parameters": [vtb.Parameter("sim.sys.cart_pole.pole_pin.position", 2.9, 3.3)],
}
ARM: dict[str, Any] = {
    "problem": ManipulatorScenario(),
    "action": ["joint_torque"],
    "observation": ["joint_position", "joint_velocity"],
    "reward": vtb.Reward(lambda state: -float(state @ state), of=STATE),
    "period": PERIOD,
    "horizon": 10.0,
}


def gymnasium_step(repeats: int = 15) -> list[Benchmark]:
    """Compare the steps of an environment with Drake's bare loop: AdvanceTo by the same period, with fixed inputs."""
    return [
        _step("gymnasium_step", ARM, 1.15, repeats=repeats, steps=25),
        _step("gymnasium_step_cart_pole", CART_POLE, None, repeats=repeats, steps=400),
    ]


def _step(name: str, statement: dict[str, Any], goal: float | None, *, repeats: int, steps: int) -> Benchmark:
    env = vtb.gymnasium_env(**statement)
    bare = _BareLoop(env, steps)
    by_env, by_loop = interleaved_values(lambda: _time_of_steps(env, steps), bare, repeats=repeats)
    if not np.array_equal(env.testbed.read(env.context, STATE), bare.state()):
        raise ArithmeticError(f"{name}: the environment and the bare loop end in different states")
    micros = [f"{1e6 * np.median(times) / steps:.3g}" for times in (by_env, by_loop)]
    return Benchmark(
        name=name,
        value=ratio(by_env, by_loop),
        unit="1",
        goal=goal,
        better=LOWER,
        against=f"Simulator.AdvanceTo by the same {1e3 * PERIOD:g} ms, the action fixed, nothing read",
        note=f"{micros[0]} and {micros[1]} us of processor time per step; with checks, observation, reward; the same "
        f"bits; n = {repeats}",
    )


def _time_of_steps(env: TestbedEnv, steps: int) -> float:
    """Return the processor time of some steps, without the reset."""
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape or ())

    def run() -> None:
        for _ in range(steps):
            env.step(action)

    return processor_time(run)


class _BareLoop:
    """Advances the testbed of an environment by plain Drake, from the start of the environment's first episode."""

    def __init__(self, env: TestbedEnv, steps: int) -> None:
        self._testbed, self._steps = env.testbed, steps
        _, info = env.reset(seed=0)
        self._start = env.testbed.default_context()
        env.testbed.write(self._start, info["values"])
        env.testbed.switch(self._start, act={signal.name: "real" for signal in env.testbed.interface.act})
        self._context = self._start

    def __call__(self) -> float:
        """Return the processor time of the steps."""
        self._context = self._start.Clone()
        simulator = Simulator(self._testbed.diagram, self._context)
        ApplySimulatorConfig(self._testbed.simulator_config, simulator)
        simulator.Initialize()

        def run() -> None:
            for k in range(self._steps):
                simulator.AdvanceTo((k + 1) * PERIOD)

        return processor_time(run)

    def state(self) -> np.ndarray:
        """Return the state of the plant at the end."""
        state: np.ndarray = self._testbed.read(self._context, STATE)
        return state


def gymnasium_vector_compiled(repeats: int = 15, steps: int = 50) -> Benchmark:
    """Compare the steps per second of compiled environments with one environment in Drake; in one thread each."""
    env = vtb.gymnasium_env(**CART_POLE)
    envs = vtb.gymnasium_vector_env(**CART_POLE, num_envs=COUNT, executor="compiled")
    action = np.zeros((COUNT, 1))

    def compiled() -> float:
        envs.reset(seed=0)

        def run() -> None:
            for _ in range(steps):
                envs.step(action)

        return processor_time(run) / COUNT

    by_drake, by_code = interleaved_values(lambda: _time_of_steps(env, steps), compiled, repeats=repeats)
    observations = [env.step(action[0])[0], envs.step(action)[0][0]]
    apart = float(np.max(np.abs(observations[0] - observations[1])))
    if not apart <= 1e-9:
        raise ArithmeticError(f"the compiled cart-pole is {apart:.2g} from Drake's after {steps + 1} steps")
    micros = [f"{1e6 * np.median(times) / steps:.3g}" for times in (by_code, by_drake)]
    return Benchmark(
        name="gymnasium_vector_compiled",
        value=ratio(by_drake, by_code),
        unit="1",
        goal=50.0,
        better=HIGHER,
        against="one environment in Drake, the cart-pole with steps of 20 ms",
        note=f"{micros[0]} us of processor time per step of one of {COUNT} environments, in Drake {micros[1]}; "
        f"{apart:.1g} apart after {steps + 1} steps; n = {repeats}",
    )
