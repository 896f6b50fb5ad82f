"""Courses: simulations in which variables are set while time runs, and that can be computed again, bit for bit."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import nan
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.rollout.quality import QualityError
from vtbdrake.rollout.runner import BY_HAND, RolloutRunner, SimulationError
from vtbdrake.rollout.task import RolloutResult, RolloutTask
from vtbdrake.state import Snapshot

if TYPE_CHECKING:
    from pydrake.systems.framework import Context

    from vtbdrake.testbed import Scenario, VirtualTestbed

LONGEST = 3600.0
"""How long a course without a problem may last, in seconds."""


class CourseError(ValueError):
    """A course cannot go on, or its data are no course."""


def task_without_problem(scenario: Scenario) -> RolloutTask:
    """Return the task of a course that no quality judges."""
    return RolloutTask(scenario, horizon=LONGEST, sample_period=LONGEST)


@dataclass(frozen=True, eq=False)
class Course:
    """A simulation that begins at a snapshot, and what was set in it while time ran.

    Attributes:
        start: The snapshot.
        step: Variables may be set at the multiples of this time from the start, in seconds.
        writes: What was set: the number of the instant, from 0 on, and values by address.
        steps: The number of steps after which somebody ended it; None: it ends as the rollouts of its task do.
    """

    start: Snapshot
    step: float
    writes: Sequence[tuple[int, Mapping[str, Any]]] = field(default_factory=tuple)
    steps: int | None = None

    def rollout(self, task: RolloutTask, *, testbed: VirtualTestbed | None = None) -> RolloutResult:
        """Compute the course again, and sample the quality of a task along it.

        Args:
            task: The task, whose own start does not count.
            testbed: A testbed of the task's scenario; None: a new one is built.

        Raises:
            ValueError: The snapshot is of another scenario, or a value cannot be set.
        """
        return self.driven(task, testbed=testbed).end()

    def driven(self, task: RolloutTask, *, testbed: VirtualTestbed | None = None) -> DrivenRollout:
        """Compute the course again as `rollout` does, and return the rollout where it ends.

        Args:
            task: The task of the rollout.
            testbed: A testbed of the task's scenario; None: a new one is built.
        """
        driven = DrivenRollout(task, self.start, step=self.step, testbed=testbed)
        writes = dict(self.writes)
        while driven.result is None and driven.steps != self.steps:
            driven.advance(writes.get(driven.steps, {}))
        driven.end()
        return driven

    def to_dict(self) -> dict[str, Any]:
        """Return the course as plain data, from which `from_dict` makes an equal one."""
        start = base64.b64encode(self.start.to_bytes()).decode()
        writes = [[n, {a: np.asarray(v).tolist() for a, v in values.items()}] for n, values in self.writes]
        return {"start": start, "step": self.step, "steps": self.steps, "writes": writes}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Course:
        """Return the course that `to_dict` has written.

        Raises:
            CourseError: The data are no course.
        """
        try:
            start = Snapshot.load(base64.b64decode(data["start"], validate=True))
            writes = tuple((int(n), dict(values)) for n, values in data["writes"])
            steps = None if data["steps"] is None else int(data["steps"])
            return cls(start, float(data["step"]), writes, steps)
        except (ValueError, TypeError, LookupError) as error:
            raise CourseError(f"this is no course: {error}") from error


class DrivenRollout:
    """A rollout that somebody drives: it advances step by step, and each step may set variables first.

    Args:
        task: The task, whose own start does not count.
        start: Where the rollout begins. As in every copy of a running robot, all switches are thrown to sim.
        step: The time between two instants at which variables may be set, in seconds.
        testbed: A testbed of the task's scenario; None: a new one is built.

    Attributes:
        context: The context of the rollout.
        steps: The number of steps so far.
        result: The result; None while the rollout goes on.

    Raises:
        ValueError: The snapshot is of another scenario.
    """

    def __init__(
        self, task: RolloutTask, start: Snapshot, *, step: float, testbed: VirtualTestbed | None = None
    ) -> None:
        # Motion and pruning are for candidates that are compared; f that fails is an outcome.
        task = RolloutTask(
            task.scenario,
            horizon=task.horizon,
            quality=task.quality,
            threshold=task.threshold,
            sample_period=task.sample_period,
            start=start,
            measures=task.measures,
            record=task.record,
            catch=True,
        )
        self._runner = RolloutRunner(task, testbed)
        self._start, self._step = start, step
        self._rollout = self._runner.drive(step)
        self._writes: list[tuple[int, Mapping[str, Any]]] = []
        self.steps = 0
        self.result: RolloutResult | None = None
        self._go(None)

    @property
    def context(self) -> Context:
        """Return the context of the rollout."""
        return self._runner.context

    @property
    def course(self) -> Course:
        """Return the course so far."""
        goes_on = self.result is None or self.result.message == BY_HAND
        return Course(self._start, self._step, tuple(self._writes), self.steps if goes_on else None)

    @property
    def value(self) -> float:
        """Return f of the present state, in the user's terms; NaN if the task has none, or it has no value."""
        measured: list[float] = []
        with suppress(SimulationError, QualityError):
            measured = self._runner.measured(self.steps * self._step)
        return measured[0] if measured and self._runner.task.quality is not None else nan

    def advance(self, values: Mapping[str, Any]) -> None:
        """Set variables, and simulate until the next instant at which they may be set, or the end.

        Raises:
            CourseError: The rollout has ended.
            ValueError: There is no such variable, or it does not take the value; nothing has been set.
        """
        if self.result is not None:
            raise CourseError(f"the driven rollout has ended: {self.result.message or self.result.end}")
        if values:
            self._runner.testbed.write(self.context, values)
            self._writes.append((self.steps, {address: np.array(value) for address, value in values.items()}))
        self.steps += 1
        self._go(False)

    def read(self, addresses: Sequence[str]) -> dict[str, float | np.ndarray]:
        """Return values of variables in the present state, by address.

        Raises:
            AddressError: There is no such variable.
        """
        return self._runner.testbed.variables().read(self.context, addresses)

    def end(self) -> RolloutResult:
        """End the rollout here, unless it has ended, and return its result."""
        if self.result is None:
            self._go(True)
        assert self.result is not None
        return self.result

    def _go(self, message: bool | None) -> None:
        try:
            self._rollout.send(message)
        except StopIteration as stop:
            self.result = stop.value
