"""Time to find a good gait: a study, against differential evolution that rebuilds the diagram each time."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from math import inf, isfinite

import numpy as np
from pydrake.systems.analysis import Simulator

import vtbdrake as vtb
from benchmarks.measure import HIGHER, Benchmark, spread
from vtbdrake.testbed.integrator import apply_simulator_config
from vtbdrake_diagrams.space_climber import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.studies.payload import MASS, PITCH

PERIOD, STROKE, RAMP_TIME = (f"dps.impl.gait.{name}" for name in ("period", "stroke", "ramp_time"))
X, ROLL = "sim.sys.climber.base.x", "sim.sys.climber.base.roll"
BOUNDS = {PERIOD: (0.3, 2.0), STROKE: (0.04, 0.3)}
# On Mars, with an attachment of 10 kg, whose inertia and friction the fastest gaits do not cope with: they slip and
# stumble. The robot is at full speed after half a second.
SCENARIO = SpaceClimberScenario(gravity=3.71)
CONDITION = {MASS: 10.0, RAMP_TIME: 0.5}
HORIZON = 2.0
SAMPLE_PERIOD = 0.1
TILT = np.radians(15.0)

BEST = 1.534
"""The best distance in m of a grid over both ranges, refined around its best point: ``python -m benchmarks.gait``."""
TARGET = 0.97 * BEST
# So many rollouts without reaching the target count as never.
LIMIT = 600


def stable_distance(x: float, roll: float, pitch: float) -> float:
    """Return how far the robot has come, in m; 0 if it tips: a torso that leans by 15 deg does not come back."""
    return max(x, 0.0) if max(abs(roll), abs(pitch)) < TILT else 0.0


def gait_problem() -> vtb.Problem:
    """Period and stroke of the fastest stable walk: the distance walked in two seconds."""
    return vtb.Problem(
        scenario=SCENARIO,
        parameters=[vtb.Parameter(address, *ends) for address, ends in BOUNDS.items()],
        quality=vtb.Quality(stable_distance, [X, ROLL, PITCH], reading="end"),
        horizon=HORIZON,
        sample_period=SAMPLE_PERIOD,
        conditions=[CONDITION],
    )


@dataclass(frozen=True)
class Search:
    """The time until a search reached the target, in s, infinite if it did not, and its rollouts."""

    seconds: float
    rollouts: int


def time_to_target(seeds: int = 3) -> list[Benchmark]:
    """The comparison of `time_to_target_full` for a few seeds, without the study on one core."""
    return _compared("time_to_target", ("auto", "rebuild"), seeds)


def time_to_target_full(seeds: int = 10) -> list[Benchmark]:
    """Wall time of differential evolution over a study's, each until it reaches the target; medians over seeds.

    The time of a search that does not reach the target is infinite.

    The target is 97 % of the best distance known, and was fixed before. The study: default solver, default executor on
    all cores, or serial; the problem is new each time, so that its build and the start of the workers count. The other:
    ``scipy.optimize.differential_evolution`` with its default settings on a function that builds the scenario and
    simulates it to the horizon, pausing at the same sample times, so that both see the same values at the same points;
    it is stopped at the first value that reaches the target. They run in turns, seed by seed.
    """
    return _compared("time_to_target_full", ("auto", "serial", "rebuild"), seeds)


def _compared(name: str, kinds: tuple[str, ...], seeds: int) -> list[Benchmark]:
    searches_by_kind: dict[str, list[Search]] = {kind: [] for kind in kinds}
    for seed in range(seeds):
        first = seed % len(kinds)
        for which in kinds[first:] + kinds[:first]:
            searches_by_kind[which].append(_differential_evolution(seed) if which == "rebuild" else _study(seed, which))
    times = {which: np.array([search.seconds for search in searches]) for which, searches in searches_by_kind.items()}
    counts = {
        which: np.array([float(search.rollouts) for search in searches]) for which, searches in searches_by_kind.items()
    }
    names = {"auto": "study", "serial": "serial study", "rebuild": "rebuild and differential evolution"}
    note = "; ".join(
        f"{names[which]}: {spread(times[which])}, rollouts {spread(counts[which], unit='')}" for which in kinds
    )
    against = "rebuild and differential evolution"
    return [
        Benchmark(
            name=name if kind == "auto" else f"{name}_{kind}",
            value=_speedup(times["rebuild"], times[kind]),
            unit="1",
            goal=4.0 if kind == "auto" else None,
            better=HIGHER,
            against=against,
            note=note if kind == "auto" else "",
        )
        for kind in kinds
        if kind != "rebuild"
    ]


def _speedup(theirs: np.ndarray, ours: np.ndarray) -> float:
    """The ratio of medians; a target that we do not reach in half of the runs is no speedup, whatever they do."""
    median = float(np.median(ours))
    return float(np.median(theirs)) / median if isfinite(median) else 0.0


def _study(seed: int, executor: str) -> Search:
    begin = time.perf_counter()
    study = gait_problem().study(seed=seed).run(rollouts=LIMIT, target=TARGET, executor=executor, progress=False)
    elapsed = time.perf_counter() - begin
    return Search(elapsed if study.reason == "target" else inf, len(study))


class _Reached(Exception):  # noqa: N818
    """The target is reached, or the limit."""


def _differential_evolution(seed: int) -> Search:
    # Imported here, before the time counts: the workers of a study import this module, and have no use for it.
    from scipy.optimize import differential_evolution

    values: list[float] = []

    def function(point: np.ndarray) -> float:
        values.append(rebuilt(point))
        if values[-1] >= TARGET or len(values) >= LIMIT:
            raise _Reached
        return -values[-1]

    begin = time.perf_counter()
    with suppress(_Reached):
        differential_evolution(function, bounds=list(BOUNDS.values()), rng=seed)
    elapsed = time.perf_counter() - begin
    return Search(elapsed if max(values) >= TARGET else inf, len(values))


def rebuilt(point: np.ndarray) -> float:
    """The quality at a point, of a testbed that is built for it."""
    testbed = SCENARIO.build()
    simulator = Simulator(testbed.diagram)
    apply_simulator_config(testbed.simulator_config, simulator)
    context = simulator.get_mutable_context()
    for address, value in {**CONDITION, **dict(zip(BOUNDS, point, strict=True))}.items():
        testbed.variables()[address].set(context, value)
    for k in range(1, round(HORIZON / SAMPLE_PERIOD) + 1):
        simulator.AdvanceTo(k * SAMPLE_PERIOD)
    return stable_distance(*(testbed.read(context, address) for address in (X, ROLL, PITCH)))


def best_known() -> tuple[float, tuple[float, ...]]:
    """(distance, period and stroke): the best of a grid over the ranges, and of a finer one around its best point."""
    problem = gait_problem()
    ranges = list(BOUNDS.values())
    for _ in range(2):
        axes = [np.linspace(*ends, 12) for ends in ranges]
        sweep = problem.sweep(values=[(period, stroke) for period in axes[0] for stroke in axes[1]], progress=False)
        best = int(np.nanargmax(sweep.h))
        steps = [float(axis[1] - axis[0]) for axis in axes]
        ranges = [
            (max(lower, float(x) - step), min(upper, float(x) + step))
            for x, step, (lower, upper) in zip(sweep.points[best], steps, BOUNDS.values(), strict=True)
        ]
    return float(sweep.h[best]), tuple(sweep.points[best].tolist())


if __name__ == "__main__":
    print(best_known())
