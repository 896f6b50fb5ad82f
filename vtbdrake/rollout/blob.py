"""A task as bytes, as it travels to other processes: pickled once, and known there by its digest."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass

import cloudpickle

from vtbdrake.rollout.executor import WorkerError
from vtbdrake.rollout.task import RolloutTask

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
        # cloudpickle also takes functions and scenarios that are defined in a notebook or a script.
        content = bytes(cloudpickle.dumps(task))
    except Exception as error:
        raise WorkerError(
            f"the problem cannot be sent to another process ({type(error).__name__}: {error}): use executor='threads' "
            "or 'serial', or keep what cannot be pickled out of its quality function and scenario"
        ) from error
    return Blob(content, hashlib.blake2b(content, digest_size=16).hexdigest())
