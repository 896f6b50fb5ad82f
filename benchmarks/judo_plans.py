"""Plans of judo for the cart-pole, timed: a program for an interpreter that has judo, and neither Drake nor vtbdrake.

It reads a JSON object from standard input, and prints one: ``{"version", "seconds", "cost"}``, the wall times of the
plans and the cost of a plan without force.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from importlib.metadata import version

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


def main() -> None:
    """Time the plans."""
    settings = json.load(sys.stdin)
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(settings["model"])
        file.flush()
        task = CartPole(file.name)
    config = PredictiveSamplingConfig(
        num_rollouts=settings["candidates"], num_nodes=settings["knots"], sigma=settings["spread"]
    )
    controller = Controller(ControllerConfig(horizon=settings["horizon"]), task, PredictiveSampling(config, task.nu))
    controller.current_state = np.array(settings["state"])
    seconds = []
    for _ in range(settings["repeats"]):
        controller.reset()
        begin = time.perf_counter()
        controller.update_action()
        seconds.append(time.perf_counter() - begin)
    # The first candidate is the plan in use, which is zero.
    print(json.dumps({"version": version("judo-rai"), "seconds": seconds, "cost": -float(controller.rewards[0])}))


if __name__ == "__main__":
    main()
