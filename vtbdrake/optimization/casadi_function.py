"""Problem (18) as a CasADi function: h(s^0) with derivatives, beside symbolic costs and constraints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor as FuturesExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import casadi
import numpy as np

from vtbdrake.argument_checks import as_number
from vtbdrake.optimization.evaluator import Evaluator, Gradients
from vtbdrake.optimization.records import Outcome, RolloutKey
from vtbdrake.optimization.solvers.solver import Point
from vtbdrake.rollout import Executor, make_executor

if TYPE_CHECKING:
    from vtbdrake.optimization.problem import Problem

CENTRAL, AUTODIFF = "central", "autodiff"

# How far outside its range a parameter may be, as a part of it: interior point methods relax bounds a little.
_SLACK = 1e-6


class ProblemFunction(casadi.Callback):
    """h(s^0) in the user's terms (a cost as a cost), over all conditions, as ``casadi.Function``: (n,) -> scalar.

    Use it as any function, in ``Opti`` or ``nlpsol``, together with symbolic expressions; solvers need
    ``hessian_approximation="limited-memory"``, as there is no second derivative. Keep it alive while they work.

    A point whose simulation fails has the value NaN, from which solvers step back. CasADi's solvers suppress the
    exceptions of a function: call `raise_error` after them, which raises the last one.

    Args:
        problem: A problem with continuous parameters and one quality.
        name: Name of the CasADi function.
        gradient: ``central`` differences, whose points are rolled out side by side, or ``autodiff`` (see `Gradients`).
        step: Step of the differences, as a part of each parameter's range.
        executor, workers: See `Problem.sweep`.

    Raises:
        ValueError: A parameter is not continuous, there are several qualities, or the gradient is unknown or not
            available.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        name: str = "h",
        gradient: str = CENTRAL,
        step: float = 1e-4,
        executor: str | Executor | FuturesExecutor = "auto",
        workers: int | None = None,
    ) -> None:
        super().__init__()
        if gradient not in (CENTRAL, AUTODIFF):
            raise ValueError(f"a gradient is taken by one of {CENTRAL}, {AUTODIFF}, not by {gradient!r}")
        if not 0.0 < as_number("the step", step) <= 0.1:
            raise ValueError(f"the step is a part of each range, in (0, 0.1], not {step}")
        if len(problem.objectives) > 1:
            raise ValueError("a CasADi function has one value, but the problem has several qualities")
        for parameter in problem.parameters:
            if not parameter.is_continuous:
                raise ValueError(f"{parameter.address} is not continuous: it has no derivative")
        self._problem = problem
        self._gradients = Gradients(problem) if gradient == AUTODIFF else None
        self._step = step
        rollouts = 2 * len(problem.parameters) * len(problem.conditions)
        self._executor = make_executor(executor, testbed=problem.testbed, rollouts=rollouts, workers=workers)
        self._owned = self._executor is not executor
        self._outcomes: dict[RolloutKey, Outcome] = {}
        self._evaluator = Evaluator(problem, self._outcomes, self._roll_out)
        self._jacobian: _Jacobian | None = None
        self.error: BaseException | None = None  # the last exception during an evaluation, or None
        self.construct(name, {})

    @property
    def rollouts(self) -> int:
        """Return the number of rollouts so far."""
        return len(self._outcomes)

    def close(self) -> None:
        """Close the executor, unless it is the caller's."""
        if self._owned:
            self._executor.close()

    def raise_error(self) -> None:
        """Raise the last exception during an evaluation, if there was one."""
        if self.error is not None:
            raise self.error

    def value(self, x: np.ndarray) -> float:
        """Return the value at ``x``, shape (n,)."""
        return self._values([self._point(x)])[0]

    def _values(self, points: Sequence[Point]) -> list[float]:
        return [self._evaluator.in_user_terms(evaluation)[0] for evaluation in self._evaluator.evaluate(points)]

    def slope(self, x: np.ndarray) -> np.ndarray:
        """Return the gradient at ``x``, shape (n,)."""
        point = self._point(x)
        if self._gradients is not None:
            return self._problem.objectives[0].sign * np.array(self._gradients.at(point))
        pairs = [self._neighbours(point, i) for i in range(len(point))]
        values = np.array(self._values([neighbour for pair in pairs for neighbour in pair])).reshape(-1, 2)
        widths = np.array([above[i] - below[i] for i, (below, above) in enumerate(pairs)])
        return (values[:, 1] - values[:, 0]) / widths

    def _neighbours(self, point: Point, index: int) -> tuple[Point, Point]:
        parameter = self._problem.parameters[index]
        lower, upper = parameter.ends
        reach = self._step * (upper - lower)
        ends = max(point[index] - reach, lower), min(point[index] + reach, upper)
        return tuple((*point[:index], end, *point[index + 1 :]) for end in ends)  # type: ignore[return-value]

    def _point(self, x: np.ndarray) -> Point:
        entries = []
        for parameter, value in zip(self._problem.parameters, np.ravel(x).tolist(), strict=True):
            lower, upper = parameter.ends
            slack = _SLACK * (upper - lower)
            entries.append(min(max(value, lower), upper) if lower - slack <= value <= upper + slack else value)
        return self._problem.point(entries)

    def _roll_out(self, keys: Sequence[RolloutKey]) -> None:
        points = [self._problem.values(point, condition=condition) for point, condition in keys]
        for index, result in self._executor.run(self._problem.task, points):
            self._outcomes[keys[index]] = Outcome.of(result)

    # -- what CasADi calls

    def get_sparsity_in(self, i: int) -> casadi.Sparsity:
        return casadi.Sparsity.dense(len(self._problem.parameters), 1)

    def eval(self, arg: Sequence[Any]) -> list[Any]:
        with self.kept_error():
            return [self.value(np.array(arg[0]))]

    @contextmanager
    def kept_error(self) -> Iterator[None]:
        """Keep the exception of an evaluation for `raise_error`."""
        try:
            yield
        except BaseException as error:
            self.error = error
            raise

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(
        self, name: str, inames: Sequence[str], onames: Sequence[str], opts: Mapping[str, Any]
    ) -> casadi.Function:
        self._jacobian = _Jacobian(self, name, opts)
        return self._jacobian


class _Jacobian(casadi.Callback):
    """The Jacobian (x, h) -> dh/dx, shape (1, n)."""

    def __init__(self, function: ProblemFunction, name: str, opts: Mapping[str, Any]) -> None:
        super().__init__()
        self._function = function
        self.construct(name, opts)

    def get_n_in(self) -> int:
        return 2

    def get_sparsity_in(self, i: int) -> casadi.Sparsity:
        return self._function.sparsity_in(0) if i == 0 else self._function.sparsity_out(0)

    def get_sparsity_out(self, i: int) -> casadi.Sparsity:
        return casadi.Sparsity.dense(1, self._function.size1_in(0))

    def eval(self, arg: Sequence[Any]) -> list[Any]:
        with self._function.kept_error():
            return [self._function.slope(np.array(arg[0])).reshape(1, -1)]
