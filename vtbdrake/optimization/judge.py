"""Judges points of a problem: which rollouts they take, under which conditions, and what these say together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from math import ceil, inf, nan

import numpy as np

from vtbdrake.optimization.outcome import Outcome, Row, aggregate
from vtbdrake.optimization.problem import Problem
from vtbdrake.optimization.solvers.solver import Evaluation, Point
from vtbdrake.rollout.task import FAILED

Outcomes = Mapping[Row, Outcome]

# Racing goes through the conditions in rounds of at least so many rollouts, so that several workers have work. It
# does not depend on their number: a study is the same with any.
_ROUND = 8


class Judge:
    """Judges batches of points by rollouts that are known, or are run.

    Args:
        problem: what is asked.
        known: the outcomes known so far; ``run`` adds to them.
        run: runs the rollouts of some rows.
        racing: drop a point as soon as it can no longer be better than the best one known, whatever the conditions
            that it has not seen would say. It never drops the winner: the risk does not fall when a quality rises,
            and the best that a quality can be is `Quality.upper` (of a cost, 0). A quality without ``upper`` can be
            anything: under the mean, say, no point is dropped for its value then.
        budget: how many rollouts the points may take together; only as many points run side by side as can be judged
            to their end.

    Attributes:
        best: the best evaluation so far; None where there are several qualities.
    """

    def __init__(
        self,
        problem: Problem,
        known: Outcomes,
        run: Callable[[Sequence[Row]], None],
        *,
        racing: bool = False,
        budget: float = inf,
    ) -> None:
        if racing and len(problem.objectives) > 1:
            raise ValueError(
                "racing is about one quality, but the problem has several: no point is behind in all of them"
            )
        self._problem = problem
        self._known = known
        self._run = run
        self._racing = racing and len(problem.conditions) > 1
        self._budget = budget
        self._conditions = range(len(problem.conditions))
        self._signs = np.array([-1.0 if quality.minimize else 1.0 for quality in problem.objectives])
        self.best: Evaluation | None = None
        # Not what is known, of which a study that is resumed has more.
        self._needed: set[Row] = set()
        # How many rows each point has needed since it was last told.
        self._news: Counter[Point] = Counter()

    def judge(self, points: Sequence[Point]) -> list[Evaluation]:
        """Return one evaluation per point, in their order."""
        evaluations: dict[Point, Evaluation] = {}
        waiting = list(dict.fromkeys(points))
        while waiting:
            count = self._affordable(len(waiting))
            evaluations |= self._judge_together(waiting[:count])
            waiting = waiting[count:]
        return [replace(evaluations[point], effort=self._effort(point)) for point in points]

    def _effort(self, point: Point) -> float:
        """Return the `Evaluation.effort` of a point that is going to be told."""
        return self._news.pop(point, 0) / len(self._conditions)

    def _affordable(self, count: int) -> int:
        """Return how many of ``count`` points are judged together."""
        left = (self._budget - len(self._needed)) / len(self._conditions)
        return max(1, int(min(left, count))) if self._racing else count

    def _judge_together(self, points: Sequence[Point]) -> dict[Point, Evaluation]:
        if self._racing:
            evaluations = self._race(points)
        else:
            self._complete([(point, condition) for point in points for condition in self._conditions])
            evaluations = {point: self.evaluation(point) for point in points}
        for evaluation in evaluations.values():
            self._remember(evaluation)
        return evaluations

    def _complete(self, rows: Sequence[Row]) -> None:
        new = dict.fromkeys(row for row in rows if row not in self._needed)
        self._needed.update(new)
        self._news.update(point for point, _ in new)
        missing = [row for row in rows if row not in self._known]
        if missing:
            self._run(missing)

    def _race(self, points: Sequence[Point]) -> dict[Point, Evaluation]:
        """Judge points in rounds, and drop those that have lost.

        Only the conditions of the rounds so far count: an interrupted study may know more.
        """
        if self.best is None and len(points) > 1:
            self._find_incumbent(points)
        order = self._order()
        evaluations: dict[Point, Evaluation] = {}
        alive = list(points)
        done = 0
        while alive and done < len(order):
            share = ceil(_ROUND / len(alive))
            self._complete([(point, condition) for point in alive for condition in order[done : done + share]])
            done += share
            evaluations |= {point: self.evaluation(point, order[:done]) for point in alive}
            alive = [point for point in alive if not self._lost(evaluations[point])]
        return evaluations

    def _find_incumbent(self, points: Sequence[Point]) -> None:
        """Run the point that does best in the first condition under the others too: the rest is held against it."""
        first = list(self._conditions)[:1]
        self._complete([(point, condition) for point in points for condition in first])
        leads = [point for point in points if self.evaluation(point, first).feasible]
        if leads:
            leader = max(leads, key=lambda point: self._known[point, first[0]].value * self._signs[0])
            self._complete([(leader, condition) for condition in self._conditions])
            self._remember(self.evaluation(leader))

    def _order(self) -> list[int]:
        """Return the conditions, those first in which the best point fares worst: they tell most."""
        if self.best is None:
            return list(self._conditions)
        h = [self._known[self.best.point, condition].value * self._signs[0] for condition in self._conditions]
        return sorted(self._conditions, key=lambda condition: h[condition])

    def _lost(self, evaluation: Evaluation) -> bool:
        """Return whether a point, judged by a bound from above, cannot become the best."""
        if evaluation.failed:
            return True
        if self.best is None or evaluation.point == self.best.point:
            return False
        return not evaluation.feasible or evaluation.values[0] <= self.best.values[0]

    def evaluation(self, point: Point, conditions: Collection[int] | None = None) -> Evaluation:
        """Return what the known outcomes of a point say together.

        Args:
            point: s^0.
            conditions: which of them count; None: all. The others, and those not known, count as the best possible.
        """
        counted = self._conditions if conditions is None else conditions
        outcomes = [self._known.get((point, c)) if c in counted else None for c in self._conditions]
        seen = [outcome for outcome in outcomes if outcome is not None]
        exact = len(seen) == len(outcomes)
        constraints = len(self._problem.constraints)
        if any(outcome.end == FAILED for outcome in seen):
            # One failed simulation leaves nothing to be said, and nothing to be gained by the others.
            return Evaluation(point, (nan,) * self._signs.size, (nan,) * constraints, exact=exact)
        values, violations = aggregate(
            outcomes,
            risk=self._problem.risk,
            minimize=[quality.minimize for quality in self._problem.objectives],
            constraints=constraints,
            bounds=[quality.bound(self._problem.task.horizon) for quality in self._problem.objectives],
        )
        return Evaluation(point, values, violations, exact=exact)

    def in_the_users_terms(self, evaluation: Evaluation) -> tuple[float, ...]:
        """Return the values in the user's terms: a cost as a cost."""
        # Adding 0 makes 0 of -0.
        return tuple(float(sign * value) + 0.0 for sign, value in zip(self._signs, evaluation.values, strict=True))

    def _remember(self, evaluation: Evaluation) -> None:
        if len(self._signs) > 1 or not evaluation.counts:
            return
        if self.best is None or evaluation.values[0] > self.best.values[0]:
            self.best = evaluation
