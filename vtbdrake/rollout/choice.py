"""The choice of an executor: by name, by an object of the user, or by the systems of the testbed."""

from __future__ import annotations

import concurrent.futures
import sys
from collections.abc import Callable
from math import inf
from typing import Any

from vtbdrake.rollout.executor import Executor, SerialExecutor, ThreadExecutor, checked_workers
from vtbdrake.rollout.futures import FuturesExecutor
from vtbdrake.rollout.worker_processes import ProcessExecutor
from vtbdrake.testbed import VirtualTestbed

NAMES = ("auto", "serial", "threads", "processes", "dask")


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
        executor: ``auto``, ``serial``, ``threads``, ``processes`` or ``dask``; an Executor of ours; any
            `concurrent.futures.Executor`; or a `distributed.Client`.
        testbed: of the rollouts; serial rollouts and threads use it.
        rollouts: how many there will be; a single one is run in this thread.
        workers: threads or processes; the number of cores if left out.
        time_limit: of one rollout, in seconds of wall time, for what can end one: processes and Dask.

    Raises:
        ValueError: the executor is unknown, or has no use for ``workers`` or ``time_limit``.
    """
    if executor == "auto":
        alone = min(rollouts, checked_workers(workers)) <= 1
        executor = "processes" if time_limit is not None else "serial" if alone else choose_executor(testbed)
        workers = None if executor == "serial" else workers
    if isinstance(executor, str):
        made = _by_name(executor, testbed=testbed, workers=workers, time_limit=time_limit)
        if isinstance(made, ProcessExecutor):
            made.start(rollouts)
        return made
    if isinstance(executor, Executor):
        _refuse("an Executor that is there already", workers=workers, time_limit=time_limit)
        return executor
    if isinstance(executor, concurrent.futures.Executor):
        _refuse("a pool that is there already", workers=workers, time_limit=time_limit)
        return FuturesExecutor(executor)
    # A client exists only if its package has been imported.
    distributed = sys.modules.get("distributed")
    if distributed is not None and isinstance(executor, distributed.Client):
        return _dask(executor, workers=workers, time_limit=time_limit)
    raise ValueError(_unknown(executor))


def _by_name(name: str, *, testbed: VirtualTestbed, workers: int | None, time_limit: float | None) -> Executor:
    if name in ("serial", "threads") and time_limit is not None:
        raise ValueError(
            f"executor={name!r} cannot keep a time limit of {time_limit:g} s, for nothing ends a rollout inside its "
            "own process: use 'processes' or 'dask'"
        )
    if name == "serial" and workers is not None:
        raise ValueError(f"executor='serial' has no workers, but workers={workers} was given: use 'threads', say")
    makers: dict[str, Callable[[], Executor]] = {
        "serial": lambda: SerialExecutor(testbed),
        "threads": lambda: ThreadExecutor(workers, testbed=testbed),
        "processes": lambda: ProcessExecutor(workers, time_limit=inf if time_limit is None else time_limit),
        "dask": lambda: _dask(None, workers=workers, time_limit=time_limit),
    }
    if name not in makers:
        raise ValueError(_unknown(name))
    return makers[name]()


def _dask(client: Any, *, workers: int | None, time_limit: float | None) -> Executor:
    from vtbdrake.rollout.cluster import DaskExecutor

    _refuse("a Dask cluster", workers=workers)
    return DaskExecutor(client, time_limit=inf if time_limit is None else time_limit)


def _refuse(what: str, **options: float | None) -> None:
    for name, value in options.items():
        if value is not None:
            raise ValueError(f"{what} has its own settings: {name}={value} cannot be given with it")


def _unknown(executor: object) -> str:
    return (
        f"an executor is one of {', '.join(NAMES)}, an Executor, a concurrent.futures.Executor or a Dask Client, not "
        f"{executor!r}"
    )
