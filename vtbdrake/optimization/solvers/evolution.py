"""Evolutionary solvers: CMA-ES of the package cmaes, and SciPy's differential evolution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.optimization.parameter import Choice, Dimension, Parameter
from vtbdrake.optimization.solvers.blocking import BlockingSolver
from vtbdrake.optimization.solvers.solver import Evaluation, Point, Search, Solver, SolverError, costs

if TYPE_CHECKING:
    from cmaes import CatCMAwM


def default_population(size: int) -> int:
    """Return lambda = 4 + floor(3 ln n), the usual number of points per generation."""
    return 4 + math.floor(3.0 * math.log(size))


class CmaEs(Solver):
    """Covariance matrix adaptation: a normal distribution over the unit cube that moves to where points are better.

    Each batch is a generation, ranked by Deb's rule. For integers and words it is CatCMA with margin: a margin keeps
    integers from freezing (those on a logarithmic scale are only rounded), and each word has a probability, at first
    the same. It ends, with success, when its distribution of the numbers has shrunk to a point or the values of many
    generations agree; `auto` restarts it.

    With two objectives, several such distributions, the kernels, move to where each adds most to the hypervolume that
    the others dominate (COMO-CatCMA with margin). Only the budget ends that.

    Args:
        search: At least one number, and one or two objectives.
        name: Name in the catalogue.
        population: Points per generation, at least 3; by default 4 + floor(3 ln n), or as many as run side by
            side (`Search.parallel`) if these are more. With two objectives, of a kernel.
        sigma: The first standard deviation, as a part of the ranges.

    Hansen, N. (2016): The CMA evolution strategy, a tutorial, arXiv:1604.00772. Hamano, R. et al. (2025): CatCMA with
    margin, arXiv:2504.07884.
    """

    def __init__(self, search: Search, *, name: str, population: int | None = None, sigma: float = 0.3) -> None:
        if search.objectives > 2:
            raise SolverError(f"{name} takes one or two objectives, not {search.objectives}; NSGA-II can do that")
        if all(isinstance(parameter, Choice) for parameter in search.space):
            raise SolverError(f"{name} varies at least one number, and here are words alone; grid or TPE can do that")
        super().__init__(search, name=name)
        population = search.batch(default_population(search.size), requested=population, least=3)
        if not sigma > 0.0:
            raise SolverError(f"sigma is a part of the ranges, above 0, not {sigma}")
        self.population = population
        self._strategy = _strategy(search, sigma, population)
        self._drawn: list[Any] = []
        self._succeeded = False

    def _next(self) -> list[Point]:
        if self._strategy.should_stop():
            self._end(
                self._succeeded, "converged" if self._succeeded else "no point was found whose simulation succeeds"
            )
            return []
        places, self._drawn = self._strategy.ask()
        return [self.search.point(u) for u in places]

    def _learn(self, evaluations: Sequence[Evaluation], by_hand: Sequence[Evaluation]) -> None:
        if evaluations:
            self._succeeded |= any(not evaluation.failed for evaluation in evaluations)
            self._strategy.tell(self._drawn, evaluations)


class _Numbers:
    """CMA-ES of continuous numbers."""

    def __init__(self, search: Search, sigma: float, population: int) -> None:
        # Imported here because it is slow: it loads scipy.stats.
        from cmaes import CMA

        self._cma = CMA(
            mean=search.start_unit(),
            sigma=sigma,
            bounds=np.tile([0.0, 1.0], (search.size, 1)),
            # What lies outside is drawn again, and moved to the bounds in the end. Among more than a hundred numbers
            # one is nearly always outside, and the package multiplies two matrices for each draw.
            n_max_resampling=100 if search.size <= 100 else 5,
            population_size=population,
            seed=search.seed,
        )
        self.should_stop = self._cma.should_stop

    def ask(self) -> tuple[list[np.ndarray], list[Any]]:
        """Return the points of a generation in the unit cube, and what is told with their evaluations."""
        drawn = [self._cma.ask() for _ in range(self._cma.population_size)]
        return drawn, drawn

    def tell(self, drawn: list[Any], evaluations: Sequence[Evaluation]) -> None:
        self._cma.tell(list(zip(drawn, costs(evaluations), strict=True)))


class _Mixed:
    """CatCMA with margin of continuous numbers, integers and words."""

    def __init__(self, search: Search, sigma: float, population: int) -> None:
        self._space = _MixedSpace(search.space)
        self._cma = self._space.strategy(search.start_unit(), sigma, population, search.seed)
        self.should_stop = self._cma.should_stop

    def ask(self) -> tuple[list[np.ndarray], list[Any]]:
        drawn = [self._cma.ask() for _ in range(self._cma.population_size)]
        return [self._space.unit(solution) for solution in drawn], drawn

    def tell(self, drawn: list[Any], evaluations: Sequence[Evaluation]) -> None:
        self._cma.tell(list(zip(drawn, costs(evaluations), strict=True)))


class _Front:
    """COMO-CatCMA with margin, for two objectives."""

    def __init__(self, search: Search, sigma: float, population: int) -> None:
        from cmaes import COMOCatCMAwM

        self._space = _MixedSpace(search.space)
        generator = np.random.default_rng(search.seed)
        starts = [search.start_unit(), *generator.random((_KERNELS - 1, search.size))]
        kernels = [self._space.strategy(start, sigma, population, search.seed) for start in starts]
        self._como = COMOCatCMAwM(**self._space.arguments, kernels=kernels, seed=search.seed)
        # The largest cost of a feasible point, per objective.
        self._worst = np.full(2, -math.inf)

    def should_stop(self) -> bool:
        return False

    def ask(self) -> tuple[list[np.ndarray], list[Any]]:
        drawn = list(self._como.ask_iter())
        return [self._space.unit(solution) for solution in drawn], drawn

    def tell(self, drawn: list[Any], evaluations: Sequence[Evaluation]) -> None:
        self._como.tell(list(zip(drawn, self._costs(evaluations), strict=True)))

    def _costs(self, evaluations: Sequence[Evaluation]) -> list[list[float]]:
        """Return costs by Deb's rule: points that are not feasible are worse than all feasible ones."""
        for evaluation in evaluations:
            if evaluation.feasible:
                self._worst = np.maximum(self._worst, np.negative(evaluation.values))
        floor = np.where(np.isfinite(self._worst), self._worst, 0.0)
        most = max((e.total_violation for e in evaluations if e.usable), default=0.0) + 1.0
        return [
            (np.negative(e.values) if e.feasible else floor + (e.total_violation if e.usable else most)).tolist()
            for e in evaluations
        ]


# Kernels of `_Front`, as many as the package has by default.
_KERNELS = 10


class _MixedSpace:
    """Continuous numbers (x), integers (z) and words (c) of a space, as the package has them.

    Attributes:
        arguments: The spaces of x, z and c, as arguments of the strategies; those that are empty are left out.
    """

    def __init__(self, space: Sequence[Dimension]) -> None:
        counts = [len(p.options) if isinstance(p, Choice) else _grid_count(p) for p in space]
        self._words = [i for i, parameter in enumerate(space) if isinstance(parameter, Choice)]
        self._integers = [i for i, count in enumerate(counts) if count and i not in self._words]
        self._continuous = [i for i, count in enumerate(counts) if not count]
        self._counts = np.array(counts)
        spaces: dict[str, list[Any]] = {
            "x_space": [[0.0, 1.0]] * len(self._continuous),
            "z_space": [np.linspace(0.0, 1.0, counts[i]).tolist() for i in self._integers],
            "c_space": [counts[i] for i in self._words],
        }
        self.arguments = {name: value for name, value in spaces.items() if value}

    def strategy(self, start: np.ndarray, sigma: float, population: int, seed: int) -> CatCMAwM:
        """Return a strategy whose numbers begin around a point in the unit cube, shape (n,)."""
        from cmaes import CatCMAwM

        counts = self._counts[self._integers]
        # From the middle of their shares of the unit cube to k / (count - 1).
        integers = np.floor(np.minimum(start[self._integers] * counts, counts - 1)) / np.maximum(counts - 1, 1)
        mean = np.concatenate([start[self._continuous], integers])
        # Without cov, the first standard deviations are a part of the distances to the bounds: 0 at a bound.
        cov = np.eye(mean.size)
        return CatCMAwM(**self.arguments, population_size=population, mean=mean, sigma=sigma, cov=cov, seed=seed)

    def unit(self, solution: Any) -> np.ndarray:
        """Return a point of the strategy in the unit cube, shape (n,)."""
        u = np.empty(len(self._counts))
        if self._continuous:
            u[self._continuous] = solution.x
        if self._integers:
            counts = self._counts[self._integers]
            u[self._integers] = (np.round(solution.z * (counts - 1)) + 0.5) / counts
        if self._words:
            # Each word is a row with a 1 at the one that is chosen.
            u[self._words] = (np.argmax(solution.c, axis=1) + 0.5) / self._counts[self._words]
        return u


def _grid_count(parameter: Dimension) -> int:
    """Return the number of values of an equally spaced integer; 0 for anything else."""
    if isinstance(parameter, Parameter) and parameter.integer and not parameter.log:
        return int(parameter.upper) - int(parameter.lower) + 1
    return 0


def _strategy(search: Search, sigma: float, population: int) -> _Numbers | _Mixed | _Front:
    if search.objectives == 2:
        return _Front(search, sigma, population)
    is_mixed = any(isinstance(parameter, Choice) or _grid_count(parameter) for parameter in search.space)
    return (_Mixed if is_mixed else _Numbers)(search, sigma, population)


class DifferentialEvolution(BlockingSolver):
    """Differential evolution: a population whose members move by the differences of others.

    A generation is a batch. Constraints follow Lampinen's rule: of two infeasible points, the one with smaller
    violations wins.

    Args:
        search: Numbers, one objective.
        name: Name in the catalogue.
        population: Points per generation and parameter; by default 15, or more if more run side by side.
        tolerance: It ends when the standard deviation of the population's values is below this part of their mean.

    Storn, R. and Price, K. (1997), Journal of Global Optimization 11.
    """

    def __init__(self, search: Search, *, name: str, population: int | None = None, tolerance: float = 0.01) -> None:
        search.require(name, ordered=True, one_objective=True)
        super().__init__(search, name=name)
        self._population = math.ceil(search.batch(15 * search.size) / search.size) if population is None else population
        self._tolerance = tolerance

    def _solve(self) -> tuple[bool, str]:
        # Imported here because it is slow.
        from scipy.optimize import NonlinearConstraint, differential_evolution

        constraint = NonlinearConstraint(self._callback(self._violations), -np.inf, 0.0)
        result = differential_evolution(
            self._callback(self._costs),
            bounds=[(0.0, 1.0)] * self.search.size,
            x0=None if self.search.start is None else self.search.start_unit(),
            popsize=self._population,
            tol=self._tolerance,
            rng=self.search.seed,
            constraints=(constraint,) if self.search.constraints else (),
            # It ends by convergence or by the budget, which is counted by us.
            maxiter=np.iinfo(np.int32).max,
            polish=False,
            vectorized=True,
            updating="deferred",
        )
        return bool(result.success), str(result.message)

    def _costs(self, X: np.ndarray) -> np.ndarray:
        """Return the costs of the columns of ``X``, shape (n, k)."""
        U = np.ascontiguousarray(X.T)
        self._evaluate(U)
        return np.array([self._at(u)[1] for u in U])

    def _violations(self, X: np.ndarray) -> np.ndarray:
        """Return the violations of the columns of ``X``, shape (n, k) or (n,), as shape (constraints, k)."""
        U = np.ascontiguousarray(np.atleast_2d(X.T))
        self._evaluate(U)
        return np.array([self._at(u)[2] for u in U]).T
