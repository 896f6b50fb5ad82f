"""The default solver: it chooses its methods by the problem, and changes them when they make no more progress."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vtbdrake.optimization.parameter import Choice, Dimension, Parameter
from vtbdrake.optimization.solvers.bayesian import Bayesian
from vtbdrake.optimization.solvers.cobyqa import Cobyqa
from vtbdrake.optimization.solvers.designs import Grid, Listed, Sobol, discrete_size
from vtbdrake.optimization.solvers.drake_solvers import Nlopt
from vtbdrake.optimization.solvers.evolution import CmaEs, DifferentialEvolution, default_population
from vtbdrake.optimization.solvers.solver import SEEDS, Evaluation, Point, Search, Solver, best_of, rank_key

MODEL = "bayesian"

# Without a budget, whole and categorical parameters with up to this many combinations are searched exhaustively.
EXHAUSTIVE = 256
# A change of the best value is progress if it exceeds this part of the spread of the values found by the model.
PROGRESS = 1e-6
# The solver ends after this many starts in a row without progress.
PATIENCE = 5
# A Gaussian process helps with up to this many parameters; beyond, a quadratic model is expensive, too.
MODEL_SIZE = 20
# Points of the model per parameter and one more.
MODEL_POINTS = 25
# Largest number of points of the model.
MODEL_LIMIT = 120
# Least number of batches of points of the model, where batches are wide.
MODEL_BATCHES = 4
# Least number of generations that CMA-ES needs.
GENERATIONS = 10
# Without generations, the budget that is left divided by this number goes to a local search.
LOCAL_PART = 3
# A local search needs at least this number of points per continuous parameter and one more: the 2 n + 1 of BOBYQA's
# first model, and some steps.
LOCAL_POINTS = 5
# Half width of the box of the local search after the model, as a part of the ranges.
LOCAL_RADIUS = 0.1
# Half width of the box of the last local search.
POLISH_RADIUS = 0.02
# Half width of the box of local searches in other basins.
BASIN_RADIUS = 0.2
# Tolerance at which they end.
BASIN_TOLERANCE = 1e-3
# Number of basins in a row that may have nothing better.
BASINS = 3


class Auto(Solver):
    """A solver that chooses its methods by the problem.

    * whole and categorical parameters only, with no more combinations than the budget (256 without one), and one
      objective: a grid;
    * several objectives, or a categorical parameter: Bayesian optimization to the end;
    * else, with up to 20 parameters: Bayesian optimization for 25 (n + 1) points, 120 at most; a local search from its
      best point, for at most a third of the remaining budget, and another one while it ends at the border of its box;
      local searches from the best points outside of the basins that were searched, until three in a row have found
      nothing better; then CMA-ES from the best point. A budget that leaves less than ten generations for CMA-ES goes to
      Bayesian optimization for two thirds, and for one to a local search from its best point; all of it goes to
      Bayesian optimization if the third is less than 5 (k + 1) points for k continuous parameters;
    * with more parameters: a Sobol design of 2 (n + 1) points, and CMA-ES from its best point.

    Bayesian optimization asks for 4 points at a time; for fewer if the budget is less than 100 evaluations. If more
    points run side by side (`Search.parallel`), every method asks for as many at a time, Bayesian optimization in at
    least four batches, and the local searches, which choose each point by the last one, are left out.

    CMA-ES ends when it has converged, or when it *stalls*: when for 20 + 30 n / lambda generations, of lambda points
    each, the best value of this start has not improved by more than 1e-6 of the spread of the values before it.
    Then it restarts at a random point with twice the population (IPOP); every third start is differential evolution.
    After five starts in a row without such an improvement the solver ends, with success. Last, if the best point is
    better than the model's, a tenth of the budget at most goes into another local search, and the rest into
    Bayesian optimization.

    The local searches (BOBYQA, or COBYQA with constraints or one continuous parameter) stay in a box around the point
    from which they begin, and keep its integers. They need at most 20 parameters, at least one of them continuous.

    Auger, A. and Hansen, N. (2005): A restart CMA evolution strategy with increasing population size, CEC 2005.
    """

    def __init__(self, search: Search, *, name: str) -> None:
        super().__init__(search, name=name)
        self._best: Evaluation | None = None
        self._spread = 0.0
        self._count = 0
        self._method = ""
        self._changes: list[tuple[int, str]] = []
        self._solver: Solver
        self._patience = math.inf
        self._limit = math.inf
        # Whether one method performs the whole search.
        self._alone = False
        # The start of a local search, whose integers stay.
        self._local_start: Point | None = None
        # The starts of all local searches.
        self._searched: list[Point] = []
        self._stage_best: Evaluation | None = None
        self._without_progress = 0
        # The evaluations of the first stages; a new model is fitted to them.
        self._before: list[Evaluation] = []
        self._plan = self._stages()
        next(self._plan)

    @property
    def method(self) -> str:
        return self._method

    @property
    def changes(self) -> tuple[tuple[int, str], ...]:
        """Return the methods used so far, each with the number of evaluations asked for before it began."""
        return tuple(self._changes)

    def change_budget(self, left: float) -> None:
        super().change_budget(left)
        if self._alone:
            self._solver.change_budget(left)
        elif self._patience < math.inf:
            # A global method has all that is left; the others are limited by their plans.
            self._solver.change_budget(self._left_but_polish())

    # -- the plan

    def _stages(self) -> Iterator[None]:
        """Yield once per method; the caller resumes when that has ended or stalled."""
        search = self.search
        discrete = not any(parameter.is_continuous for parameter in search.space)
        if search.objectives == 1 and discrete and discrete_size(search.space) <= (search.budget or EXHAUSTIVE):
            return self._one("grid", Grid(replace(search, start=None), name="grid"))
        if search.objectives > 1 or any(isinstance(parameter, Choice) for parameter in search.space):
            return self._one(MODEL, Bayesian(search, name=MODEL, batch=self._batch))
        return self._global_stages()

    def _one(self, method: str, solver: Solver) -> Iterator[None]:
        self._alone = True
        self._begin(method, solver)
        yield
        self._end(bool(solver.success), solver.message)

    @property
    def _batch(self) -> int:
        """Return the number of points that the model asks for at a time; 1 with a small budget, to learn from each."""
        return self.search.batch(4 if self.search.budget is None else min(max(self.search.budget // 25, 1), 4))

    def _global_stages(self) -> Iterator[None]:
        search = self.search
        if search.start is not None:
            self._begin("start", Listed(replace(search, start=None, budget=None), name="start", points=[search.start]))
            yield
        reserve = self._local_reserve()
        self._begin_model(reserve)
        yield
        model_best = self._best
        if model_best is not None and self._has_local:
            yield from self._descent(model_best.point, whole=reserve > 0)
            yield from self._other_basins()
        fruitless, start = 0, 0
        least = self._generations if reserve else 0
        while fruitless < PATIENCE and self._left_but_polish() > least:
            before = self._best
            self._begin_global(start)
            yield
            start += 1
            fruitless = 0 if self._progress(before, self._best) else fruitless + 1
        if self._has_local and self._progress(model_best, self._best):
            assert self._best is not None
            self._begin_local(self._best.point, radius=POLISH_RADIUS, limit=math.inf)
            yield
        if fruitless == PATIENCE:
            self._end(True, f"{PATIENCE} starts in a row found nothing better")
            return
        while self._left:
            self._begin_model()
            yield
        self._spent()

    def _descent(self, start: Point, *, whole: bool) -> Iterator[None]:
        """Search locally from a point; go on in another box while the best point lies at the border of its own.

        A search gets the ``whole`` of what is left, or else a third of it, without the reserve for the last search.
        """
        while self._left_but_polish() > 0:
            limit = math.inf if whole else self._left_but_polish() / 3.0
            self._begin_local(start, radius=LOCAL_RADIUS, limit=limit)
            yield
            end = self._stage_best
            if end is None:
                return
            u, moved = self.search.unit(end.point), np.abs(self.search.unit(end.point) - self.search.unit(start))
            if not ((moved > 0.99 * LOCAL_RADIUS) & (u > 0.0) & (u < 1.0))[self._continuous].any():
                return
            start = end.point

    def _other_basins(self) -> Iterator[None]:
        """Search locally from the best points that lie outside of the basins known so far, while that pays."""
        fruitless = 0
        while fruitless < BASINS and self._left_but_polish() > self._local_limit:
            start = self._outside()
            if start is None:
                return
            before = self._best
            self._begin_local(start, radius=BASIN_RADIUS, limit=math.inf, tolerance=BASIN_TOLERANCE)
            yield
            fruitless = 0 if self._progress(before, self._best) else fruitless + 1

    def _outside(self) -> Point | None:
        """Return the best point of the model that is far from the starts and ends of all local searches."""
        assert self._best is not None
        centres = [self.search.unit(point) for point in [*self._searched, self._best.point]]
        for evaluation in sorted((e for e in self._before if e.counts), key=rank_key):
            u = self.search.unit(evaluation.point)
            if all(np.abs(u - centre).max() > LOCAL_RADIUS for centre in centres):
                return evaluation.point
        return None

    def _begin_model(self, reserve: int = 0) -> None:
        """Begin the Gaussian process, or for many parameters a design; leave ``reserve`` points of a small budget."""
        search, size, left = self.search, self.search.size, math.inf if self._left is None else self._left
        if size > MODEL_SIZE:
            points = int(min(search.batch(2 * (size + 1)), max(1, left // 2)))
            self._begin("sobol", Sobol(replace(search, start=None, budget=None), name="sobol", points=points))
            return
        points = int(left) - reserve if self._is_small else self._model_points
        model = Bayesian(replace(search, start=None, budget=max(1, points)), name=MODEL, batch=self._batch)
        # These evaluations are charged already.
        model.tell([replace(evaluation, effort=0.0) for evaluation in (*self._before, self._best) if evaluation])
        # With racing, the budget may allow many more points: the number of points is limited, too.
        self._begin(MODEL, model, limit=points)

    @property
    def _model_points(self) -> int:
        """Return the number of points of the model in a large budget."""
        return max(min(MODEL_POINTS * (self.search.size + 1), MODEL_LIMIT), MODEL_BATCHES * self.search.batch(1))

    @property
    def _is_small(self) -> bool:
        """Return whether the budget left is too small for the model and CMA-ES."""
        return self._left is not None and self._left < self._model_points + self._generations

    @property
    def _generations(self) -> int:
        """Return the number of evaluations that CMA-ES needs at least."""
        return GENERATIONS * self.search.batch(default_population(self.search.size))

    def _local_reserve(self) -> int:
        """Return the number of evaluations that the model leaves to a local search in a small budget."""
        if not (self._has_local and self._is_small):
            return 0
        assert self._left is not None
        points = self._left // LOCAL_PART
        return points if points >= LOCAL_POINTS * (len(self._continuous) + 1) else 0

    def _begin_global(self, start: int) -> None:
        """Begin a global search, counted from 0: CMA-ES twice, differential evolution, and so on."""
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
                generation=search.batch(15 * search.size),
            )
            return
        population = search.batch(default_population(search.size)) << (start - start // 3)
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
    def _has_local(self) -> bool:
        return len(self._continuous) > 0 and self.search.size <= MODEL_SIZE and not self.search.is_wide

    @property
    def _continuous(self) -> list[int]:
        """Return the indices of the continuous parameters."""
        return [i for i, parameter in enumerate(self.search.space) if parameter.is_continuous]

    @property
    def _local_limit(self) -> int:
        """Return the largest number of evaluations of a local search."""
        return 20 * (len(self._continuous) + 1)

    def _left_but_polish(self) -> float:
        """Return the number of evaluations left for global methods."""
        if self._left is None or self.search.budget is None:
            return math.inf
        reserve = min(self.search.budget // 10, self._local_limit) if self._has_local else 0
        return self._left - reserve

    def _begin_local(self, start: Point, *, radius: float, limit: float, tolerance: float | None = None) -> None:
        """Begin a local search at a point, whose integers stay."""
        varied = self._continuous
        u = self.search.unit(start)
        self._searched.append(start)
        lower = self.search.point(np.maximum(u - radius, 0.0))
        upper = self.search.point(np.minimum(u + radius, 1.0))
        box = tuple(_between(self.search.space[i], lower[i], upper[i]) for i in varied)
        # BOBYQA takes no constraints, and at least two parameters.
        name = "COBYQA" if self.search.constraints or len(varied) == 1 else "LN_BOBYQA"
        budget = int(max(1, min(limit, self._local_limit)))
        search = replace(self.search, space=box, start=tuple(start[i] for i in varied), budget=budget)
        place = "around the best" if self._best is None or start == self._best.point else "in another basin"
        options: dict[str, Any] = {} if tolerance is None else {"tolerance": tolerance}
        make = Cobyqa if name == "COBYQA" else Nlopt
        self._begin(f"{name} {place}", make(search, name=name, **options))
        self._local_start = start

    # -- its steps

    def _begin(self, method: str, solver: Solver, *, generation: int | None = None, limit: float = math.inf) -> None:
        """Begin a method.

        Args:
            method: Name of the method, for the user.
            solver: The solver that runs it.
            generation: Points per generation of a method that may stall; None if it cannot.
            limit: The number of points after which the method ends.
        """
        self._method = method
        self._local_start = None
        self._changes.append((self._count, method))
        self._solver = solver
        self._stage_best = None
        self._without_progress = 0
        self._limit = self._count + limit
        self._patience = math.inf if generation is None else 20.0 * generation + 30.0 * self.search.size

    def _next(self) -> list[Point]:
        while self.success is None:
            ended = self._without_progress > self._patience or self._count >= self._limit
            points = [] if ended else [self._with_integers(point) for point in self._solver.ask()]
            if points:
                self._count += len(points)
                return points
            self._solver.close()
            next(self._plan, None)
        return []

    def _with_integers(self, point: Point) -> Point:
        """Return a point of the method, completed by the integers of the start."""
        if self._local_start is None:
            return point
        varied = dict(zip(self._continuous, point, strict=True))
        return tuple(varied.get(i, value) for i, value in enumerate(self._local_start))

    def _without_integers(self, point: Point) -> Point:
        return point if self._local_start is None else tuple(point[i] for i in self._continuous)

    def _learn(self, evaluations: Sequence[Evaluation], by_hand: Sequence[Evaluation]) -> None:
        self._solver.tell([replace(e, point=self._without_integers(e.point)) for e in (*evaluations, *by_hand)])
        if self.search.objectives > 1:
            return
        if not self._changes or self._solver.name in ("start", MODEL, "sobol"):
            self._before += [*evaluations, *by_hand]
            values = [evaluation.values[0] for evaluation in evaluations if evaluation.counts]
            self._spread = max(self._spread, max(values, default=0.0) - min(values, default=0.0))
        best = best_of([*evaluations, self._stage_best])
        progress = self._progress(self._stage_best, best)
        self._without_progress = 0 if progress else self._without_progress + len(evaluations)
        if progress:
            self._stage_best = best
        self._best = best_of([self._best, *evaluations, *by_hand])

    def _progress(self, before: Evaluation | None, after: Evaluation | None) -> bool:
        """Return whether the best has improved by more than `PROGRESS`."""
        if after is None or before is None:
            return after is not None
        (kind, cost), (kind_before, cost_before) = rank_key(after), rank_key(before)
        return kind < kind_before or (kind == kind_before and cost < cost_before - PROGRESS * self._spread)

    def close(self) -> None:
        self._solver.close()


def _between(parameter: Dimension, lower: float, upper: float) -> Parameter:
    """Return the parameter with other ends; unchanged if they are equal, in a range of few floating-point numbers."""
    assert isinstance(parameter, Parameter)
    return replace(parameter, lower=lower, upper=upper) if lower < upper else parameter
