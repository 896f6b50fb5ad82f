"""Evolutionary solvers: CMA-ES of the package cmaes, and SciPy's differential evolution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.optimization.parameter import Dimension, Parameter
from vtbdrake.optimization.solvers.blocking import BlockingSolver
from vtbdrake.optimization.solvers.solver import Evaluation, Point, Search, Solver, SolverError, costs

if TYPE_CHECKING:
    from cmaes import CMA, CMAwM


def default_population(size: int) -> int:
    """Return lambda = 4 + floor(3 ln n), the usual number of points per generation."""
    return 4 + math.floor(3.0 * math.log(size))


class CmaEs(Solver):
    """Covariance matrix adaptation: a normal distribution over the unit cube that moves to where points are better.

    Each batch is a generation, ranked by Deb's rule. Points outside the ranges are drawn again. A margin keeps integers
    from freezing (CMA-ES with margin); those on a logarithmic scale are only rounded. It ends, with success, when its
    distribution has shrunk to a point or the values of many generations agree; `auto` restarts it.

    Args:
        search: Numbers, one objective.
        name: Name in the catalogue.
        population: Points per generation, at least 3; by default 4 + floor(3 ln n), or as many as run side by
            side (`Search.parallel`) if these are more.
        sigma: The first standard deviation, as a part of the ranges.

    Hansen, N. (2016): The CMA evolution strategy, a tutorial, arXiv:1604.00772. Hamano, R. et al. (2022): CMA-ES with
    margin, arXiv:2205.13482.
    """

    def __init__(self, search: Search, *, name: str, population: int | None = None, sigma: float = 0.3) -> None:
        search.require(name, ordered=True, one_objective=True)
        super().__init__(search, name=name)
        population = search.batch(default_population(search.size), requested=population, least=3)
        if not sigma > 0.0:
            raise SolverError(f"sigma is a part of the ranges, above 0, not {sigma}")
        self.population = population
        self._counts = np.array([_grid_count(parameter) for parameter in search.space])
        self._strategy = _strategy(self._encode(search.start_unit()), sigma, self._counts, population, search.seed)
        self._drawn: list[np.ndarray] = []
        self._succeeded = False

    def _encode(self, u: np.ndarray) -> np.ndarray:
        """Move integers from the middle of their shares of the unit cube to k / (count - 1)."""
        steps = self._counts > 0
        encoded = np.array(u, dtype=float)
        encoded[steps] = np.floor(u[steps] * self._counts[steps]) / (self._counts[steps] - 1)
        return encoded

    def _decode(self, x: np.ndarray) -> np.ndarray:
        steps = self._counts > 0
        u = np.array(x, dtype=float)
        u[steps] = (np.round(x[steps] * (self._counts[steps] - 1)) + 0.5) / self._counts[steps]
        return u

    def _next(self) -> list[Point]:
        if self._strategy.should_stop():
            self._end(
                self._succeeded, "converged" if self._succeeded else "no point was found whose simulation succeeds"
            )
            return []
        drawn = [self._strategy.ask() for _ in range(self.population)]
        # With margin, each is a pair: the point to evaluate, and the drawn point before its integers were rounded.
        pairs = drawn if self._counts.any() else [(x, x) for x in drawn]
        self._drawn = [raw for _, raw in pairs]
        return [self.search.point(self._decode(x)) for x, _ in pairs]

    def _learn(self, evaluations: Sequence[Evaluation], by_hand: Sequence[Evaluation]) -> None:
        if evaluations:
            self._succeeded |= any(not evaluation.failed for evaluation in evaluations)
            self._strategy.tell(list(zip(self._drawn, costs(evaluations), strict=True)))


def _grid_count(parameter: Dimension) -> int:
    """Return the number of values of an equally spaced integer; 0 for anything else."""
    if isinstance(parameter, Parameter) and parameter.integer and not parameter.log:
        return int(parameter.upper) - int(parameter.lower) + 1
    return 0


def _strategy(mean: np.ndarray, sigma: float, counts: np.ndarray, population: int, seed: int) -> CMA | CMAwM:
    # Imported here because it is slow: it loads scipy.stats.
    from cmaes import CMA, CMAwM

    # What lies outside is drawn again, and moved to the bounds in the end. Among more than a hundred numbers one is
    # nearly always outside, and the package multiplies two matrices for each draw.
    options: dict[str, Any] = {
        "bounds": np.tile([0.0, 1.0], (len(mean), 1)),
        "n_max_resampling": 100 if len(mean) <= 100 else 5,
        "population_size": population,
    }
    if not counts.any():
        return CMA(mean=mean, sigma=sigma, seed=seed, **options)
    steps = np.array([1.0 / (count - 1) if count else 0.0 for count in counts])
    return CMAwM(mean=mean, sigma=sigma, steps=steps, seed=seed, **options)


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
