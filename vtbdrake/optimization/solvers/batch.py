"""The bookkeeping that all solvers share: batches, the budget, and how it ended."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

from vtbdrake.optimization.solvers.search import Search
from vtbdrake.optimization.solvers.solver import Evaluation, Point, Solver, SolverError


class BatchSolver(Solver):
    """A solver that says what comes next (`_next`) and learns from it (`_learn`).

    It asks until evaluations have taken ``search.budget``: a point is charged in full when it is asked for; what it did
    not take (`Evaluation.effort`) comes back when it is told, and what points given by hand took is charged then. Of a
    batch that exceeds the budget, as many points are asked for as it allows, so that no evaluation is wasted; the rest
    follows if they leave budget for it, and the method learns when the batch is complete.
    """

    def __init__(self, search: Search, *, name: str) -> None:
        self.name = name
        self.search = search
        self._asked: list[Point] = []
        self._budget: float | None = search.budget
        # Of the method's present batch: what is to be asked for yet, and what was told.
        self._rest: list[Point] = []
        self._told: list[Evaluation] = []
        self._given: list[Evaluation] = []
        self._success: bool | None = None
        self._message = ""

    @abstractmethod
    def _next(self) -> list[Point]:
        """The next batch; empty after a call of `_end`."""

    @abstractmethod
    def _learn(self, asked: Sequence[Evaluation], given: Sequence[Evaluation]) -> None:
        """The evaluations of a complete batch (none: before the first), and those given by hand."""

    def _end(self, success: bool, message: str) -> None:
        """It asks for no more points."""
        self._success = success
        self._message = message
        self.close()

    def _spent(self) -> None:
        """The budget is spent, and it did not end before."""
        self._end(False, f"the budget of {self.search.budget} evaluations is spent")

    @property
    def _left(self) -> int | None:
        """How many evaluations may be asked for; None: any number."""
        # Efforts are fractions, whose sum is not exact.
        return None if self._budget is None else max(0, int(self._budget + 1e-6))

    def ask(self) -> list[Point]:
        if self._asked:
            raise SolverError(f"{self.name} was not told yet of the {len(self._asked)} points that it asked for")
        if self._success is None and self._left == 0:
            self._spent()
        if self._success is not None:
            return []
        if not self._rest:
            self._rest = list(self._next())
        points, self._rest = self._rest[: self._left], self._rest[self._left :] if self._left is not None else []
        if self._budget is not None:
            self._budget -= len(points)
        self._asked = points
        return list(points)

    def tell(self, evaluations: Sequence[Evaluation]) -> None:
        count = len(self._asked)
        if [evaluation.point for evaluation in evaluations[:count]] != self._asked:
            raise SolverError(
                f"{self.name} asked for {count} points and is to be told of those first, in their order; "
                f"it was told of {len(evaluations)}"
            )
        for evaluation in evaluations:
            self._check(evaluation)
        self._asked = []
        if self._budget is not None:
            self._budget += count - sum(evaluation.effort for evaluation in evaluations)
        self._told += evaluations[:count]
        self._given += evaluations[count:]
        if not self._rest:
            told, given, self._told, self._given = self._told, self._given, [], []
            self._learn(told, given)

    def _check(self, evaluation: Evaluation) -> None:
        for name, told, expected in (
            ("values", evaluation.values, self.search.objectives),
            ("violations", evaluation.violations, self.search.constraints),
        ):
            if len(told) != expected:
                raise SolverError(f"an evaluation of this problem has {expected} {name}, not {len(told)}")

    @property
    def success(self) -> bool | None:
        return self._success

    @property
    def message(self) -> str:
        return self._message
