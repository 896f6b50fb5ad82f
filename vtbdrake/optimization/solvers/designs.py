"""Designs: points that are fixed before the first is evaluated."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from math import prod

import numpy as np

from vtbdrake.common.argument_checks import as_whole
from vtbdrake.optimization.parameter import Choice, Dimension
from vtbdrake.optimization.solvers.solver import BudgetTooSmallError, Evaluation, Point, Search, Solver, SolverError

# A power of two, so that a Sobol sequence is balanced batch by batch; enough to keep a machine busy.
BATCH = 64
# A batch ends when its last rollout does, and workers wait for that; with this number of rollouts for each, they hardly
# do.
ROUNDS = 16
# The largest number of values of one parameter in a grid.
MOST_VALUES = 1_000_000


class Design(Solver):
    """A fixed sequence of points, asked for in batches; any parameters, objectives and constraints.

    Args:
        search: What is searched.
        name: Name in the catalogue.
        as_budgeted: Whether the design goes on until the budget is spent; otherwise it ends with its points.
    """

    takes_start = False

    def __init__(self, search: Search, *, name: str, as_budgeted: bool = False) -> None:
        super().__init__(search, name=name)
        search.require(name, no_start=True)
        self._as_budgeted = as_budgeted
        if not as_budgeted:
            self._budget = None
        self._points = self._generate()

    def _generate(self) -> Iterator[Point]:
        """Return all points."""
        raise NotImplementedError

    def _next(self) -> list[Point]:
        batch = BATCH if self.search.parallel is None else max(BATCH, ROUNDS * self.search.parallel)
        points = list(itertools.islice(self._points, batch if self._left is None else min(batch, self._left)))
        if not points:
            self._spent()
        return points

    def change_budget(self, left: float) -> None:
        if self._as_budgeted:
            super().change_budget(left)

    def _spent(self) -> None:
        self._end(True, "the design is complete")

    def _learn(self, evaluations: Sequence[Evaluation], by_hand: Sequence[Evaluation]) -> None:
        return


class Grid(Design):
    """All combinations of equally spaced values, both ends included; of integers and choices, all values.

    Without parameters there is one combination, the scenario as it is, under all conditions.

    Args:
        search: What is searched.
        name: Name in the catalogue.
        points: How many values a continuous parameter has: one number for all, one per parameter, or by address. By
            default as many as the budget allows, and 11 without one. By address, it thins out integers too.

    Raises:
        SolverError: The grid is larger than the budget, or ``points`` does not fit the parameters.
    """

    needs_parameters = False

    def __init__(
        self, search: Search, *, name: str, points: int | Sequence[int] | Mapping[str, int] | None = None
    ) -> None:
        self._axes = _axes(search, points)
        count = prod(len(axis) for axis in self._axes)
        if search.budget is not None and count > search.budget:
            raise BudgetTooSmallError(
                f"the grid has {count} points, and the budget is {search.budget} evaluations; give fewer points"
            )
        super().__init__(search, name=name)

    def _generate(self) -> Iterator[Point]:
        return itertools.product(*self._axes)


class Listed(Design):
    """Given points, in their order.

    Args:
        points: The points, in their order.
    """

    def __init__(self, search: Search, *, name: str, points: Sequence[Point]) -> None:
        self._listed = points
        super().__init__(search, name=name)

    def _generate(self) -> Iterator[Point]:
        return iter(self._listed)


class Sobol(Design):
    """A Sobol sequence, scrambled by the seed: quasi-random points, more even than random ones.

    Its first points do not depend on the number of points. Numbers of points that are a power of two are balanced.

    Args:
        search: What is searched.
        name: Name in the catalogue.
        points: How many; by default until the budget is spent, or without one the first power of two >= 64 n.

    Owen, A. B. (1998): Scrambling Sobol' and Niederreiter-Xing points. Journal of Complexity 14.
    """

    def __init__(self, search: Search, *, name: str, points: int | None = None) -> None:
        as_budgeted = points is None and search.budget is not None
        self._count = None if as_budgeted else _count(search, points)
        self.plans_for_budget = points is None and not as_budgeted
        super().__init__(search, name=name, as_budgeted=as_budgeted)

    def _generate(self) -> Iterator[Point]:
        for u in itertools.islice(sobol_units(self.search), self._count):
            yield self.search.point(u)


class LatinHypercube(Design):
    """One point in each of N equal slices of every parameter's range, combined at random.

    Args:
        search: What is searched.
        name: Name in the catalogue.
        points: N; by default what the budget allows if no point is dropped, or without one the first power of two
            >= 64 n.

    McKay, M. D., Beckman, R. J. and Conover, W. J. (1979), Technometrics 21.
    """

    def __init__(self, search: Search, *, name: str, points: int | None = None) -> None:
        self._count = _count(search, points)
        self.plans_for_budget = points is None
        super().__init__(search, name=name, as_budgeted=points is None)

    def _generate(self) -> Iterator[Point]:
        from scipy.stats import qmc

        # Points given by hand may have taken from the budget before the first.
        count = self._count if self._left is None else self._left
        for u in qmc.LatinHypercube(self.search.size, rng=self.search.seed).random(count):
            yield self.search.point(u)


class RandomSearch(Design):
    """Independent uniform points: the baseline of every other solver.

    Args:
        search: What is searched.
        name: Name in the catalogue.
        points: How many; by default until the budget is spent, or without one no end.
    """

    def __init__(self, search: Search, *, name: str, points: int | None = None) -> None:
        self._count = None if points is None else _count(search, points)
        super().__init__(search, name=name, as_budgeted=points is None)

    def _generate(self) -> Iterator[Point]:
        generator = np.random.default_rng(self.search.seed)
        for _ in itertools.count() if self._count is None else range(self._count):
            yield self.search.point(generator.random(self.search.size))


def sobol_units(search: Search) -> Iterator[np.ndarray]:
    """Yield the Sobol sequence in the unit cube, scrambled by the seed of the search; it does not end."""
    # Imported here because it is slow.
    from scipy.stats import qmc

    sequence = qmc.Sobol(search.size, scramble=True, rng=search.seed)
    while True:
        yield from sequence.random(BATCH)


def _count(search: Search, points: int | None) -> int:
    if points is None:
        return search.budget or 1 << (64 * search.size - 1).bit_length()
    if points < 1:
        raise SolverError(f"a design has at least one point, not {points}")
    if search.budget is not None and points > search.budget:
        raise BudgetTooSmallError(f"the design has {points} points, and the budget is {search.budget} evaluations")
    return points


def _axes(search: Search, points: int | Sequence[int] | Mapping[str, int] | None) -> list[list[object]]:
    space = search.space
    if isinstance(points, Mapping):
        unknown = set(points) - {parameter.address for parameter in space}
        if unknown:
            raise SolverError(f"points are given for {sorted(unknown)}, which is no parameter")
        counts = [points.get(parameter.address) for parameter in space]
    else:
        each = points if isinstance(points, Sequence) else [points] * len(space)
        if len(each) != len(space):
            raise SolverError(f"points has one number per parameter, {len(space)}, not {len(each)}")
        counts = [count if parameter.is_continuous else None for count, parameter in zip(each, space, strict=True)]
    try:
        counts = [None if count is None else as_whole("a number of points", count) for count in counts]
    except (ValueError, OverflowError) as error:
        raise SolverError(str(error)) from None
    fair = _fair_count(search)
    return [_axis(parameter, count, fair) for parameter, count in zip(space, counts, strict=True)]


def _axis(parameter: Dimension, count: int | None, fair: int) -> list[object]:
    if isinstance(parameter, Choice):
        if count is not None:
            raise SolverError(f"{parameter.address} has {len(parameter.options)} options, and a grid takes all of them")
        return list(parameter.options)
    whole = int(parameter.upper) - int(parameter.lower) + 1 if parameter.integer and count is None else None
    too_few = BudgetTooSmallError if count is None else SolverError
    count = fair if count is None else count
    if (size := count if whole is None else whole) > MOST_VALUES:
        raise SolverError(
            f"a grid has at most {MOST_VALUES:,} values of one parameter, not {size:,} of {parameter.address}: give "
            "fewer points (points={...}), or take another solver"
        )
    if whole is not None:
        return list(range(int(parameter.lower), int(parameter.upper) + 1))
    if count < 2:
        raise too_few(f"a grid has at least two values of {parameter.address}, not {count}")
    values = (parameter.from_unit(u) for u in np.linspace(0.0, 1.0, count))
    return list(dict.fromkeys(values))


def _fair_count(search: Search) -> int:
    """Return the default number of values of each continuous parameter."""
    if search.budget is None:
        return 11
    continuous = sum(parameter.is_continuous for parameter in search.space)
    whole = discrete_size(search.space)
    count = 1
    while continuous and whole * (count + 1) ** continuous <= search.budget:
        count += 1
    return count


def discrete_size(space: Sequence[Dimension]) -> int:
    """Return the number of combinations of the parameters that are not continuous."""
    return prod(
        len(p.options) if isinstance(p, Choice) else int(p.upper) - int(p.lower) + 1
        for p in space
        if not p.is_continuous
    )
