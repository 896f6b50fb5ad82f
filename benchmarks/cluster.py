"""Efficiency of a thousand worker slots: scheduler, client and messages are real, the rollouts only wait."""

from __future__ import annotations

import pickle
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from distributed import Client

from benchmarks.dask_cluster import dask_cluster
from benchmarks.measure import HIGHER, Benchmark
from vtbdrake.rollout import Quality, RolloutResult, RolloutTask
from vtbdrake.rollout.cluster import DaskExecutor
from vtbdrake_diagrams.space_climber import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.studies.payload import MASS

PROCESSES = 2
DURATION = 0.5
"""The duration of a rollout, in s."""
TIMES = np.linspace(0.0, 15.0, 151)


def cluster_projection() -> list[Benchmark]:
    """The throughput of rollouts over the one of workers that do nothing else, from the first rollout to the last.

    A real network, and the building of the testbeds, are left out.
    """
    rows = []
    for slots, each, goal in ((1000, 40, 0.9), (100, 10, None)):
        elapsed = _elapsed(slots, each)
        rows.append(
            Benchmark(
                name=f"cluster_projection_{slots}",
                value=each * DURATION / elapsed,
                unit="1",
                goal=goal,
                better=HIGHER,
                against=f"{slots} workers that only simulate, rollouts of {DURATION:g} s",
                note=f"{each * slots} rollouts in {elapsed:.1f} s; a simulated cluster, whose rollouts only wait",
            )
        )
    return rows


def _elapsed(slots: int, each: int) -> float:
    """Return the time in s that a cluster of ``slots`` slots needs for ``each`` rollouts per slot."""
    task = RolloutTask(SpaceClimberScenario(), 15.0, Quality(abs, MASS))
    points = [{MASS: float(mass)} for mass in np.linspace(0.0, 20.0, each * slots)]
    with dask_cluster(workers=PROCESSES, threads=slots // PROCESSES) as cluster, Waiting(cluster.client) as executor:
        list(executor.run(task, points[: 2 * slots]))
        begin = time.perf_counter()
        count = sum(1 for _ in executor.run(task, points))
        assert count == len(points)
        return time.perf_counter() - begin


class Waiting(DaskExecutor):
    """An executor on a Dask cluster whose rollouts only wait for ``duration`` (s), so that its slots may be many.

    They cost what `cost` says.
    """

    def __init__(self, client: Client | str, *, duration: float = DURATION) -> None:
        super().__init__(client)
        self._function = partial(wait_on_dask, duration)


def wait_on_dask(
    duration: float,
    name: str,
    indices: Sequence[int],
    points: Sequence[bytes],
    starts: Sequence[bytes],
    time_limit: float,
) -> list[bytes]:
    """Take the time of rollouts on a worker, and return results of the usual size."""
    answers = []
    for index, content in zip(indices, points, strict=True):
        time.sleep(duration)
        point = pickle.loads(content)
        value = cost(point)
        result = RolloutResult(
            point,
            "horizon",
            TIMES,
            np.cos(TIMES),
            t_star=0.0,
            h=1.0 / (1.0 + value),
            value=value,
            wall_time=duration,
        )
        answers.append(pickle.dumps((index, result)))
    return answers


def cost(point: Mapping[str, Any]) -> float:
    """Return the cost of a rollout that only waits: the sum of squares of what is set in s0."""
    return float(sum(np.sum(np.square(value)) for value in point.values()))
