"""Executors by their names, or around a pool or a cluster of the user."""

from __future__ import annotations

import concurrent.futures
import sys
from collections.abc import Callable
from typing import Any

from vtbdrake.rollout.executor import Executor, SerialExecutor, ThreadExecutor, checked_workers
from vtbdrake.rollout.futures import FuturesExecutor
from vtbdrake.rollout.worker_processes import TIME_LIMIT, ProcessExecutor
from vtbdrake.testbed import VirtualTestbed

# Number of rollouts from which on ``auto`` compiles their testbed, which takes some seconds.
COMPILE_FROM = 200

NAMES = ("auto", "serial", "threads", "processes", "dask", "compiled")


def choose_executor(testbed: VirtualTestbed) -> str:
    """Return the executor that suits a testbed: threads, or processes where systems in Python have work to do."""
    return "processes" if testbed.python_systems else "threads"


def make_executor(
    executor: str | Executor | concurrent.futures.Executor | Any,
    *,
    testbed: VirtualTestbed,
    rollouts: int,
    workers: int | None = None,
    time_limit: float | None = None,
) -> Executor:
    """Return the requested executor. Closing it leaves a pool or client of the user open.

    Args:
        executor: ``auto``, ``serial``, ``threads``, ``processes``, ``dask`` or ``compiled``; an Executor of ours; any
            `concurrent.futures.Executor`; or a `distributed.Client`. ``auto`` takes the compiled testbed for 200
            rollouts and more, if it can be compiled (see `AutoExecutor`); else threads, processes where systems in
            Python have work to do, or this thread alone for a single worker.
        testbed: The testbed of the rollouts; serial rollouts and threads use it.
        rollouts: The number of rollouts; a single one is run in this thread.
        workers: The number of threads or processes; by default the number of cores.
        time_limit: The longest wall time of one rollout, in seconds; only processes and Dask can end one, by default
            after an hour.

    Raises:
        ValueError: The executor is unknown, or cannot use ``workers`` or ``time_limit``.
    """
    if executor == "auto":
        alone = min(rollouts, checked_workers(workers)) <= 1
        in_drake = "processes" if time_limit is not None else "serial" if alone else choose_executor(testbed)
        of_drake = None if in_drake == "serial" else workers
        if time_limit is None and rollouts >= COMPILE_FROM:
            from vtbdrake.rollout.compiled_executor import AutoExecutor  # CasADi is slow to import.

            return AutoExecutor(testbed, _by_name(in_drake, testbed=testbed, workers=of_drake), workers=workers)
        executor, workers = in_drake, of_drake
    if isinstance(executor, str):
        made = _by_name(executor, testbed=testbed, workers=workers, time_limit=time_limit)
        if isinstance(made, ProcessExecutor):
            made.start_workers(rollouts)
        return made
    if isinstance(executor, Executor):
        _refuse("an existing Executor", workers=workers, time_limit=time_limit)
        return executor
    if isinstance(executor, concurrent.futures.Executor):
        _refuse("an existing pool", workers=workers, time_limit=time_limit)
        return FuturesExecutor(executor)
    # A client exists only if its package has been imported.
    distributed = sys.modules.get("distributed")
    if distributed is not None and isinstance(executor, distributed.Client):
        return _dask(executor, workers=workers, time_limit=time_limit)
    raise ValueError(_unknown(executor))


def _by_name(name: str, *, testbed: VirtualTestbed, workers: int | None, time_limit: float | None = None) -> Executor:
    if name in ("serial", "threads", "compiled") and time_limit is not None:
        raise ValueError(
            f"executor={name!r} cannot keep a time limit of {time_limit:g} s, because a rollout in this process "
            "cannot be ended: use 'processes' or 'dask'"
        )
    if name == "serial" and workers is not None:
        raise ValueError(f"executor='serial' has no workers, but workers={workers} was given: use 'threads'")
    makers: dict[str, Callable[[], Executor]] = {
        "serial": lambda: SerialExecutor(testbed),
        "threads": lambda: ThreadExecutor(workers, testbed=testbed),
        "processes": lambda: ProcessExecutor(workers, time_limit=TIME_LIMIT if time_limit is None else time_limit),
        "compiled": lambda: _compiled(testbed, workers),
        "dask": lambda: _dask(None, workers=workers, time_limit=time_limit),
    }
    if name not in makers:
        raise ValueError(_unknown(name))
    return makers[name]()


def _compiled(testbed: VirtualTestbed, workers: int | None) -> Executor:
    from vtbdrake.rollout.compiled_executor import CompiledExecutor  # CasADi is slow to import.

    return CompiledExecutor(testbed, workers=workers)


def _dask(client: Any, *, workers: int | None, time_limit: float | None) -> Executor:
    from vtbdrake.rollout.cluster import DaskExecutor

    _refuse("a Dask cluster", workers=workers)
    return DaskExecutor(client, time_limit=TIME_LIMIT if time_limit is None else time_limit)


def _refuse(executor: str, **options: float | None) -> None:
    for name, value in options.items():
        if value is not None:
            raise ValueError(f"{executor} has its own settings: {name}={value} cannot be given with it")


def _unknown(executor: object) -> str:
    return (
        f"an executor is one of {', '.join(NAMES)}, an Executor, a concurrent.futures.Executor or a Dask Client, not "
        f"{executor!r}"
    )
