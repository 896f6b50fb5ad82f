"""Gain of two cores: rollouts of the SpaceClimber on every executor, against one after another."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context
from typing import Any

import numpy as np

from benchmarks.cpp_climber import CppClimberScenario
from benchmarks.dask_cluster import dask_cluster
from benchmarks.measure import HIGHER, Benchmark, seconds, spread
from vtbdrake.rollout import (
    Executor,
    FuturesExecutor,
    ProcessExecutor,
    Quality,
    RolloutRunner,
    RolloutTask,
    SerialExecutor,
    ThreadExecutor,
)
from vtbdrake.rollout.cluster import DaskExecutor
from vtbdrake_diagrams.space_climber import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.studies.payload import MASS, PITCH, SAMPLE_PERIOD

CORES = 2
HORIZON = 5.0
CEILING = "processes that share nothing"
GOAL = 0.95  # share of what processes that share nothing reach

Points = list[dict[str, float]]
# Runs all rollouts of a task, and returns when they are done.
Run = Callable[[RolloutTask, Points], None]


def parallel_efficiency_cpp(rollouts: int = 40, repeats: int = 3) -> Benchmark:
    """The efficiency of the best executor, with a DPS of Drake's systems only."""
    return _efficiency("parallel_efficiency_cpp", climber_task(CppClimberScenario()), rollouts, repeats)


def parallel_efficiency_python(rollouts: int = 24, repeats: int = 3) -> Benchmark:
    """The efficiency of the best executor, with the SpaceClimber's own DPS, in Python."""
    return _efficiency("parallel_efficiency_python", climber_task(SpaceClimberScenario()), rollouts, repeats)


def climber_task(scenario: SpaceClimberScenario, *, horizon: float = HORIZON) -> RolloutTask:
    """The tilt of the torso while it walks for ``horizon`` seconds."""
    return RolloutTask(scenario, horizon, Quality(tilt, PITCH), sample_period=SAMPLE_PERIOD)


def tilt(pitch: float) -> float:
    return abs(pitch)


def _efficiency(name: str, task: RolloutTask, rollouts: int, repeats: int) -> Benchmark:
    """Measure the efficiency over the efficiency of processes that share nothing.

    An efficiency is the time on one core / (cores x the time on all), the median over runs that are neighbours.

    The runs on one core and on all take turns, one against three, and every executor has its turn in every repeat. Each
    is compared with the mean of the runs on one core before and after it, so that what else the machine does meets
    both. What the machine itself allows is measured in the same way: processes that do a fixed share of the rollouts
    each, without a word in between.

    The masses are so small that no rollout ends early.
    """
    points = [{MASS: float(mass)} for mass in np.linspace(0.0, 20.0, rollouts)]
    times: dict[str, list[float]] = {}
    ratios: dict[str, list[float]] = {}
    with ExitStack() as stack:
        serial = _executor(stack.enter_context(SerialExecutor()))
        runs = {kind: _executor(make(stack)) for kind, make in EXECUTORS.items()} | {CEILING: _apart(stack, task)}
        for run in [serial, *runs.values()]:
            run(task, points[::2])
        alone = [seconds(lambda: serial(task, points))]
        for repeat in range(repeats):
            order = list(runs) if repeat % 2 == 0 else list(reversed(runs))
            for kinds in zip(order[::3], order[1::3], order[2::3], strict=True):
                elapsed_by_kind = {kind: seconds(lambda kind=kind: runs[kind](task, points)) for kind in kinds}
                alone.append(seconds(lambda: serial(task, points)))
                for kind, elapsed in elapsed_by_kind.items():
                    times.setdefault(kind, []).append(elapsed)
                    ratios.setdefault(kind, []).append(np.mean(alone[-2:]) / (CORES * elapsed))
    efficiency = {kind: float(np.median(values)) for kind, values in ratios.items()}
    ceiling = efficiency.pop(CEILING)
    best = max(efficiency, key=lambda kind: efficiency[kind])
    table = "; ".join(
        f"{kind} {value:.3f} ({spread(np.array(times[kind]))})"
        for kind, value in sorted(efficiency.items(), key=lambda item: -item[1])
    )
    return Benchmark(
        name=name,
        value=efficiency[best] / ceiling,
        unit="1",
        goal=GOAL,
        better=HIGHER,
        against=f"as many {CEILING}",
        note=f"{rollouts} rollouts of {HORIZON:g} s on {CORES} workers, which were warm (started, testbed built); "
        f"best: {best}; efficiencies against one core: {CORES} {CEILING} {ceiling:.3f} "
        f"({spread(np.array(times[CEILING]))}), {table}; "
        f"one core {spread(np.array(alone))}",
    )


def _executor(executor: Executor) -> Run:
    def run(task: RolloutTask, points: Points) -> None:
        for _ in executor.run(task, points):
            pass

    return run


def _apart(stack: ExitStack, task: RolloutTask) -> Run:
    """Processes that know nothing of executors."""
    pools = [stack.enter_context(process_pool(1, initializer=Alone.prepare, initargs=(task,))) for _ in range(CORES)]

    def run(task: RolloutTask, points: Points) -> None:
        for future in [pool.submit(Alone.run, points[share::CORES]) for share, pool in enumerate(pools)]:
            future.result()

    return run


class Alone:
    """A process that simulates what it is sent, and knows nothing of executors."""

    runner: RolloutRunner

    @classmethod
    def prepare(cls, task: RolloutTask) -> None:
        cls.runner = RolloutRunner(task)

    @classmethod
    def run(cls, points: Points, start: object = None) -> None:
        for point in points:
            cls.runner.run(point, start=start)


def process_pool(workers: int, **options: Any) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(workers, mp_context=get_context("spawn"), **options)


EXECUTORS: Mapping[str, Callable[[ExitStack], Executor]] = {
    "threads": lambda stack: stack.enter_context(ThreadExecutor(CORES)),
    "processes": lambda stack: stack.enter_context(ProcessExecutor(CORES)),
    "pool of threads": lambda stack: FuturesExecutor(stack.enter_context(ThreadPoolExecutor(CORES))),
    "pool of processes": lambda stack: FuturesExecutor(stack.enter_context(process_pool(CORES))),
    "dask": lambda stack: stack.enter_context(DaskExecutor(stack.enter_context(dask_cluster(workers=CORES)).client)),
}
