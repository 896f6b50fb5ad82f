"""The search of a study at a moment: ranges, frozen values, forbidden regions, solver and budget."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import ceil, inf
from typing import Any

import numpy as np

from vtbdrake.optimization.identity import dimensions
from vtbdrake.optimization.parameter import Choice, Dimension
from vtbdrake.optimization.solvers import Evaluation, Point, Solver, SolverError, make_solver
from vtbdrake.optimization.study.forbidden_regions import Box, contains, leave_something, searched_box

# The weight of the sum in an achievement scalarizing function: it makes every maximum Pareto optimal.
_AUGMENTATION = 1e-3


@dataclass(frozen=True)
class StudySearch:
    """The search of a study: as it was begun, or as its interventions have left it.

    Attributes:
        ranges: The parameters with the ranges that are searched, also those that are frozen.
        widest: The parameters with the widest ranges that the study has had; every point lies in them.
        frozen: The values of the parameters that are not varied at present, by address.
        forbidden: The forbidden regions by the number of their intervention: address -> [lower, upper], or the options
            of a choice; an end that is None is open.
        solver, options: The solver's name and options.
        budget: The number of rollouts that the study has in the end; None: no limit.
        budget_from: The number of the intervention that set the budget; None: `Study.run` set it.
        aspiration: The values that are aimed at, one per quality, a cost as a cost; None: the whole Pareto front.
        paused: Whether the study is paused.
        signs: By quality, 1, or -1 for a cost.
        limits: By parameter, the bounds that its range must not exceed; None for a choice.
        conditions: The number of conditions.
        constraints: The number of constraints.
        seed: The seed of the solver.
        parallel: The number of rollouts side by side that the solver asks points for, or None.
        solver_changed: Whether an intervention has changed the solver.
    """

    ranges: tuple[Dimension, ...]
    widest: tuple[Dimension, ...]
    solver: str
    options: Mapping[str, Any]
    budget: int | None
    signs: tuple[float, ...]
    limits: tuple[tuple[float, float] | None, ...] = field(repr=False)
    conditions: int = field(repr=False)
    constraints: int = field(repr=False)
    seed: int = field(repr=False)
    parallel: int | None = field(repr=False)
    frozen: Mapping[str, Any] = field(default_factory=dict)
    forbidden: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)
    budget_from: int | None = None
    aspiration: tuple[float, ...] | None = None
    paused: bool = False
    solver_changed: bool = field(default=False, repr=False)

    @classmethod
    def of(cls, meta: Mapping[str, Any]) -> StudySearch:
        """Return the search with which a study begins, from the description in its file."""
        problem = meta["problem"]
        ranges = dimensions(problem)
        return cls(
            ranges=ranges,
            widest=ranges,
            solver=meta["solver"],
            options=meta["options"],
            budget=meta.get("budget"),
            signs=tuple(-1.0 if quality["minimize"] else 1.0 for quality in problem["qualities"]),
            limits=tuple(None if limits is None else (limits[0], limits[1]) for limits in meta["limits"]),
            conditions=len(problem["conditions"]),
            constraints=len(problem["constraints"]),
            seed=meta["seed"],
            parallel=meta.get("parallel"),
        )

    def same_points(self, other: StudySearch) -> bool:
        """Return whether another search differs in nothing but the budget and whether it is paused."""
        return replace(self, budget=None, budget_from=None, paused=False, widest=()) == replace(
            other, budget=None, budget_from=None, paused=False, widest=()
        )

    # -- its space

    @property
    def free(self) -> tuple[Dimension, ...]:
        """Return the parameters that are varied at present, with their ranges."""
        return tuple(parameter for parameter in self.ranges if parameter.address not in self.frozen)

    def complete(self, point: Point) -> Point:
        """Return a point of the free parameters, completed by the frozen ones."""
        values = iter(point)
        return tuple(self.frozen[p.address] if p.address in self.frozen else next(values) for p in self.ranges)

    def reduce(self, point: Point) -> Point:
        """Return the values of the free parameters at a point."""
        return tuple(x for p, x in zip(self.ranges, point, strict=True) if p.address not in self.frozen)

    def allows(self, point: Point) -> bool:
        """Return whether a point lies in no forbidden region."""
        if not self.forbidden:
            return True
        parameters = self.by_address
        values = dict(zip(parameters, point, strict=True))
        return not any(contains(region, parameters, values) for region in self.forbidden.values())

    def contains(self, point: Point) -> bool:
        """Return whether a point could be asked for: it lies in the ranges, has the frozen values, and is allowed."""
        for parameter, value in zip(self.ranges, point, strict=True):
            if parameter.address in self.frozen:
                if value != self.frozen[parameter.address]:
                    return False
            elif isinstance(parameter, Choice):
                if value not in parameter.options:
                    return False
            elif not parameter.lower <= value <= parameter.upper:
                return False
        return self.allows(point)

    @property
    def by_address(self) -> dict[str, Dimension]:
        """Return the parameters with the ranges that are searched, by address."""
        return {parameter.address: parameter for parameter in self.ranges}

    @property
    def box(self) -> Box:
        """Return the space that is searched, forbidden regions included, as a box."""
        return searched_box(self.ranges, self.frozen)

    def parameter(self, address: Any) -> tuple[int, Dimension]:
        """Return the place and the present range of a parameter.

        Raises:
            ValueError: There is no such parameter.
        """
        for index, parameter in enumerate(self.ranges):
            if parameter.address == address:
                return index, parameter
        varied = ", ".join(parameter.address for parameter in self.ranges)
        raise ValueError(f"the study varies no parameter {address!r}; it varies {varied}")

    # -- its solver

    def check(self) -> None:
        """Check that a solver can perform the search.

        Raises:
            ValueError: No parameter is varied, no point is left, or the solver cannot search what is left.
        """
        if not self.free and self.ranges:
            raise ValueError("no parameter is left to vary: unfreeze one first")
        if not leave_something(list(self.forbidden.values()), self.by_address, self.box):
            raise ValueError("the forbidden regions cover all that is searched: no point is left")
        solver = self.make_solver()
        solver.close()
        if solver.wants_gradient and self.solver_changed:
            raise SolverError(
                f"{solver.name} takes derivatives of the testbed, with which a study must be begun: give "
                "gradient='central'"
            )

    def make_solver(
        self, *, evaluations: float = inf, start: Point | None = None, racing: bool = False, begun: bool = False
    ) -> Solver:
        """Return a solver for the free parameters.

        Args:
            evaluations: The number of evaluations that it may ask for.
            start: A point of all parameters from which a local method starts.
            racing: Whether points are raced.
            begun: Whether the study has begun, so that the budget is the rest of one. A design of a fixed size that
                exceeds the rest is then cut, and not refused.

        Raises:
            SolverError: The solver cannot perform the search.
        """
        # The rollouts of a batch are its points under all conditions; a race begins with two of each.
        width = min(self.conditions, 2) if racing else self.conditions

        def make(budget: int | None) -> Solver:
            return make_solver(
                self.solver,
                self.free,
                objectives=1 if self.aspiration else len(self.signs),
                constraints=self.constraints,
                seed=self.seed,
                budget=budget,
                parallel=None if self.parallel is None else ceil(self.parallel / width),
                start=None if start is None else self.reduce(start),
                **self.options,
            )

        budget = None if evaluations == inf else max(1, int(evaluations + 1e-6))
        try:
            return make(budget)
        except SolverError:
            if not begun or budget is None:
                raise
            return make(None)

    def achievement(self, evaluations: Iterable[Evaluation]) -> Callable[[Evaluation], Evaluation]:
        """Return the function that replaces the values of an evaluation by one, which is largest at the aspiration.

        It is Wierzbicki's achievement scalarizing function, min_i w_i (f_i - a_i) + rho sum_i w_i (f_i - a_i), where
        f_i are the values (larger is better), a_i those that are aimed at, and 1 / w_i is the range of f_i among
        ``evaluations``.

        Wierzbicki, A. P. (1980): The use of reference objectives in multiobjective optimization. Lecture Notes in
        Economics and Mathematical Systems 177.
        """
        if self.aspiration is None:
            return lambda evaluation: evaluation
        values = np.array([e.values for e in evaluations if e.counts]).reshape(-1, len(self.signs))
        ranges = np.ptp(values, axis=0) if len(values) else np.zeros(len(self.signs))
        weights = 1.0 / np.where(ranges > 0.0, ranges, 1.0)
        target = np.array(self.signs) * np.array(self.aspiration)

        def scalar(evaluation: Evaluation) -> Evaluation:
            distances = weights * (np.array(evaluation.values) - target)
            return replace(
                evaluation, values=(float(distances.min() + _AUGMENTATION * distances.sum()),), gradient=None
            )

        return scalar
