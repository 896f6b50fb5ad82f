"""COBYQA: a local search with quadratic models, for curved constraints."""

from __future__ import annotations

import numpy as np

from vtbdrake.optimization.solvers.blocking import BlockingSolver
from vtbdrake.optimization.solvers.solver import Search, SolverError

# The most calls of a search without a budget.
LIMIT = 5_000
# The least number of points that a model interpolates, unless 2 n + 1 are fewer.
LEAST_POINTS = 8
# The largest number of points that a model interpolates, unless n + 2 are more.
MOST_POINTS = 16


class Cobyqa(BlockingSolver):
    """Constrained optimization by quadratic approximations, without derivatives; of the package cobyqa.

    Sequential quadratic programming in a trust region: the objective and every constraint are interpolated by quadratic
    models. COBYLA has linear ones, with which it follows a curved constraint in small steps only. It asks for one point
    at a time, and ends, with success, when the trust region has shrunk to ``tolerance``.

    A model interpolates 1 + 3 n / 2 points, rounded down: at least 8, unless 2 n + 1 are fewer, and at most 16, unless
    n + 2 are more. The package's 2 n + 1, which tell the curvature along each axis, would spend most of a small budget
    on the first model; with n + 2, the fewest that tell some curvature, it creeps in ill-conditioned valleys.

    Args:
        search: Continuous parameters, one objective.
        name: Name in the catalogue.
        radius: The first radius of the trust region, as a part of the ranges.
        tolerance: The last one.

    Ragonneau, T. M. (2022): Model-based derivative-free optimization methods and software, PhD thesis, The Hong Kong
    Polytechnic University.
    """

    plans_for_budget = True

    def __init__(self, search: Search, *, name: str, radius: float = 0.1, tolerance: float = 1e-6) -> None:
        search.require(name, continuous=True, one_objective=True, not_wide=True)
        if not 0.0 < tolerance < radius <= 0.5:
            raise SolverError(f"0 < tolerance < radius <= 0.5 is required, not {tolerance} and {radius}")
        super().__init__(search, name=name)
        self._radius = radius
        self._tolerance = tolerance

    def _solve(self) -> tuple[bool, str]:
        # Imported here because it is slow.
        from cobyqa import minimize
        from scipy.optimize import Bounds, NonlinearConstraint

        size, lower = self.search.size, np.zeros(self.search.size)
        points = max(size + 2, min(2 * size + 1, LEAST_POINTS), min(3 * size // 2 + 1, MOST_POINTS))
        constraint = NonlinearConstraint(self._callback(lambda u: self._at(u)[2]), -np.inf, 0.0)
        result = minimize(
            self._callback(lambda u: self._at(u)[1]),
            self.search.start_unit(),
            bounds=Bounds(lower, lower + 1.0),
            constraints=(constraint,) if self.search.constraints else (),
            options={
                "radius_init": self._radius,
                "radius_final": self._tolerance,
                "maxfev": self.search.budget or LIMIT,
                "nb_points": points,
            },
        )
        return bool(result.success), str(result.message)
