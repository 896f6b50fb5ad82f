"""A task as bytes, as it travels to other processes: pickled once here, and known there by its digest."""

from __future__ import annotations

import hashlib
import pickle
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vtbdrake.pickling import dumps
from vtbdrake.rollout.executor import WorkerError
from vtbdrake.rollout.runner import Runners, Testbeds
from vtbdrake.rollout.task import RolloutResult, RolloutTask

_KEPT = 16


@dataclass(frozen=True)
class Blob:
    """A pickled task.

    Attributes:
        content: the bytes; `pickle.loads` gives the task.
        digest: of the content.
    """

    content: bytes
    digest: str


class Blobs:
    """The blobs of the tasks last used."""

    def __init__(self) -> None:
        self._blobs: OrderedDict[int, tuple[RolloutTask, Blob]] = OrderedDict()

    def get(self, task: RolloutTask) -> Blob:
        """The blob of ``task``, which is known by its identity.

        Raises:
            WorkerError: it cannot be pickled.
        """
        if id(task) not in self._blobs:
            self._blobs[id(task)] = (task, _pickled(task))
            if len(self._blobs) > _KEPT:
                self._blobs.popitem(last=False)
        self._blobs.move_to_end(id(task))
        return self._blobs[id(task)][1]


def _pickled(task: RolloutTask) -> Blob:
    try:
        content = dumps(task)
    except Exception as error:
        raise WorkerError(
            f"the problem cannot be sent to another process ({type(error).__name__}: {error}): use executor='threads' "
            "or 'serial', keep what cannot be pickled out of its quality function and scenario, or move the class or "
            "function that holds it from the notebook or script into a module"
        ) from error
    return Blob(content, hashlib.blake2b(content, digest_size=16).hexdigest())


def pack(point: Mapping[str, Any]) -> bytes:
    """Return a point (address -> value) as bytes; `unpack` reads them.

    Raises:
        WorkerError: a value cannot be pickled.
    """
    try:
        return dumps(dict(point))
    except Exception:
        for address, value in point.items():
            try:
                dumps(value)
            except Exception as error:
                raise WorkerError(
                    f"{address} = {value!r} cannot be sent to another process ({type(error).__name__}: {error}): vary "
                    "a value that pickles, or use executor='threads' or 'serial'"
                ) from error
        raise


def unpack(content: bytes) -> Any:
    """Return what was pickled in another process.

    Raises:
        WorkerError: this process cannot import what it takes.
    """
    try:
        return pickle.loads(content)
    except Exception as error:
        raise WorkerError(
            f"a worker process cannot read what it was sent ({type(error).__name__}: {error}): it needs the same "
            "modules as the main process, in the same versions"
        ) from error


class _Kept:
    """What a process of a pool that is not ours keeps: the tasks last used, by digest, and their runners."""

    def __init__(self) -> None:
        self.runners = Runners(Testbeds())
        self._tasks: OrderedDict[str, RolloutTask] = OrderedDict()
        self._lock = threading.Lock()

    def task(self, blob: Blob) -> RolloutTask:
        with self._lock:
            if blob.digest not in self._tasks:
                self._tasks[blob.digest] = unpack(blob.content)
                if len(self._tasks) > _KEPT:
                    self._tasks.popitem(last=False)
            self._tasks.move_to_end(blob.digest)
            return self._tasks[blob.digest]


_kept = _Kept()


def run_blob(blob: Blob, point: bytes) -> RolloutResult:
    """One rollout of the task in ``blob``, in a process that keeps its testbed until the next; see `Runners.run`.

    Args:
        point: as `pack` made it.
    """
    return _kept.runners.run(_kept.task(blob), unpack(point))
