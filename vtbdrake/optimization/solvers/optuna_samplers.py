"""Optuna's samplers, behind a study in memory."""

from __future__ import annotations

import importlib
import logging
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from vtbdrake.common.extras import extra_module
from vtbdrake.optimization.parameter import Choice, Dimension
from vtbdrake.optimization.solvers.solver import Evaluation, Point, Search, Solver, SolverError

if TYPE_CHECKING:
    import optuna
    from optuna.distributions import BaseDistribution

# By name: Optuna's class, its options besides the seed, and the default size of a batch.
SAMPLERS: Mapping[str, tuple[str, Mapping[str, Any], int]] = {
    "TPE": ("TPESampler", {"constant_liar": True, "multivariate": True}, 4),
    "GP": ("GPSampler", {}, 1),
    "NSGA-II": ("NSGAIISampler", {}, 50),
    "NSGA-III": ("NSGAIIISampler", {}, 50),
    "QMC": ("QMCSampler", {"scramble": True}, 16),
}
ONE_OBJECTIVE = frozenset({"QMC"})


class OptunaSolver(Solver):
    """A sampler of Optuna: continuous, whole and categorical parameters, several objectives, constraints.

    The sampler asks until its budget is spent. A failed simulation is a failed trial, without a value. Points given by
    hand are added to the study from which the sampler learns.

    Args:
        search: What is searched.
        name: Name in the catalogue: TPE, GP, NSGA-II, NSGA-III, QMC.
        batch: Number of points asked for at a time, on which the search depends; by default 4 for TPE, a population for
            NSGA (50), 1 for GP, 16 for QMC, or as many as run side by side (`Search.parallel`) if these are more.
        sampler_options: Further options of Optuna's sampler (``n_startup_trials``, ``population_size``, ...).

    Raises:
        ModuleNotFoundError: Optuna is not installed (or, for GP, torch).
        SolverError: Optuna does not know an option.
    """

    def __init__(
        self,
        search: Search,
        *,
        name: str,
        batch: int | None = None,
        sampler_options: Mapping[str, Any] | None = None,
    ) -> None:
        search.require(name, one_objective=name in ONE_OBJECTIVE, no_constraints=name in ONE_OBJECTIVE)
        super().__init__(search, name=name)
        kind, defaults, usual = SAMPLERS[name]
        options = {**defaults, **(sampler_options or {})}
        wide = search.batch(usual)
        if name.startswith("NSGA") and wide > usual:
            # A batch is a generation.
            options.setdefault("population_size", wide)
        self._batch = search.batch(wide, requested=options.get("population_size") if batch is None else batch)
        self._keys = [f"{i} {parameter.address}" for i, parameter in enumerate(search.space)]
        self._optuna = import_optuna(name)
        self._distributions = {
            key: distribution(parameter, self._optuna) for key, parameter in zip(self._keys, search.space, strict=True)
        }
        self._study = self._make_study(kind, options)
        self._trials: list[optuna.Trial] = []
        if search.start is not None:
            self._study.enqueue_trial(self._parameters(search.start))

    def _make_study(self, kind: str, options: Mapping[str, Any]) -> optuna.Study:
        with quiet():
            try:
                sampler = getattr(self._optuna.samplers, kind)(seed=self.search.seed, **options)
            except TypeError as error:
                raise SolverError(f"{self.name} of Optuna: {error}") from error
            return self._optuna.create_study(
                study_name=self.name, sampler=sampler, directions=["maximize"] * self.search.objectives
            )

    def _parameters(self, point: Point) -> dict[str, Any]:
        return {
            key: parameter.options.index(parameter.as_value(value)) if isinstance(parameter, Choice) else value
            for key, parameter, value in zip(self._keys, self.search.space, point, strict=True)
        }

    def _point(self, parameters: Mapping[str, Any]) -> Point:
        return tuple(
            parameter.options[parameters[key]] if isinstance(parameter, Choice) else parameter.as_value(parameters[key])
            for key, parameter in zip(self._keys, self.search.space, strict=True)
        )

    def _next(self) -> list[Point]:
        with quiet():
            self._trials = [self._study.ask(self._distributions) for _ in range(self._batch)]
        return [self._point(trial.params) for trial in self._trials]

    def _learn(self, evaluations: Sequence[Evaluation], by_hand: Sequence[Evaluation]) -> None:
        with quiet():
            if evaluations:
                for trial, evaluation in zip(self._trials, evaluations, strict=True):
                    self._tell(trial, evaluation)
            for evaluation in by_hand:
                if evaluation.usable:
                    self._study.add_trial(
                        self._optuna.create_trial(
                            params=self._parameters(evaluation.point),
                            distributions=self._distributions,
                            values=list(evaluation.values),
                            constraints={str(i): violation for i, violation in enumerate(evaluation.violations)},
                        )
                    )

    def _tell(self, trial: optuna.Trial, evaluation: Evaluation) -> None:
        if not evaluation.usable:
            self._study.tell(trial, state=self._optuna.trial.TrialState.FAIL)
            return
        for i, violation in enumerate(evaluation.violations):
            trial.set_constraint(str(i), violation)
        self._study.tell(trial, list(evaluation.values))


def import_optuna(name: str) -> Any:
    """Return the module optuna for a purpose or a sampler ``name``.

    Raises:
        ModuleNotFoundError: Optuna (or, for GP, torch) is not installed.
    """
    module = extra_module("optuna", purpose=name, extra="optuna")
    if name == "GP":
        try:
            importlib.import_module("torch")
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("GP of Optuna needs PyTorch: pip install 'vtbdrake[optuna]' torch") from error
    return module


def distribution(parameter: Dimension, optuna: Any) -> BaseDistribution:
    """Return the range of a parameter as Optuna's distribution; for a choice, of the indices of its options.

    Args:
        parameter: A parameter, or a choice.
        optuna: The module ``optuna``, which is imported only when it is needed.
    """
    distributions = optuna.distributions
    if isinstance(parameter, Choice):
        # By index: for Optuna, 1 and True are equal.
        return distributions.CategoricalDistribution(range(len(parameter.options)))
    kind = distributions.IntDistribution if parameter.integer else distributions.FloatDistribution
    return kind(parameter.lower, parameter.upper, log=parameter.log)


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress Optuna's log messages on this thread, and its warnings about experimental parts."""
    thread = threading.get_ident()
    handlers = logging.getLogger("optuna").handlers

    def of_another_thread(record: logging.LogRecord) -> bool:
        return record.thread != thread

    for handler in handlers:
        handler.addFilter(of_another_thread)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="optuna")
            warnings.filterwarnings("ignore", message=".*xperimental")
            yield
    finally:
        for handler in handlers:
            handler.removeFilter(of_another_thread)
