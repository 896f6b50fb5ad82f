"""Rollouts on a Dask cluster: a scheduler with workers, such as processes, SLURM jobs, pods or hosts behind SSH."""

from __future__ import annotations

import logging
import os
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from math import inf, isfinite
from typing import Any

from vtbdrake.common.failures import error_text
from vtbdrake.common.lru import LruDict
from vtbdrake.rollout.executor import WorkerError
from vtbdrake.rollout.futures import Call, FuturesExecutor
from vtbdrake.rollout.pickled_task import PickledTask, answer, pack, unpack
from vtbdrake.rollout.task import RolloutResult
from vtbdrake.rollout.worker_processes import TIME_LIMIT, ProcessExecutor, checked_time_limit

try:
    from distributed import Client, KilledWorker, WorkerPlugin, as_completed, get_worker
    from distributed.client import ClosedClientError
    from distributed.security import Security
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("rollouts on a Dask cluster need: pip install 'vtbdrake[cluster]'") from error

_log = logging.getLogger(__name__)

# What a client raises whose scheduler has ended.
_GONE = (OSError, ClosedClientError)

ADDRESS = "DASK_SCHEDULER_ADDRESS"
# The number of tasks that the workers keep.
_TASKS = 16
# Least duration of a chunk per thread of the cluster, in s: a scheduler needs about 3 ms for a chunk.
_TASK_TIME = 0.01
# Assumed duration of a rollout before any was timed, in s.
_GUESS = 1.0
# Weight of the newest rollout in the mean duration.
_NEWEST = 0.1
# Largest number of rollouts in a chunk.
_LARGEST_CHUNK = 256
# Seconds after which a cluster without workers is reported, again and again.
NO_WORKERS = 30.0
# The period in seconds at which the size of the cluster is read: it may grow while it works.
_SIZE_PERIOD = 5.0


def run_on_dask(
    name: str, indices: Sequence[int], points: Sequence[bytes], starts: Sequence[bytes], time_limit: float
) -> list[bytes]:
    """Run rollouts of the task called ``name`` on a Dask worker; return what `answer` returns for each.

    Args:
        name: Name of the worker's plugin that holds the task.
        indices: Index of the point of each rollout, for its answer.
        points: The pickled points.
        starts: The starts, see `pack_starts`.
        time_limit: The longest wall time of one rollout, in seconds.
    """
    plugin: Any = get_worker().plugins[name]
    rollouts = (
        partial(_roll, plugin.task, point, start, time_limit) for point, start in zip(points, starts, strict=True)
    )
    return [answer(index, rollout) for index, rollout in zip(indices, rollouts, strict=True)]


class DaskExecutor(FuturesExecutor):
    """Rollouts on a Dask cluster, whose workers need the same vtbdrake and what the problem imports.

    A task is sent once to every worker, also to those that join later. Each thread of a worker runs its rollouts in a
    child process (see `ProcessExecutor`), which builds the testbed once and keeps it. So a rollout that crashes or
    hangs costs two such processes and becomes a failed result; it costs no Dask worker.

    Rollouts travel in chunks, which a thread runs one after another: the more of them the shorter they are and the
    larger the cluster, because a scheduler handles some 300 chunks a second. When a Dask worker is lost, Dask runs its
    chunks elsewhere. The rollouts of a chunk that was running when more workers than
    ``distributed.scheduler.allowed-failures`` were lost are tried again one by one, because one of them, or one of
    another chunk, may be at fault; if that fails too, it is a failed result. Without any worker, the executor waits for
    one, and logs a warning every half minute.

    Args:
        client: A client of the cluster, which stays open, or the address of the scheduler; by default the address in
            the environment variable ``DASK_SCHEDULER_ADDRESS``.
        time_limit: The wall time for one rollout, in seconds, without building its testbed; an hour by default, ``inf``
            for none.
        in_flight: The number of chunks that the cluster has at a time; by default twice its threads.

    Attributes:
        client: The client of Dask that has the rollouts run; closed with the executor unless the user has given it.

    Raises:
        ValueError: No scheduler is given.
        WorkerError: The scheduler does not answer.
    """

    _name = "a Dask cluster"
    _loss = KilledWorker
    _loss_text = "its workers died again and again, also while no other rollout ran"
    # What a worker runs: (name of the task, indices, points, starts, time limit) -> answers.
    _function: Callable[..., list[bytes]] = staticmethod(run_on_dask)

    def __init__(
        self, client: Client | str | None = None, *, time_limit: float = TIME_LIMIT, in_flight: int | None = None
    ) -> None:
        self._time_limit = checked_time_limit(time_limit)
        self._closes_client = not isinstance(client, Client)
        self.client: Client = client if isinstance(client, Client) else _connected(client)
        super().__init__(self.client, in_flight=in_flight)
        if self.client.asynchronous:
            raise ValueError("an asynchronous Dask client cannot be waited for: make it with asynchronous=False")
        self._threads = 0
        self._counted = -inf
        self._sent: LruDict[str, str] = LruDict(_TASKS)
        # Task's digest -> how long its rollouts take, in s.
        self._durations: LruDict[str, float] = LruDict(_TASKS)

    def _run(
        self, call: Call, indices: Iterable[int], *, retrying: bool = False
    ) -> Iterator[tuple[int, RolloutResult]]:
        ended = threading.Event()
        threading.Thread(target=_report_no_workers, args=(self.client, ended), daemon=True).start()
        try:
            yield from super()._run(call, indices, retrying=retrying)
        finally:
            ended.set()

    def _landed(self) -> Any:
        return as_completed(loop=self.client.loop, with_results=True, raise_errors=False)

    def _outcomes(self, reply: Any) -> list[bytes] | BaseException:
        # The status of a future may change after its reply has arrived. An error is (class, error, traceback).
        if isinstance(reply, BaseException):
            return _given_up(reply)
        outcomes: list[bytes] | BaseException = reply[1] if isinstance(reply, tuple) else reply
        return outcomes

    def _chunk(self, call: Call, waiting: int) -> int:
        # As many as need so long that the scheduler can follow, but none that would leave other threads without work.
        together = _TASK_TIME * self._threads / max(self._durations.get(call.task.digest, _GUESS), 1e-6)
        shared = -(-waiting // (2 * max(self._threads, 1)))
        return int(max(min(together, shared, _LARGEST_CHUNK), 1))

    def _result(self, call: Call, index: int, outcome: bytes | BaseException) -> RolloutResult:
        result = super()._result(call, index, outcome)
        if isfinite(result.wall_time):  # It was not lost.
            before = self._durations.get(call.task.digest, result.wall_time)
            self._durations.add(call.task.digest, before + _NEWEST * (result.wall_time - before))
        return result

    def _submit(self, call: Call, chunk: Sequence[int]) -> Any:
        name, key = self._send(call.task), f"rollouts-{uuid.uuid4().hex}"
        points, starts = [pack(call.points[i]) for i in chunk], [call.starts[i] for i in chunk]
        with self._scheduler_asked():
            return self.client.submit(
                self._function, name, chunk, points, starts, self._time_limit, key=key, pure=False
            )

    def _cancel(self, futures: Iterable[Any]) -> None:
        under_way = list(futures)
        if under_way and self.client.status == "running":
            self.client.cancel(under_way)

    def _retries(self) -> bool:
        return True

    def _retry(self, call: Call, lost: Mapping[int, BaseException]) -> Iterator[tuple[int, RolloutResult]]:
        # One after another: each may be the one that kills its worker.
        for index, error in lost.items():
            _log.warning("rollout %d is tried again, alone: %s", index, error)
            yield from self._run(call, [index], retrying=True)

    def _send(self, task: PickledTask) -> str:
        """Send the task to the workers, unless they have it, and return its name there."""
        name = self._sent.use(task.digest)
        if name is not None:
            return name
        name = f"vtbdrake-{task.digest}-{uuid.uuid4().hex}"
        try:
            with self._scheduler_asked():
                self.client.register_plugin(TaskPlugin(task), name=name)
        except WorkerError:
            raise
        except Exception as error:
            raise WorkerError(
                f"the Dask workers cannot read the problem ({error_text(error)}): they need the same vtbdrake as this "
                "process"
            ) from error
        dropped = self._sent.add(task.digest, name)
        if dropped is not None:
            self._forget(dropped)
        return name

    @contextmanager
    def _scheduler_asked(self) -> Iterator[None]:
        """Raise a WorkerError for whatever fails because the scheduler is gone, or the client closed for that."""
        try:
            yield
        except _GONE as error:
            raise _given_up(error) from error
        except Exception as error:
            if self.client.status == "running":
                raise
            raise _given_up(error) from error

    def _forget(self, name: str) -> None:
        """Remove a task from the workers; without a scheduler there are none.

        A worker that is being closed, such as at a restart of the cluster, has removed its tasks itself (KeyError).
        """
        with suppress(WorkerError, KeyError), self._scheduler_asked():
            self.client.unregister_worker_plugin(name)

    def _room(self) -> int:
        if self._in_flight is not None:
            return self._in_flight
        if time.monotonic() >= self._counted + _SIZE_PERIOD:
            with self._scheduler_asked():
                self._threads = sum(self.client.nthreads().values())
            self._counted = time.monotonic()
        return max(2, 2 * self._threads)

    def close(self) -> None:
        """Remove the tasks from the workers; close the client, unless it belongs to the user."""
        if self.client.status == "running":
            for name in self._sent.values():
                self._forget(name)
        self._sent.clear()
        if self._closes_client:
            self.client.close()


def _connected(address: str | None) -> Client:
    address = address or os.environ.get(ADDRESS)
    if not address:
        raise ValueError(
            "executor='dask' needs a scheduler: start one with `dask scheduler` and workers with `dask worker ADDRESS` "
            f"and set {ADDRESS}, or give executor=distributed.Client(...)"
        )
    if address.startswith("tls://") and Security().get_connection_args("client").get("ssl_context") is None:
        raise ValueError(
            f"the scheduler at {address} needs certificates: give executor=Client(address, security=Security(...)), or "
            "name them in Dask's configuration (distributed.comm.tls)"
        )
    try:
        return Client(address, set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise WorkerError(f"no Dask scheduler answers at {address}: start one with `dask scheduler`") from error


def _report_no_workers(client: Client, ended: threading.Event) -> None:
    """Log a warning, again and again, while a cluster has no worker."""
    since = time.monotonic()
    while not ended.wait(NO_WORKERS):
        try:
            if client.nthreads():
                since = time.monotonic()
                continue
        except Exception:  # The scheduler is gone, which the executor reports.
            return
        waited = time.monotonic() - since
        _log.warning(
            "no Dask worker for %.0f s: the rollouts wait for one; start `dask worker %s`, or interrupt the run",
            waited,
            client.scheduler_info()["address"],
        )


def _given_up(error: BaseException) -> WorkerError:
    return WorkerError(f"the Dask scheduler has given up rollouts, or is gone: {error}")


class TaskPlugin(WorkerPlugin):
    """Brings a task to every worker of a cluster, also to those that join later or are restarted."""

    def __init__(self, task: PickledTask) -> None:
        self.task = task

    def setup(self, worker: Any) -> None:
        _children.users += 1

    def teardown(self, worker: Any) -> None:
        _children.users -= 1
        if not _children.users:
            _children.close()


class _Children:
    """The child processes that run the rollouts of this Dask worker, one for each of its threads.

    Attributes:
        users: The number of tasks that the worker holds.
    """

    def __init__(self) -> None:
        self.users = 0
        self._executors: dict[tuple[int, float], ProcessExecutor] = {}

    def get(self, time_limit: float) -> ProcessExecutor:
        if not self.users:  # The rest of a chunk must not keep a worker that is being closed.
            raise WorkerError("the Dask worker is being closed, or its task was removed")
        key = (threading.get_ident(), time_limit)
        if key not in self._executors:
            self._executors[key] = ProcessExecutor(1, time_limit=time_limit)
        return self._executors[key]

    def close(self) -> None:
        while self._executors:
            self._executors.popitem()[1].close()


_children = _Children()


def _roll(task: PickledTask, point: bytes, start: bytes, time_limit: float) -> RolloutResult:
    ((_, result),) = _children.get(time_limit).run_pickled(task, [unpack(point)], [start])
    return result
