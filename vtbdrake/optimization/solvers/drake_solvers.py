"""SNOPT, IPOPT and the algorithms of NLopt, as Drake brings them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydrake.solvers import IpoptSolver, MathematicalProgramResult, NloptSolver, SnoptSolver, SolverInterface

from vtbdrake.optimization.solvers.mathematical_program import GradientProgramSolver, ProgramSolver
from vtbdrake.optimization.solvers.nlopt_algorithms import (
    LIMIT,
    NO_EXCEPTIONS,
    RESULTS,
    SEEDED_BY_CLOCK,
    SEVERAL_PARAMETERS,
    UNTIL_LIMIT,
    WITH_CONSTRAINTS,
)
from vtbdrake.optimization.solvers.search import Search


class Snopt(GradientProgramSolver):
    """SNOPT: sequential quadratic programming; Gill, Murray and Saunders (2005), SIAM Review 47."""

    def _solver(self) -> SolverInterface:
        return SnoptSolver()

    def _options(self) -> dict[str, Any]:
        return {
            "Major optimality tolerance": self._tolerance,
            "Major feasibility tolerance": self._feasibility,
            # It would check our differences against its own.
            "Verify level": -1,
        }

    def _status(self, result: MathematicalProgramResult) -> str:
        info = result.get_solver_details().info
        return f"{result.get_solution_result().name} (EXIT {10 * (info // 10)}, INFO {info})"


class Ipopt(GradientProgramSolver):
    """IPOPT: interior point; Wächter and Biegler (2006), Mathematical Programming 106."""

    def _solver(self) -> SolverInterface:
        return IpoptSolver()

    def _options(self) -> dict[str, Any]:
        return {
            "tol": self._tolerance,
            "acceptable_tol": self._tolerance,
            "constr_viol_tol": self._feasibility,
            "acceptable_constr_viol_tol": self._feasibility,
        }

    def _status(self, result: MathematicalProgramResult) -> str:
        return f"{result.get_solution_result().name} ({result.get_solver_details().ConvertStatusToString()})"


class _Nlopt(ProgramSolver):
    """An algorithm of NLopt, by its name. Those of `NO_EXCEPTIONS` make at most `LIMIT` calls without a budget."""

    def _choose(self) -> None:
        if self.name not in WITH_CONSTRAINTS:
            self.search.require(self.name, no_constraints=True)
        self.search.require(self.name, several=self.name in SEVERAL_PARAMETERS)
        self.local = self.name.startswith("L")
        self._survives_exceptions = self.name not in NO_EXCEPTIONS
        self.reproducible = self.name not in SEEDED_BY_CLOCK

    def _solver(self) -> SolverInterface:
        return NloptSolver()

    def _options(self) -> dict[str, Any]:
        return {
            NloptSolver.AlgorithmName(): self.name,
            NloptSolver.XRelativeToleranceName(): self._tolerance,
            NloptSolver.XAbsoluteToleranceName(): self._tolerance,
            NloptSolver.ConstraintToleranceName(): self._feasibility,
            # 0: no limit. Drake's is 1000, and the budget is counted by us.
            NloptSolver.MaxEvalName(): (self.search.budget or LIMIT) if self.name in NO_EXCEPTIONS else 0,
        }

    def _judge(self, result: MathematicalProgramResult) -> tuple[bool, str]:
        success, message = super()._judge(result)
        return success and self.name not in UNTIL_LIMIT, message

    def _status(self, result: MathematicalProgramResult) -> str:
        status = result.get_solver_details().status
        return f"{result.get_solution_result().name} ({RESULTS.get(status, status)})"


class NloptDerivativeFree(_Nlopt):
    """An algorithm of NLopt that looks at values only; it asks for one point at a time."""

    def __init__(
        self,
        search: Search,
        *,
        name: str,
        tolerance: float = 1e-6,
        feasibility: float = 1e-6,
        solver_options: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(search, name=name, tolerance=tolerance, feasibility=feasibility, solver_options=solver_options)
        self._choose()


class NloptWithDerivatives(GradientProgramSolver, _Nlopt):
    """An algorithm of NLopt that uses derivatives."""

    def __init__(
        self,
        search: Search,
        *,
        name: str,
        gradient: str = "central",
        step: float | None = None,
        tolerance: float = 1e-6,
        feasibility: float = 1e-6,
        solver_options: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(
            search,
            name=name,
            gradient=gradient,
            step=step,
            tolerance=tolerance,
            feasibility=feasibility,
            solver_options=solver_options,
        )
        self._choose()
