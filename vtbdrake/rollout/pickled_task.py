"""Tasks, points and results as bytes, for rollouts in other processes."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.common.lru import LruDict
from vtbdrake.common.pickling import dumps
from vtbdrake.rollout.executor import WorkerError
from vtbdrake.rollout.start import Start, Starts, start_of_each
from vtbdrake.rollout.task import RolloutResult, RolloutTask

MAX_TASKS = 16


@dataclass(frozen=True)
class PickledTask:
    """A pickled task.

    Attributes:
        content: The bytes, which `unpack` reads.
        digest: A digest of the content.
    """

    content: bytes
    digest: str


class TaskPickler:
    """Pickles tasks, and keeps the bytes of those used last."""

    def __init__(self) -> None:
        self._pickled: LruDict[int, tuple[RolloutTask, PickledTask]] = LruDict(MAX_TASKS)

    def pickle(self, task: RolloutTask) -> PickledTask:
        """Return the pickled task. A task is known by its identity.

        Raises:
            WorkerError: It cannot be pickled.
        """
        entry = self._pickled.use(id(task))
        if entry is None:
            entry = (task, _pickle(task))
            self._pickled.add(id(task), entry)
        return entry[1]


def _pickle(task: RolloutTask) -> PickledTask:
    try:
        content = dumps(task)
    except Exception as error:
        raise WorkerError(
            f"the problem cannot be sent to another process ({error_text(error)}): use executor='threads' "
            "or 'serial', keep what cannot be pickled out of its quality function and scenario, or move the class or "
            "function that holds it from the notebook or script into a module"
        ) from error
    return PickledTask(content, hashlib.blake2b(content, digest_size=16).hexdigest())


def pack(point: Mapping[str, Any]) -> bytes:
    """Return a point (address -> value) as bytes, which `unpack` reads.

    Raises:
        WorkerError: A value cannot be pickled.
    """
    try:
        return dumps(dict(point))
    except Exception:
        for address, value in point.items():
            try:
                dumps(value)
            except Exception as error:
                raise WorkerError(
                    f"{address} = {value!r} cannot be sent to another process ({error_text(error)}): vary "
                    "a value that pickles, or use executor='threads' or 'serial'"
                ) from error
        raise


def pack_starts(start: Starts, count: int) -> list[bytes]:
    """Return the start of each of ``count`` rollouts as bytes, for `unpack_start`; the task's own s0 is empty.

    A start that several rollouts share is the same object for all of them.

    Args:
        start: One start for all rollouts, one for each, or None for the task's own s0.
        count: Number of rollouts.

    Raises:
        StartError: It is no start, or there are too many or too few.
    """
    starts = start_of_each(start, count)
    packed = {each: pickle.dumps(each) if each is not None else b"" for each in dict.fromkeys(starts)}
    return [packed[each] for each in starts]


@lru_cache(maxsize=16)
def unpack_start(content: bytes) -> Start | None:
    """Return the start of a rollout: the same object for the same bytes, as a runner prepares each start once."""
    return unpack(content) if content else None


def unpack(content: bytes) -> Any:
    """Return an object that was pickled in another process.

    Raises:
        WorkerError: This process cannot import what the content needs.
    """
    try:
        return pickle.loads(content)
    except Exception as error:
        raise WorkerError(
            f"a worker process cannot read what it was sent ({error_text(error)}): it needs the same "
            "modules as the main process, in the same versions"
        ) from error


def answer(index: int, rollout: Callable[[], RolloutResult]) -> bytes:
    """Run a rollout and return the pickled pair of its index and its result, or the exception that it raised.

    What cannot be pickled, or not be read again, becomes an exception that says so.

    Args:
        index: Index of the rollout's point in the call of the executor.
        rollout: Runs the rollout.
    """
    outcome: RolloutResult | BaseException
    try:
        outcome = rollout()
    except FAILURES as error:
        outcome = error
    try:
        reply = _dumps((index, outcome))
        if isinstance(outcome, BaseException):
            pickle.loads(reply)  # Some exceptions pickle but cannot be read again.
        if not isinstance(outcome, SystemExit):  # It would end the main program.
            return reply
    except Exception as error:
        if isinstance(outcome, RolloutResult):
            remedy = "record vectors, or use executor='serial'"
            outcome = TypeError(f"a result cannot be sent from a worker process ({error}): {remedy}")
            return pickle.dumps((index, outcome))
    return pickle.dumps((index, RuntimeError(error_text(outcome))))


def _dumps(reply: tuple[int, Any]) -> bytes:
    try:
        return pickle.dumps(reply)
    except Exception:  # The main program defines the class.
        return dumps(reply)
