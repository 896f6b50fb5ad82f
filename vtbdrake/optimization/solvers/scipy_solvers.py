"""Solvers of SciPy."""

from __future__ import annotations

import numpy as np

from vtbdrake.optimization.solvers.blocking import BlockingSolver
from vtbdrake.optimization.solvers.search import Search


class DifferentialEvolution(BlockingSolver):
    """Differential evolution: a population whose members move by the differences of others.

    A generation is a batch. Constraints by Lampinen's rule (of two that break them, the one that breaks each less).

    Args:
        search: what is searched: numbers, one objective.
        name: in the catalogue.
        population: points per generation and parameter.
        tolerance: it ends when the standard deviation of the population's values is below this part of their mean.

    Storn, R. and Price, K. (1997), Journal of Global Optimization 11.
    """

    def __init__(self, search: Search, *, name: str, population: int = 15, tolerance: float = 0.01) -> None:
        search.require(name, ordered=True, one_objective=True)
        super().__init__(search, name=name)
        self._population = population
        self._tolerance = tolerance

    def _solve(self) -> tuple[bool, str]:
        # Imported here, since it takes long.
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
        """The costs of the columns of ``X``, shape (n, k)."""
        U = np.ascontiguousarray(X.T)
        self._evaluate(U)
        return np.array([self._at(u)[1] for u in U])

    def _violations(self, X: np.ndarray) -> np.ndarray:
        """The violations of the columns of ``X``, shape (n, k) or one of shape (n,), shape (constraints, k)."""
        U = np.ascontiguousarray(np.atleast_2d(X.T))
        self._evaluate(U)
        return np.array([self._at(u)[2] for u in U]).T
