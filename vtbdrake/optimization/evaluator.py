"""The evaluation of points: the rollouts that they take, their values over all conditions, their gradients."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from math import ceil, inf, nan

import numpy as np

from vtbdrake.optimization.problem import Problem
from vtbdrake.optimization.records import Outcome, RolloutKey
from vtbdrake.optimization.risk import aggregate
from vtbdrake.optimization.solvers.solver import Evaluation, Point, SolverError
from vtbdrake.rollout import RolloutResult
from vtbdrake.rollout.derivative import DerivativeRunner
from vtbdrake.rollout.pruning import PRUNED
from vtbdrake.rollout.task import FAILED
from vtbdrake.rollout.testbeds import split

# Racing goes through the conditions in rounds of at least this many rollouts, enough for several workers. It does not
# depend on their number: a study is the same with any.
ROUND = 8

# The step of a quality by which the slope of the risk is taken.
_STEP = 1e-7


class Evaluator:
    """An evaluator of batches of points, by rollouts that are known or are run.

    Args:
        problem: The problem to evaluate.
        outcomes: The outcomes so far; ``run`` adds to them.
        run: Function that runs the rollouts of the given keys.
        racing: Whether to drop a point as soon as it can no longer be better than the best one, whatever the results
            under its other conditions. The winner is never dropped: the risk does not fall when a quality rises, and a
            quality is at most `Quality.upper` (a cost at least 0). Without ``upper``, the mean of a quality has no
            bound, for example, and no point is dropped for its value.
        budget: Number of rollouts that the points may take together; no more points run side by side than can finish
            within it.
        round_size: Number of rollouts that racing runs side by side at least, as long as there are as many.

    Raises:
        ValueError: Racing, but several qualities.
    """

    def __init__(
        self,
        problem: Problem,
        outcomes: Mapping[RolloutKey, Outcome | RolloutResult],
        run: Callable[[Sequence[RolloutKey]], None],
        *,
        racing: bool = False,
        budget: float = inf,
        round_size: int = ROUND,
    ) -> None:
        if racing and len(problem.objectives) > 1:
            raise ValueError("racing compares one quality, but the problem has several: leave racing out")
        self._problem = problem
        self._outcomes = outcomes
        self._run = run
        self._racing = racing and len(problem.conditions) > 1
        self._budget = budget
        self._round = round_size
        self._conditions = range(len(problem.conditions))
        self._signs = [quality.sign for quality in problem.objectives]
        self._minimize = [quality.minimize for quality in problem.objectives]
        self._bounds = [quality.bound(problem.task.horizon) for quality in problem.objectives]
        self.best: Evaluation | None = None  # the best evaluation so far; None if there are several qualities
        self._allows: Callable[[Point], bool] = lambda _: True
        # The rollouts that the evaluations so far have needed, whether they were known or run.
        self.needed: set[RolloutKey] = set()
        # The number of rollouts that each point has needed since its last evaluation.
        self._untold: Counter[Point] = Counter()

    def restrict(
        self, allows: Callable[[Point], bool], evaluations: Sequence[Evaluation], *, budget: int | None
    ) -> None:
        """Let only points that ``allows`` accepts be the best, of those in ``evaluations`` and of new ones.

        Args:
            allows: Predicate of a point.
            evaluations: The evaluations so far; the best one that is allowed is found again.
            budget: Number of rollouts that the points may take together, those so far included; None: no limit.
        """
        self._allows, self.best, self._budget = allows, None, inf if budget is None else budget
        for evaluation in evaluations:
            self._remember(evaluation)

    def evaluate(self, points: Sequence[Point]) -> list[Evaluation]:
        """Return one evaluation per point, in their order."""
        evaluations: dict[Point, Evaluation] = {}
        waiting = list(dict.fromkeys(points))
        while waiting:
            count = len(waiting)
            if self._racing:
                left = (self._budget - len(self.needed)) / len(self._conditions)
                count = max(1, int(min(left, count)))
            evaluations |= self._evaluate_together(waiting[:count])
            waiting = waiting[count:]
        return [_with_effort(evaluations[p], self._untold.pop(p, 0) / len(self._conditions)) for p in points]

    def _evaluate_together(self, points: Sequence[Point]) -> dict[Point, Evaluation]:
        if self._racing:
            evaluations = self._race(points)
        else:
            self._complete([(point, condition) for point in points for condition in self._conditions])
            evaluations = {point: self.evaluation(point) for point in points}
        for evaluation in evaluations.values():
            self._remember(evaluation)
        return evaluations

    def _complete(self, keys: Sequence[RolloutKey]) -> None:
        new = dict.fromkeys(key for key in keys if key not in self.needed)
        self.needed.update(new)
        self._untold.update(point for point, _ in new)
        missing = [key for key in keys if key not in self._outcomes]
        if missing:
            self._run(missing)

    def _race(self, points: Sequence[Point]) -> dict[Point, Evaluation]:
        """Evaluate points in rounds, and drop those that have lost.

        Only the conditions of the rounds so far count, although an interrupted study may know more.
        """
        if self.best is None and len(points) > 1:
            self._find_incumbent(points)
        order = self._order()
        evaluations: dict[Point, Evaluation] = {}
        alive = list(points)
        done = 0
        while alive and done < len(order):
            share = ceil(self._round / len(alive))
            self._complete([(point, condition) for point in alive for condition in order[done : done + share]])
            done += share
            evaluations |= {point: self.evaluation(point, order[:done]) for point in alive}
            alive = [point for point in alive if not self._lost(evaluations[point])]
        return evaluations

    def _find_incumbent(self, points: Sequence[Point]) -> None:
        """Determine the first point to beat: run the best point of the first condition under all others."""
        first = list(self._conditions)[:1]
        self._complete([(point, condition) for point in points for condition in first])
        leads = [point for point in points if self.evaluation(point, first).feasible]
        if leads:
            leader = max(leads, key=lambda point: self._outcomes[point, first[0]].value * self._signs[0])
            self._complete([(leader, condition) for condition in self._conditions])
            self._remember(self.evaluation(leader))

    def _order(self) -> list[int]:
        """Return the conditions, the worst ones of the best point first: they tell points apart best."""
        if self.best is None:
            return list(self._conditions)
        h = [self._outcomes[self.best.point, condition].value * self._signs[0] for condition in self._conditions]
        return sorted(self._conditions, key=lambda condition: h[condition])

    def _lost(self, evaluation: Evaluation) -> bool:
        """Return whether a point, given an upper bound of its value, cannot become the best."""
        if evaluation.failed:
            return True
        if self.best is None or evaluation.point == self.best.point:
            return False
        return not evaluation.feasible or evaluation.values[0] <= self.best.values[0]

    def evaluation(self, point: Point, conditions: Collection[int] | None = None) -> Evaluation:
        """Return the evaluation of a point by its known outcomes.

        Args:
            point: The point s^0.
            conditions: Numbers of the conditions that count; None: all. For the others, and for conditions that have
                not run, the best possible outcome is assumed.
        """
        counted = self._conditions if conditions is None else set(conditions)
        outcomes = [self._outcomes.get((point, c)) if c in counted else None for c in self._conditions]
        ends = [outcome.end for outcome in outcomes if outcome is not None]
        exact = len(ends) == len(outcomes) and PRUNED not in ends
        constraints = len(self._problem.constraints)
        if FAILED in ends:
            # After one failed simulation the other conditions change nothing.
            return Evaluation(point, (nan,) * len(self._signs), (nan,) * constraints, exact=exact)
        values, violations = aggregate(
            outcomes,
            risk=self._problem.risk,
            minimize=self._minimize,
            constraints=constraints,
            bounds=self._bounds,
        )
        return Evaluation(point, values, violations, exact=exact)

    def in_user_terms(self, evaluation: Evaluation) -> tuple[float, ...]:
        """Return the values in the user's terms: a cost as a cost."""
        # Adding 0 makes 0 of -0.
        return tuple(float(sign * value) + 0.0 for sign, value in zip(self._signs, evaluation.values, strict=True))

    def _remember(self, evaluation: Evaluation) -> None:
        if len(self._signs) > 1 or (self.best is not None and not evaluation.values[0] > self.best.values[0]):
            return
        if evaluation.counts and self._allows(evaluation.point):
            self.best = evaluation


def _with_effort(evaluation: Evaluation, effort: float) -> Evaluation:
    return evaluation if evaluation.effort == effort else replace(evaluation, effort=effort)


class Gradients:
    """Derivatives of a problem's first quality, over all conditions, with respect to its parameters.

    A gradient takes one simulation with AutoDiffXd per condition, for any number of parameters.

    Raises:
        SolverError: A parameter is not continuous, or is a field of the scenario, which needs another diagram.
        DerivativeError: The testbed does not convert to AutoDiffXd, or its integrator controls its error.
    """

    def __init__(self, problem: Problem) -> None:
        for parameter in problem.parameters:
            if parameter.is_field or not parameter.is_continuous:
                raise SolverError(f"there is no derivative by {parameter.address}: use gradient='central'")
        self._problem = problem
        self._addresses = [parameter.address for parameter in problem.parameters]
        placed = [problem.placed(problem.task, condition) for condition in problem.conditions]
        # Converting a testbed takes longer than simulating it: most conditions share one.
        distinct = {id(testbed): (task, testbed) for task, testbed in placed}
        runners = {key: DerivativeRunner(*pair) for key, pair in distinct.items()}
        self._runners = [runners[id(testbed)] for _, testbed in placed]

    def at(self, point: Point) -> tuple[float, ...]:
        """Return the gradient of the value that a solver maximizes, shape (n,)."""
        problem = self._problem
        sign = problem.objectives[0].sign
        values, slopes = [], []
        for condition, runner in enumerate(self._runners):
            parameters = split(problem.assigned(point, condition=condition))[1]
            value, slope = runner.run(parameters, self._addresses)
            values.append(sign * value)
            slopes.append(sign * slope)
        h = np.array(values)
        base = problem.risk(h)
        weights = [(problem.risk(h + _STEP * unit) - base) / _STEP for unit in np.eye(h.size)]
        return tuple((np.array(weights) @ np.array(slopes)).tolist())
