"""SNOPT, IPOPT and eight algorithms of NLopt, as Drake provides them.

NLopt's names: the first letter says global or local, the second whether the algorithm uses derivatives (D) or not (N).
Drake lists more, which are not offered because

* they cannot be repeated, as Drake cannot seed NLopt's random numbers: GN_CRS2_LM, GN_DIRECT_L_RAND (and
  ..._RAND_NOSCAL), GN_ESCH, GN_ISRES, GN_MLSL, GD_MLSL, GD_STOGO_RAND, LN_PRAXIS;
* they do not survive an exception in their callback, by which a solver is closed: GD_STOGO, LN_NEWUOA (LN_BOBYQA is its
  successor); or compute for ever without a call of the function: LN_NEWUOA_BOUND; or crash: GN_ORIG_DIRECT(_L);
* they are another one in the unit cube and without equality constraints: GN_DIRECT_NOSCAL and GN_DIRECT_L_NOSCAL
  (GN_DIRECT_L), LN_AUGLAG_EQ (LN_COBYLA), LD_AUGLAG_EQ (LD_MMA); or that one with slower constraints: LN_AUGLAG,
  LD_AUGLAG;
* they report success far from the optimum under a linear constraint: LD_MMA (LD_CCSAQ is its successor);
* they end at once with more than ten parameters: GN_AGS;
* they are hardly ever better than the others on the functions of `benchmarks/auto_regret.py`: GN_MLSL_LDS, GD_MLSL_LDS;
* Drake cannot run them: Luksan's (LD_LBFGS, LD_VAR1, LD_VAR2, LD_TNEWTON...), which it omits, and those that
  need a second algorithm inside (AUGLAG, AUGLAG_EQ, G_MLSL, G_MLSL_LDS), which it cannot name.

https://nlopt.readthedocs.io/en/latest/NLopt_Algorithms/
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.solvers import (
    IpoptSolver,
    MathematicalProgram,
    MathematicalProgramResult,
    NloptSolver,
    SnoptSolver,
    SolverInterface,
    SolverOptions,
)

from vtbdrake.optimization.solvers.blocking import BlockingSolver
from vtbdrake.optimization.solvers.solver import Search, SolverError

# NLopt's algorithms: whether each takes constraints.
ALGORITHMS = {
    "GN_DIRECT": False,
    "GN_DIRECT_L": False,
    "LN_BOBYQA": False,
    "LN_COBYLA": True,
    "LN_NELDERMEAD": False,
    "LN_SBPLX": False,
    "LD_CCSAQ": True,
    "LD_SLSQP": True,
}

# The names of NLopt's return codes.
RESULTS = {
    1: "SUCCESS",
    2: "STOPVAL_REACHED",
    3: "FTOL_REACHED",
    4: "XTOL_REACHED",
    5: "MAXEVAL_REACHED",
    6: "MAXTIME_REACHED",
    0: "NO RESULT",
    -1: "FAILURE",
    -2: "INVALID_ARGS",
    -3: "OUT_OF_MEMORY",
    -4: "ROUNDOFF_LIMITED",
    -5: "FORCED_STOP",
}

AUTODIFF = "autodiff"

# Differences: multiples of the step at which neighbours lie, and the weight of each neighbour's value minus the
# point's, divided by the step; first inside the range, then where its end leaves no room on one side.
FORMULAS = {
    "forward": (((1.0,), (1.0,)), ((1.0,), (1.0,))),
    "central": (((1.0, -1.0), (0.5, -0.5)), ((1.0, 2.0), (2.0, -0.5))),
}
# Near eps^(1/2) and eps^(1/3), where rounding error and truncation error are equal, and wide enough for a simulation.
STEPS = {"forward": 1e-7, "central": 1e-5, AUTODIFF: 0.0}


class ProgramSolver(BlockingSolver):
    """A solver of min c(u), g(u) <= 0, 0 <= u <= 1: c the negated value, g the violations, u in the unit cube.

    The result is the best point evaluated, not the x that the solver returns. ``success`` is True only if the solver
    converged by its own criterion, at a point whose simulation did not fail.

    The constraints are tightened by twice ``feasibility``, the tolerance to which the solver keeps them, so that the
    optimum keeps them exactly.

    Args:
        search: Continuous parameters, one objective.
        name: Name in the catalogue.
        gradient: ``central`` differences of second order (the default), a point and its 2 n neighbours in one batch;
            ``forward`` differences of first order, n neighbours, with a step that is often too coarse to detect
            convergence; or ``autodiff``: `Evaluation.gradient`, without constraints. None for derivative-free methods.
        step: Step of the differences, as a part of each parameter's range; by default 1e-5 (central) or 1e-7 (forward).
            At an end of the range they are taken inwards. Where a neighbour's simulation fails, the derivative in its
            direction counts as 0.
        tolerance: Tolerance of convergence (optimality in SNOPT and IPOPT, change of x in NLopt).
        feasibility: Tolerance of the constraints, in their units.
        solver_options: Further options of the solver, by its own names.
    """

    def __init__(
        self,
        search: Search,
        *,
        name: str,
        gradient: str | None = None,
        step: float | None = None,
        tolerance: float = 1e-6,
        feasibility: float = 1e-6,
        solver_options: Mapping[str, Any] | None = None,
    ) -> None:
        self._uses_derivatives = name not in ALGORITHMS or name[1] == "D"
        if not self._uses_derivatives and (gradient is not None or step is not None):
            option = "step" if gradient is None else "gradient"
            raise SolverError(f"{name} has no option {option!r}: it takes no derivatives")
        gradient = "central" if gradient is None else gradient
        if gradient not in (*FORMULAS, AUTODIFF):
            raise SolverError(f"gradient is one of {[*FORMULAS, AUTODIFF]}, not {gradient!r}")
        if gradient == AUTODIFF and search.constraints:
            raise SolverError(f"constraints need gradient='central': {AUTODIFF} gives the objective's only")
        if step is not None and (gradient == AUTODIFF or not 0.0 < step <= 0.25):
            raise SolverError(f"step is of differences, a part of the range in (0, 0.25], not {step} of {gradient}")
        no_constraints = not ALGORITHMS.get(name, True)
        search.require(name, continuous=True, one_objective=True, not_wide=True, no_constraints=no_constraints)
        super().__init__(search, name=name)
        self.wants_gradient = gradient == AUTODIFF
        self._gradient = gradient
        self._step = STEPS[gradient] if step is None else step
        self._tolerance = tolerance
        self._feasibility = feasibility
        self._solver_options = dict(solver_options or {})

    @abstractmethod
    def _solver(self) -> SolverInterface:
        """Return Drake's solver."""

    @abstractmethod
    def _options(self) -> dict[str, Any]:
        """Return the solver's options for the tolerances."""

    @abstractmethod
    def _status(self, result: MathematicalProgramResult) -> str:
        """Return the end of the solver, in its own words."""

    def _solve(self) -> tuple[bool, str]:
        start = self.search.start_unit()
        # A local method descends from its start, and cannot go on if the simulation fails there.
        if not self.name.startswith("G"):
            self._prepare(start)
            if not self._at(start)[0].usable:
                return False, f"the simulation failed at the start {self.search.point(start)}; give another start"
        program = MathematicalProgram()
        u = program.NewContinuousVariables(self.search.size, "u")
        program.AddBoundingBoxConstraint(0.0, 1.0, u)
        program.AddCost(self._callback(lambda x: self._functions(x)[0]), vars=u)
        count = self.search.constraints
        if count:
            program.AddConstraint(
                self._callback(lambda x: self._functions(x)[1:]),
                lb=np.full(count, -np.inf),
                ub=np.full(count, -2.0 * self._feasibility),
                vars=u,
            )
        solver = self._solver()
        options = SolverOptions()
        for key, value in {**self._options(), **self._solver_options}.items():
            options.SetOption(solver.solver_id(), key, value)
        result = solver.Solve(program, start, options)
        status = f"{self.name}: {self._status(result)}"
        x = np.asarray(result.get_x_val(), dtype=float)
        if not (result.is_success() and np.all(np.isfinite(x))):
            return False, status
        if not self._at(np.clip(x, 0.0, 1.0))[0].usable:
            return False, f"{status}, but at a point where the simulation fails"
        return True, status

    def _functions(self, x: np.ndarray) -> np.ndarray:
        """Return (c, g) at ``x``, shape (1 + constraints,): numbers, or AutoDiffXd if ``x`` is of AutoDiffXd."""
        # NLopt calls with AutoDiffXd even where it takes no derivatives, and ignores what is returned otherwise.
        if x.dtype != object:
            _, cost, violations = self._at(np.array(x, dtype=float))
            return np.concatenate([[cost], violations])
        u = np.array(ExtractValue(x), dtype=float).ravel()
        self._prepare(u)
        _, cost, violations = self._at(u)
        values = np.concatenate([[cost], violations])
        if not self._uses_derivatives:
            return np.array([AutoDiffXd(value) for value in values])
        return InitializeAutoDiff(values, self._derivatives(u) @ ExtractGradient(x)).ravel()

    def _prepare(self, u: np.ndarray) -> None:
        """Have all points evaluated that functions and derivatives at ``u``, shape (n,), need."""
        differences = self._uses_derivatives and not self.wants_gradient
        stencils = (self._stencil(u, i)[0] for i in range(self.search.size)) if differences else ()
        self._evaluate(np.vstack([u, *stencils]))

    def _stencil(self, u: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the neighbours of ``u`` along coordinate i, shape (k, n), and the weights of their values, (k,)."""
        inside, at_end = FORMULAS[self._gradient]
        room = self._step <= u[i] <= 1.0 - self._step
        offsets, weights = (np.array(numbers) for numbers in (inside if room else at_end))
        step = self._step if u[i] < 0.5 or room else -self._step
        neighbours = np.tile(u, (len(offsets), 1))
        neighbours[:, i] += step * offsets
        return neighbours, weights / step

    def _derivatives(self, u: np.ndarray) -> np.ndarray:
        """Return d(c, g)/du, shape (1 + constraints, n)."""
        evaluation, cost, violations = self._at(u)
        derivatives = np.zeros((1 + len(violations), self.search.size))
        if not evaluation.usable:
            return derivatives
        if self.wants_gradient:
            if evaluation.gradient is None:
                raise SolverError(f"{self.name} needs the gradient of each evaluation; choose gradient='central'")
            derivatives[0] = -np.array(evaluation.gradient) * self.search.slope(evaluation.point)
            return derivatives
        values = np.concatenate([[cost], violations])
        for i in range(self.search.size):
            neighbours, weights = self._stencil(u, i)
            evaluated = [self._at(neighbour) for neighbour in neighbours]
            if all(evaluation.usable for evaluation, _, _ in evaluated):
                beside = np.array([np.concatenate([[cost], violations]) for _, cost, violations in evaluated])
                derivatives[:, i] = weights @ (beside - values)
        return derivatives


class Snopt(ProgramSolver):
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


class Ipopt(ProgramSolver):
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


class Nlopt(ProgramSolver):
    """An algorithm of NLopt, by its name; derivative-free ones ask for one point at a time. See `ProgramSolver`."""

    def _solver(self) -> SolverInterface:
        return NloptSolver()

    def _options(self) -> dict[str, Any]:
        return {
            NloptSolver.AlgorithmName(): self.name,
            NloptSolver.XRelativeToleranceName(): self._tolerance,
            NloptSolver.XAbsoluteToleranceName(): self._tolerance,
            NloptSolver.ConstraintToleranceName(): self._feasibility,
            # 0: no limit. Drake's is 1000, and the budget is counted by us.
            NloptSolver.MaxEvalName(): 0,
        }

    def _status(self, result: MathematicalProgramResult) -> str:
        status = result.get_solver_details().status
        return f"{result.get_solution_result().name} ({RESULTS.get(status, status)})"
