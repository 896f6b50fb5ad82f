"""The campaign of application O3: screening, race, judgement and sensitivities, on captures that are kept."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array
from vtbdrake_diagrams.satellite.studies.light_captures import Capture, KeptCaptures, Key
from vtbdrake_diagrams.satellite.studies.light_cases import (
    BY_HAND,
    CANDIDATES,
    JUDGED_ON,
    RACED_ON,
    SCREENED_ON,
    TODAY,
    VARIED,
    VARIED_ON,
    Case,
    Values,
    lighting_problem,
    text,
)

FINALISTS = 2
"""The number of candidates of the screening that race with today's constants."""
RACE_BUDGET = 3 * len(RACED_ON)
"""The number of captures that the race may take, the screening's included."""


@dataclass(frozen=True)
class Screening:
    """The result of the screening.

    Attributes:
        candidates: The candidates, first those `BY_HAND`.
        costs: The mean time in s and the mean error in m of each, shape (n, 2).
        front: The candidates that no other one beats in both.
    """

    candidates: tuple[Values, ...]
    costs: Array
    front: tuple[Values, ...]

    @property
    def finalists(self) -> tuple[Values, ...]:
        """Return the fastest candidates but today's constants; of equally fast ones the more accurate."""
        order = np.lexsort((self.costs[:, 1], self.costs[:, 0]))
        return tuple(self.candidates[k] for k in order if self.candidates[k] != TODAY)[:FINALISTS]


@dataclass(frozen=True)
class Race:
    """The result of the race.

    Attributes:
        candidates: The candidates.
        costs: The mean of the worst quarter of each, in s, shape (n,); of one that was dropped a lower bound.
        exact: Whether a candidate was tried in all cases, shape (n,).
        choice: The winner.
    """

    candidates: tuple[Values, ...]
    costs: Array
    exact: NDArray[np.bool_]
    choice: Values


class Campaign:
    """The four stages, on captures that are kept.

    Args:
        captures: The captures so far; new ones are added.
        keep: Is called after each new capture; None: nothing is simulated.
        echo: Gets a line for each new capture.
    """

    def __init__(
        self,
        captures: dict[Key, Capture],
        *,
        keep: Callable[[], Any] | None = None,
        echo: Callable[[str], Any] = lambda line: None,
    ) -> None:
        def keep_newest() -> None:
            (values, case), capture = list(captures.items())[-1]
            echo(f"{len(captures)}: {text(values)}; {case.light}, start {case.seed}: {capture}")
            if keep is not None:
                keep()

        self._executor = KeptCaptures(captures, None if keep is None else keep_newest)

    def screen(self, candidates: int = CANDIDATES) -> Screening:
        """Try the candidates of the design, and those `BY_HAND`, ``candidates`` together."""
        problem = lighting_problem(SCREENED_ON, two_qualities=True, risk="mean")
        with problem.study(solver="sobol") as study:
            study.add(*BY_HAND.values())
            study.run(rollouts=candidates * len(SCREENED_ON), executor=self._executor, progress=False)
            trials = study.trials
            front = tuple(trial.point for trial in study.pareto())
        return Screening(tuple(t.point for t in trials), np.array([t.values for t in trials]), front)

    def race(self, screening: Screening) -> Race:
        """Race the constants of today, the best of the screening, and what the budget allows of another design."""
        with lighting_problem(RACED_ON).study(solver="sobol", seed=1) as study:
            study.add(TODAY, *screening.finalists)
            study.run(rollouts=RACE_BUDGET, racing=True, executor=self._executor, progress=False)
            trials, choice = study.trials, study.best.point
        costs, exact = np.array([t.value for t in trials]), np.array([t.exact for t in trials])
        return Race(tuple(t.point for t in trials), costs, exact, choice)

    def judge(self, choice: Values) -> None:
        """Simulate the captures of the judgement, with today's constants and the choice in turn."""
        self._simulate(dict.fromkeys((TODAY, choice)), JUDGED_ON)

    def vary(self) -> None:
        """Simulate the captures of the sensitivities."""
        self._simulate(VARIED, VARIED_ON)

    def _simulate(self, candidates: Iterable[Values], on: Sequence[Case]) -> None:
        problem = lighting_problem(on)
        points = [problem.values(values, condition=k) for k in range(len(on)) for values in candidates]
        for _ in self._executor.run(problem.task, points):
            pass
