"""A study: problem (18) solved, recorded rollout by rollout, interrupted and resumed at will."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor as FuturesExecutor
from datetime import datetime
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from vtbdrake.optimization.identity import describe, differences, dimensions, revision, versions
from vtbdrake.optimization.outcome import Outcome, Row, Trial
from vtbdrake.optimization.parameter import Dimension
from vtbdrake.optimization.solvers.catalogue import make_solver
from vtbdrake.optimization.solvers.solver import Solver
from vtbdrake.optimization.study_file import StudyError, StudyFile
from vtbdrake.optimization.study_run import StudyRun, check_budget
from vtbdrake.rollout import Executor, make_executor

if TYPE_CHECKING:
    import optuna
    from matplotlib.figure import Figure
    from optuna.storages import BaseStorage

    from vtbdrake.optimization.problem import Problem


class Study:
    """The rollouts and points of one problem, in one file or in memory.

    A study is made by `Problem.study`, which also resumes it, or opened to be read, and be given points, by `open`,
    while another process runs it.

    What it examines depends on the problem, the solver, the seed and the budget that the solver was made for, and not
    on the executor: a study that is resumed makes its solver anew and tells it what is known, so that it goes on as if
    it had not been interrupted.

    Attributes:
        reason: why the last run in this process ended: ``budget``, ``time``, ``target``, ``solver``, ``interrupted``;
            empty before the first.
        message: the same in a sentence.
    """

    def __init__(self, file: StudyFile, problem: Problem | None = None) -> None:
        self._file = file
        self._problem = problem
        self._meta = file.meta
        self.reason = ""
        self.message = ""

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Self:
        """Opens a study file to be read and to be given points.

        Raises:
            StudyError: there is none, it is damaged, or of another version.
        """
        return cls(StudyFile(path))

    @classmethod
    def of(
        cls,
        problem: Problem,
        path: str | os.PathLike[str] | None,
        *,
        solver: str | None = None,
        seed: int | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> Self:
        """See `Problem.study`."""
        meta: dict[str, Any] = {
            "problem": describe(problem),
            "solver": solver or "auto",
            "seed": 0 if seed is None else int(seed),
            "options": dict(options or {}),
            "versions": versions(),
            "revision": revision(problem.scenario),
            "units": list(problem.units),
        }
        # An unknown solver, or one that cannot solve the problem, is told before there is a file.
        made = _solver(problem, meta, budget=None)
        made.close()
        meta["solver"] = made.name
        given = {"solver": solver, "seed": seed, "options": options}
        study = cls(StudyFile(path, meta=meta), problem)
        try:
            changed = differences(study._meta["problem"], meta["problem"])
            if changed:
                raise StudyError(
                    f"{path} is a study of another problem ({'; '.join(changed)}): give another file, or restore the "
                    "problem"
                )
            for key, value in given.items():
                if value is not None and study._meta[key] != meta[key]:
                    raise StudyError(
                        f"{path} was begun with {key} {study._meta[key]!r}, not {meta[key]!r}: leave {key} out to "
                        "resume it, or give another file"
                    )
        except BaseException:
            study.close()
            raise
        return study

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # -- to run it

    def run(
        self,
        *,
        rollouts: int | None = None,
        seconds: float | None = None,
        target: float | None = None,
        racing: bool | None = None,
        executor: str | Executor | FuturesExecutor = "auto",
        workers: int | None = None,
        time_limit: float | None = None,
        progress: bool = True,
    ) -> Self:
        """Goes on until the budget is spent, the target is reached, or the solver is finished. Ctrl-C keeps all.

        Args:
            rollouts: how many the study has in the end, those of former runs included.
            seconds: of wall time, in this run.
            target: ends when a point is at least as good: a quality as large, a cost as small.
            racing: drop points that can no longer win before all their conditions have run (see `Judge`). By default,
                where there are several conditions and one quality.
            executor, workers: see `Problem.sweep`.
            time_limit: of one rollout, in seconds; one that takes longer fails.
            progress: show a progress bar: rollouts per second, the best so far, the time left.

        Raises:
            ValueError: there is no budget at all, or it makes no sense; an executor or solver is unknown.
            StudyError: another process runs the study, or it was opened without its problem.
            QualityError: f raises, is negative or NaN. What was finished before is kept.
        """
        problem = self._problem
        if problem is None:
            raise StudyError(
                f"{self._file.path} was opened without its problem: run problem.study({str(self._file.path)!r})"
            )
        check_budget(problem, rollouts=rollouts, seconds=seconds, target=target)
        racing = len(problem.conditions) > 1 and len(problem.objectives) == 1 if racing is None else racing
        budget = rollouts if rollouts is not None else 10**9
        chosen = make_executor(
            executor, testbed=problem.testbed, rollouts=budget, workers=workers, time_limit=time_limit
        )
        try:
            with self._file.running(versions=versions(), revision=revision(problem.scenario)) as reason:
                solver = self._make_solver(problem, rollouts, racing=racing)
                run = StudyRun(self._file, problem, solver, chosen, racing=racing, progress=progress)
                self.reason, self.message = run.until(rollouts=rollouts, seconds=seconds, target=target)
                reason.append(self.reason)
        finally:
            if chosen is not executor:
                chosen.close()
        return self

    def _make_solver(self, problem: Problem, rollouts: int | None, *, racing: bool) -> Solver:
        # The budget that the solver was first made for belongs to the study: another one would be another sequence.
        if "evaluations" not in self._meta:
            # With racing, a point may take one rollout only.
            evaluations = None if rollouts is None else ceil(rollouts / (1 if racing else len(problem.conditions)))
            self._file.set("evaluations", evaluations)
            self._meta = self._file.meta
        return _solver(problem, self._meta, budget=self._meta["evaluations"])

    def add(self, *points: Any) -> None:
        """Gives points by hand, each a mapping address -> value or values in the order of the parameters.

        They are judged with the next batch of the study, in whatever process runs it, and the solver is told of them.

        Raises:
            ValueError: a point has other entries than the study, or one lies outside its range.
        """
        space = self.parameters
        checked = []
        for point in points:
            if isinstance(point, Mapping):
                unknown = set(point) ^ {dimension.address for dimension in space}
                if unknown:
                    raise ValueError(f"a point sets each parameter once; this one is wrong about {', '.join(unknown)}")
                point = [point[dimension.address] for dimension in space]
            entries = list(point) if isinstance(point, Sequence) and not isinstance(point, str) else [point]
            if len(entries) != len(space):
                raise ValueError(f"a point has {len(space)} entries, not {len(entries)}")
            checked.append(tuple(d.check(value) for d, value in zip(space, entries, strict=True)))
        self._file.give(checked)

    def import_optuna(self, storage: str | BaseStorage, name: str) -> int:
        """Gives the points of a study in Optuna's storage, as `add` does: evaluated by whomever, or only enqueued.

        They are judged by rollouts of this problem: a value from elsewhere says nothing about it. Points that are
        judged already are left out, so that what `to_optuna` wrote costs nothing when it comes back.

        Args:
            storage: an URL or a storage of Optuna's, see `to_optuna`.
            name: of Optuna's study. Its parameters are named by their addresses.

        Returns:
            How many points were given.

        Raises:
            ModuleNotFoundError: Optuna is not installed.
            StudyError: there is no such study, or it varies other parameters.
            ValueError: a point lies outside its range.
        """
        from vtbdrake.optimization.optuna_bridge import points_from_optuna

        points = points_from_optuna(self, storage, name=name)
        self._file.give(points)
        return len(points)

    # -- to read it

    def to_optuna(self, storage: str | BaseStorage, name: str) -> optuna.Study:
        """Writes the study into Optuna's storage, for ``optuna-dashboard <storage>``, Optuna's plots and importances.

        Every point becomes a trial: complete; failed, where a simulation failed; or pruned, where racing dropped it.
        Values, t*, ends and times of its rollouts are its user attributes, what the study is about those of the study.
        Writing it again adds the points that are new.

        Args:
            storage: an URL, such as ``sqlite:///study.db``, or a storage of Optuna's.
            name: of the study there.

        Raises:
            ModuleNotFoundError: Optuna is not installed.
            StudyError: the storage cannot be opened, or has another study of that name.
        """
        from vtbdrake.optimization.optuna_bridge import to_optuna

        return to_optuna(self, storage, name=name)

    @property
    def path(self) -> Path | None:
        """Of the file; None of a study in memory."""
        return self._file.path

    @property
    def parameters(self) -> tuple[Dimension, ...]:
        """What is varied."""
        return dimensions(self._meta["problem"])

    @property
    def units(self) -> tuple[str, ...]:
        """Of the parameters, see `Problem.units`."""
        return tuple(self._meta["units"])

    @property
    def directions(self) -> tuple[str, ...]:
        """``maximize`` or ``minimize`` for each quality."""
        return tuple(
            "minimize" if quality["minimize"] else "maximize" for quality in self._meta["problem"]["qualities"]
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Of the qualities."""
        return tuple(quality["name"] for quality in self._meta["problem"]["qualities"])

    @property
    def record(self) -> dict[str, Any]:
        """What the study is about: the problem, the scenario, the solver, the seed, the versions, the git revision."""
        return dict(self._meta)

    @property
    def trials(self) -> tuple[Trial, ...]:
        """All judged points, as they are in the file now."""
        addresses = [dimension.address for dimension in self.parameters]
        return tuple(
            Trial(number, dict(zip(addresses, point, strict=True)), values, violations, exact, origin, method, batch)
            for number, (batch, _, point, values, violations, exact, origin, method) in enumerate(self._file.trials())
        )

    @property
    def rollouts(self) -> dict[Row, Outcome]:
        """All finished rollouts by (point, number of the condition), as they are in the file now."""
        return self._file.outcomes()

    @property
    def finished(self) -> dict[Row, datetime]:
        """When each rollout was finished, in UTC."""
        return self._file.finished()

    def __len__(self) -> int:
        """How many rollouts there are."""
        return self._file.count()

    @property
    def best(self) -> Trial:
        """s^0*, equation (18), among the points examined: the best that keeps all constraints.

        Raises:
            ValueError: there are several qualities, or no point has a value and keeps the constraints.
        """
        if len(self.directions) > 1:
            raise ValueError("of several qualities there is no best point: ask for pareto()")
        found = [trial for trial in self.trials if trial.exact and trial.feasible]
        if not found:
            kept = " and keeps the constraints" if self._meta["problem"]["constraints"] else ""
            raise ValueError(f"no point has a quality{kept}{self._why()}")
        sign = self._signs[0]
        return max(found, key=lambda trial: sign * trial.value)

    def pareto(self) -> tuple[Trial, ...]:
        """The points that no other point beats in one quality without losing in another."""
        found = [trial for trial in self.trials if trial.exact and trial.feasible]
        signed = {t.number: [s * v for s, v in zip(self._signs, t.values, strict=True)] for t in found}
        return tuple(t for t in found if not any(_dominates(signed[o.number], signed[t.number]) for o in found))

    @property
    def _signs(self) -> tuple[float, ...]:
        return tuple(-1.0 if direction == "minimize" else 1.0 for direction in self.directions)

    def _why(self) -> str:
        messages = Counter(o.message for o in self.rollouts.values() if o.end == "failed")
        return "".join(f"; {count} rollouts failed: {message}" for message, count in messages.most_common(1))

    def to_dict(self) -> dict[str, list[Any]]:
        """Columns by name, one entry per trial."""
        trials = self.trials
        columns: dict[str, list[Any]] = {d.address: [t.parameters[d.address] for t in trials] for d in self.parameters}
        for k, name in enumerate(self.names):
            columns[name if name not in columns else f"{name} {k}"] = [t.values[k] for t in trials]
        for name in ("feasible", "exact", "origin", "method", "batch"):
            columns[name] = [getattr(trial, name) for trial in trials]
        return columns

    def summary(self) -> str:
        """What was done, what came out, and what went wrong, to be read."""
        trials, outcomes = self.trials, self.rollouts
        methods = Counter(trial.method for trial in trials)
        lines = [
            f"{len(trials)} points, {len(outcomes)} rollouts; solver {self._meta['solver']}, seed "
            f"{self._meta['seed']}: " + ", ".join(f"{method} ({count})" for method, count in methods.items())
        ]
        if self.message:
            lines.append(f"ended: {self.message}")
        if len(self.directions) > 1:
            lines.append(f"Pareto front of {len(self.pareto())} points")
        else:
            try:
                best = self.best
                at = ", ".join(f"{address} = {value!r}" for address, value in best.parameters.items())
                lines.append(f"best: {self.names[0]} = {best.value:g} at {at}")
            except ValueError as error:
                lines.append(f"best: {error}")
        dropped = sum(not trial.exact for trial in trials)
        if dropped:
            saved = len(trials) * len(self._meta["problem"]["conditions"]) - len(outcomes)
            lines.append(f"racing dropped {dropped} points before all their conditions had run, {saved} rollouts less")
        ends = Counter(outcome.end for outcome in outcomes.values())
        times = sorted(outcome.wall_time for outcome in outcomes.values() if outcome.wall_time == outcome.wall_time)
        if times:
            lines.append(
                f"rollouts took {sum(times):.3g} s in all, the median {times[len(times) // 2]:.3g} s; they ended by "
                + ", ".join(f"{end} ({count})" for end, count in ends.items())
                + self._why()
            )
        return "\n".join(lines)

    def plot_history(self) -> Figure:
        """The values in the order of the study, and the best so far."""
        from vtbdrake.visualization import study_plots

        return study_plots.plot_history(self)

    def plot_landscape(self, *addresses: str) -> Figure:
        """The quality over one or two parameters (Figure 6); the best value at each where there are more."""
        from vtbdrake.visualization import study_plots

        return study_plots.plot_landscape(self, *addresses)

    def plot_slices(self) -> Figure:
        """The quality over every parameter, each alone."""
        from vtbdrake.visualization import study_plots

        return study_plots.plot_slices(self)

    def plot_importances(self) -> Figure:
        """How much each parameter decides about whether a point is among the best; needs the extra ``optuna``."""
        from vtbdrake.visualization import study_plots

        return study_plots.plot_importances(self)

    def plot_pareto(self) -> Figure:
        """Two qualities against each other, the Pareto front marked."""
        from vtbdrake.visualization import study_plots

        return study_plots.plot_pareto(self)


def _solver(problem: Problem, meta: Mapping[str, Any], *, budget: int | None) -> Solver:
    return make_solver(
        meta["solver"],
        problem.parameters,
        objectives=len(problem.objectives),
        constraints=len(problem.constraints),
        seed=meta["seed"],
        budget=budget,
        **meta["options"],
    )


def _dominates(a: Sequence[float], b: Sequence[float]) -> bool:
    """Whether signed values ``a`` are nowhere worse than ``b``, and somewhere better."""
    return all(x >= y for x, y in zip(a, b, strict=True)) and any(x > y for x, y in zip(a, b, strict=True))
