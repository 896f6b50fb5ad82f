"""CMA-ES, of the package cmaes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from vtbdrake.optimization.parameter import Dimension, Parameter
from vtbdrake.optimization.solvers.batch import BatchSolver
from vtbdrake.optimization.solvers.ranking import costs
from vtbdrake.optimization.solvers.search import Search
from vtbdrake.optimization.solvers.solver import Evaluation, Point, SolverError

if TYPE_CHECKING:
    from cmaes import CMA, CMAwM


def default_population(size: int) -> int:
    """lambda = 4 + floor(3 ln n), the usual number of points per generation."""
    return 4 + math.floor(3.0 * math.log(size))


class CmaEs(BatchSolver):
    """Covariance matrix adaptation: a normal distribution over the unit cube that learns where better points are.

    Each batch is a generation, ranked by Deb's rule: failed simulations last, before them what breaks constraints. What
    falls outside of the ranges is drawn again. Integers are kept from freezing by a margin (CMA-ES with margin); those
    on a logarithmic scale are rounded only. It ends, with success, when its distribution has shrunk to a point or the
    values of many generations agree; restarts are the business of `auto`.

    Args:
        search: what is searched: numbers, one objective.
        name: in the catalogue.
        population: points per generation, at least 3; left away: 4 + floor(3 ln n).
        sigma: the first standard deviation, as a part of the ranges.

    Hansen, N. (2016): The CMA evolution strategy, a tutorial, arXiv:1604.00772. Hamano, R. et al. (2022): CMA-ES with
    margin, arXiv:2205.13482.
    """

    def __init__(self, search: Search, *, name: str, population: int | None = None, sigma: float = 0.3) -> None:
        search.require(name, ordered=True, one_objective=True)
        super().__init__(search, name=name)
        population = default_population(search.size) if population is None else population
        if population < 3:
            raise SolverError(f"a population has at least 3 points, not {population}")
        if not sigma > 0.0:
            raise SolverError(f"sigma is a part of the ranges, above 0, not {sigma}")
        self.population = population
        self._counts = np.array([_grid_count(parameter) for parameter in search.space])
        self._strategy = _strategy(self._encode(search.start_unit()), sigma, self._counts, population, search.seed)
        self._drawn: list[np.ndarray] = []
        self._found = False

    def _encode(self, u: np.ndarray) -> np.ndarray:
        """Integers lie at k / (count - 1) in the distribution, and in the middle of their shares in the unit cube."""
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
            self._end(self._found, "converged" if self._found else "no point was found whose simulation succeeds")
            return []
        drawn = [self._strategy.ask() for _ in range(self.population)]
        # With margin, each is what is to be judged, and what it was before its integers were rounded.
        pairs = drawn if self._counts.any() else [(x, x) for x in drawn]
        self._drawn = [raw for _, raw in pairs]
        return [self.search.point(self._decode(x)) for x, _ in pairs]

    def _learn(self, asked: Sequence[Evaluation], given: Sequence[Evaluation]) -> None:
        if asked:
            self._found |= any(not evaluation.failed for evaluation in asked)
            self._strategy.tell(list(zip(self._drawn, costs(asked), strict=True)))


def _grid_count(parameter: Dimension) -> int:
    """How many values an integer has that are equally spaced; 0 of all else."""
    if isinstance(parameter, Parameter) and parameter.integer and not parameter.log:
        return int(parameter.upper) - int(parameter.lower) + 1
    return 0


def _strategy(mean: np.ndarray, sigma: float, counts: np.ndarray, population: int, seed: int) -> CMA | CMAwM:
    # Imported here, since it takes long: it loads scipy.stats.
    from cmaes import CMA, CMAwM

    bounds = np.tile([0.0, 1.0], (len(mean), 1))
    if not counts.any():
        return CMA(mean=mean, sigma=sigma, bounds=bounds, seed=seed, population_size=population)
    steps = np.array([1.0 / (count - 1) if count else 0.0 for count in counts])
    return CMAwM(mean=mean, sigma=sigma, bounds=bounds, steps=steps, seed=seed, population_size=population)
