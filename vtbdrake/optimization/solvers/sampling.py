"""Sampling-based predictive control as solvers: predictive sampling, the cross-entropy method, MPPI.

All three draw each batch from a normal distribution over the unit cube, N(mu, diag(sigma)^2), and move mu towards good
points. They need few points per batch and no derivatives, and tolerate noise and discontinuities.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
import scipy

from vtbdrake.optimization.solvers.evolution import default_population
from vtbdrake.optimization.solvers.solver import (
    Evaluation,
    Point,
    Search,
    Solver,
    SolverError,
    best_of,
    costs,
    rank_key,
)


class SamplingSolver(Solver):
    """A normal distribution over the unit cube, from which each batch is drawn; the first point of a batch is mu.

    The batches do not depend on the budget: a larger budget continues the same sequence. Only the budget ends it.

    Args:
        search: n numbers, one objective; mu begins at its start.
        name: Name in the catalogue.
        population: The number N of points per batch, at least 2; by default 2 (4 + floor(3 ln n)), or as many as
            run side by side (`Search.parallel`) if these are more.
        sigma: The standard deviation, as a part of the ranges; above 0.

    Raises:
        SolverError: An option is out of range, or the search has choices or several objectives.
    """

    is_prompt = True

    def __init__(self, search: Search, *, name: str, population: int | None, sigma: float) -> None:
        search.require(name, ordered=True, one_objective=True)
        super().__init__(search, name=name)
        self.population = search.batch(2 * default_population(search.size), requested=population, least=2)
        if not sigma > 0.0:
            raise SolverError(f"sigma is a part of the ranges, above 0, not {sigma}")
        self._mu = search.start_unit()
        self._sigma = np.full(search.size, float(sigma))
        self._generator = np.random.default_rng(search.seed)
        self._U = np.empty((0, search.size))

    def _next(self) -> list[Point]:
        self._U = np.vstack([self._mu, self._draw((self.population - 1, self.search.size))])
        return self.search.points(self._U)

    def _draw(self, shape: tuple[int, int]) -> np.ndarray:
        """Return points of the distribution, clipped to the unit cube."""
        return np.clip(self._mu + self._sigma * self._generator.standard_normal(shape), 0.0, 1.0)

    def _learn(self, evaluations: Sequence[Evaluation], by_hand: Sequence[Evaluation]) -> None:
        if any(evaluation.usable for evaluation in evaluations):
            self._move(self._U, evaluations)

    @abstractmethod
    def _move(self, U: np.ndarray, evaluations: Sequence[Evaluation]) -> None:
        """Move the distribution.

        Args:
            U: The batch in the unit cube, shape (N, n).
            evaluations: The N evaluations of the batch; at least one did not fail.
        """


class PredictiveSampling(SamplingSolver):
    """Predictive sampling: the best point so far, and normal noise around it.

    mu <- argmax of f over {mu, clip(mu + sigma e_1), ..., clip(mu + sigma e_(N-1))}, e_i ~ N(0, I). A batch leaves mu
    out once its evaluation is known.

    Args:
        search: See `SamplingSolver`.
        name: See `SamplingSolver`.
        population: See `SamplingSolver`.
        sigma: See `SamplingSolver`; constant.

    Howell, T. et al. (2022): Predictive Sampling: Real-time Behaviour Synthesis with MuJoCo, arXiv:2212.00541.
    """

    def __init__(self, search: Search, *, name: str, population: int | None = None, sigma: float = 0.1) -> None:
        super().__init__(search, name=name, population=population, sigma=sigma)
        self._best: Evaluation | None = None

    def _next(self) -> list[Point]:
        points = super()._next()
        new = slice(int(self._best is not None and self._best.exact), None)
        self._U = self._U[new]
        return points[new]

    def _move(self, U: np.ndarray, evaluations: Sequence[Evaluation]) -> None:
        best = best_of([self._best, *evaluations])
        if best is not None and best is not self._best:
            # The first of equal points, as in `best_of`.
            self._best, self._mu = best, U[evaluations.index(best)]


class Cem(SamplingSolver):
    """The cross-entropy method: the normal distribution of the best points of each batch.

    The distribution is truncated to the unit cube. The elites are the K best points, by Deb's rule, of a batch and the
    best point before it. With their mean m and standard deviation s, per coordinate: mu <- (1 - a) mu + a m,
    sigma <- max((1 - a) sigma + a s, sigma_min).

    Args:
        search: See `SamplingSolver`.
        name: See `SamplingSolver`.
        population: See `SamplingSolver`.
        sigma: The first standard deviation, as a part of the ranges.
        elites: The part K / N of a batch that is elite, in (0, 1]; at least 2 points.
        smoothing: The weight a, in (0, 1]; with a smaller one the distribution adapts more slowly.
        sigma_min: The least standard deviation, as a part of the ranges.

    Rubinstein, R. Y. and Kroese, D. P. (2004): The Cross-Entropy Method, Springer. Kobilarov, M. (2012): Cross-entropy
    motion planning, Int. J. of Robotics Research 31.
    """

    def __init__(
        self,
        search: Search,
        *,
        name: str,
        population: int | None = None,
        sigma: float = 0.3,
        elites: float = 0.34,
        smoothing: float = 0.7,
        sigma_min: float = 0.005,
    ) -> None:
        super().__init__(search, name=name, population=population, sigma=sigma)
        for option, value in (("elites", elites), ("smoothing", smoothing)):
            if not 0.0 < value <= 1.0:
                raise SolverError(f"{option} of {name} lies in (0, 1], unlike {value}")
        if not sigma_min > 0.0:
            raise SolverError(f"sigma_min is a part of the ranges, above 0, not {sigma_min}")
        self._elites = max(2, round(elites * self.population))
        self._smoothing = smoothing
        self._sigma_min = sigma_min
        # The best point so far, once there is one.
        self._best: list[tuple[np.ndarray, Evaluation]] = []

    def _draw(self, shape: tuple[int, int]) -> np.ndarray:
        # Truncated, not clipped: many equal points at an end of the range would be elite together.
        low, high = (scipy.special.ndtr((end - self._mu) / self._sigma) for end in (0.0, 1.0))
        drawn = self._mu + self._sigma * scipy.special.ndtri(low + (high - low) * self._generator.random(shape))
        return np.clip(drawn, 0.0, 1.0)

    def _move(self, U: np.ndarray, evaluations: Sequence[Evaluation]) -> None:
        usable = [(u, evaluation) for u, evaluation in zip(U, evaluations, strict=True) if evaluation.usable]
        elites = sorted([*self._best, *usable], key=lambda pair: rank_key(pair[1]))[: self._elites]
        self._best = elites[:1]
        X, a = np.array([u for u, _ in elites]), self._smoothing
        self._mu = (1.0 - a) * self._mu + a * X.mean(axis=0)
        self._sigma = np.maximum((1.0 - a) * self._sigma + a * X.std(axis=0), self._sigma_min)


class Mppi(SamplingSolver):
    """Model predictive path integral control: the mean of each batch, weighted by the exponential of its quality.

    With costs c_i = -f(u_i): w_i = exp(-(c_i - min c) / lambda), mu <- sum w_i u_i / sum w_i; sigma stays the same. In
    the paper lambda is in the unit of the cost. Here it is ``temperature`` times the standard deviation of the batch's
    costs, so that one setting serves qualities of any unit. Where a constraint is violated, the costs are in the order
    of Deb's rule; points that failed or were dropped have no weight.

    Args:
        search: See `SamplingSolver`.
        name: See `SamplingSolver`.
        population: See `SamplingSolver`.
        sigma: See `SamplingSolver`; constant.
        temperature: Temperature lambda, in standard deviations of the batch's costs; above 0. Towards 0 only the best
            point counts.

    Williams, G. et al. (2017): Information theoretic MPC for model-based reinforcement learning, ICRA.
    """

    def __init__(
        self,
        search: Search,
        *,
        name: str,
        population: int | None = None,
        sigma: float = 0.2,
        temperature: float = 0.3,
    ) -> None:
        super().__init__(search, name=name, population=population, sigma=sigma)
        if not temperature > 0.0:
            raise SolverError(f"the temperature of {name} is above 0, not {temperature}")
        self._temperature = temperature

    def _move(self, U: np.ndarray, evaluations: Sequence[Evaluation]) -> None:
        weighed = [i for i, evaluation in enumerate(evaluations) if evaluation.usable and evaluation.exact]
        if not weighed:
            return
        c = np.array(costs([evaluations[i] for i in weighed]))
        spread = float(c.std())
        w = np.exp(-(c - c.min()) / (self._temperature * spread)) if spread > 0.0 else np.ones(c.size)
        self._mu = w @ U[weighed] / w.sum()
