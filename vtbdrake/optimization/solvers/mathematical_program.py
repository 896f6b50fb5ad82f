"""What Drake's solvers of a MathematicalProgram share: cost, constraints, derivatives, and when to believe them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.solvers import MathematicalProgram, MathematicalProgramResult, SolverInterface, SolverOptions

from vtbdrake.optimization.solvers.blocking import BlockingSolver, Stopped
from vtbdrake.optimization.solvers.ranking import usable
from vtbdrake.optimization.solvers.search import Search
from vtbdrake.optimization.solvers.solver import SolverError

AUTODIFF = "autodiff"

# Differences: multiples of the step at which neighbours lie, and the weight of each neighbour's value minus that of the
# point, divided by the step. Inside of the range, and where its end leaves no room on one side.
FORMULAS = {
    "forward": (((1.0,), (1.0,)), ((1.0,), (1.0,))),
    "central": (((1.0, -1.0), (0.5, -0.5)), ((1.0, 2.0), (2.0, -0.5))),
}
# Near eps^(1/2) and eps^(1/3), where the errors of rounding and of the formula meet, and wide enough for a simulation.
STEPS = {"forward": 1e-7, "central": 1e-5, AUTODIFF: 0.0}


class ProgramSolver(BlockingSolver):
    """min c(u), g(u) <= 0, 0 <= u <= 1: c the negated value, g the violations, u the place in the unit cube.

    What counts is the best point that was judged, not the x that the solver returns. ``success`` is True only if it
    converged by its own criterion, at a point whose simulation did not fail.

    The constraints are tightened by twice ``feasibility``, to which the solver keeps them: so the optimum that it
    converges to keeps them truly.

    Args:
        search: what is searched; continuous parameters, one objective.
        name: in the catalogue.
        tolerance: to which it converges, in its own sense (optimality of SNOPT and IPOPT, change of x in NLopt).
        feasibility: to which it keeps constraints, in their units.
        solver_options: more options of the solver, by its own names.
    """

    # Whether it looks downhill from its start, and is lost if the simulation fails there.
    local = True
    # Whether an exception in its callback ends it.
    _survives_exceptions = True

    def __init__(
        self,
        search: Search,
        *,
        name: str,
        tolerance: float = 1e-6,
        feasibility: float = 1e-6,
        solver_options: Mapping[str, Any] | None = None,
    ) -> None:
        search.require(name, continuous=True, one_objective=True)
        super().__init__(search, name=name)
        self._tolerance = tolerance
        self._feasibility = feasibility
        self._solver_options = dict(solver_options or {})

    @abstractmethod
    def _solver(self) -> SolverInterface:
        """Drake's solver."""

    @abstractmethod
    def _options(self) -> dict[str, Any]:
        """The options that its tolerances mean."""

    @abstractmethod
    def _status(self, result: MathematicalProgramResult) -> str:
        """How it ended, in its own words."""

    def _prepare(self, u: np.ndarray) -> None:
        """Has all judged that cost and constraints at ``u`` need, shape (n,)."""
        self._evaluate(u[np.newaxis])

    def _derivatives(self, u: np.ndarray) -> np.ndarray | None:
        """d(c, g)/du, shape (1 + constraints, n); None where the method looks at values only."""
        return None

    def _solve(self) -> tuple[bool, str]:
        start = self.search.start_unit()
        if self.local:
            self._prepare(start)
            if not usable(self._at(start)[0]):
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
        return self._judge(solver.Solve(program, start, options))

    def _functions(self, x: np.ndarray) -> np.ndarray:
        """(c, g) at ``x``, shape (1 + constraints,), of numbers or of AutoDiffXd, as ``x`` is."""
        count = 1 + self.search.constraints
        # NLopt calls with AutoDiffXd even where it takes no derivatives, and swallows what is returned otherwise.
        if x.dtype != object:
            _, cost, violations = self._at(np.array(x, dtype=float))
            return np.concatenate([[cost], violations])
        u = np.array(ExtractValue(x), dtype=float).ravel()
        try:
            self._prepare(u)
        except Stopped:
            if self._survives_exceptions:
                raise
            return InitializeAutoDiff(np.zeros(count), np.zeros((count, self.search.size))).ravel()
        _, cost, violations = self._at(u)
        values = np.concatenate([[cost], violations])
        derivatives = self._derivatives(u)
        if derivatives is None:
            return np.array([AutoDiffXd(value) for value in values])
        return InitializeAutoDiff(values, derivatives @ ExtractGradient(x)).ravel()

    def _judge(self, result: MathematicalProgramResult) -> tuple[bool, str]:
        status = f"{self.name}: {self._status(result)}"
        x = np.asarray(result.get_x_val(), dtype=float)
        if not (result.is_success() and np.all(np.isfinite(x))):
            return False, status
        if not usable(self._at(np.clip(x, 0.0, 1.0))[0]):
            return False, f"{status}, but at a point where the simulation fails"
        return True, status


class GradientProgramSolver(ProgramSolver):
    """A solver that uses derivatives.

    Args:
        search: what is searched.
        name: in the catalogue.
        gradient: "central": differences of second order, a point and its 2 n neighbours in one batch; "forward": of
            first order, with n neighbours, half the price, but with a wide step too coarse for a solver to find that it
            has converged; or "autodiff": what `Evaluation.gradient` says (no constraints then).
        step: of the differences, as a part of each parameter's range; left away: 1e-5 (central) or 1e-7 (forward). At
            an end of the range, they are taken inwards. Where the simulation of a neighbour fails, the derivative in
            its direction counts as 0.
        tolerance, feasibility, solver_options: as of every `ProgramSolver`.
    """

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
        if gradient not in (*FORMULAS, AUTODIFF):
            raise SolverError(f"gradient is one of {[*FORMULAS, AUTODIFF]}, not {gradient!r}")
        if gradient == AUTODIFF and search.constraints:
            raise SolverError(f"constraints need gradient='central': {AUTODIFF} gives the objective's only")
        if step is not None and (gradient == AUTODIFF or not 0.0 < step <= 0.25):
            raise SolverError(f"step is of differences, a part of the range in (0, 0.25], not {step} of {gradient}")
        super().__init__(search, name=name, tolerance=tolerance, feasibility=feasibility, solver_options=solver_options)
        self.wants_gradient = gradient == AUTODIFF
        self._gradient = gradient
        self._step = STEPS[gradient] if step is None else step

    def _stencil(self, u: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray]:
        """The neighbours of ``u`` along coordinate i, shape (k, n), and the weights of what they differ, (k,)."""
        inside, at_end = FORMULAS[self._gradient]
        room = self._step <= u[i] <= 1.0 - self._step
        offsets, weights = (np.array(numbers) for numbers in (inside if room else at_end))
        step = self._step if u[i] < 0.5 or room else -self._step
        neighbours = np.tile(u, (len(offsets), 1))
        neighbours[:, i] += step * offsets
        return neighbours, weights / step

    def _prepare(self, u: np.ndarray) -> None:
        stencils = () if self.wants_gradient else (self._stencil(u, i)[0] for i in range(self.search.size))
        self._evaluate(np.vstack([u, *stencils]))

    def _derivatives(self, u: np.ndarray) -> np.ndarray:
        evaluation, cost, violations = self._at(u)
        derivatives = np.zeros((1 + len(violations), self.search.size))
        if not usable(evaluation):
            return derivatives
        if self.wants_gradient:
            if evaluation.gradient is None:
                raise SolverError(f"{self.name} was told of no gradient; choose gradient='central'")
            derivatives[0] = -np.array(evaluation.gradient) * self.search.slope(evaluation.point)
            return derivatives
        values = np.concatenate([[cost], violations])
        for i in range(self.search.size):
            neighbours, weights = self._stencil(u, i)
            judged = [self._at(neighbour) for neighbour in neighbours]
            if all(usable(evaluation) for evaluation, _, _ in judged):
                beside = np.array([np.concatenate([[cost], violations]) for _, cost, violations in judged])
                derivatives[:, i] = weights @ (beside - values)
        return derivatives
