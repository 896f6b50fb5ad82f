"""Small problems for the tests of studies, importable by other processes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import System
from pydrake.systems.primitives import LinearSystem, MatrixGain

from tests.testbeds import PendulumScenario
from vtbdrake.optimization import Parameter, Problem
from vtbdrake.rollout import Executor, Quality, RolloutResult, RolloutTask
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

THETA = "sim.sys.Pendulum.theta.position"
RATE = "sim.sys.Pendulum.theta.velocity"
DAMPING = "sim.sys.Pendulum.theta.damping"


def gap(theta: float) -> float:
    """Return how far the pendulum is from where it is wanted, in rad."""
    return abs(theta - 0.3)


def pendulum_problem(**more: object) -> Problem:
    """From which angle and with which speed does the pendulum get nearest to 0.3 rad at the end?"""
    settings: dict = {
        # Accurate to 1e-6 rad, and four times as fast as with the scenario's own configuration.
        "scenario": PendulumScenario(simulator_config=SimulatorConfig(accuracy=1e-4, max_step_size=0.1)),
        "parameters": [Parameter(THETA, -1.5, 1.5), Parameter(RATE, -3.0, 3.0)],
        "quality": Quality(gap, THETA, minimize=True, reading="end"),
        "horizon": 0.3,
        "sample_period": 0.1,
    }
    return Problem(**{**settings, **more})


@dataclass
class DoubleIntegratorScenario(Scenario):
    """x'' = u with u = -stiffness x - damping x': the gains are fields, so that each pair takes another diagram."""

    simulator_config: SimulatorConfig = field(default_factory=lambda: SimulatorConfig(max_step_size=0.1, accuracy=1e-7))
    stiffness: float = 0.5
    damping: float = 1.0

    def interface(self) -> Interface:
        return Interface(sense=[Signal("state", size=2)], act=[Signal("force", size=1, unit="N", idle=0.0)])

    def make_dps(self) -> System:
        law = MatrixGain(np.array([[-self.stiffness, -self.damping]]))
        from pydrake.systems.framework import DiagramBuilder

        builder = DiagramBuilder()
        builder.AddNamedSystem("law", law)
        builder.ExportInput(law.get_input_port(), "state")
        builder.ExportOutput(law.get_output_port(), "force")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        mass = builder.add(
            "sys", "mass", LinearSystem(np.eye(2, k=1), np.array([[0.0], [1.0]]), np.eye(2), np.zeros((2, 1)))
        )
        builder.sim_sensor("state", mass.get_output_port())
        builder.sim_actuator("force", mass.get_input_port())


class StatedExecutor(Executor):
    """Rollouts that are not simulated: a function states their outcomes.

    Args:
        outcome: maps what is set in s0 to (the quality, the further measures), or to None if the simulation fails.
    """

    def __init__(self, outcome: Callable[[Mapping[str, Any]], tuple[float, tuple[float, ...]] | None]) -> None:
        self._outcome = outcome

    def run(self, task: RolloutTask, points: Sequence[Mapping[str, Any]]) -> Iterator[tuple[int, RolloutResult]]:
        for index, point in enumerate(points):
            found, none = self._outcome(point), np.array([])
            if found is None:
                yield index, RolloutResult(point, "failed", none, none, message="stated to fail", wall_time=0.0)
                continue
            value, measures = found
            h = float(task.quality.quality(value)) if task.quality else value
            yield (
                index,
                RolloutResult(
                    point, "horizon", none, none, t_star=0.0, h=h, value=value, measures=measures, wall_time=0.0
                ),
            )


def run_for_ever(path: str, executor: str) -> None:
    """Run a study that never ends, in a process that is going to be killed."""
    print("ready", flush=True)
    pendulum_problem().study(path, solver="cmaes", seed=3).run(rollouts=100_000, executor=executor, progress=False)


if __name__ == "__main__":
    run_for_ever(*sys.argv[1:])
