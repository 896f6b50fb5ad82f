"""The solver of a study, begun anew whenever an intervention changes its search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil, inf, nan
from typing import Any

from vtbdrake.optimization.solvers import Evaluation, Point
from vtbdrake.optimization.solvers.designs import Design
from vtbdrake.optimization.solvers.solver import rank_key
from vtbdrake.optimization.study.study_search import StudySearch


class StudySolver:
    """The solver of a study, begun anew whenever an intervention changes its search.

    It asks for points of all parameters, none of them in a forbidden region: the method is told that a point there has
    failed, at no cost. A new method starts at the best point so far, with the rest of the budget, and is told the
    evaluations so far that lie in its space. A change of the budget alone lets the method go on.

    Args:
        search: The search with which the study begins.
        racing: Whether points are raced.

    Attributes:
        circles: Whether the method has asked for all points of its last batch before.
    """

    # Numbers of forbidden points in a row that end a solver, and a design, whose points cost nothing.
    patience, patience_of_designs = 2000, 1_000_000

    def __init__(self, search: StudySearch, *, racing: bool) -> None:
        self.search = search
        self._racing = racing
        self._spent = 0.0
        self._evaluations: dict[Point, Evaluation] = {}
        self._proposed: list[Point] = []
        # The points that were known when the method began, and those that it has asked for.
        self._earlier: frozenset[Point] = frozenset()
        self._repeated: set[Point] = set()
        self._scalar = search.achievement(())
        self._solver = search.make_solver(evaluations=self._left, racing=racing)
        self._message = ""
        self.circles = False

    @property
    def _left(self) -> float:
        budget = self.search.budget
        return inf if budget is None else ceil(budget / self.search.conditions) - self._spent

    @property
    def name(self) -> str:
        """Return the solver's name in the catalogue."""
        return self._solver.name

    @property
    def method(self) -> str:
        """Return the name of the method in use at the moment."""
        return self._solver.method

    @property
    def success(self) -> bool | None:
        """Return whether the solver ended by its own criterion; None before the end."""
        return False if self._message else self._solver.success

    @property
    def message(self) -> str:
        """Return the end of the solver, in words."""
        return self._message or self._solver.message

    @property
    def wants_gradient(self) -> bool:
        """Return whether the solver needs `Evaluation.gradient`."""
        return self._solver.wants_gradient

    @property
    def evaluations(self) -> list[Evaluation]:
        """Return the exact evaluations so far."""
        return list(self._evaluations.values())

    def change(self, search: StudySearch) -> None:
        """Go on with another search."""
        before, self.search = self.search, search
        if search.same_points(before):
            if search.budget == before.budget:
                return
            if not self._solver.plans_for_budget:
                self._solver.change_budget(self._left)
                return
        self._solver.close()
        self._scalar = search.achievement(self._evaluations.values())
        inside = [e for point, e in self._evaluations.items() if search.contains(point)]
        scalar = [self._for_solver(evaluation, effort=0.0) for evaluation in inside]
        usable = [(rank_key(e), k) for k, e in enumerate(scalar) if e.usable]
        fresh = search.make_solver(evaluations=self._left, racing=self._racing, begun=True)
        # With several qualities there is no best point to start at.
        if usable and fresh.takes_start and fresh.search.objectives == 1:
            start = inside[min(usable)[1]].point
            fresh = search.make_solver(evaluations=self._left, start=start, racing=self._racing, begun=True)
        self._solver = fresh
        self._earlier, self._repeated = frozenset(self._evaluations), set()
        if scalar:
            self._solver.tell(scalar)

    def ask(self) -> list[Point]:
        """Return the points to be evaluated next; an empty list when the solver has ended."""
        patience = self.patience_of_designs if isinstance(self._solver, Design) else self.patience
        forbidden = 0
        while forbidden < patience:
            self._proposed = [self.search.complete(point) for point in self._solver.ask()]
            points = [point for point in self._proposed if self.search.allows(point)]
            if points or not self._proposed:
                self.circles = bool(points) and self._repeated.issuperset(points)
                self._repeated.update(points)
                return points
            forbidden += len(self._proposed)
            self._answer([])
        self._message = f"{forbidden} points in a row lay in forbidden regions"
        self._solver.close()
        return []

    def repeats(self, evaluation: Evaluation) -> bool:
        """Return whether the point was evaluated before the present method began."""
        return evaluation.point in self._earlier

    def tell(self, evaluations: Sequence[Evaluation]) -> None:
        """Tell the evaluations of the points asked for, in their order."""
        self._remember(evaluations)
        self._answer(evaluations)

    def tell_by_hand(self, evaluations: Sequence[Evaluation]) -> None:
        """Tell the evaluations of points that were not asked for."""
        self._remember(evaluations)
        inside = [evaluation for evaluation in evaluations if self.search.contains(evaluation.point)]
        if inside:
            self._solver.tell([self._for_solver(evaluation) for evaluation in inside])
        if len(inside) < len(evaluations):
            self._solver.change_budget(self._left)

    def close(self) -> None:
        """Release the resources of the solver."""
        self._solver.close()

    def _remember(self, evaluations: Sequence[Evaluation]) -> None:
        self._spent += sum(evaluation.effort for evaluation in evaluations)
        self._evaluations.update({e.point: e for e in evaluations if e.exact})

    def _answer(self, evaluations: Sequence[Evaluation]) -> None:
        allowed = iter(evaluations)
        nothing = (nan,) * len(self.search.signs), (nan,) * self.search.constraints
        answers = [
            next(allowed) if self.search.allows(point) else Evaluation(point, *nothing, effort=0.0)
            for point in self._proposed
        ]
        self._proposed = []
        self._solver.tell([self._for_solver(evaluation) for evaluation in answers])

    def _for_solver(self, evaluation: Evaluation, **changes: Any) -> Evaluation:
        """Return an evaluation as the solver sees it: with the free parameters, and one value if it aims at a point."""
        gradient = evaluation.gradient
        if gradient is not None:
            gradient = self.search.reduce(gradient)
        point = self.search.reduce(evaluation.point)
        return self._scalar(replace(evaluation, point=point, gradient=gradient, **changes))
