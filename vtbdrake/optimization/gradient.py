"""The gradient of h by AutoDiff, for solvers that want it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vtbdrake.optimization.problem import Problem
from vtbdrake.optimization.solvers.solver import Evaluation, Point, SolverError
from vtbdrake.rollout.derivative import DerivativeRunner
from vtbdrake.rollout.runner import split

# Of a quality, when what it does to the risk is measured.
_STEP = 1e-7


class Gradients:
    """Derivatives of a problem's first quality, over all conditions, by its parameters.

    It takes one simulation with AutoDiffXd under each condition, whatever the number of parameters.

    Raises:
        SolverError: a parameter is not continuous, or is a field of the scenario, which takes another diagram.
        DerivativeError: the testbed does not convert to AutoDiffXd, or its integrator controls its error.
    """

    def __init__(self, problem: Problem) -> None:
        for parameter in problem.parameters:
            if parameter.is_field or not parameter.is_continuous:
                raise SolverError(f"there is no derivative by {parameter.address}: use gradient='central'")
        self._problem = problem
        self._addresses = [parameter.address for parameter in problem.parameters]
        placed = [problem.placed(problem.task, condition) for condition in problem.conditions]
        # To convert a testbed takes longer than to simulate it: most conditions share one.
        distinct = {id(testbed): (task, testbed) for task, testbed in placed}
        runners = {key: DerivativeRunner(*pair) for key, pair in distinct.items()}
        self._runners = [runners[id(testbed)] for _, testbed in placed]

    def at(self, point: Point) -> tuple[float, ...]:
        """The gradient of the value that a solver is told, larger being better, shape (n,)."""
        problem = self._problem
        sign = -1.0 if problem.objectives[0].minimize else 1.0
        values, slopes = [], []
        for condition, runner in enumerate(self._runners):
            parameters = split(problem.values(point, condition=condition))[1]
            value, slope = runner.run(parameters, self._addresses)
            values.append(sign * value)
            slopes.append(sign * slope)
        h = np.array(values)
        base = problem.risk(h)
        weights = [(problem.risk(h + _STEP * unit) - base) / _STEP for unit in np.eye(h.size)]
        return tuple((np.array(weights) @ np.array(slopes)).tolist())

    def fill(self, evaluation: Evaluation, known: dict[Point, tuple[float, ...]]) -> Evaluation:
        """The evaluation with its gradient; what is computed goes into ``known``."""
        if evaluation.failed:
            return evaluation
        if evaluation.point not in known:
            known[evaluation.point] = self.at(evaluation.point)
        return replace(evaluation, gradient=known[evaluation.point])
