"""What is computed from the trials of a study for its page: a Gaussian process, and importances of parameters."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from vtbdrake.common.argument_checks import counted
from vtbdrake.optimization import Study, Trial
from vtbdrake.optimization.importance import importances_of
from vtbdrake.optimization.parameter import Choice, Dimension
from vtbdrake.optimization.solvers.bayesian import Bayesian
from vtbdrake.optimization.solvers.solver import Evaluation, Search
from vtbdrake.web.study.study_feed import place

# Cells along each axis.
_CELLS = 24
# Largest number of points to which the model is fitted.
_POINTS = 160
# Number of the best points among them.
_BEST = 40
# What computes it gives way to rollouts.
_NICENESS = 10


class Surrogate:
    """The mean of the model with which the Bayesian solver searches, as a grid over two parameters; and importances.

    The model is fitted to the best trials, and to a random part of the others. The parameters that are not shown have
    the values of a given point. It needs as many trials as the solver has before its first model.
    """

    def __init__(self, study: Study) -> None:
        self._study, self._signs = study, np.array(study.signs)
        self._constraints = len(study.record["problem"]["constraints"])
        self._thread = ThreadPoolExecutor(1, "vtbdrake model", initializer=_give_way)

    def close(self) -> None:
        """End the computation."""
        self._thread.shutdown()

    def grid(self, trials: Sequence[Trial], x: str, y: str, *, quality: int, at: Trial) -> dict[str, Any]:
        """Return the grid: ``mean``, ``x``, ``y``, ``remark`` and ``seconds``.

        ``mean`` has rows over y of columns over x; it is None if too little is known, which ``remark`` tells. ``x`` and
        ``y`` are the centres of the cells in the parameters' units, of a choice the numbers of its options.
        ``seconds`` is the CPU time.

        Args:
            trials: All trials so far.
            x: The address of the horizontal parameter.
            y: That of the vertical one, another.
            quality: The number of the quality.
            at: The point whose values the other parameters have.
        """
        return self._thread.submit(self._grid, trials, x, y, quality=quality, at=at).result()

    def importance(self, trials: Sequence[Trial], *, quality: int) -> dict[str, Any]:
        """Return the parameters' importances: ``shares`` by address, ``points`` they are of, and ``seconds`` of CPU.

        Args:
            trials: All trials so far.
            quality: The number of the quality.

        Raises:
            ValueError: There are too few points with a value, or they all have the same.
        """
        return self._thread.submit(self._importance, trials, quality=quality).result()

    def _importance(self, trials: Sequence[Trial], *, quality: int) -> dict[str, Any]:
        begin, study = time.thread_time(), self._study
        name, sign = study.names[quality], study.signs[quality]
        shares = importances_of(trials, study.parameters, quality=quality, name=name, sign=sign)
        points = sum(trial.exact and not trial.failed for trial in trials)
        return {"shares": shares, "points": points, "seconds": time.thread_time() - begin}

    def _grid(self, trials: Sequence[Trial], x: str, y: str, *, quality: int, at: Trial) -> dict[str, Any]:
        begin = time.thread_time()
        parameters = self._study.parameters
        fewest, valued = 2 * (len(parameters) + 1), sum(trial.exact and not trial.failed for trial in trials)
        if valued < fewest:
            remark = f"no model yet: it needs {counted(fewest, 'trial')} with a value, and there {_are(valued)}"
            return {"x": [], "y": [], "mean": None, "remark": remark, "seconds": time.thread_time() - begin}
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
            "remark": "" if np.isfinite(mean).all() else "no model: no trial has a value that the solver could use",
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


def _are(number: int) -> str:
    return f"is {number}" if number == 1 else f"are {number or 'none'}"


def _give_way() -> None:
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)


def _centres(parameter: Dimension) -> np.ndarray:
    if isinstance(parameter, Choice):
        count = len(parameter.options)
    else:
        count = min(_CELLS, int(parameter.upper - parameter.lower) + 1) if parameter.integer else _CELLS
    return (np.arange(count) + 0.5) / count
