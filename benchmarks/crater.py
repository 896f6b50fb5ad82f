"""Benchmark of the decision in the crater: its wall time, and the error of its fast integrator."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from pydrake.systems.analysis import SimulatorConfig

from benchmarks.measure import LOWER, Benchmark
from vtbdrake.reasoning import Decision
from vtbdrake.rollout import RolloutResult, RolloutRunner, RolloutTask
from vtbdrake_diagrams.space_climber import CraterScenario, SpaceClimberScenario
from vtbdrake_diagrams.space_climber.crater import (
    HEADING,
    HEADINGS,
    HORIZON,
    Expedition,
    World,
    heading_reasoner,
    model,
)

SEED = 1
GOAL = 15.0
X = "sim.sys.climber.base.x"
FINE = SimulatorConfig(integration_scheme="cenic", max_step_size=0.045, accuracy=1e-4)


def crater_decision_time() -> list[Benchmark]:
    """Wall time of a decision among 7 headings of 300 s on two cores, with and without ending rollouts that are stuck.

    The workers are warm: the note has the time of their start and of building their testbeds.
    """
    scenario = model(SEED)
    to_the_end, first, plain = _decide(replace(scenario, patience=0.0))
    early, _, cut = _decide(scenario)
    same = to_the_end.values == early.values
    simulated = sum(float(result.times[-1]) for result in _rollouts(early))
    against = f"{HEADINGS.size} headings of {HORIZON:g} s, two cores; one heading in reality takes {HORIZON:g} s"
    note = (
        f"both choose {np.degrees(to_the_end.values[HEADING]):.0f} deg"
        if same
        else f"the choices differ: {to_the_end.values}, {early.values}"
    )
    return [
        Benchmark(name="crater_decision_time", value=plain, unit="s", goal=GOAL, better=LOWER, against=against,
                  holds=same and plain <= GOAL,
                  note=f"{note}; the first decision, with the start of the workers, {first:.1f} s. {_error(scenario)}"),
        Benchmark(name="crater_decision_time_early_end", value=cut, unit="s", goal=GOAL, better=LOWER, against=against,
                  holds=same and cut <= GOAL,
                  note=f"rollouts end where the robot is stuck: {simulated:.0f} s simulated instead of "
                  f"{sum(float(result.times[-1]) for result in _rollouts(to_the_end)):.0f} s"),
    ]  # fmt: skip


def _rollouts(decision: Decision) -> list[RolloutResult]:
    return [rollout for candidate in decision.candidates for rollout in candidate.rollouts]


def _decide(scenario: CraterScenario) -> tuple[Decision, float, float]:
    """Return the decision, and the wall times of the first decision and of a second one in seconds."""
    expedition = Expedition(World(CraterScenario(seed=SEED)))
    with heading_reasoner(scenario, executor="processes", workers=2) as reasoner:
        times = []
        for _ in range(2):
            begin = time.perf_counter()
            decision = expedition.decide(reasoner)
            times.append(time.perf_counter() - begin)
    return decision, times[0], times[1]


def _error(scenario: CraterScenario) -> str:
    """Return the error of the mental integrator against a fine one, where the robot walks and where it slips."""
    fast = scenario.mental()
    plane = SpaceClimberScenario(
        simulator_config=fast.simulator_config, plant_config=fast.plant_config, period=fast.period, payload=False
    )
    texts = []
    for name, fields in {
        "level": {},
        "20 deg uphill": {"slope_deg": -20.0, "friction": fast.friction},
        "22 deg uphill with friction 0.35": {"slope_deg": -22.0, "friction": 0.35},
    }.items():
        mental, fine = (
            _walked(replace(plane, simulator_config=config, plant_config=plant, **fields))
            for config, plant in (
                (fast.simulator_config, fast.plant_config),
                (FINE, CraterScenario().plant_config),
            )
        )
        texts.append(f"{name} {mental:+.2f} m ({fine:+.2f} m)")
    return f"Way in 20 s with the mental integrator (and with CENIC, accuracy {FINE.accuracy:g}): {', '.join(texts)}"


def _walked(scenario: SpaceClimberScenario) -> float:
    task = RolloutTask(scenario, 20.0, None, sample_period=10.0, record=(X,))
    x = RolloutRunner(task).run({}).record[X]
    return float((x[-1] - x[0]) / np.cos(np.radians(scenario.slope_deg)))
