"""What a Gaussian process makes of the trials of a study, over two of its parameters."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from vtbdrake.optimization import Study, Trial
from vtbdrake.optimization.parameter import Choice, Dimension
from vtbdrake.optimization.solvers.bayesian import Bayesian
from vtbdrake.optimization.solvers.solver import Evaluation, Search
from vtbdrake.web.study_feed import place

# Cells along each axis, and points to which the model is fitted at most, of which so many are the best ones.
_CELLS, _POINTS, _BEST = 24, 160, 40
# What computes it gives way to rollouts.
_NICENESS = 10


class Surrogate:
    """The mean of the model with which the Bayesian solver searches, as a grid over two parameters.

    The model is fitted to the best trials, and to a random part of the others. The parameters that are not shown have
    the values of a given point.
    """

    def __init__(self, study: Study) -> None:
        self._study, self._signs = study, np.array(study.signs)
        self._constraints = len(study.record["problem"]["constraints"])
        self._thread = ThreadPoolExecutor(1, "vtbdrake model", initializer=_give_way)

    def close(self) -> None:
        """End the computation."""
        self._thread.shutdown()

    def grid(self, trials: Sequence[Trial], x: str, y: str, *, quality: int, at: Trial) -> dict[str, Any]:
        """Return the grid: ``mean``, ``x``, ``y`` and ``seconds``.

        ``mean`` has rows over y of columns over x; it is None if nothing is known. ``x`` and ``y`` are the centres of
        the cells in the parameters' units, of a choice the numbers of its options. ``seconds`` is the CPU time.

        Args:
            trials: All trials so far.
            x: The address of the horizontal parameter.
            y: That of the vertical one, another.
            quality: The number of the quality.
            at: The point whose values the other parameters have.
        """
        return self._thread.submit(self._grid, trials, x, y, quality=quality, at=at).result()

    def _grid(self, trials: Sequence[Trial], x: str, y: str, *, quality: int, at: Trial) -> dict[str, Any]:
        begin = time.thread_time()
        parameters = self._study.parameters
        search = Search(parameters, objectives=len(self._signs), constraints=self._constraints)
        solver = Bayesian(search, name="bayesian", memory=_POINTS)
        solver.tell([self._evaluation(trial) for trial in self._selected(trials)])
        addresses = [parameter.address for parameter in parameters]
        columns, rows = (parameters[addresses.index(address)] for address in (x, y))
        u, v = _centres(columns), _centres(rows)
        units = np.tile(search.unit(at.point), (len(u) * len(v), 1))
        units[:, addresses.index(x)] = np.tile(u, len(v))
        units[:, addresses.index(y)] = np.repeat(v, len(u))
        mean = (self._signs * solver.mean(units))[:, quality].reshape(len(v), len(u))
        return {
            "x": [place(columns, columns.from_unit(centre)) for centre in u],
            "y": [place(rows, rows.from_unit(centre)) for centre in v],
            "mean": mean.tolist() if np.isfinite(mean).all() else None,
            "seconds": time.thread_time() - begin,
        }

    def _selected(self, trials: Sequence[Trial]) -> list[Trial]:
        exact = [trial for trial in trials if trial.exact]
        if len(exact) <= _POINTS:
            return exact
        order = sorted(exact, key=lambda trial: (not trial.counts, -self._signs[0] * trial.value))
        rest = np.random.default_rng(0).choice(len(exact) - _BEST, _POINTS - _BEST, replace=False)
        return [*order[:_BEST], *(order[_BEST + k] for k in rest)]

    def _evaluation(self, trial: Trial) -> Evaluation:
        values = tuple(float(value) for value in self._signs * np.array(trial.values))
        return Evaluation(trial.point, values, trial.violations)


def _give_way() -> None:
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)


def _centres(parameter: Dimension) -> np.ndarray:
    if isinstance(parameter, Choice):
        count = len(parameter.options)
    else:
        count = min(_CELLS, int(parameter.upper - parameter.lower) + 1) if parameter.integer else _CELLS
    return (np.arange(count) + 0.5) / count
