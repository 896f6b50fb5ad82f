"""The default: a solver chosen from the problem, and changed when it makes no more progress."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from vtbdrake.optimization.parameter import Choice, Dimension, Parameter
from vtbdrake.optimization.solvers.batch import BatchSolver
from vtbdrake.optimization.solvers.cmaes_solver import CmaEs, default_population
from vtbdrake.optimization.solvers.designs import Design, Grid, Listed, Sobol, discrete_size
from vtbdrake.optimization.solvers.drake_solvers import NloptDerivativeFree
from vtbdrake.optimization.solvers.optuna_samplers import OptunaSolver
from vtbdrake.optimization.solvers.ranking import best_of, rank_key
from vtbdrake.optimization.solvers.scipy_solvers import DifferentialEvolution
from vtbdrake.optimization.solvers.search import SEEDS, Search
from vtbdrake.optimization.solvers.solver import Evaluation, Point

# Where all parameters are whole or categorical, and there is no budget: up to so many points are all tried.
EXHAUSTIVE = 256
# A change of the best value is progress if it exceeds this part of the spread of the values of the first design.
PROGRESS = 1e-6
# So many methods in a row without progress are an end.
PATIENCE = 5
# The last search runs in a box around the best point, so many of the ranges to each side.
POLISH_RADIUS = 0.02
# Quadratic models of more parameters are not cheap any more.
POLISH_SIZE = 20


class Auto(BatchSolver):
    """Chooses by the problem:

    * several objectives: NSGA-II of Optuna;
    * whole and categorical parameters only, with no more combinations than the budget (256 without one): a grid;
    * a categorical parameter: TPE of Optuna;
    * else a Sobol design, and from its best point CMA-ES. A budget that is too small for ten generations of CMA-ES is
      spent on the Sobol design alone.

    CMA-ES ends when it has converged, or when it *stalls*: when for 20 + 30 n / lambda generations, of lambda points
    each, the best value of this start has not improved by more than 1e-6 of the spread of the first design's values.
    Then it starts anew at a random point with twice the population (IPOP); every third start is differential evolution,
    since no global method alone is reliable. Five starts in a row that do not improve the best value by as much are the
    end, with success. Last, a tenth of the budget at most goes into a local search (BOBYQA, or COBYLA with constraints
    or one parameter) in a small box around the best point, if all parameters are continuous and there are at most 20.

    Args:
        search: what is searched.
        name: in the catalogue.

    Raises:
        ModuleNotFoundError: the problem needs Optuna, which is not installed.

    Auger, A. and Hansen, N. (2005): A restart CMA evolution strategy with increasing population size, CEC 2005.
    """

    def __init__(self, search: Search, *, name: str) -> None:
        super().__init__(search, name=name)
        self._best: Evaluation | None = None
        self._spread = 0.0
        self._count = 0
        self._method = ""
        self._changes: list[tuple[int, str]] = []
        self._solver: BatchSolver
        self._patience = math.inf
        self._stage_best: Evaluation | None = None
        self._without_progress = 0
        self._plan = self._stages()
        next(self._plan)

    @property
    def method(self) -> str:
        return self._method

    @property
    def changes(self) -> tuple[tuple[int, str], ...]:
        """The methods in their order, each with the number of evaluations asked for before it began."""
        return tuple(self._changes)

    # ------------------------------------------------------------------------------ the plan

    def _stages(self) -> Iterator[None]:
        """Each stage begins a method; the caller comes back when that has ended or stalled."""
        search = self.search
        if search.objectives > 1:
            return self._one("NSGA-II", OptunaSolver(search, name="NSGA-II"))
        discrete = not any(parameter.is_continuous for parameter in search.space)
        if discrete and discrete_size(search.space) <= (search.budget or EXHAUSTIVE):
            return self._one("grid", Grid(replace(search, start=None), name="grid"))
        if any(isinstance(parameter, Choice) for parameter in search.space):
            return self._one("TPE", OptunaSolver(search, name="TPE"))
        return self._global_stages()

    def _one(self, method: str, solver: BatchSolver) -> Iterator[None]:
        self._begin(method, solver)
        yield
        self._end(bool(solver.success), solver.message)

    def _global_stages(self) -> Iterator[None]:
        search = self.search
        design = 1 << (4 * (search.size + 1) - 1).bit_length()
        free = replace(search, start=None, budget=None)
        if search.start is not None:
            self._begin("start", Listed(free, name="start", points=[search.start]))
            yield
        if search.budget is not None and search.budget < design + 10 * default_population(search.size):
            self._begin("sobol", Sobol(replace(free, budget=self._left), name="sobol"))
            yield
            self._end(True, "the design is complete")
            return
        self._begin("sobol", Sobol(free, name="sobol", points=design))
        yield
        fruitless, start = 0, 0
        while fruitless < PATIENCE and self._left_but_polish() > 0:
            before = self._best
            self._begin_global(start)
            yield
            start += 1
            fruitless = 0 if self._progress(before, self._best) else fruitless + 1
        if self._best is not None and self._polishable:
            self._begin_polish(self._best.point)
            yield
        if fruitless == PATIENCE:
            self._end(True, f"{PATIENCE} starts in a row found nothing better")
        else:
            self._spent()

    def _begin_global(self, start: int) -> None:
        """The start-th global search, counted from 0: CMA-ES twice, differential evolution, and so on."""
        left = self._left_but_polish()
        search = replace(
            self.search,
            start=None,
            seed=(self.search.seed + start) % SEEDS,
            budget=None if self._left is None else int(left),
        )
        if start % 3 == 2:
            self._begin(
                f"differential-evolution, start {start + 1}",
                DifferentialEvolution(search, name="differential-evolution"),
                generation=15 * search.size,
            )
            return
        population = default_population(search.size) << (start - start // 3)
        if start == 0 and self._best is not None:
            search = replace(search, start=self._best.point)
        else:
            generator = np.random.default_rng([self.search.seed, start])
            search = replace(search, start=search.point(generator.random(search.size)))
        self._begin(
            f"CMA-ES, start {start + 1}, population {population}",
            CmaEs(search, name="CMA-ES", population=population),
            generation=population,
        )

    @property
    def _polishable(self) -> bool:
        space = self.search.space
        return len(space) <= POLISH_SIZE and all(parameter.is_continuous for parameter in space)

    def _left_but_polish(self) -> float:
        """The evaluations that are left for global methods."""
        if self._left is None or self.search.budget is None:
            return math.inf
        reserve = min(self.search.budget // 10, 20 * (self.search.size + 1)) if self._polishable else 0
        return self._left - reserve

    def _begin_polish(self, best: Point) -> None:
        u = self.search.unit(best)
        lower = self.search.point(np.maximum(u - POLISH_RADIUS, 0.0))
        upper = self.search.point(np.minimum(u + POLISH_RADIUS, 1.0))
        box = tuple(_between(*ends) for ends in zip(self.search.space, lower, upper, strict=True))
        # BOBYQA takes no constraints, and at least two parameters.
        name = "LN_COBYLA" if self.search.constraints or self.search.size == 1 else "LN_BOBYQA"
        search = replace(self.search, space=box, start=best, budget=self._left)
        self._begin(f"{name}, polish", NloptDerivativeFree(search, name=name))

    # ------------------------------------------------------------------------------ its steps

    def _begin(self, method: str, solver: BatchSolver, *, generation: int | None = None) -> None:
        """``generation``: the points of each, of a method that may stall."""
        self._method = method
        self._changes.append((self._count, method))
        self._solver = solver
        self._stage_best = None
        self._without_progress = 0
        self._patience = math.inf if generation is None else 20.0 * generation + 30.0 * self.search.size

    def _next(self) -> list[Point]:
        while self._success is None:
            points = [] if self._without_progress > self._patience else self._solver.ask()
            if points:
                self._count += len(points)
                return points
            self._solver.close()
            next(self._plan, None)
        return []

    def _learn(self, asked: Sequence[Evaluation], given: Sequence[Evaluation]) -> None:
        self._solver.tell([*asked, *given])
        if self.search.objectives > 1:
            return
        if self._solver.name == "sobol":
            values = [evaluation.values[0] for evaluation in asked if evaluation.feasible]
            self._spread = max(self._spread, max(values, default=0.0) - min(values, default=0.0))
        best = best_of([*asked, *([self._stage_best] if self._stage_best else [])])
        progress = self._progress(self._stage_best, best)
        self._without_progress = 0 if progress else self._without_progress + len(asked)
        if progress:
            self._stage_best = best
        self._best = best_of([*([self._best] if self._best else []), *asked, *given])

    def _progress(self, before: Evaluation | None, after: Evaluation | None) -> bool:
        """Whether the best has become better by more than a trifle."""
        if after is None or before is None:
            return after is not None
        (kind, cost), (kind_before, cost_before) = rank_key(after), rank_key(before)
        return kind < kind_before or (kind == kind_before and cost < cost_before - PROGRESS * self._spread)

    def _spent(self) -> None:
        # A design that is as long as the budget is complete.
        if isinstance(self._solver, Design) and not self._solver.ask():
            self._end(True, self._solver.message)
        else:
            super()._spent()

    def close(self) -> None:
        self._solver.close()


def _between(parameter: Dimension, lower: float, upper: float) -> Parameter:
    assert isinstance(parameter, Parameter)
    return replace(parameter, lower=lower, upper=upper)
