"""Testbeds and runners that are kept: one testbed per choice of scenario fields, one runner per thread on it.

A point of a rollout is a mapping address -> value. An address ``scenario.<field>`` is a field of the scenario, which
takes another testbed; all others are variables of s0.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import Future
from dataclasses import replace
from typing import Any

import numpy as np

from vtbdrake.rollout.result import FAILED, RolloutResult
from vtbdrake.rollout.runner import RolloutRunner
from vtbdrake.rollout.task import RolloutTask
from vtbdrake.testbed import Scenario, ScenarioError, VirtualTestbed
from vtbdrake.testbed.interrupt import Interruptible

FIELD = "scenario."
# How many testbeds are kept, beside one that is given.
KEPT = 4
# How many runners a thread keeps, on these testbeds; an executor may see any number of tasks.
_RUNNERS = 16


class BuildError(Exception):
    """A testbed cannot be built with these values of its scenario's fields; it becomes the outcome of the rollout."""


def split(point: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The scenario's fields of a point, by their names, and the variables of s0, by address."""
    fields = {address.removeprefix(FIELD): value for address, value in point.items() if address.startswith(FIELD)}
    return fields, {address: value for address, value in point.items() if not address.startswith(FIELD)}


def failed(point: Mapping[str, Any], message: str) -> RolloutResult:
    """The result of a rollout that could not be run."""
    return RolloutResult(parameters=dict(point), end=FAILED, message=message, times=np.array([]), quality=np.array([]))


class Testbeds:
    """The testbeds last used, built once per distinct scenario and shared by threads.

    Args:
        known: a testbed that is there already, and stays.
        kept: how many others are kept; the one that was not used for longest goes first.
    """

    def __init__(self, known: VirtualTestbed | None = None, *, kept: int = KEPT) -> None:
        if kept < 1:
            raise ValueError(f"at least one testbed must be kept, not {kept}")
        self.kept = kept
        self._known = known if known is not None and known.scenario is not None else None
        self._built: OrderedDict[Hashable, Future[VirtualTestbed]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, scenario: Scenario) -> VirtualTestbed:
        """The testbed of ``scenario``. A thread that asks for one that another thread builds waits for it."""
        key = _key(scenario.record())
        if self._known is not None and self._known.scenario is not None and key == _key(self._known.scenario.record()):
            return self._known
        with self._lock:
            mine = key not in self._built
            future = self._built.setdefault(key, Future())
            self._built.move_to_end(key)
            if len(self._built) > self.kept:
                self._built.popitem(last=False)
        if mine:
            try:
                future.set_result(scenario.build())
            except BaseException as error:
                with self._lock:
                    self._built.pop(key, None)
                future.set_exception(error)
        return future.result()

    def touch(self, testbed: VirtualTestbed) -> None:
        """Says that ``testbed`` is used again."""
        with self._lock:
            for key in [key for key, future in self._built.items() if _gave(future, testbed)]:
                self._built.move_to_end(key)

    def __contains__(self, testbed: object) -> bool:
        with self._lock:
            return testbed is self._known or any(_gave(future, testbed) for future in self._built.values())

    def __len__(self) -> int:
        return len(self._built)

    def clear(self) -> None:
        with self._lock:
            self._built.clear()


class Runners:
    """The runners last used by each thread: one for every task and every choice of scenario fields."""

    def __init__(self, testbeds: Testbeds) -> None:
        self._testbeds = testbeds
        self._threads = threading.local()

    def get(self, task: RolloutTask, fields: Mapping[str, Any]) -> RolloutRunner:
        """This thread's runner of ``task``, with ``fields`` (name -> value) set in its scenario.

        Raises:
            ScenarioError: there is no such field, or the scenario refuses its value.
            BuildError: no testbed can be built with these fields for another reason.
            SnapshotError: the task starts from a snapshot, which is of the scenario as it was.
        """
        mine: OrderedDict[Hashable, tuple[RolloutTask, RolloutRunner]]
        mine = self._threads.__dict__.setdefault("runners", OrderedDict())
        # A task is its own key: to compare what it holds would take longer than to run it.
        key = (id(task), _key(fields))
        if key not in mine:
            mine[key] = (task, self._make(task, fields))
            for old in [k for k, (_, runner) in mine.items() if runner.testbed not in self._testbeds]:
                del mine[old]
            if len(mine) > _RUNNERS:
                mine.popitem(last=False)
        mine.move_to_end(key)
        runner = mine[key][1]
        self._testbeds.touch(runner.testbed)
        return runner

    def _make(self, task: RolloutTask, fields: Mapping[str, Any]) -> RolloutRunner:
        if not fields:
            return RolloutRunner(task, self._testbeds.get(task.scenario))
        changed = replace(task, scenario=task.scenario.with_fields(fields))
        try:
            testbed = self._testbeds.get(changed.scenario)
        except ScenarioError:
            raise
        except (Exception, SystemExit) as error:  # A failed assertion inside Drake arrives as SystemExit.
            chosen = ", ".join(f"{FIELD}{name} = {value!r}" for name, value in fields.items())
            text = " ".join(str(error).split())
            raise BuildError(f"no testbed can be built with {chosen}: {type(error).__name__}: {text}") from error
        return RolloutRunner(changed, testbed)

    def run(
        self,
        task: RolloutTask,
        point: Mapping[str, Any],
        *,
        cancel: threading.Event | None = None,
        begin: Callable[[], Any] | None = None,
    ) -> RolloutResult:
        """One rollout at ``point``, in this thread; see `RolloutRunner.run`.

        A testbed that cannot be built with the point's fields is a failed rollout; fields that the scenario refuses
        are an error.

        Args:
            begin: called when the testbed is there, before the rollout.
        """
        with Interruptible():
            fields, variables = split(point)
            try:
                runner = self.get(task, fields)
            except BuildError as error:
                return failed(point, str(error))
            if begin is not None:
                begin()
            result = runner.run(variables, cancel=cancel)
            return replace(result, parameters=dict(point)) if fields else result

    def clear(self) -> None:
        """Forgets the runners of all threads, and the testbeds."""
        self._threads = threading.local()
        self._testbeds.clear()


def _gave(future: Future[VirtualTestbed], testbed: object) -> bool:
    return future.done() and not future.exception() and future.result() is testbed


def _key(values: Mapping[str, Any]) -> Hashable:
    # By their representation: 1, 1.0 and True are equal, and so are 0.0 and -0.0, but not to a testbed.
    return frozenset((name, repr(value)) for name, value in values.items())
