"""The ask-and-tell interface of all solvers of problem (18)."""

from __future__ import annotations

import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import isfinite, isnan
from queue import Empty, SimpleQueue
from typing import Any, Protocol

import numpy as np

from vtbdrake.common.argument_checks import counted
from vtbdrake.optimization.parameter import Choice, Dimension, Parameter, checked_points

# A point s^0: one value per parameter, in their order.
Point = tuple[Any, ...]

# Seeds are below this, as numpy's legacy generators require (cmaes, Optuna).
SEEDS = 2**32

# The largest number of points in a batch, which all are in memory.
MOST_IN_BATCH = 1_000_000


class SolverError(ValueError):
    """A solver is unknown, or cannot solve the problem."""


class BudgetTooSmallError(SolverError):
    """A design has more points than the budget has evaluations."""


class PointValues:
    """The predicates that an `Evaluation` and a `Trial` share."""

    values: tuple[float, ...]
    violations: tuple[float, ...]
    exact: bool

    @property
    def failed(self) -> bool:
        """Return whether the point has no value because a simulation failed."""
        # An infinite bound is no failure: it belongs to a dropped point, about which little is known.
        return not all(map(isfinite, self.values)) and (self.exact or any(map(isnan, self.values)))

    @property
    def feasible(self) -> bool:
        """Return whether the point has values, or bounds of them, and keeps all constraints as far as is known."""
        return not self.failed and all(violation <= 0.0 for violation in self.violations)

    @property
    def counts(self) -> bool:
        """Return whether the point can be the best: it is feasible, and its values are exact."""
        return self.exact and self.feasible


@dataclass(frozen=True)
class Evaluation(PointValues):
    """The evaluation of a point, from which a solver learns.

    Attributes:
        point: s^0.
        values: One number per objective; larger is better in every case (a cost is negated). NaN if a
            simulation failed.
        violations: One number per constraint, at most 0 where it holds; NaN if a simulation failed.
        gradient: Gradient of the first value, shape (n,), if the solver wants it.
        exact: False if racing dropped the point before all its conditions had run. ``values`` is then an upper bound
            (infinite if the point was dropped for a violated constraint and nothing bounds its value), ``violations`` a
            lower bound.
        effort: The rollouts that this evaluation took, divided by the number of conditions: 1 for a new point, less if
            racing dropped it, 0 if it was known before.
    """

    point: Point
    values: tuple[float, ...]
    violations: tuple[float, ...] = ()
    gradient: tuple[float, ...] | None = None
    exact: bool = True
    effort: float = 1.0

    @property
    def usable(self) -> bool:
        """Return whether the simulation gave numbers, feasible or not."""
        return not self.failed and not any(map(isnan, self.violations))

    @property
    def total_violation(self) -> float:
        """Return the sum of the violated constraints' violations."""
        return sum(max(violation, 0.0) for violation in self.violations)


# Deb's rule: a feasible point is better than an infeasible one; of two feasible points the one of larger value is
# better, of two infeasible ones the one of smaller total violation; a failed simulation is worse than both.
# Deb, K. (2000): An efficient constraint handling method for genetic algorithms. Comput. Methods Appl. Mech. Eng. 186.


def rank_key(evaluation: Evaluation) -> tuple[int, float]:
    """Return a sort key by Deb's rule, the best first; points that racing dropped follow the exact ones."""
    if not evaluation.usable:
        return 3, 0.0
    if not evaluation.feasible:
        return 2, evaluation.total_violation
    return (0 if evaluation.exact else 1), -evaluation.values[0]


def best_of(evaluations: Iterable[Evaluation | None]) -> Evaluation | None:
    """Return the best evaluation of one objective by Deb's rule; None if all failed or are None."""
    best = min((each for each in evaluations if each is not None), key=rank_key, default=None)
    return best if best is not None and best.usable else None


def costs(evaluations: Sequence[Evaluation]) -> list[float]:
    """Return costs in the order of Deb's rule, smaller is better; of feasible points, the negated value."""
    feasible = [-evaluation.values[0] for evaluation in evaluations if evaluation.feasible]
    floor = max(feasible, default=0.0)
    worst = floor + max((e.total_violation for e in evaluations if e.usable), default=0.0) + 1.0
    return [worst if not e.usable else -e.values[0] if e.feasible else floor + e.total_violation for e in evaluations]


@dataclass(frozen=True)
class Search:
    """The task of a solver: a search over the unit cube [0, 1]^n, one coordinate per parameter.

    Attributes:
        space: The n parameters.
        objectives: Number of values of an evaluation.
        constraints: Number of violations of an evaluation.
        seed: Seed of all random numbers, in [0, 2^32).
        budget: The number of evaluations that may be asked for; None: as many as the method needs.
        start: Where a local method starts; None: in the middle of the ranges.
        parallel: The number of points that are evaluated side by side: a batch has at least as many. None: the method
            chooses its batches.

    Raises:
        SolverError: A number is out of range, or the start lies outside the space.
    """

    space: tuple[Dimension, ...]
    objectives: int = 1
    constraints: int = 0
    seed: int = 0
    budget: int | None = None
    start: Point | None = None
    parallel: int | None = None

    def __post_init__(self) -> None:
        for name, lowest in (("objectives", 1), ("constraints", 0)):
            if getattr(self, name) < lowest:
                raise SolverError(f"the number of {name} is at least {lowest}, not {getattr(self, name)}")
        if not 0 <= self.seed < SEEDS:
            raise SolverError(f"a seed is a whole number in [0, 2^32), not {self.seed}")
        if self.budget is not None and self.budget < 1:
            raise SolverError(f"a budget is at least one evaluation, not {self.budget}")
        if self.parallel is not None and self.parallel < 1:
            raise SolverError(f"parallel is a number of points side by side, at least one, not {self.parallel}")
        if self.start is not None:
            if len(self.start) != self.size:
                raise SolverError(f"a start has one value per parameter, {self.size}, not {len(self.start)}")
            try:
                (start,) = checked_points(self.space, [self.start])
            except ValueError as error:
                raise SolverError(f"the start lies outside of the space: {error}") from error
            object.__setattr__(self, "start", start)

    @property
    def size(self) -> int:
        """Return the number of parameters, n."""
        return len(self.space)

    @property
    def is_wide(self) -> bool:
        """Return whether more than one point at a time is asked for."""
        return self.parallel is not None and self.parallel > 1

    def batch(self, usual: int, *, requested: int | None = None, least: int = 1) -> int:
        """Return the size of a batch: the requested one, or the usual one or as many as are evaluated side by side.

        Args:
            usual: The usual size of the method's batch.
            requested: The size that the user asks for; None: none.
            least: The smallest size that the method can work with.

        Raises:
            SolverError: The requested number is below ``least``, or above `MOST_IN_BATCH`.
        """
        if requested is not None and requested > MOST_IN_BATCH:
            raise SolverError(f"a batch has at most {MOST_IN_BATCH:,} points, not {requested:,}: take fewer")
        if requested is not None and requested < least:
            raise SolverError(f"a batch has at least {counted(least, 'point')}, not {requested}")
        return max(usual, self.parallel or 1) if requested is None else requested

    def point(self, u: Any) -> Point:
        """Return the point at ``u`` in the unit cube, shape (n,); coordinates outside are clipped."""
        # As Python's numbers, with which the parameters compute faster than with numpy's.
        return tuple(parameter.from_unit(x) for parameter, x in zip(self.space, np.asarray(u).tolist(), strict=True))

    def points(self, U: np.ndarray) -> list[Point]:
        """Return the points at ``U`` in the unit cube, shape (N, n)."""
        if not all(isinstance(p, Parameter) and p.is_continuous and not p.log for p in self.space):
            return [self.point(u) for u in U]
        lower, upper = np.array([p.ends for p in self.space if isinstance(p, Parameter)]).T
        return list(map(tuple, np.clip(lower + np.clip(U, 0.0, 1.0) * (upper - lower), lower, upper).tolist()))

    def unit(self, point: Point) -> np.ndarray:
        """Return a point in the coordinates of the unit cube, shape (n,)."""
        return np.array([parameter.to_unit(value) for parameter, value in zip(self.space, point, strict=True)])

    def start_unit(self) -> np.ndarray:
        """Return the start in the unit cube, shape (n,)."""
        return np.full(self.size, 0.5) if self.start is None else self.unit(self.start)

    def slope(self, point: Point) -> np.ndarray:
        """Return dx/du of continuous parameters at a point, shape (n,), in their units."""
        return np.array(
            [
                value * math.log(p.upper / p.lower) if p.log else p.upper - p.lower
                for p, value in zip(self.space, point, strict=True)
                if not isinstance(p, Choice)
            ]
        )

    def require(
        self,
        name: str,
        *,
        continuous: bool = False,
        ordered: bool = False,
        one_objective: bool = False,
        no_constraints: bool = False,
        no_start: bool = False,
        not_wide: bool = False,
    ) -> None:
        """Check that a method can perform this search.

        Args:
            name: The method's name, for the message.
            continuous: Whether the method needs continuous parameters.
            ordered: Whether it needs numbers, continuous or whole.
            one_objective: Whether it takes one objective only.
            no_constraints: Whether it takes no constraints.
            no_start: Whether it does not start at a point.
            not_wide: Whether it chooses each point by the last one, so that its batches cannot be widened.

        Raises:
            SolverError: The method cannot; the message names a solver that can.
        """
        for parameter in self.space:
            if isinstance(parameter, Choice) and (continuous or ordered):
                raise SolverError(
                    f"{name} varies numbers, but {parameter.address} is one of {parameter.range_text}; "
                    f"TPE or grid can do that"
                )
            if continuous and not parameter.is_continuous:
                raise SolverError(
                    f"{name} varies continuous parameters, but {parameter.address} is an integer; CMA-ES can do that"
                )
        if one_objective and self.objectives > 1:
            raise SolverError(f"{name} takes one objective, not {self.objectives}; NSGA-II can do that")
        if no_constraints and self.constraints:
            raise SolverError(f"{name} takes no constraints, and there are {self.constraints}; CMA-ES can do that")
        if not_wide and self.is_wide:
            raise SolverError(
                f"{name} chooses each point by the last one, and cannot evaluate {self.parallel} side by side; leave "
                "parallel out, or take CMA-ES"
            )
        if no_start and self.start is not None:
            raise SolverError(f"{name} does not start at a point; leave start out, or tell the solver of that point")


class Solver(ABC):
    """A method that asks for batches of points, and gets the evaluations of each batch before it asks for the next.

    The points depend only on the seed and on the evaluations so far, not on the number of workers or on time. So a
    study is the same in series and in parallel, and is resumed by telling a new solver the recorded evaluations.

    A solver asks until its evaluations have taken ``search.budget``. Each point is charged in full when it is asked
    for; the unused part (see `Evaluation.effort`) is refunded with the evaluation. Points given by hand are charged
    with their evaluation. A batch that exceeds the budget is cut; the rest follows if budget is refunded, and the
    method learns when the batch is complete.

    A subclass implements `_next` and `_learn`.

    Attributes:
        name: Name in the catalogue.
        search: The search to perform.
        wants_gradient: Whether the solver needs `Evaluation.gradient`.
        takes_start: Whether the solver starts at a point (`Search.start`).
        needs_parameters: Whether there must be a parameter to vary.
        is_prompt: Whether `ask` always returns at once, so that nobody must watch how long it takes.
        plans_for_budget: Whether another budget takes a new solver, because this one has planned for its own.
        success: Whether the solver ended by its own criterion (converged, or its design is complete); None before.
        message: How the solver ended.
    """

    wants_gradient: bool = False
    takes_start: bool = True
    needs_parameters: bool = True
    plans_for_budget: bool = False
    is_prompt: bool = False

    def __init__(self, search: Search, *, name: str) -> None:
        self.name = name
        self.search = search
        self.success: bool | None = None
        self.message = ""
        # The points asked for, until their evaluations are told.
        self._pending: list[Point] = []
        self._budget: float | None = search.budget
        self._used = 0.0
        # The remaining points of the method's present batch, and the evaluations received for it.
        self._rest: list[Point] = []
        self._evaluated: list[Evaluation] = []
        self._by_hand: list[Evaluation] = []

    @property
    def method(self) -> str:
        """Return the name of the method in use at the moment."""
        return self.name

    @abstractmethod
    def _next(self) -> list[Point]:
        """Return the next batch; an empty one after a call of `_end`."""

    @abstractmethod
    def _learn(self, evaluations: Sequence[Evaluation], by_hand: Sequence[Evaluation]) -> None:
        """Learn from a complete batch (empty before the first), and from points given by hand."""

    def _end(self, success: bool, message: str) -> None:
        self.success = success
        self.message = message
        self.close()

    def _spent(self) -> None:
        self._end(False, f"the budget of {self.search.budget} evaluations is spent")

    @property
    def _left(self) -> int | None:
        """Return the number of evaluations that may be asked for; None: any number."""
        # Efforts are fractions, whose sum is not exact.
        return None if self._budget is None else max(0, int(self._budget + 1e-6))

    def ask(self) -> list[Point]:
        """Return the points to be evaluated next; an empty list when the solver has ended.

        Raises:
            SolverError: The evaluations of the points asked for before have not been told yet.
            Exception: Any error of the method.
        """
        if self._pending:
            raise SolverError(f"{self.name} was not told yet of the {len(self._pending)} points that it asked for")
        if self.success is None and self._left == 0:
            self._spent()
        if self.success is not None:
            return []
        if not self._rest:
            self._rest = list(self._next())
        points, self._rest = self._rest[: self._left], self._rest[self._left :] if self._left is not None else []
        if self._budget is not None:
            self._budget -= len(points)
        self._pending = points
        return list(points)

    def tell(self, evaluations: Sequence[Evaluation]) -> None:
        """Tell the evaluations of the last batch, in its order, and after them any of points given by hand.

        Points given by hand may also be told alone, before any `ask`. Bayesian optimization and Optuna's samplers learn
        from them, and so does `auto` when it begins a new method; local methods, designs and CMA-ES ignore them.

        Raises:
            SolverError: The batch is incomplete or in another order, or has another number of values or violations than
                the problem.
        """
        count = len(self._pending)
        if [evaluation.point for evaluation in evaluations[:count]] != self._pending:
            raise SolverError(
                f"{self.name} asked for {count} points and is to be told of those first, in their order; "
                f"it was told of {len(evaluations)}"
            )
        sizes = self.search.objectives, self.search.constraints
        for evaluation in evaluations:
            if (len(evaluation.values), len(evaluation.violations)) != sizes:
                raise SolverError(
                    f"an evaluation of this problem has {sizes[0]} values and {sizes[1]} violations, not "
                    f"{len(evaluation.values)} and {len(evaluation.violations)}"
                )
        self._pending = []
        used = sum(evaluation.effort for evaluation in evaluations)
        self._used += used
        if self._budget is not None:
            self._budget += count - used
        self._evaluated += evaluations[:count]
        self._by_hand += evaluations[count:]
        if not self._rest:
            evaluated, by_hand, self._evaluated, self._by_hand = self._evaluated, self._by_hand, [], []
            self._learn(evaluated, by_hand)

    def change_budget(self, left: float) -> None:
        """Let the solver ask for another number of evaluations from now on, between two batches."""
        endless = left == math.inf
        self.search = replace(self.search, budget=None if endless else max(1, math.ceil(self._used + left)))
        self._budget = None if endless else left

    def close(self) -> None:
        """Release the resources of the solver; called after the last `ask`."""
        return


class Asker(Protocol):
    """Anything that asks for points, as a solver does."""

    @property
    def name(self) -> str: ...

    def ask(self) -> list[Point]: ...


def ask_within(solver: Asker, seconds: float) -> list[Point] | None:
    """Return the points that a solver asks for; None if it has not answered after ``seconds``: it must be closed then.

    Args:
        solver: The solver, or what has its method ``ask``.
        seconds: The longest wall time to wait, in seconds; infinity: ask in this thread, without a limit.

    Raises:
        Exception: Any error of the method.
    """
    if seconds == math.inf:
        return solver.ask()
    answer: SimpleQueue[list[Point] | BaseException] = SimpleQueue()

    def ask() -> None:
        try:
            answer.put(solver.ask())
        except BaseException as error:
            answer.put(error)

    # A daemon thread does not keep the program from ending if the solver never answers.
    threading.Thread(target=ask, name=f"solver {solver.name}", daemon=True).start()
    try:
        points = answer.get(timeout=max(0.0, seconds))
    except Empty:
        return None
    if isinstance(points, BaseException):
        raise points
    return points
