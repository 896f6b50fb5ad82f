"""Where rollouts run: one after another, in threads that share a Diagram, or in processes that keep theirs.

The results are the same, to the last bit, whichever runs them.
"""

from __future__ import annotations

import os
import queue
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Self

from vtbdrake.rollout.result import RolloutResult
from vtbdrake.rollout.runner import CancelledError, RolloutRunner, same_scenario
from vtbdrake.rollout.task import RolloutTask
from vtbdrake.testbed import VirtualTestbed

Parameters = Mapping[str, Any]


def cores() -> int:
    """The processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


class Executor(ABC):
    """Runs rollouts of a task. It may be used for several tasks and is closed at the end (it is a context manager)."""

    @abstractmethod
    def run(self, task: RolloutTask, points: Sequence[Parameters]) -> Iterator[tuple[int, RolloutResult]]:
        """Runs one rollout per point and yields (index of the point, result) as they finish.

        A rollout that fails is a result; an error in the quality function is raised, and ends the others.
        """

    def close(self) -> None:
        """Gives back what it holds."""
        return

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class SerialExecutor(Executor):
    """One rollout after another, in this thread."""

    def __init__(self, testbed: VirtualTestbed | None = None) -> None:
        self._testbed = testbed

    def run(self, task: RolloutTask, points: Sequence[Parameters]) -> Iterator[tuple[int, RolloutResult]]:
        runner = RolloutRunner(task, _testbed_of(task, self._testbed))
        for index, parameters in enumerate(points):
            yield index, runner.run(parameters)


class ThreadExecutor(Executor):
    """Threads that share one Diagram, each with a Context of its own.

    The fastest where all systems are Drake's: a system in Python makes the threads wait for each other.
    """

    def __init__(self, workers: int | None = None, *, testbed: VirtualTestbed | None = None) -> None:
        self._count = _checked(workers)
        self._testbed = testbed

    def run(self, task: RolloutTask, points: Sequence[Parameters]) -> Iterator[tuple[int, RolloutResult]]:
        testbed = _testbed_of(task, self._testbed)
        waiting: queue.SimpleQueue[tuple[int, Parameters]] = queue.SimpleQueue()
        done: queue.SimpleQueue[tuple[int, RolloutResult] | BaseException] = queue.SimpleQueue()
        cancel = threading.Event()
        for item in enumerate(points):
            waiting.put(item)

        def work() -> None:
            try:
                runner = RolloutRunner(task, testbed)
                while not cancel.is_set():
                    index, parameters = waiting.get_nowait()
                    done.put((index, runner.run(parameters, cancel=cancel)))
            except (queue.Empty, CancelledError):
                return
            except BaseException as error:  # Raised again where the results are read.
                done.put(error)

        count = min(self._count, len(points))
        threads = [threading.Thread(target=work, name=f"rollout-{i}", daemon=True) for i in range(count)]
        for thread in threads:
            thread.start()
        try:
            for _ in points:
                result = done.get()
                if isinstance(result, BaseException):
                    raise result
                yield result
        finally:
            cancel.set()
            for thread in threads:
                thread.join()


def _testbed_of(task: RolloutTask, known: VirtualTestbed | None) -> VirtualTestbed:
    """The testbed that is known, if it is the task's."""
    return known if known is not None and same_scenario(known, task) else task.scenario.build()


def choose_executor(testbed: VirtualTestbed) -> str:
    """The kind of executor that suits a testbed: threads, or processes where systems in Python have work to do."""
    return "processes" if testbed.python_systems else "threads"


def make_executor(
    executor: str | Executor, *, testbed: VirtualTestbed, rollouts: int, workers: int | None = None
) -> Executor:
    """An executor by name (``auto``, ``serial``, ``threads``, ``processes``), or the one given.

    Raises:
        ValueError: the name is unknown.
    """
    from vtbdrake.rollout.processes import ProcessExecutor

    if isinstance(executor, Executor):
        return executor
    if executor == "auto":
        alone = min(rollouts, workers if workers is not None else cores()) <= 1
        executor = "serial" if alone else choose_executor(testbed)
    if executor == "serial":
        return SerialExecutor(testbed)
    if executor == "threads":
        return ThreadExecutor(workers, testbed=testbed)
    if executor == "processes":
        return ProcessExecutor(workers)
    raise ValueError(f"an executor is one of auto, serial, threads, processes, or an Executor, not {executor!r}")


def _checked(workers: int | None) -> int:
    if workers is not None and workers < 1:
        raise ValueError(f"an executor needs at least one worker, not {workers}")
    return workers if workers is not None else cores()
