"""The testbeds and runners that an executor keeps from rollout to rollout, also for other fields of the scenario."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.common.lru import LruDict
from vtbdrake.drake_workarounds.lost_interrupts import Interruptible
from vtbdrake.drake_workarounds.making import making
from vtbdrake.rollout.pruning import Cutoff
from vtbdrake.rollout.runner import RolloutRunner, values_key
from vtbdrake.rollout.start import Start
from vtbdrake.rollout.task import FAILED, RolloutResult, RolloutTask
from vtbdrake.testbed import Scenario, ScenarioError, VirtualTestbed

FIELD = "scenario."
# The number of testbeds that are kept besides the permanent one.
MAX_TESTBEDS = 4
# The number of runners that a thread keeps; an executor may run any number of tasks.
_MAX_RUNNERS = 16


class BuildError(Exception):
    """No testbed can be built with some values of its scenario's fields; the error is the outcome of the rollout."""


def split(point: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split a point into the scenario's fields, by their names, and the variables of s0, by address."""
    fields = {address.removeprefix(FIELD): value for address, value in point.items() if address.startswith(FIELD)}
    return fields, {address: value for address, value in point.items() if not address.startswith(FIELD)}


def failed(point: Mapping[str, Any], message: str) -> RolloutResult:
    """Return the result of a rollout that could not be run.

    Args:
        point: The point of the rollout, address -> value.
        message: Why it could not be run.
    """
    return RolloutResult(parameters=dict(point), end=FAILED, message=message, times=np.array([]), quality=np.array([]))


class Testbeds:
    """The testbeds last used, built once per distinct scenario and shared by threads.

    One testbed is built at a time: CasADi's expressions, which may be parts of a DPS, count their references
    without atomics, and its Python package gives up the interpreter lock.

    Args:
        permanent: A testbed that exists already and is never dropped.
        max_testbeds: The number of other testbeds that are kept; the least recently used one is dropped first.
    """

    def __init__(self, permanent: VirtualTestbed | None = None, *, max_testbeds: int = MAX_TESTBEDS) -> None:
        if not isinstance(permanent, VirtualTestbed | None):
            raise ValueError(f"rollouts run in a testbed, scenario.build(), not in {permanent!r}")
        if max_testbeds < 1:
            raise ValueError(f"at least one testbed must be kept, not {max_testbeds}")
        self.max_testbeds = max_testbeds
        self._permanent = permanent
        self._built: LruDict[Hashable, VirtualTestbed] = LruDict(max_testbeds)
        self._lock = threading.RLock()

    def get(self, scenario: Scenario) -> VirtualTestbed:
        """Return the testbed of ``scenario``; build it if it is not there, when other threads have built theirs."""
        key = _key(scenario)
        if self._permanent is not None and key == _key(self._permanent.scenario):
            return self._permanent
        if (testbed := self._used(key)) is not None:
            return testbed
        with making():
            if (testbed := self._used(key)) is not None:
                return testbed
            testbed = scenario.build()
            with self._lock:
                dropped = self._built.add(key, testbed)
            del dropped  # Here, so that it is taken apart while nothing is built, and without the lock.
            return testbed

    def _used(self, key: Hashable) -> VirtualTestbed | None:
        with self._lock:
            return self._built.use(key)

    def touch(self, testbed: VirtualTestbed) -> None:
        """Mark ``testbed`` as just used."""
        with self._lock:
            for key in [key for key, built in self._built.items() if built is testbed]:
                self._built.use(key)

    def __contains__(self, testbed: object) -> bool:
        with self._lock:
            return testbed is self._permanent or any(built is testbed for built in self._built.values())

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
        """Return this thread's runner of ``task``, with ``fields`` (name -> value) set in its scenario.

        Args:
            task: The task, which is known again by its identity.
            fields: Values of fields of the task's scenario, by their names; empty: the scenario as it is.

        Raises:
            ScenarioError: There is no such field, or the scenario refuses its value.
            BuildError: No testbed can be built with these fields for another reason.
            SnapshotError: The task starts from a snapshot of the scenario without these fields.
        """
        runners: LruDict[Hashable, tuple[RolloutTask, RolloutRunner]]
        runners = self._threads.__dict__.setdefault("runners", LruDict(_MAX_RUNNERS))
        # By identity: comparing tasks can take longer than running them.
        key = (id(task), values_key(fields))
        entry = runners.use(key)
        if entry is None:
            entry = (task, self._make(task, fields))
            for stale in [k for k, (_, runner) in runners.items() if runner.testbed not in self._testbeds]:
                del runners[stale]
            # Other threads may have dropped its testbed already: it is used all the same.
            runners.add(key, entry)
        self._testbeds.touch(entry[1].testbed)
        return entry[1]

    def _make(self, task: RolloutTask, fields: Mapping[str, Any]) -> RolloutRunner:
        if not fields:
            return RolloutRunner(task, self._testbeds.get(task.scenario))
        changed = replace(task, scenario=task.scenario.with_fields(fields))
        try:
            testbed = self._testbeds.get(changed.scenario)
        except ScenarioError:
            raise
        except FAILURES as error:
            values = ", ".join(f"{FIELD}{name} = {value!r}" for name, value in fields.items())
            raise BuildError(f"no testbed can be built with {values}: {error_text(error)}") from error
        return RolloutRunner(changed, testbed)

    def run(
        self,
        task: RolloutTask,
        point: Mapping[str, Any],
        *,
        start: Start | None = None,
        cutoff: Cutoff | None = None,
        cancel: threading.Event | None = None,
        announce: Callable[[], Any] | None = None,
    ) -> RolloutResult:
        """Run one rollout at ``point``, in this thread; see `RolloutRunner.run`.

        A testbed that cannot be built with the point's fields is a failed rollout; fields that the scenario refuses
        are an error.

        Args:
            task: The task of the rollout.
            point: Address, or scenario field with its prefix -> value.
            start: Where the rollout begins instead of the task's s0.
            cutoff: When to end the rollout early.
            cancel: An event that stops the rollout.
            announce: Called when the testbed has been built, before the rollout.
        """
        with Interruptible():
            fields, variables = split(point)
            try:
                runner = self.get(task, fields)
            except BuildError as error:
                return failed(point, str(error))
            if announce is not None:
                announce()
            result = runner.run(variables, start=start, cutoff=cutoff, cancel=cancel)
            return replace(result, parameters=dict(point)) if fields else result

    def clear(self) -> None:
        """Forget the runners of all threads, and the testbeds."""
        self._threads = threading.local()
        self._testbeds.clear()


def _key(scenario: Scenario | None) -> Hashable:
    return None if scenario is None else values_key(scenario.record())
