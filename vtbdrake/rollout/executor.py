"""Executors, which run rollouts: one after another, or in threads that share a Diagram."""

from __future__ import annotations

import concurrent.futures
import logging
import os
import queue
import sys
import threading
import weakref
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from typing import Any, NoReturn

from vtbdrake.common.argument_checks import as_whole
from vtbdrake.common.closing import Closing
from vtbdrake.common.interrupt import interrupt_taken
from vtbdrake.drake_workarounds.lost_interrupts import Interruptible
from vtbdrake.drake_workarounds.renderer_threads import release_renderers
from vtbdrake.rollout.pruning import Cutoff
from vtbdrake.rollout.runner import CancelledError
from vtbdrake.rollout.start import Start, Starts, start_of_each
from vtbdrake.rollout.task import RolloutResult, RolloutTask, check_call, quality_warning
from vtbdrake.rollout.testbeds import MAX_TESTBEDS, Runners, Testbeds
from vtbdrake.testbed import VirtualTestbed

Parameters = Mapping[str, Any]

_log = logging.getLogger(__name__)

# Longest wait for a thread whose rollout should stop, in s.
GRACE = 10.0


class WorkerError(RuntimeError):
    """An error of the workers, not of a rollout."""


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


class Executor(Closing):
    """Runs rollouts of a task. It may be used for several tasks and is closed at the end (it is a context manager).

    Testbeds and runners are kept from call to call, so that a call with a single point costs little more than its
    rollout. Tasks are compared by identity: pass the same object each time.

    Attributes:
        cancels: Whether `run` accepts a `Cutoff`.
        side_by_side: Number of rollouts that run side by side, each about as fast as one alone.
    """

    cancels: bool = True
    side_by_side: int = 1

    @abstractmethod
    def run(
        self, task: RolloutTask, points: Sequence[Parameters], *, start: Starts = None, cutoff: Cutoff | None = None
    ) -> Iterator[tuple[int, RolloutResult]]:
        """Run one rollout per point, and yield (index of the point, result) as they finish.

        A point is a mapping address -> value; ``scenario.<field>`` is a field of the task's scenario, for which
        another testbed is built, and kept. A rollout that fails is a result, also when no testbed can be built with
        its fields; an error in the quality function, a start that does not fit, or a field that does not exist or that
        the scenario refuses, is raised, and ends the others.

        Args:
            task: The data that all rollouts share.
            points: One point per rollout.
            start: Where the rollouts begin instead of the task's own s0: one start for all, or one for each point. No
                testbed is built for a start, and only the start is sent to the workers.
            cutoff: When to end rollouts early. Rollouts cancelled by its deadline are not yielded.

        Raises:
            ValueError: There is a ``cutoff``, and the executor cannot cancel rollouts (see ``cancels``).
            WorkerError: The task cannot be sent to the workers, they are lost or take no more work, or the executor
                has not finished another call.
        """

    def warm_up(self, task: RolloutTask, rollouts: int) -> None:
        """Build what ``rollouts`` rollouts of a task need at a time, so that the next ones need not wait for it.

        Args:
            task: The task of the rollouts.
            rollouts: Number of rollouts at a time.
        """
        if self.cancels:
            # They are cancelled at their first sample.
            list(self.run(task, [{}] * rollouts, cutoff=Cutoff(deadline=-inf)))

    def close(self) -> None:
        """Release threads, processes and testbeds."""
        return

    def __reduce__(self) -> NoReturn:
        raise TypeError(f"a {type(self).__name__} cannot be pickled or copied: send the task, and make one there")


class SerialExecutor(Executor):
    """One rollout after another, in this thread.

    Args:
        testbed: A testbed to use for tasks of its scenario; others are built.
        max_testbeds: Number of testbeds that are kept, for points with different scenario fields.
    """

    def __init__(self, testbed: VirtualTestbed | None = None, *, max_testbeds: int = MAX_TESTBEDS) -> None:
        self._runners = Runners(Testbeds(testbed, max_testbeds=max_testbeds))

    def run(
        self, task: RolloutTask, points: Sequence[Parameters], *, start: Starts = None, cutoff: Cutoff | None = None
    ) -> Iterator[tuple[int, RolloutResult]]:
        check_call(task, points)
        starts = start_of_each(start, len(points))
        for index, (point, point_start) in enumerate(zip(points, starts, strict=True)):
            try:
                result = self._runners.run(task, point, start=point_start, cutoff=cutoff)
            except CancelledError:
                return
            yield index, result

    def close(self) -> None:
        self._runners.clear()


@dataclass(frozen=True)
class _Job:
    """One rollout for a thread. Its state is its future's: pending, running, finished, or cancelled."""

    future: concurrent.futures.Future[RolloutResult]
    task: RolloutTask
    point: Parameters
    start: Start | None
    cutoff: Cutoff | None
    cancel: threading.Event


class ThreadExecutor(Executor):
    """Threads that share one Diagram, each with its own Context.

    The fastest executor if all systems are in C++: systems in Python make the threads wait for each other.

    Args:
        workers: Number of threads; by default the number of cores.
        testbed: A testbed to use for tasks of its scenario; others are built.
        max_testbeds: Number of testbeds that are kept, for points with different scenario fields.
    """

    def __init__(
        self, workers: int | None = None, *, testbed: VirtualTestbed | None = None, max_testbeds: int = MAX_TESTBEDS
    ) -> None:
        self._count = self.side_by_side = checked_workers(workers)
        self._runners = Runners(Testbeds(testbed, max_testbeds=max_testbeds))
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._threads: list[threading.Thread] = []
        # The threads hold no reference to the executor, so that one that was not closed can be freed.
        self._end = weakref.finalize(self, self._jobs.put, None)

    def run(
        self, task: RolloutTask, points: Sequence[Parameters], *, start: Starts = None, cutoff: Cutoff | None = None
    ) -> Iterator[tuple[int, RolloutResult]]:
        check_call(task, points)
        starts = start_of_each(start, len(points))
        if len(points) == 1:  # Without the cost of another thread.
            with suppress(CancelledError):
                yield 0, self._runners.run(task, points[0], start=starts[0], cutoff=cutoff)
            return
        while len(self._threads) < min(self._count, len(points)):
            name = f"rollout-{len(self._threads)}"
            thread = threading.Thread(target=_work, args=(self._jobs, self._runners), name=name, daemon=True)
            thread.start()
            self._threads.append(thread)
        # Ctrl-C may come between any two steps: what is to be waited for is asked of the jobs, never counted here.
        cancel = threading.Event()
        indices: dict[concurrent.futures.Future[RolloutResult], int] = {}
        landed: queue.SimpleQueue[concurrent.futures.Future[RolloutResult]] = queue.SimpleQueue()
        try:
            for index, point in enumerate(points):
                future: concurrent.futures.Future[RolloutResult] = concurrent.futures.Future()
                future.add_done_callback(landed.put)
                indices[future] = index
                self._jobs.put(_Job(future, task, point, starts[index], cutoff, cancel))
            for _ in points:
                future = landed.get()
                try:
                    result = future.result()
                except CancelledError:
                    continue
                yield indices[future], result
        finally:
            cancel.set()
            # A job that can be cancelled has not begun, and never will; the others end at their next sample.
            begun = [future for future in indices if not future.cancel()]
            if concurrent.futures.wait(begun, GRACE).not_done:
                _log.error("a rollout does not stop: its thread is left behind, and may keep a core busy for ever")

    def close(self) -> None:
        self._jobs.put(None)
        for thread in self._threads:
            thread.join(GRACE)
        self._threads.clear()
        self._runners.clear()
        self._end.detach()
        self._jobs = queue.SimpleQueue()
        self._end = weakref.finalize(self, self._jobs.put, None)


def _work(jobs: queue.SimpleQueue[_Job | None], runners: Runners) -> None:
    while (job := jobs.get()) is not None:
        if job.future.set_running_or_notify_cancel():
            try:
                result = runners.run(job.task, job.point, start=job.start, cutoff=job.cutoff, cancel=job.cancel)
            except BaseException as error:  # Raised again where the results are read.
                job.future.set_exception(error)
            else:
                job.future.set_result(result)
                del result
        # Keep nothing of the last job while waiting for the next one.
        del job
    jobs.put(None)  # For the other threads.
    release_renderers()


def checked_workers(workers: int | None) -> int:
    """Return the number of workers; the number of cores if ``workers`` is None.

    Raises:
        ValueError: There are none, or it is no number.
    """
    count = cores() if workers is None else as_whole("the number of workers", workers)
    if count < 1:
        raise ValueError(f"an executor needs at least one worker, not {workers}")
    return count


def run_rollouts(
    executor: Executor,
    task: RolloutTask,
    points: Sequence[Parameters],
    *,
    progress: bool = True,
    description: str = "rollouts",
) -> list[RolloutResult | None]:
    """Run the rollouts with a progress bar; return one result per point, in the order of ``points``.

    Ctrl-C ends the running rollouts and starts no more; a point without a result has None. The first failure of f that
    the task catches is logged.

    Args:
        executor: Runs the rollouts.
        task: The data that all rollouts share.
        points: One point per rollout, address -> value.
        progress: Whether to show a progress bar in a terminal or a notebook.
        description: The text before the progress bar.

    Raises:
        QualityError: f raises, is negative or NaN, and the task does not catch that.
    """
    from tqdm.auto import tqdm  # Here, because worker processes need none: it takes a tenth of their start.

    results: list[RolloutResult | None] = [None] * len(points)
    warned = False
    with tqdm(total=len(points), desc=description, unit="rollout", disable=not (progress and watched())) as bar:
        rollouts = executor.run(task, points)
        try:
            with Interruptible() as interruptible:
                for index, result in rollouts:
                    results[index] = result
                    warned = warned or _log_quality_warning(result.message)
                    bar.update()
                    interruptible.raise_interrupt()
        except KeyboardInterrupt:
            done = sum(result is not None for result in results)
            _log.warning("interrupted: %d of %d rollouts are finished and kept", done, len(points))
            rollouts.close()  # type: ignore[attr-defined]
            interrupt_taken()
        finally:
            rollouts.close()  # type: ignore[attr-defined]
    return results


def _log_quality_warning(message: str) -> bool:
    """Log that the quality function fails, if the message of a result says so; return whether it does."""
    warning = quality_warning(message)
    if warning:
        _log.warning("%s", warning)
    return bool(warning)


def watched() -> bool:
    """Return whether the output goes to a terminal or a notebook."""
    # Only the shell of a notebook has a kernel. Programs that run notebooks import ipykernel, too.
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return sys.stderr.isatty() or hasattr(shell, "kernel")
