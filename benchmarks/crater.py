"""Benchmark of the decision in the crater beside its bare rollouts, and the error of its fast integrator."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context

from benchmarks.measure import LOWER, Benchmark, interleaved, ratio, spread
from benchmarks.parallel import CORES, Alone, process_pool
from vtbdrake.reasoning import Belief, Decision, Reasoner
from vtbdrake.rollout import RolloutResult, RolloutRunner, RolloutTask
from vtbdrake.rollout.start import Start
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.space_climber import CraterScenario, SpaceClimberScenario
from vtbdrake_diagrams.space_climber.studies.crater import (
    HEADING,
    HORIZON,
    STANDING,
    WALK,
    heading_reasoner,
    model,
)

SEED = 1
# Length of the rollouts that are compared, in s: their durations hardly differ, and both sides share them out alike.
SHORT = 40.0
X = "sim.sys.climber.base.x"
FINE = SimulatorConfig(integration_scheme="cenic", max_step_size=0.045, accuracy=1e-4)


def crater_decision(repeats: int = 3) -> list[Benchmark]:
    """Wall time of a decision among 7 headings, over the time of its bare rollouts on the same cores.

    The rollouts are short, so that many repeats fit, and what the decision adds counts for more than in rollouts of 300
    s. The bare rollouts begin at the same belief, in processes that get one after the other, as they become free; they
    are the same to the last bit, which is checked. All workers are warm: started, testbed built. Printed only: one
    decision of the whole horizon, beside one without ending rollouts that are stuck.
    """
    context = (testbed := CraterScenario(seed=SEED).build()).default_context()
    testbed.write(context, {WALK: 0.0})
    testbed.simulator(context).AdvanceTo(STANDING)
    testbed.write(context, {WALK: 1.0})
    scenario = model(SEED)
    with ExitStack() as stack:
        short, early, whole = (
            stack.enter_context(heading_reasoner(robot, horizon=horizon, executor="processes", workers=CORES))
            for robot, horizon in ((scenario, SHORT), (scenario, HORIZON), (replace(scenario, patience=0.0), HORIZON))
        )
        pool = stack.enter_context(process_pool(CORES, initializer=Alone.prepare, initargs=(short.task,)))
        rollouts = _rollouts(short.decide(testbed, context))
        start = short.belief_to_start.start(Belief.of(testbed, context))
        points = [dict(rollout.parameters) for rollout in rollouts]

        def bare() -> list[RolloutResult]:
            return list(pool.map(partial(_alone, start=start), points))

        alike = all(a.identical(b) for a, b in zip(rollouts, bare(), strict=True))
        ours, theirs = interleaved(lambda: short.decide(testbed, context), bare, repeats=repeats, warm_up=0)
        decision, took = _timed(early, testbed, context)
        to_the_end, without = _timed(whole, testbed, context)
    same = to_the_end.values == decision.values
    choices = f"{np.degrees(decision.values[HEADING]):.0f} and {np.degrees(to_the_end.values[HEADING]):.0f} deg"
    simulated, longest = (sum(float(r.times[-1]) for r in _rollouts(d)) for d in (decision, to_the_end))
    return [
        Benchmark(
            name="crater_decision",
            value=ratio(ours, theirs),
            unit="1",
            goal=1.1,
            better=LOWER,
            holds=None if alike else False,
            against=f"the bare rollouts of the decision on {CORES} cores",
            note=f"decision {spread(ours)}, {len(points)} bare rollouts of {SHORT:g} s {spread(theirs)}, "
            f"{'the same' if alike else 'NOT the same'} to the last bit; with a horizon of {HORIZON:g} s a decision "
            f"took {took:.1f} s. {_error(scenario)}",
        ),
        Benchmark(
            name="crater_decision_early_end",
            value=took / without,
            unit="1",
            goal=1.0,
            better=LOWER,
            against="the decision whose rollouts go on where the robot is stuck",
            holds=same and took <= without,
            note=f"they choose {choices}; {simulated:.0f} s simulated instead of {longest:.0f} s",
        ),
    ]


def _alone(point: Mapping[str, Any], start: Start) -> RolloutResult:
    """Simulate in a process that knows nothing of executors."""
    return Alone.runner.run(point, start=start)


def _timed(reasoner: Reasoner, testbed: VirtualTestbed, context: Context) -> tuple[Decision, float]:
    """Return a decision of warm workers, and its wall time in s."""
    reasoner.warm_up()
    begin = time.perf_counter()
    decision = reasoner.decide(testbed, context)
    return decision, time.perf_counter() - begin


def _rollouts(decision: Decision) -> list[RolloutResult]:
    return [rollout for candidate in decision.candidates for rollout in candidate.rollouts]


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
