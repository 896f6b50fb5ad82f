"""Runs the rollouts of sweeps and boundaries."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np

from vtbdrake.optimization.boundary import (
    Boundary,
    Candidate,
    Chance,
    Refinement,
    boundary_of,
    find_boundary,
    repeat_around,
    why_never_unsafe,
)
from vtbdrake.optimization.parameter import Parameter
from vtbdrake.optimization.problem import Problem
from vtbdrake.optimization.study_file import RolloutKey
from vtbdrake.optimization.sweep import Sweep
from vtbdrake.rollout import Executor, RolloutResult, RolloutTask, make_executor
from vtbdrake.rollout.arguments import as_number, as_whole
from vtbdrake.rollout.executor import run_rollouts

# Of each value close to a boundary, under each condition.
_REPEATS = 5


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
        results = _run(problem, chosen, task, rows, progress=progress, name="sweep")
    return _table(problem, rows, results)


def boundary(
    problem: Problem,
    *,
    resolution: float,
    coarse: float,
    repeats: int | None,
    jitter: float,
    executor: str | Executor,
    workers: int | None,
    progress: bool,
) -> Boundary:
    """See `Problem.boundary`."""
    if len(problem.parameters) != 1:
        raise ValueError(f"a boundary is that of one parameter, but the problem has {len(problem.parameters)}")
    (parameter,) = numeric(problem)
    reason = why_never_unsafe(
        finite_threshold=problem.task.threshold is not None,
        minimize=[quality.minimize for quality in problem.objectives],
        constraints=len(problem.constraints),
    )
    if reason:
        raise ValueError(reason)
    refinement = Refinement(parameter, resolution=resolution, coarse=coarse)
    repeats, jitter = _checked_jitter(parameter, repeats, jitter)
    first = len(refinement.start()) * len(problem.conditions)
    with _executor(problem, executor, rollouts=first, workers=workers) as chosen:
        search = _Search(problem, refinement, chosen, progress=progress)
        outcomes = find_boundary(refinement, len(problem.conditions), search.examine)
        if repeats:
            unsafe = [index for found in outcomes for index, bad in found.items() if bad]
            count = partial(search.repeat, repeats=repeats, jitter=jitter)
            repeat_around(min(unsafe, default=refinement.last + 1), refinement.last, count)
    return search.boundary()


def _checked_jitter(parameter: Parameter, repeats: int | None, jitter: float) -> tuple[int, float]:
    if repeats is None:
        repeats = 0 if parameter.integer or parameter.is_field else _REPEATS
    repeats, jitter = as_whole("the number of repeats", repeats), as_number("the jitter", jitter)
    if repeats < 0 or not 0.0 < jitter <= 0.5:
        raise ValueError(f"it takes repeats >= 0 and 0 < jitter <= 0.5, not {repeats} and {jitter:g}")
    if repeats and parameter.integer:
        raise ValueError(f"{parameter.address} is an integer, which cannot be jittered: leave repeats out")
    return repeats, jitter


class _Search:
    """The rollouts of a search for a boundary: one at each value, and repeats with jitter close to the boundary."""

    def __init__(self, problem: Problem, refinement: Refinement, executor: Executor, *, progress: bool) -> None:
        self._problem = problem
        self._refinement = refinement
        self._executor = executor
        self._progress = progress
        self._rows: list[RolloutKey] = []
        self._results: list[RolloutResult] = []
        self._repeated_rows: list[RolloutKey] = []
        self._repeated_results: list[RolloutResult] = []
        # Candidate -> (rollouts, unsafe ones); first of those without jitter.
        self._counts: dict[Candidate, tuple[int, int]] = {}
        self._repeated: set[Candidate] = set()

    def examine(self, wanted: Sequence[Candidate]) -> list[bool]:
        """One rollout for each candidate; whether it was unsafe."""
        rows: list[RolloutKey] = [((self._refinement.value(index),), condition) for index, condition in wanted]
        results = self._roll(rows)
        self._rows += rows
        self._results += results
        unsafe = self._table(rows, results).unsafe.tolist()
        self._counts.update({candidate: (1, int(bad)) for candidate, bad in zip(wanted, unsafe, strict=True)})
        return unsafe

    def repeat(self, indices: Sequence[int], *, repeats: int, jitter: float) -> dict[int, list[float]]:
        """Repeats values under all conditions; index -> the share of unsafe rollouts under each condition."""
        conditions = range(len(self._problem.conditions))
        wanted = [(index, condition) for index in indices for condition in conditions]
        new = [candidate for candidate in wanted if candidate not in self._counts]
        if new:
            self.examine(new)
        rows: list[RolloutKey] = [
            ((value,), candidate[1]) for candidate in wanted for value in self._jittered(candidate, repeats, jitter)
        ]
        results = self._roll(rows)
        self._repeated_rows += rows
        self._repeated_results += results
        unsafe = self._table(rows, results).unsafe.reshape(-1, repeats).sum(axis=1)
        for candidate, more in zip(wanted, unsafe.tolist(), strict=True):
            rollouts, bad = self._counts[candidate]
            self._counts[candidate] = rollouts + repeats, bad + more
        self._repeated.update(wanted)
        return {index: [self._share(index, condition) for condition in conditions] for index in indices}

    def _share(self, index: int, condition: int) -> float:
        rollouts, unsafe = self._counts[index, condition]
        return unsafe / rollouts

    def _jittered(self, candidate: Candidate, repeats: int, jitter: float) -> list[float]:
        """Values beside that of a candidate: the same ones in every search."""
        parameter = self._refinement.parameter
        u = parameter.to_unit(self._refinement.value(candidate[0]))
        moved = np.abs(u + np.random.default_rng(candidate).uniform(-jitter, jitter, repeats))
        # What would leave the range is reflected at its end.
        return [float(parameter.from_unit(1.0 - abs(1.0 - v))) for v in moved.tolist()]

    def _roll(self, rows: Sequence[RolloutKey]) -> list[RolloutResult]:
        found = _run(self._problem, self._executor, self._problem.task, rows, progress=self._progress, name="boundary")
        finished = [result for result in found if result is not None]
        if len(finished) < len(found):
            raise KeyboardInterrupt
        return finished

    def _table(self, rows: Sequence[RolloutKey], results: Sequence[RolloutResult]) -> Sweep:
        return _table(self._problem, rows, results)

    def boundary(self) -> Boundary:
        """What the rollouts so far say."""
        value = self._refinement.value
        chances = [Chance(value(i), c, *self._counts[i, c]) for i, c in self._repeated]
        repeated = self._sorted(self._repeated_rows, self._repeated_results) if self._repeated else None
        return boundary_of(self._sorted(self._rows, self._results), chances, repeated)

    def _sorted(self, rows: Sequence[RolloutKey], results: Sequence[RolloutResult]) -> Sweep:
        order = sorted(range(len(rows)), key=lambda k: rows[k])
        return self._table([rows[k] for k in order], [results[k] for k in order])


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
    problem: Problem,
    executor: Executor,
    task: RolloutTask,
    rows: Sequence[RolloutKey],
    *,
    progress: bool,
    name: str,
) -> list[RolloutResult | None]:
    points = [problem.values(point, condition=condition) for point, condition in rows]
    return run_rollouts(executor, task, points, progress=progress, description=name)


def _table(problem: Problem, rows: Sequence[RolloutKey], results: Sequence[RolloutResult | None]) -> Sweep:
    finished = [(*row, result) for row, result in zip(rows, results, strict=True) if result is not None]
    return Sweep(
        parameters=numeric(problem),
        units=problem.units,
        conditions=problem.conditions,
        points=np.array([point for point, _, _ in finished], dtype=float).reshape(-1, len(problem.parameters)),
        condition=np.array([condition for _, condition, _ in finished], dtype=int),
        rollouts=tuple(result for _, _, result in finished),
        scenario=problem.scenario.record(),
        complete=len(finished) == len(rows),
        minimize=tuple(quality.minimize for quality in problem.objectives),
        constraints=tuple(constraint.name for constraint in problem.constraints),
        risk=problem.risk,
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
