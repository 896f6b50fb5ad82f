"""Plans of judo, timed: a program for an interpreter that has judo and casadi, and neither Drake nor vtbdrake.

It reads a JSON object from standard input, and prints one: ``{"version", "seconds", "processor", "cost"}``, the wall
times and the processor times of the plans, in s, and the cost of the plan that is zero. It plans for the quadruped if
the object has the quadruped's functions of CasADi, ``controls`` and ``cost``, and else for the cart-pole.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from importlib.metadata import version

import casadi
import judo.tasks.base
import numpy as np
from judo.controller.controller import Controller, ControllerConfig
from judo.optimizers.ps import PredictiveSampling, PredictiveSamplingConfig
from judo.tasks.base import Task, TaskConfig

# It would download the meshes of other robots.
judo.tasks.base.download_and_extract_meshes = lambda **_: None


class CartPole(Task):
    """The cart-pole with the cost of `vtbdrake_diagrams.cart_pole.decision.cost`."""

    config_t = TaskConfig

    def reward(self, states, sensors, controls, system_metadata=None):
        x, theta, speed, rate = np.moveaxis(states, -1, 0)
        return -self.dt * (1.0 + np.cos(theta) + 0.1 * x**2 + 0.01 * (speed**2 + rate**2)).sum(axis=-1)


class Quadruped(Task):
    """The quadruped whose trot is planned, with the cost of `vtbdrake_diagrams.quadruped.decision.cost`."""

    config_t = TaskConfig

    def __init__(self, path, settings):
        super().__init__(path)
        self._limits = np.array(settings["limits"])
        self._controls, self._cost = (casadi.Function.deserialize(settings[name]) for name in ("controls", "cost"))
        self.time = settings["time"]

    @property
    def nu(self):
        return len(self._limits)

    @property
    def actuator_ctrlrange(self):
        return np.column_stack([-self._limits, self._limits])

    def task_to_sim_ctrl(self, controls):
        count, steps, _ = controls.shape
        times = np.tile(self.time + self.dt * np.arange(steps), count)
        targets = self._controls.map(count * steps)(controls.reshape(count * steps, -1).T, times[np.newaxis])
        return targets.full().T.reshape(count, steps, -1)

    def reward(self, states, sensors, controls, system_metadata=None):
        count, steps, _ = states.shape
        offsets = controls.reshape(count * steps, -1).T
        values = self._cost.map(count * steps)(states.reshape(count * steps, -1).T, offsets).full()
        return -np.where(np.isfinite(values), values, 1e6).reshape(count, steps).sum(axis=1)


def main() -> None:
    """Time the plans."""
    settings = json.load(sys.stdin)
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(settings["model"])
        file.flush()
        task = Quadruped(file.name, settings) if "controls" in settings else CartPole(file.name)
    config = PredictiveSamplingConfig(
        num_rollouts=settings["candidates"], num_nodes=settings["knots"], sigma=settings["spread"]
    )
    controller = Controller(ControllerConfig(horizon=settings["horizon"]), task, PredictiveSampling(config, task.nu))
    controller.current_state = np.array(settings["state"])
    seconds, processor = [], []
    for _ in range(settings["repeats"]):
        controller.reset()
        begin, spent = time.perf_counter(), time.process_time()
        controller.update_action()
        seconds.append(time.perf_counter() - begin)
        processor.append(time.process_time() - spent)
    # The first candidate is the plan in use, which is zero.
    cost = -float(controller.rewards[0])
    print(json.dumps({"version": version("judo-rai"), "seconds": seconds, "processor": processor, "cost": cost}))


if __name__ == "__main__":
    main()
