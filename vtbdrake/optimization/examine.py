"""Runs the rollouts of sweeps and boundaries."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from math import inf

import numpy as np

from vtbdrake.optimization.boundary import Boundary, Candidate, Refinement, find_boundary
from vtbdrake.optimization.outcome import Row
from vtbdrake.optimization.parameter import Parameter
from vtbdrake.optimization.problem import Problem
from vtbdrake.optimization.sweep import Sweep
from vtbdrake.rollout import Executor, RolloutResult, RolloutTask, make_executor
from vtbdrake.rollout.many import run_rollouts


def sweep(
    problem: Problem,
    task: RolloutTask,
    table: np.ndarray,
    *,
    executor: str | Executor,
    workers: int | None,
    progress: bool,
) -> Sweep:
    """A rollout at every row of ``table``, under every condition; see `Problem.sweep`."""
    points = [problem.point(point.tolist()) for point in table]
    rows = [(point, condition) for point in points for condition in range(len(problem.conditions))]
    with _executor(problem, executor, rollouts=len(rows), workers=workers) as chosen:
        results = _run(problem, chosen, task, rows, progress=progress, description="sweep")
    return _table(problem, rows, results)


def boundary(
    problem: Problem,
    *,
    resolution: float,
    coarse: float,
    executor: str | Executor,
    workers: int | None,
    progress: bool,
) -> Boundary:
    """See `Problem.boundary`."""
    if len(problem.parameters) != 1 or problem.task.threshold == inf:
        raise ValueError(
            "a boundary is that of one parameter under a finite threshold, but the problem has "
            f"{len(problem.parameters)} parameters and a threshold of {problem.task.threshold:g}"
        )
    (parameter,) = numeric(problem)
    refinement = Refinement(parameter.lower, parameter.upper, resolution=resolution, coarse=coarse)
    rows: list[Row] = []
    results: list[RolloutResult] = []
    first = len(refinement.start()) * len(problem.conditions)
    with _executor(problem, executor, rollouts=first, workers=workers) as chosen:

        def examine(wanted: Sequence[Candidate]) -> list[bool]:
            new: list[Row] = [((value,), condition) for value, condition in wanted]
            found = _run(problem, chosen, problem.task, new, progress=progress, description="boundary")
            finished = [result for result in found if result is not None]
            if len(finished) < len(found):
                raise KeyboardInterrupt
            rows.extend(new)
            results.extend(finished)
            return [result.failed or result.exceedances.size > 0 for result in finished]

        find_boundary(refinement, len(problem.conditions), examine)
    return _table(problem, rows, results).boundary()


@contextmanager
def _executor(problem: Problem, executor: str | Executor, *, rollouts: int, workers: int | None) -> Iterator[Executor]:
    """The executor that is meant; closed afterwards, unless it is the user's."""
    chosen = make_executor(executor, testbed=problem.testbed, rollouts=rollouts, workers=workers)
    try:
        yield chosen
    finally:
        if chosen is not executor:
            chosen.close()


def _run(
    problem: Problem, executor: Executor, task: RolloutTask, rows: Sequence[Row], *, progress: bool, description: str
) -> list[RolloutResult | None]:
    points = [problem.values(point, condition=condition) for point, condition in rows]
    return run_rollouts(executor, task, points, progress=progress, description=description)


def _table(problem: Problem, rows: Sequence[Row], results: Sequence[RolloutResult | None]) -> Sweep:
    finished = [(*row, result) for row, result in zip(rows, results, strict=True) if result is not None]
    finished.sort(key=lambda row: row[:2])
    return Sweep(
        parameters=numeric(problem),
        units=problem.units,
        conditions=problem.conditions,
        points=np.array([point for point, _, _ in finished], dtype=float).reshape(-1, len(problem.parameters)),
        condition=np.array([condition for _, condition, _ in finished], dtype=int),
        rollouts=tuple(result for _, _, result in finished),
        scenario=problem.scenario.record(),
        complete=len(finished) == len(rows),
    )


def numeric(problem: Problem) -> tuple[Parameter, ...]:
    """The parameters, which are numbers.

    Raises:
        ValueError: one is a choice.
    """
    found = tuple(parameter for parameter in problem.parameters if isinstance(parameter, Parameter))
    if len(found) < len(problem.parameters):
        choices = [parameter.address for parameter in problem.parameters if not isinstance(parameter, Parameter)]
        raise ValueError(f"a sweep goes over numbers, but {choices[0]} is a choice: use problem.study(solver='grid')")
    return found
