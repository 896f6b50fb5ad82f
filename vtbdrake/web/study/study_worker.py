"""The warm worker of a study's page: rollouts of points that are pointed at or tried, not behind the study's own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass, replace
from typing import TypeVar

from vtbdrake.common.failures import FAILURES, one_line
from vtbdrake.common.lru import LruDict
from vtbdrake.optimization import Problem
from vtbdrake.optimization.evaluator import Evaluator
from vtbdrake.optimization.parameter import Dimension
from vtbdrake.optimization.problem import recording_motion
from vtbdrake.optimization.records import DrivenTrial, RolloutKey
from vtbdrake.optimization.solvers.solver import Evaluation, Point
from vtbdrake.rollout import RolloutResult, RolloutTask
from vtbdrake.rollout.worker_processes import ProcessExecutor
from vtbdrake.testbed import Scenario
from vtbdrake.web.serving.requests import wait_for_end

_Kind = TypeVar("_Kind")

# Rollouts that are kept: some tens of megabytes.
_KEPT = 200
_ATTEMPT = "attempt"
# What waits for the worker, first what comes first: a point that is tried, and rollouts by their roles.
_ORDER = (_ATTEMPT, "tried", "best", "pointed")


class PointError(ValueError):
    """A point cannot be simulated here."""


@dataclass(frozen=True)
class PointRollout:
    """A rollout of a point under one condition, or a driven one, with the states of its plant.

    Attributes:
        point, condition: The point and the number of the condition; of a driven rollout, where it began, and 0.
        scenario: The scenario, with the fields that the point sets.
        result: The rollout; ``record`` has ``plant.state``, if the testbed has a plant.
    """

    point: Point
    condition: int
    scenario: Scenario
    result: RolloutResult


@dataclass(frozen=True)
class Tried:
    """A point that was tried: its value under all conditions, as in the study.

    Attributes:
        evaluation: As a study has it, but with values in the user's terms: a cost as a cost.
        messages: Why rollouts have failed.
    """

    evaluation: Evaluation
    messages: tuple[str, ...]


class PointSimulator:
    """Simulates points of a problem in a process of its own, which keeps its testbed.

    Args:
        problem: The problem.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        task = replace(problem.task, catch=True)
        self._task: RolloutTask = recording_motion(task, problem.testbed) if problem.testbed.plant is not None else task
        self._executor = ProcessExecutor(1)
        self._executor.start_workers(1)
        self._rollouts: LruDict[RolloutKey, PointRollout] = LruDict(_KEPT)
        self._drives: LruDict[int, PointRollout] = LruDict(_KEPT)
        # The newest of each kind that waits: what it is of, what is to be done, and its result.
        self._waiting: dict[str, tuple[object, Callable[[], object], Future[object]]] = {}
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="vtbdrake points", daemon=True)
        self._thread.start()

    def widen(self, parameters: Sequence[Dimension]) -> None:
        """Take points of these ranges."""
        if tuple(parameters) != self.problem.parameters:
            self.problem = self.problem.with_ranges(parameters)

    def results(self, point: Point) -> list[RolloutResult] | None:
        """Return the rollouts of a point under all conditions, without their records; None if some are not there."""
        with self._changed:
            rollouts = [self._rollouts.use((point, k)) for k in range(len(self.problem.conditions))]
        return None if None in rollouts else [replace(r.result, record={}) for r in rollouts if r is not None]

    def close(self) -> None:
        """End the worker."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        # Closing ends a rollout under way, too; another condition's may begin just then.
        wait_for_end(self._thread, "the simulation of a point", end=self._executor.close)
        self._executor.close()

    def rollout(self, point: Point, *, condition: int, role: str = "pointed") -> PointRollout:
        """Return the rollout of a point under a condition, computed if it is not kept.

        Args:
            point: The point.
            condition: The number of the condition.
            role: The role in which it is shown: ``tried``, ``best`` or ``pointed``.

        Raises:
            PointError: The pointer has moved on, so that another point is simulated in its role instead; or there is no
                such condition, or the worker is lost or has ended.
        """
        with self._changed:
            if (rollout := self._rollouts.use((point, condition))) is not None:
                return rollout
        return self._result(role, (point, condition), lambda: self._simulate(point, condition), PointRollout)

    def drive(self, trial: DrivenTrial, *, role: str = "pointed") -> PointRollout:
        """Return the rollout of a driven trial, whose course is computed again if it is not kept.

        Args:
            trial: The trial.
            role: The role in which it is shown, as of `rollout`.

        Raises:
            PointError: The pointer has moved on, or the course cannot be computed: its scenario has changed.
        """
        with self._changed:
            if (rollout := self._drives.use(trial.number)) is not None:
                return rollout
        return self._result(role, trial.number, lambda: self._repeat(trial), PointRollout)

    def attempt(self, point: Point) -> Tried:
        """Evaluate a point under all conditions.

        Raises:
            PointError: Another point is tried instead, or the worker is lost or has ended.
        """
        return self._result(_ATTEMPT, point, lambda: self._evaluate(point), Tried)

    def _result(self, name: str, key: object, action: Callable[[], object], kind: type[_Kind]) -> _Kind:
        """Return the result of an action in the thread of the worker, which replaces one of that name that waits.

        Pages that ask for the same, which the key tells, share its result.
        """
        future: Future[object] = Future()
        with self._changed:
            if self._closed:
                raise PointError("the page has ended")
            waiting_key, _, waiting = self._waiting.get(name, (None, None, None))
            if waiting is not None and waiting_key == key:
                future = waiting
            elif waiting is not None:
                waiting.cancel()
            self._waiting[name] = key, action, future
            self._changed.notify_all()
        try:
            result = future.result()
        except CancelledError:
            raise PointError("the page has ended" if self._closed else "another point is simulated instead") from None
        assert isinstance(result, kind)
        return result

    # -- in the thread of the worker

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._waiting)
                if self._closed:
                    for _, _, future in self._waiting.values():
                        future.cancel()
                    return
                _, action, future = self._waiting.pop(next(name for name in _ORDER if name in self._waiting))
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(action())
            except FAILURES as error:
                future.set_exception(PointError(one_line(error)))

    def _simulate(self, point: Point, condition: int) -> PointRollout:
        values = self.problem.values(point, condition=condition)
        ((_, result),) = self._executor.run(self._task, [values])
        scenario = self.problem.placed(self._task, values)[0].scenario
        rollout = PointRollout(point, condition, scenario, result)
        with self._changed:
            self._rollouts.add((point, condition), rollout)
        return rollout

    def _repeat(self, trial: DrivenTrial) -> PointRollout:
        result = trial.course.rollout(self._task, testbed=self.problem.testbed)
        rollout = PointRollout(tuple(trial.parameters.values()), 0, self.problem.scenario, result)
        with self._changed:
            self._drives.add(trial.number, rollout)
        return rollout

    def _evaluate(self, point: Point) -> Tried:
        results: dict[RolloutKey, RolloutResult] = {}
        for condition in range(len(self.problem.conditions)):
            with self._changed:
                rollout = self._rollouts.use((point, condition))
            results[point, condition] = (rollout or self._simulate(point, condition)).result
        evaluator = Evaluator(self.problem, results, lambda _: None)
        evaluation = evaluator.evaluation(point)
        messages = tuple(dict.fromkeys(result.message for result in results.values() if result.failed))
        return Tried(replace(evaluation, values=evaluator.in_user_terms(evaluation)), messages)
