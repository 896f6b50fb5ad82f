"""COBYQA: a local search with quadratic models, for curved constraints."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np

from vtbdrake.optimization.solvers.blocking import BlockingSolver
from vtbdrake.optimization.solvers.solver import Search, SolverError

# The most calls of a search without a budget.
LIMIT = 5_000


class Cobyqa(BlockingSolver):
    """Constrained optimization by quadratic approximations, without derivatives; of SciPy.

    Sequential quadratic programming in a trust region: the objective and every constraint are interpolated by quadratic
    models. COBYLA has linear ones, with which it follows a curved constraint in small steps only. It asks for one point
    at a time, and ends, with success, when the trust region has shrunk to ``tolerance``.

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
        from scipy.optimize import NonlinearConstraint, minimize

        _run_side_by_side()
        constraint = NonlinearConstraint(self._callback(lambda u: self._at(u)[2]), -np.inf, 0.0)
        result = minimize(
            self._callback(lambda u: self._at(u)[1]),
            self.search.start_unit(),
            method="COBYQA",
            bounds=[(0.0, 1.0)] * self.search.size,
            constraints=(constraint,) if self.search.constraints else (),
            options={
                "initial_tr_radius": self._radius,
                "final_tr_radius": self._tolerance,
                "maxfev": self.search.budget or LIMIT,
            },
        )
        return bool(result.success), str(result.message)


def _run_side_by_side() -> None:
    """Replace the lock that SciPy 1.17 holds during a whole search: a second one, in another thread, would never begin.

    The algorithm shares no state between calls, and newer releases have no lock.
    """
    from scipy.optimize import _cobyqa_py

    if hasattr(_cobyqa_py, "COBYQA_LOCK"):
        _cobyqa_py.COBYQA_LOCK = nullcontext()
