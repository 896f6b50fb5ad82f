"""Costs and savings of the framework on the SpaceClimber."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pydrake.systems.analysis import Simulator, SimulatorConfig

import vtbdrake as vtb
from benchmarks.measure import HIGHER, LOWER, Benchmark, interleaved, seconds, spread
from benchmarks.plain_climber import build_plain_climber
from vtbdrake.rollout import RolloutRunner, RolloutTask
from vtbdrake_diagrams.space_climber import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.studies.payload import (
    HORIZON,
    MASS,
    PITCH,
    SAMPLE_PERIOD,
    payload_problem,
    tipped_over,
)

DISTANCE = "sim.sys.climber.base.x"
REFERENCE = SimulatorConfig(integration_scheme="cenic", max_step_size=0.1, accuracy=1e-6)


def testbed_overhead(repeats: int = 20, chunk: float = 0.5) -> Benchmark:
    """The testbed against the same systems wired by hand in plain Drake, same integrator, 15 s of walking.

    The machine's speed drifts within a rollout: so both walk in turns of ``chunk`` simulated seconds, and each turn is
    compared with its neighbour. The layout of their memory makes a difference of a percent: so both are rebuilt for
    every rollout, in alternating order, and kept, so that none is laid out in the gaps of an earlier one.
    """
    scenario = SpaceClimberScenario()
    ends = chunk * np.arange(1, round(HORIZON / chunk) + 1)
    ratios, ours, theirs = [], [], []
    alive = []
    for i in range(repeats):
        if i % 2:
            testbed, plain = scenario.build(), build_plain_climber(scenario)
        else:
            plain, testbed = build_plain_climber(scenario), scenario.build()
        a, b = testbed.simulator(), plain.simulator()
        alive.append((testbed, plain, a, b))
        times = _side_by_side(a, b, ends)
        ratios.append(times[:, 0] / times[:, 1])
        ours.append(times[:, 0].sum())
        theirs.append(times[:, 1].sum())
    x = testbed.read(a.get_context(), DISTANCE)
    x_plain = plain.plant.GetPositions(plain.plant.GetMyContextFromRoot(b.get_context()))[4]
    return Benchmark(
        name="testbed_overhead",
        value=float(np.median(ratios)),
        unit="1",
        goal=1.03,
        better=LOWER,
        against="the same systems wired by hand in plain Drake",
        note=f"testbed {spread(np.array(ours))}, by hand {spread(np.array(theirs))}; distance walked {x:.6f} m and "
        f"{x_plain:.6f} m",
    )


def _side_by_side(a: Simulator, b: Simulator, ends: np.ndarray) -> np.ndarray:
    """Wall times (n, 2) of advancing both from end to end, the one or the other first."""

    def pair(i: int) -> np.ndarray:
        return np.ravel(
            interleaved(lambda: a.AdvanceTo(ends[i]), lambda: b.AdvanceTo(ends[i]), repeats=1, warm_up=0, first=i % 2)
        )

    return np.array([pair(i) for i in range(ends.size)])


def sweep_speedup(masses: int = 31) -> list[Benchmark]:
    """The payload sweep against what one would write first: rebuild per mass, serial, full horizon."""
    values = np.linspace(0.0, 60.0, masses)
    problem = payload_problem(phases=(0.0,))
    scenario = SpaceClimberScenario()
    tipped: dict[str, list[bool]] = {}

    def naive() -> None:
        tipped["naive"] = [_naive_rollout(mass, scenario, problem.task.sample_times()) for mass in values]

    def ours(executor: str) -> Callable[[], None]:
        def sweep() -> None:
            tipped[executor] = problem.sweep(values=values, executor=executor, progress=False).exceeded.tolist()

        return sweep

    by_hand, serial, parallel = seconds(naive), seconds(ours("serial")), seconds(ours("auto"))
    agree = sum(a == b for a, b in zip(tipped["naive"], tipped["auto"], strict=True))
    note = (
        f"{masses} masses: by hand {by_hand:.1f} s, serial {serial:.1f} s, two cores {parallel:.1f} s (starting the "
        f"workers included); {agree} of {masses} outcomes agree"
    )
    against = "rebuild per mass, serial, full horizon, same integrator and masses"
    return [
        Benchmark(name="sweep_speedup", value=by_hand / parallel, unit="1", goal=2.5, better=HIGHER, against=against,
                  note=note),
        Benchmark(name="sweep_speedup_serial", value=by_hand / serial, unit="1", goal=None, better=HIGHER,
                  against=against),
    ]  # fmt: skip


def _naive_rollout(mass: float, scenario: SpaceClimberScenario, times: np.ndarray) -> bool:
    """One rollout as one would write it first, with the same pauses; whether it tipped over."""
    plain = build_plain_climber(scenario)
    simulator = plain.simulator()
    plant_context = plain.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plain.plant.GetBodyByName("payload").SetMass(plant_context, mass)
    base = plain.plant.GetBodyByName("base")
    worst = 0.0
    for t in times[1:]:
        simulator.AdvanceTo(t)
        R_WB = base.EvalPoseInWorld(plant_context).rotation()
        worst = max(worst, tipped_over(float(R_WB.ToRollPitchYaw().pitch_angle())))
    return worst > 0.9


def rollout_rtf(repeats: int = 5) -> list[Benchmark]:
    """Simulated seconds per wall second of one rollout with the scenario's settings, and the reasons for these."""
    scenario = SpaceClimberScenario()
    reference = _walk(scenario, REFERENCE)
    step = scenario.simulator_config.max_step_size
    candidates = {
        f"accuracy {a:g}": SimulatorConfig(integration_scheme="cenic", max_step_size=step, accuracy=a)
        for a in (1e-2, 1e-3, 1e-4)
    }
    rows = []
    for name, fields in candidates.items():
        rtf, distance = _measured(scenario, fields, 2)
        rows.append(f"{name}: RTF {rtf:.1f}, distance {100 * (distance / reference - 1):+.2f} %")
    rtf, distance = _measured(scenario, scenario.simulator_config, repeats)
    error = abs(distance / reference - 1.0)
    ours = _first_tipping(scenario, scenario.simulator_config, 32.0)
    # The reference takes seconds for each mass: it begins where it should not tip yet.
    fine = _first_tipping(scenario, REFERENCE, min(ours, 44.0) - 1.0)
    study = "; ".join(rows)
    return [
        Benchmark(
            name="rollout_rtf",
            value=rtf,
            unit="1",
            goal=None,
            better=HIGHER,
            against=f"accuracy {REFERENCE.accuracy:g}: {reference:.4f} m walked in {HORIZON:g} s",
            note=f"the goal was 70 times real time, now see rollout_ladder_climber;  "
            f"{study}. First mass that tips: {ours:g} kg, with the reference {fine:g} kg",
        ),
        Benchmark(name="rollout_distance_error", value=error, unit="1", goal=0.01, better=LOWER,
                  against="the fine reference"),
    ]  # fmt: skip


def _runner(scenario: SpaceClimberScenario, fields: SimulatorConfig) -> RolloutRunner:
    quality = vtb.Quality(tipped_over, of=PITCH)
    scenario = replace(scenario, simulator_config=fields)
    return RolloutRunner(
        RolloutTask(scenario, HORIZON, quality, threshold=0.9, sample_period=SAMPLE_PERIOD, record=(DISTANCE,))
    )


def _walk(scenario: SpaceClimberScenario, fields: SimulatorConfig) -> float:
    return float(_runner(scenario, fields).run({MASS: 0.0}).record[DISTANCE][-1])


def _measured(scenario: SpaceClimberScenario, fields: SimulatorConfig, repeats: int) -> tuple[float, float]:
    """(real-time factor, distance walked), the median of ``repeats`` rollouts."""
    runner = _runner(scenario, fields)
    results = [runner.run({MASS: 0.0}) for _ in range(repeats)]
    return HORIZON / float(np.median([r.wall_time for r in results])), float(results[0].record[DISTANCE][-1])


def _first_tipping(scenario: SpaceClimberScenario, fields: SimulatorConfig, least: float) -> float:
    """The least of the masses from ``least`` to 44 kg, in steps of 1 kg, that tips the robot over."""
    runner = _runner(scenario, fields)
    return next((m for m in np.arange(least, 45.0) if runner.run({MASS: m}).end == "threshold"), np.inf)
