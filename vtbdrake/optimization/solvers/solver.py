"""What every solver of problem (18) is: something that asks for points and is told how good they are."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from math import isinf, isnan
from typing import Any

# A point s^0: one value per parameter, in their order.
Point = tuple[Any, ...]


class SolverError(ValueError):
    """A solver that is unknown, or cannot solve the problem."""


class Judged:
    """What can be said of anything with values and violations; see `Evaluation`."""

    values: tuple[float, ...]
    violations: tuple[float, ...]
    exact: bool

    @property
    def failed(self) -> bool:
        """Whether it has no value: a bound that is infinite is one, of a point of which little is known yet."""
        return any(isnan(value) or (self.exact and isinf(value)) for value in self.values)

    @property
    def feasible(self) -> bool:
        """Whether it has a value, or a bound of it, and keeps all constraints, as far as is known."""
        return not self.failed and all(violation <= 0.0 for violation in self.violations)

    @property
    def counts(self) -> bool:
        """Whether it can be the best: it is feasible, and its values are no mere bounds."""
        return self.exact and self.feasible


@dataclass(frozen=True)
class Evaluation(Judged):
    """How good a point is.

    Attributes:
        point: s^0.
        values: one number per objective, larger is better whatever the user's direction (a cost appears negated); NaN
            if the point has none, since a simulation failed.
        violations: one number per constraint, at most 0 where it holds; NaN if the simulation failed.
        gradient: of the first value, shape (n,), where the solver asked for it.
        exact: False if racing dropped the point before it had met all conditions. ``values`` then bounds it from above
            (by infinity if nothing bounds it, and it was dropped since it breaks a constraint), ``violations`` from
            below.
        effort: the rollouts that this evaluation took, divided by the number of conditions: 1 if the point met all of
            them for the first time, less if racing dropped it, 0 if it was known already.
    """

    point: Point
    values: tuple[float, ...]
    violations: tuple[float, ...] = ()
    gradient: tuple[float, ...] | None = None
    exact: bool = True
    effort: float = 1.0


class Solver(ABC):
    """Asks for batches of points, and is told of each batch before it asks for the next.

    What it asks for depends on its seed and on what it was told, and on nothing else: not on the number of workers, and
    not on time. So a study is the same in series and in parallel, and can be resumed by telling it again.

    A budget counts evaluations under all conditions. One that took less (`Evaluation.effort`) leaves budget for others,
    and points given by hand take from it: a solver that plans its budget goes by the efforts that it was told.

    In each step a study first judges the points that were given by hand, if there are any, and tells them by
    themselves; then it asks, judges and tells.

    Attributes:
        name: as the catalogue spells it.
        wants_gradient: whether `Evaluation.gradient` is to be filled.
        reproducible: False for the few algorithms whose library draws its random numbers from the clock: those ask for
            other points each time, whatever the seed.
    """

    name: str
    wants_gradient: bool = False
    reproducible: bool = True

    @property
    def method(self) -> str:
        """What it works with at the moment; a solver that changes its method names the present one."""
        return self.name

    @abstractmethod
    def ask(self) -> list[Point]:
        """The points to be judged next; empty when it is finished.

        Raises:
            SolverError: it was not told yet of the points that it asked for before.
            Exception: what the method itself raised, as it is.
        """

    @abstractmethod
    def tell(self, evaluations: Sequence[Evaluation]) -> None:
        """The evaluations of the last batch, in its order, and after them any that were given by hand.

        Points given by hand may also be told by themselves, before any `ask`. TPE and its kin learn from them, and so
        does `auto` when it begins anew; a local method, a design and CMA-ES go on as they would have without.

        Raises:
            SolverError: the batch is not complete or not in its order, or there are not as many values or violations as
                the problem has.
        """

    @property
    def success(self) -> bool | None:
        """Whether it ended by its own criterion (converged, or its design is complete); None while it works."""
        return None

    @property
    def message(self) -> str:
        """How it ended, in its own words."""
        return ""

    def close(self) -> None:
        """Gives back what it holds; it is not asked again."""
        return
