"""Gain of a Dask cluster of any size, extrapolated from the costs of a local one of two workers."""

from __future__ import annotations

import pickle
import time

import numpy as np

from benchmarks.dask_cluster import DaskCluster, dask_cluster
from benchmarks.measure import HIGHER, Benchmark, spread
from benchmarks.parallel import climber_task
from vtbdrake.rollout import RolloutTask
from vtbdrake.rollout.cluster import DaskExecutor
from vtbdrake.rollout.pickled_task import TaskPickler
from vtbdrake_diagrams.space_climber import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.payload import HORIZON, MASS

WORKERS = 2
SIZES = (100, 10, 1000)


def predicted_efficiency(workers: int, *, t_r: float, t_x: float, t_s: float) -> float:
    """Efficiency of W workers: the throughput X that they reach over that of W workers that do nothing but simulate.

    * A worker takes t_r for a rollout and waits t_x for the next: W of them finish W / (t_r + t_x) a second.
    * Scheduler and client each handle one task after another. The slower of them needs t_s of its core for a task, so
      that never more than 1 / t_s are finished a second.

        X = min(W / (t_r + t_x), 1 / t_s),    efficiency = X t_r / W

    All times in seconds. Left out are what a real network adds to t_x, and the slow start while testbeds are built.
    """
    throughput = min(workers / (t_r + t_x), 1.0 / t_s)
    return throughput * t_r / workers


def cluster_projection(rollouts: int = 16, tasks: int = 400) -> list[Benchmark]:
    """The predicted efficiency at 10, 100 and 1,000 workers; see `predicted_efficiency` for the model.

    t_r is the wall time of a payload rollout (15 s of walking) on a worker. t_x is the round trip of a rollout that is
    alone in the cluster, less its wall time: an upper bound, for with two rollouts in flight per worker part of it is
    hidden. t_s is the processor time that scheduler or client, whichever needs more, spends on one of many rollouts
    that are next to nothing themselves.
    """
    task = climber_task(SpaceClimberScenario(), horizon=HORIZON)
    tiny = climber_task(SpaceClimberScenario(), horizon=0.1)
    with dask_cluster(workers=WORKERS) as cluster, DaskExecutor(cluster.client) as executor:
        for warm_up in (task, tiny):
            list(executor.run(warm_up, [{MASS: 0.0}] * (2 * WORKERS)))
        t_r, size = _rollout_time(executor, task, rollouts)
        t_x = _transfer(executor, tiny, tasks // 10)
        scheduler, client = _overhead(cluster, executor, tiny, tasks)
    costs = {"t_r": float(np.median(t_r)), "t_x": float(np.median(t_x)), "t_s": max(scheduler, client)}
    note = (
        f"rollout {spread(t_r)}; transfer per task {spread(1e3 * t_x, unit='ms')}, with a result of {size} bytes; "
        f"per task {1e3 * scheduler:.2f} ms of the scheduler's processor and {1e3 * client:.2f} ms of the client's; "
        f"the task itself is sent once, {len(TaskPickler().pickle(task).content)} bytes; saturated by "
        f"{costs['t_r'] / costs['t_s']:.0f} workers"
    )
    rows = []
    for workers in SIZES:
        first = workers == SIZES[0]
        rows.append(
            Benchmark(
                name="cluster_projection" if first else f"cluster_projection_{workers}",
                value=predicted_efficiency(workers, **costs),
                unit="1",
                goal=None,
                better=HIGHER,
                against=f"{workers} workers that only simulate; measured on a local Dask cluster of {WORKERS}",
                note=note if first else "",
            )
        )
    return rows


def _rollout_time(executor: DaskExecutor, task: RolloutTask, rollouts: int) -> tuple[np.ndarray, int]:
    """Wall times of rollouts on the workers, in seconds, and the bytes of a result."""
    points = [{MASS: float(mass)} for mass in np.linspace(0.0, 20.0, rollouts)]
    results = [result for _, result in executor.run(task, points)]
    return np.array([result.wall_time for result in results]), len(pickle.dumps(results[0]))


def _transfer(executor: DaskExecutor, task: RolloutTask, rollouts: int) -> np.ndarray:
    """Round trips of rollouts that are alone, less their wall times, in seconds."""
    transfers = []
    for _ in range(rollouts):
        begin = time.perf_counter()
        ((_, result),) = executor.run(task, [{MASS: 0.0}])
        transfers.append(time.perf_counter() - begin - result.wall_time)
    return np.array(transfers)


def _overhead(cluster: DaskCluster, executor: DaskExecutor, task: RolloutTask, tasks: int) -> tuple[float, float]:
    """Processor time per task in seconds, of the scheduler and of this process, the client."""
    scheduler, client = cluster.client.run_on_scheduler(time.process_time), time.process_time()
    list(executor.run(task, [{MASS: 0.0}] * tasks))
    client = time.process_time() - client
    return (cluster.client.run_on_scheduler(time.process_time) - scheduler) / tasks, client / tasks
