"""Rollouts on a Dask cluster: a scheduler and its workers, be they processes, SLURM jobs, pods or hosts behind SSH."""

from __future__ import annotations

import logging
import os
import pickle
import threading
import time
import uuid
from collections import OrderedDict, deque
from collections.abc import Iterator, Sequence
from functools import partial
from math import inf
from typing import Any

from vtbdrake.rollout.blob import Blob, Blobs, pack, unpack
from vtbdrake.rollout.executor import Executor, Parameters, WorkerError
from vtbdrake.rollout.runner import failed
from vtbdrake.rollout.task import RolloutResult, RolloutTask
from vtbdrake.rollout.worker import answer
from vtbdrake.rollout.worker_processes import ProcessExecutor, checked_time_limit

try:
    from distributed import Client, Future, KilledWorker, WorkerPlugin, as_completed, get_worker
    from distributed.client import ClosedClientError
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("rollouts on a Dask cluster need: pip install 'vtbdrake[cluster]'") from error

_log = logging.getLogger(__name__)

ADDRESS = "DASK_SCHEDULER_ADDRESS"
# How many tasks the workers are told about at a time.
_TASKS = 16
# How often the cluster is asked for its size, in seconds: it may grow while it works.
_SIZE_PERIOD = 5.0


class DaskExecutor(Executor):
    """Rollouts on a Dask cluster, whose workers need the same vtbdrake and what the problem imports.

    A task is told to all workers once, also to those that come later. Each thread of a worker has its rollouts run in a
    process of its own (see `ProcessExecutor`), which builds the testbed once and keeps it. So a rollout that crashes or
    hangs costs two such processes, and is a failed result with the reasons; it costs no worker. When a worker itself is
    lost, Dask runs its rollouts elsewhere. A rollout with which more workers were lost than
    ``distributed.scheduler.allowed-failures`` is tried again when no other runs, for it may have been the neighbour of
    the one at fault; when that fails too, it is a failed result. With no worker left, it waits for new ones, as one
    does for a queue of jobs.

    Args:
        client: of the cluster, and left open; or the address of its scheduler; left out, that in the environment
            variable ``DASK_SCHEDULER_ADDRESS``.
        time_limit: in seconds of wall time for one rollout, from when its testbed is there.
        in_flight: how many rollouts the cluster is given at a time; twice its threads if left out.

    Raises:
        ValueError: no scheduler is known.
        WorkerError: none answers.
    """

    def __init__(
        self, client: Client | str | None = None, *, time_limit: float = inf, in_flight: int | None = None
    ) -> None:
        if in_flight is not None and in_flight < 1:
            raise ValueError(f"at least one rollout must be in flight, not {in_flight}")
        self._time_limit = checked_time_limit(time_limit)
        self._own = not isinstance(client, Client)
        self._client: Client = client if isinstance(client, Client) else _connected(client)
        if self._client.asynchronous:
            raise ValueError("an asynchronous Dask client cannot be waited for: make it with asynchronous=False")
        self._limit = in_flight
        self._threads = 0
        self._counted = -inf
        self._blobs = Blobs()
        self._told: OrderedDict[str, str] = OrderedDict()

    def run(self, task: RolloutTask, points: Sequence[Parameters]) -> Iterator[tuple[int, RolloutResult]]:
        """See `Executor.run`.

        Raises:
            WorkerError: the task cannot be sent to the workers, or the scheduler is lost.
        """
        name = self._tell(self._blobs.get(task))
        waiting = deque(range(len(points)))
        suspects: deque[int] = deque()
        tried: set[int] = set()
        flying: dict[Future[bytes], int] = {}
        landed = as_completed(loop=self._client.loop, with_results=True, raise_errors=False)
        try:
            while waiting or flying or suspects:
                alone = not waiting and not flying
                room = 1 if alone else self._room() - len(flying)
                batch = suspects if alone else waiting
                for _ in range(min(room, len(batch))):
                    index = batch.popleft()
                    future = self._submit(name, index, points[index])
                    flying[future] = index
                    landed.add(future)
                future, outcome = next(landed)
                index = flying.pop(future)
                error = _error(outcome)
                if isinstance(error, KilledWorker) and index not in tried:
                    tried.add(index)
                    suspects.append(index)
                    _log.warning("rollout %d is tried again, alone: %s", index, error)
                elif isinstance(error, KilledWorker):
                    message = f"its workers died, time and again, also when no other rollout ran: {error}"
                    yield index, failed(points[index], message)
                elif error is not None:
                    raise error
                else:
                    yield index, pickle.loads(outcome)[1]
        finally:
            if flying and self._client.status == "running":
                self._client.cancel(list(flying))

    def _submit(self, name: str, index: int, point: Parameters) -> Future[bytes]:
        key = f"rollout-{uuid.uuid4().hex}"
        try:
            return self._client.submit(roll_on_dask, name, index, pack(point), self._time_limit, key=key, pure=False)
        except ClosedClientError as error:
            raise _given_up(error) from error

    def _tell(self, blob: Blob) -> str:
        """The name under which the workers know the task; sent once."""
        if blob.digest not in self._told:
            name = f"vtbdrake-{blob.digest}-{uuid.uuid4().hex}"
            try:
                self._client.register_plugin(TaskPlugin(blob), name=name)
            except Exception as error:
                raise WorkerError(
                    f"the Dask workers do not take the problem ({type(error).__name__}: {error}): they need the same "
                    "vtbdrake as this process"
                ) from error
            self._told[blob.digest] = name
            if len(self._told) > _TASKS:
                self._client.unregister_worker_plugin(self._told.popitem(last=False)[1])
        self._told.move_to_end(blob.digest)
        return self._told[blob.digest]

    def _room(self) -> int:
        if self._limit is not None:
            return self._limit
        if time.monotonic() >= self._counted + _SIZE_PERIOD:
            try:
                self._threads = sum(self._client.nthreads().values())
            except OSError as error:
                raise _given_up(error) from error
            self._counted = time.monotonic()
        return max(2, 2 * self._threads)

    def close(self) -> None:
        if self._client.status == "running":
            for name in self._told.values():
                self._client.unregister_worker_plugin(name)
        self._told.clear()
        if self._own:
            self._client.close()


def _connected(address: str | None) -> Client:
    address = address or os.environ.get(ADDRESS)
    if not address:
        raise ValueError(
            "executor='dask' needs a scheduler: start one with `dask scheduler` and workers with `dask worker ADDRESS` "
            f"and set {ADDRESS}, or give executor=distributed.Client(...)"
        )
    try:
        return Client(address, set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise WorkerError(f"no Dask scheduler answers at {address}: start one with `dask scheduler`") from error


def _given_up(error: BaseException) -> WorkerError:
    return WorkerError(f"the Dask scheduler has given up rollouts, or is gone: {error}")


def _error(outcome: Any) -> BaseException | None:
    """What went wrong, on Dask's side or in the rollout. The status of a future may change after its outcome came."""
    if isinstance(outcome, BaseException):
        return _given_up(outcome)
    error = outcome[1] if isinstance(outcome, tuple) else pickle.loads(outcome)[1]
    return error if isinstance(error, BaseException) else None


class TaskPlugin(WorkerPlugin):
    """Brings a task to every worker of a cluster, also to those that come later or are started again."""

    def __init__(self, blob: Blob) -> None:
        self.blob = blob

    def setup(self, worker: Any) -> None:
        _children.users += 1

    def teardown(self, worker: Any) -> None:
        _children.users -= 1
        if not _children.users:
            _children.close()


class _Children:
    """The processes in which the threads of this Dask worker have their rollouts run, one each.

    Attributes:
        users: how many tasks the worker knows.
    """

    def __init__(self) -> None:
        self.users = 0
        self._of: dict[tuple[int, float], ProcessExecutor] = {}

    def get(self, time_limit: float) -> ProcessExecutor:
        key = (threading.get_ident(), time_limit)
        if key not in self._of:
            self._of[key] = ProcessExecutor(1, time_limit=time_limit)
        return self._of[key]

    def close(self) -> None:
        while self._of:
            self._of.popitem()[1].close()


_children = _Children()


def roll_on_dask(name: str, index: int, point: bytes, time_limit: float) -> bytes:
    """One rollout on a worker, of the task that it knows by ``name``; the answer is that of `worker.answer`."""
    plugin: Any = get_worker().plugins[name]
    return answer(index, partial(_roll, plugin.blob, point, time_limit))


def _roll(blob: Blob, point: bytes, time_limit: float) -> RolloutResult:
    ((_, result),) = _children.get(time_limit).run_blob(blob, [unpack(point)])
    return result
