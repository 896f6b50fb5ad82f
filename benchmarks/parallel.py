"""What two cores bring: rollouts of the SpaceClimber on every executor, against one after another."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from multiprocessing import get_context

import numpy as np

from benchmarks.cpp_climber import CppClimberScenario
from benchmarks.dask_cluster import dask_cluster
from benchmarks.measure import HIGHER, Benchmark, seconds, spread
from diagrams.space_climber import SpaceClimberScenario
from diagrams.space_climber.payload import MASS, PITCH, SAMPLE_PERIOD
from vtbdrake.rollout import (
    Executor,
    FuturesExecutor,
    ProcessExecutor,
    Quality,
    RolloutTask,
    SerialExecutor,
    ThreadExecutor,
)
from vtbdrake.rollout.cluster import DaskExecutor

CORES = 2
HORIZON = 5.0
SERIAL = "serial"


def parallel_efficiency_cpp(rollouts: int = 40, repeats: int = 3) -> Benchmark:
    """The efficiency of the best executor, with a DPS of Drake's systems only."""
    return _efficiency("parallel_efficiency_cpp", climber_task(CppClimberScenario()), rollouts, repeats)


def parallel_efficiency_python(rollouts: int = 30, repeats: int = 3) -> Benchmark:
    """The efficiency of the best executor, with the SpaceClimber's own DPS, in Python."""
    return _efficiency("parallel_efficiency_python", climber_task(SpaceClimberScenario()), rollouts, repeats)


def climber_task(scenario: SpaceClimberScenario, *, horizon: float = HORIZON) -> RolloutTask:
    """The tilt of the torso while it walks for ``horizon`` seconds."""
    return RolloutTask(scenario, horizon, Quality(tilt, PITCH), sample_period=SAMPLE_PERIOD)


def tilt(pitch: float) -> float:
    return abs(pitch)


def _efficiency(name: str, task: RolloutTask, rollouts: int, repeats: int) -> Benchmark:
    """Serial time / (cores x parallel time), of medians; every executor has its turn in every repeat.

    The masses are so small that no rollout ends early.
    """
    points = [{MASS: float(mass)} for mass in np.linspace(0.0, 20.0, rollouts)]
    times: dict[str, list[float]] = {}
    with ExitStack() as stack:
        executors = {kind: make(stack) for kind, make in EXECUTORS.items()}
        for executor in executors.values():
            _run(executor, task, points[::2])
        for repeat in range(repeats):
            order = list(executors) if repeat % 2 == 0 else list(reversed(executors))
            for kind in order:
                times.setdefault(kind, []).append(seconds(partial(_run, executors[kind], task, points)))
    medians = {kind: float(np.median(measured)) for kind, measured in times.items()}
    efficiency = {kind: medians[SERIAL] / (CORES * t) for kind, t in medians.items() if kind != SERIAL}
    best = max(efficiency, key=lambda kind: efficiency[kind])
    table = "; ".join(
        f"{kind} {value:.3f} ({spread(np.array(times[kind]))})"
        for kind, value in sorted(efficiency.items(), key=lambda item: -item[1])
    )
    return Benchmark(
        name=name,
        value=efficiency[best],
        unit="1",
        goal=0.9,
        better=HIGHER,
        against="one core, one rollout after another",
        note=f"{rollouts} rollouts of {HORIZON:g} s on {CORES} workers, which were warm (started, testbed built); "
        f"best: {best}. {table}; serial {spread(np.array(times[SERIAL]))}",
    )


def _run(executor: Executor, task: RolloutTask, points: list[dict[str, float]]) -> None:
    for _ in executor.run(task, points):
        pass


def _processes(stack: ExitStack) -> ProcessPoolExecutor:
    return stack.enter_context(ProcessPoolExecutor(CORES, mp_context=get_context("spawn")))


EXECUTORS: dict[str, Callable[[ExitStack], Executor]] = {
    SERIAL: lambda stack: stack.enter_context(SerialExecutor()),
    "threads": lambda stack: stack.enter_context(ThreadExecutor(CORES)),
    "processes": lambda stack: stack.enter_context(ProcessExecutor(CORES)),
    "pool of threads": lambda stack: FuturesExecutor(stack.enter_context(ThreadPoolExecutor(CORES))),
    "pool of processes": lambda stack: FuturesExecutor(_processes(stack)),
    "dask": lambda stack: stack.enter_context(DaskExecutor(stack.enter_context(dask_cluster(workers=CORES)).client)),
}
