"""Studies: solutions of problem (18) that record every rollout, so that they can be interrupted and resumed."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Executor as FuturesExecutor
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from vtbdrake import upper_layers
from vtbdrake.common.argument_checks import all_of, as_flag, as_whole, check_takes, counted
from vtbdrake.common.closing import Closing
from vtbdrake.common.extras import extra_module
from vtbdrake.common.failures import safe_text
from vtbdrake.common.interrupt import interrupt_taken
from vtbdrake.common.summary_html import summary_html
from vtbdrake.optimization.identity import plain, revision, versions
from vtbdrake.optimization.parameter import Dimension, checked_point
from vtbdrake.optimization.records import (
    PAUSE,
    RESUME,
    STOP,
    TRY,
    DrivenTrial,
    Intervention,
    Outcome,
    RolloutKey,
    Trial,
)
from vtbdrake.optimization.study.begin_or_resume import begin_or_resume
from vtbdrake.optimization.study.interventions import Interventions, name_of_person, repeated_interventions
from vtbdrake.optimization.study.study_error import StudyError
from vtbdrake.optimization.study.study_file import INTERRUPTED, StudyFile
from vtbdrake.optimization.study.study_results import StudyResults, distinct_names
from vtbdrake.optimization.study.study_run import StudyRun, check_budget, renew_solver
from vtbdrake.optimization.study.study_search import StudySearch
from vtbdrake.optimization.sweep import borrowed
from vtbdrake.rollout import Executor, RolloutResult
from vtbdrake.rollout.course import Course
from vtbdrake.rollout.task import catches
from vtbdrake.testbed.addressed import record_differences

if TYPE_CHECKING:
    import optuna
    import pandas
    from matplotlib.figure import Figure
    from optuna.storages import BaseStorage

    from vtbdrake.optimization.problem import Problem
    from vtbdrake.upper_layers import StudyView

# A function that is called with a study and each of its new trials.
Callback = Callable[["Study", Trial], Any]


class Study(Closing):
    """The rollouts and points of one problem, in one file or in memory.

    `Problem.study` begins a study, or resumes the one in a file. `open` opens a file for reading and for giving points,
    also while another process runs the study. Properties read the file each time.

    The points that are examined depend on the problem, the solver, the seed and the budget for which the solver was
    made, not on the executor. To resume a study, a new solver is told the recorded evaluations, so that it continues as
    if it had not been interrupted. For a larger budget, a new solver starts from the beginning; points that it asks for
    again are known, and take no rollouts.

    Args:
        file: The file of the study, or its substitute in memory.
        problem: The problem, if it is known here; without it, no rollout is run.

    Attributes:
        reason: Why the last run in this process ended: ``budget``, ``time``, ``target``, ``solver``, ``stopped``,
            ``interrupted``; empty before the first.
        message: The same in a sentence.
    """

    def __init__(self, file: StudyFile, problem: Problem | None = None) -> None:
        self._file = file
        self._problem = problem
        self._meta = file.meta
        self._interventions = Interventions(file)
        self.reason = ""
        self.message = ""

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Self:
        """Open a study file for reading and for giving points.

        Raises:
            StudyError: The file does not exist, is damaged, or is of another version.
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
        parallel: int | None = None,
        allow_changed_code: bool = False,
        more_conditions: bool = False,
    ) -> Self:
        """Begin or resume the study of a problem; see `Problem.study`.

        Args:
            problem: The problem.
            path: Path of the file; None keeps the study in memory.
            solver: Name of the solver; by default ``auto``, or the file's.
            seed: Seed of the solver, in [0, 2^32); 0 by default, or the file's.
            options: Options of the solver; none by default, or the file's.
            parallel: The number of rollouts that can run side by side, at least; by default the solver chooses its
                batches.
            allow_changed_code: Whether to go on although the code of the problem has changed; its rollouts stay.
            more_conditions: Whether the problem may have further conditions behind the file's.
        """
        requested = {"solver": solver, "seed": seed, "options": options, "parallel": parallel}
        file = begin_or_resume(
            problem, path, requested, allow_changed_code=allow_changed_code, more_conditions=more_conditions
        )
        return cls(file, problem)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __repr__(self) -> str:
        where = "in memory" if self.path is None else str(self.path)
        return f"Study({where}: {counted(len(self), 'rollout')}, solver {self._meta['solver']})"

    def _repr_html_(self) -> str:
        """Show the summary with the values so far in a notebook."""
        first, *lines = self.summary().split("\n")
        rows = {name: text for name, _, text in (line.partition(": ") for line in lines)}
        drawn = any(trial.counts for trial in self.trials)
        return summary_html(first, rows, self.plot_history() if drawn else None)

    # -- runs

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
        on_error: str = "record",
        callbacks: Sequence[Callback] = (),
        progress: bool = True,
    ) -> Self:
        """Run rollouts until the budget is spent, the target is reached, or the solver has ended.

        Ctrl-C ends the run; finished rollouts are kept.

        Args:
            rollouts: Number of rollouts that the study has in the end, former runs included. With racing, a
                rest that is smaller than one point under all conditions is left; `message` says so.
            seconds: The wall time of this run.
            target: The run ends as soon as a point is at least as good: a quality as large, a cost as small. With
                several workers, other points may be finished by then.
            racing: Whether to drop points that can no longer win before all their conditions have run (see
                `Evaluator`). By default, if there are several conditions and one quality.
            executor: See `Problem.sweep`.
            workers: See `Problem.sweep`.
            time_limit: Wall time in seconds; a rollout that takes longer fails.
            on_error: What happens if a quality or constraint function raises, is negative or NaN. ``record``: the
                rollout counts as failed, with the message, and the first of a run is logged; ``raise``: the run ends.
            callbacks: Functions of the study and a trial, called in this thread for every trial that is recorded for
                the first time, batch by batch. One may set attributes, add points, or `stop` the run; an exception ends
                the run.
            progress: Whether to show a progress bar: rollouts per second, the best so far, the time left. Without a
                terminal or a notebook, progress is logged every half minute instead, at the level INFO.

        Raises:
            ValueError: No budget is given, or an invalid one; or an executor or solver is unknown.
            StudyError: Another process runs the study, or it was opened without its problem.
            QualityError: f raises, is negative or NaN, and ``on_error`` is ``raise``. Finished rollouts are kept.
        """
        problem = self._problem
        if problem is None:
            raise self._no_problem()
        check_budget(problem, rollouts=rollouts, seconds=seconds, target=target)
        catch = catches(on_error)
        callbacks = all_of(object, callbacks, name="callbacks", form="functions of a study and a trial")
        for callback in callbacks:
            check_takes(callback, ["study", "trial"], name="a callback")
        default = len(problem.conditions) > 1 and len(problem.objectives) == 1
        racing = default if racing is None else as_flag("racing", racing)
        self._run(
            {"rollouts": rollouts, "seconds": seconds, "target": target},
            executor=executor,
            workers=workers,
            time_limit=time_limit,
            racing=racing,
            catch=catch,
            progress=progress,
            callbacks=callbacks,
        )
        return self

    def replay(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        without: Sequence[int] = (),
        reuse: bool = True,
        executor: str | Executor | FuturesExecutor = "auto",
        workers: int | None = None,
        time_limit: float | None = None,
        on_error: str = "record",
        progress: bool = True,
    ) -> Study:
        """Repeat the study from its first batch, into another file, and return it.

        With all interventions the trials come out the same, to the last bit, up to the end of this study. (Trials that
        an earlier solver made for a smaller budget are left out.) Without some of them it is the study as it would
        have been, until its budget is spent. Pauses and stops are not repeated.

        Args:
            path: Path of the new file; None keeps the study in memory.
            without: The numbers of the interventions to leave out.
            reuse: Whether rollouts that this study has finished are taken over, and not run again.
            executor: See `run`, as for the arguments below.
            workers: See `run`.
            time_limit: See `run`.
            on_error: See `run`.
            progress: See `run`.

        Raises:
            StudyError: The study was opened without its problem, has not run yet, or the new file exists.
            ValueError: There is no such intervention, or a later one makes no sense without it.
        """
        if self._problem is None:
            raise self._no_problem()
        meta = self._file.meta
        if "racing" not in meta:
            raise StudyError(f"{self.path or 'the study'} has not run yet: there is nothing to replay")
        if path is not None and Path(path).exists():
            raise StudyError(f"{path} exists already: a study is replayed into a new file")
        without = all_of(int, without, name="without", form="numbers of interventions")
        changes = repeated_interventions(StudySearch.of(meta), self.interventions, without=without)
        study = Study(StudyFile(path, meta=self._file.description), self._problem)
        study._file.copy_interventions(changes)
        study._run(
            {"rollouts": len(self) if not without or meta["budget"] is None else meta["budget"]},
            executor=executor,
            workers=workers,
            time_limit=time_limit,
            racing=meta["racing"],
            catch=catches(on_error),
            progress=progress,
            callbacks=(),
            outcomes=self.rollouts if reuse else {},
            batches=None if without else self._file.batches(),
        )
        return study

    @property
    def is_running(self) -> bool:
        """Return whether a process runs the study, this one or another."""
        return self._file.is_running

    @property
    def sessions(self) -> tuple[Mapping[str, Any], ...]:
        """Return every run: started, ended and reason (None if it was killed), versions and git revision."""
        return tuple(self._file.sessions())

    def _run(
        self,
        budget: dict[str, Any],
        *,
        executor: str | Executor | FuturesExecutor,
        workers: int | None,
        time_limit: float | None,
        racing: bool,
        callbacks: Sequence[Callback],
        **settings: Any,
    ) -> None:
        problem, rollouts = self._problem, budget["rollouts"]
        assert problem is not None

        def after_batch(batch: int) -> None:
            for trial in self._file.trials_of(batch) if callbacks else ():
                for callback in callbacks:
                    callback(self, trial)

        def run() -> str:
            if "outcomes" not in settings:  # A replay has the solver of the other study.
                renew_solver(self._file, self.search, rollouts=rollouts, racing=racing)
                self._meta = self._file.meta
            study_run = StudyRun(self._file, problem, opened, racing=racing, after_batch=after_batch, **settings)
            self.reason, self.message = study_run.until(**budget)
            return self.reason

        most = rollouts if rollouts is not None else 10**9
        with borrowed(problem, executor, rollouts=most, workers=workers, time_limit=time_limit) as opened:
            self._file.while_claimed(run, versions=versions(), revision=revision(problem.scenario))
        if self.reason == INTERRUPTED:
            interrupt_taken()

    def _no_problem(self) -> StudyError:
        return StudyError(
            f"{self._file.path} was opened without its problem: run problem.study({str(self._file.path)!r})"
        )

    # -- interventions

    def intervene(self, kind: str, *, by: str | None = None, **payload: Any) -> Intervention:
        """Change the study, also while another process runs it.

        The change is a row of the study's file. The process that runs the study makes it before its next batch of
        points, or the next run does. From then on the points come from the changed study: a resumed or replayed
        study repeats them exactly. After a change of ranges, regions, solver or aspiration the method begins anew, at
        the best point so far; it is told all evaluations in its space, and has the rest of the budget.

        ====================  =========================================================================================
        kind                  effect
        ====================  =========================================================================================
        pause, resume, stop   No further points are asked for; the run waits, goes on, or ends.
        range                 The range of a parameter: ``address``, ``lower`` and ``upper`` within the bounds of its
                              variable (of a field of the scenario: within its first range), or ``options`` of a choice.
        freeze, unfreeze      A parameter, ``address``, is held at ``value`` (by default the best point's), or is
                              varied again.
        forbid                No more points in ``region``, {address: [lower, upper] or options, ...}, where None is an
                              open end. Its points count no longer as the best.
        allow                 The region forbidden by intervention ``number`` is allowed again.
        budget                ``rollouts`` that the study has in the end; None: no limit. It holds for later runs, too,
                              whatever they are given.
        solver                Another ``solver``, with its ``options``.
        try                   A ``point``, address -> value, is evaluated before the solver's points; see `add`.
        aspiration            For several qualities: ``targets``, one value per quality. From now on the solver
                              maximizes one value, how far all of them are exceeded (see `StudySearch.achievement`).
                              None: the whole Pareto front again.
        ====================  =========================================================================================

        Args:
            kind: One of the table.
            by: Who makes the change; by default the user of this process.
            payload: The arguments of the kind.

        Raises:
            ValueError: There is no such kind, it takes other arguments, or nothing would be left to search.
            SolverError: The solver cannot search what would be left.
            StudyError: The study is finished, nobody runs what is to be stopped, or the file cannot be written.
        """
        if kind == "freeze" and "value" not in payload and len(self.directions) == 1:
            payload["value"] = self.best.parameters[self.search.parameter(payload.get("address"))[1].address]
        if kind == TRY and "point" in payload:
            payload["point"] = _by_address(self.parameters, payload["point"])
        (intervention,) = self._interventions.make(kind, [payload], name=name_of_person(by))
        return intervention

    def pause(self, *, by: str | None = None) -> None:
        """Let the run finish its batch of points and wait; see `intervene`."""
        self.intervene(PAUSE, by=by)

    def resume(self, *, by: str | None = None) -> None:
        """Let a paused run go on; see `intervene`."""
        self.intervene(RESUME, by=by)

    def stop(self, *, by: str | None = None) -> None:
        """End the run after the present batch of points; may be called by a callback, or anywhere else."""
        self.intervene(STOP, by=by)

    @property
    def interventions(self) -> tuple[Intervention, ...]:
        """Return all interventions, in their order."""
        return tuple(self._file.interventions())

    @property
    def search(self) -> StudySearch:
        """Return the ranges, regions, solver and budget, as the interventions so far leave them."""
        return self._interventions.search

    # -- points, driven rollouts and attributes given by hand

    def add(self, *points: Any, by: str | None = None) -> None:
        """Add points by hand, each a mapping address -> value or values in the order of the parameters.

        They are interventions of the kind ``try``, see `intervene`.
        They are evaluated before the next points of the solver, in the process that runs the study, and the solver
        learns from them.

        Args:
            *points: The points: address -> value, or values in the order of the parameters.
            by: Name of the person, for the record of interventions.

        Raises:
            ValueError: A point has other entries than the study, or one lies outside its range.
        """
        parameters = self.parameters
        payloads = [{"point": _by_address(parameters, point)} for point in points]
        self._interventions.make(TRY, payloads, name=name_of_person(by))

    def add_results(self, point: Any, results: Sequence[RolloutResult], *, by: str | None = None) -> Intervention:
        """Add a point by hand whose rollouts were run elsewhere, for example by `Problem.rollout` in another process.

        Args:
            point: As in `add`.
            results: Its rollouts, one per condition of the problem.
            by: As in `intervene`.

        Raises:
            ValueError: As in `add`, or there is another number of results.
        """
        values = _by_address(self.parameters, point)
        count = len(self._meta["problem"]["conditions"])
        if len(results) != count:
            raise ValueError(f"a point has one rollout per condition, {count}, not {len(results)}")
        for condition, result in enumerate(results):
            self._file.add(tuple(values.values()), condition, Outcome.of(result))
        return self.intervene(TRY, point=values, by=by)

    def add_driven(
        self, course: Course, result: RolloutResult, *, parameters: Mapping[str, Any], by: str | None = None
    ) -> DrivenTrial:
        """Store a rollout that somebody has driven, such as one of a session of the live page.

        It stands beside the trials, marked as driven: no solver learns from it, and it is no point's best. Its course
        computes it again, bit for bit.

        Args:
            course: What was set when.
            result: The rollout of the study's problem along it.
            parameters: The values of the study's parameters where it began, address -> value.
            by: As in `intervene`.

        Raises:
            ValueError: A parameter is missing, or the course is one of another scenario.
        """
        addresses = [parameter.address for parameter in self.parameters]
        if set(parameters) != set(addresses):
            raise ValueError(f"a driven trial has values of {', '.join(addresses)}, not of {', '.join(parameters)}")
        if differing := record_differences(self._meta["problem"]["scenario"], course.start.scenario, where="there"):
            raise ValueError(f"the course is one of another scenario ({'; '.join(differing)})")
        values = plain({address: parameters[address] for address in addresses}, "the parameters of a driven trial")
        return self._file.add_drive(values, Outcome.of(result), course, name=name_of_person(by))

    @property
    def driven(self) -> tuple[DrivenTrial, ...]:
        """Return the rollouts that somebody has driven, in their order; see `add_driven`."""
        return tuple(self._file.drives())

    def edit(self, number: int, point: Any) -> None:
        """Replace a point of the `queue`.

        Args:
            number: Number of the point in the queue.
            point: The new point: address -> value, or values in the order of the parameters.

        Raises:
            StudyError: The queue has no point of that number: it was evaluated, removed, or never added.
            ValueError: As in `add`.
        """
        payload = {"point": _by_address(self.parameters, point)}
        self._interventions.change_waiting(as_whole("the number of a point in the queue", number), payload, kind=TRY)

    def remove(self, number: int) -> None:
        """Remove a point from the `queue`, or another intervention that waits for its batch.

        Raises:
            StudyError: No intervention of that number waits: it had its effect, was removed, or was never made.
            ValueError: A later intervention makes no sense without it.
        """
        self._interventions.change_waiting(as_whole("the number of an intervention", number), None)

    def set_attribute(self, key: str, value: Any, *, point: Any = None) -> None:
        """Set an attribute of the study, or of a point: for example an operator or a remark. No result changes.

        Args:
            key: Name of the attribute; one of the same name is replaced.
            value: A number, a word, or lists and dicts of these.
            point: As in `add`; None for the study itself.

        Raises:
            ValueError: The value cannot be stored, or the point is invalid.
        """
        if not isinstance(key, str) or not key or key != safe_text(key):
            raise ValueError(f"an attribute has a name, such as 'operator', not {key!r}")
        (stored,) = plain({key: value}, "attributes").values()
        self._file.set_attribute(None if point is None else checked_point(self.parameters, point), key, stored)

    @property
    def queue(self) -> dict[int, dict[str, Any]]:
        """Return the points given by hand that are not evaluated yet: number -> the point, address -> value."""
        return {i.number: dict(i.payload["point"]) for i in self._file.interventions(waiting=True) if i.kind == TRY}

    @property
    def attributes(self) -> dict[str, Any]:
        """Return the attributes of the study, see `set_attribute`; a point has `Trial.attributes`."""
        return self._file.attributes().get(None, {})

    # -- description

    @property
    def problem(self) -> Problem:
        """Return the problem, with the widest ranges that the study has had: all its points lie in them.

        Raises:
            StudyError: The study was opened without its problem.
        """
        if self._problem is None:
            raise self._no_problem()
        return self._problem.with_ranges(self.parameters)

    @property
    def path(self) -> Path | None:
        """Return the path of the file; None if the study is in memory."""
        return self._file.path

    @property
    def parameters(self) -> tuple[Dimension, ...]:
        """Return the parameters that are varied, with the widest ranges that the study has had."""
        return self.search.widest

    @property
    def units(self) -> tuple[str, ...]:
        """Return the units of the parameters, see `Problem.units`."""
        return tuple(self._meta["units"])

    @property
    def directions(self) -> tuple[str, ...]:
        """Return ``maximize`` or ``minimize`` for each quality."""
        return tuple(
            "minimize" if quality["minimize"] else "maximize" for quality in self.record["problem"]["qualities"]
        )

    @property
    def signs(self) -> tuple[float, ...]:
        """Return 1 for a quality and -1 for a cost, for each of them."""
        return tuple(-1.0 if direction == "minimize" else 1.0 for direction in self.directions)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the qualities, each another one: of two functions of one name, with their variables."""
        return distinct_names(self._meta["problem"]["qualities"])

    @property
    def quality_units(self) -> tuple[str, ...]:
        """Return the units of the qualities; empty where none is given, and in older files."""
        return tuple(self._meta.get("quality_units", [""] * len(self.directions)))

    @property
    def record(self) -> dict[str, Any]:
        """Return the identity of the study: problem, solver, seed, versions, git revision, allowed code ``changes``."""
        return dict(self._meta)

    # -- results

    @property
    def trials(self) -> tuple[Trial, ...]:
        """Return all evaluated points."""
        return tuple(self._file.trials())

    @property
    def rollouts(self) -> dict[RolloutKey, Outcome]:
        """Return all finished rollouts by (point, number of the condition)."""
        return self._file.outcomes()

    @property
    def finished(self) -> dict[RolloutKey, datetime]:
        """Return the time at which each rollout was finished, in UTC."""
        return self._file.finished()

    def __len__(self) -> int:
        """Return the number of finished rollouts."""
        return self._file.count()

    @property
    def best(self) -> Trial:
        """Return s^0*, equation (18), among the points examined: the best that keeps all constraints.

        Raises:
            ValueError: There are several qualities, or no point has a value and keeps the constraints.
        """
        return self._results.best()

    def pareto(self) -> tuple[Trial, ...]:
        """Return the points that no other point beats in one quality without losing in another."""
        return self._results.pareto()

    def to_dict(self) -> dict[str, list[Any]]:
        """Return columns by name, one entry per trial.

        The columns are the parameters by address, the qualities, the violations of the constraints, the origin of the
        trial (solver or user, method, batch), and its attributes (None if it does not have one).
        """
        return self._results.columns()

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the columns of `to_dict` as a DataFrame, one row per trial; its index is `Trial.number`.

        Raises:
            ModuleNotFoundError: Pandas is not installed.
        """
        pd = extra_module("pandas", purpose="a DataFrame", extra="dataframe")
        frame: pandas.DataFrame = pd.DataFrame(self.to_dict(), index=pd.RangeIndex(len(self.trials), name="number"))
        return frame

    def summary(self) -> str:
        """Return a text with the progress, the results and the errors."""
        return self._results.summary(self.message)

    @property
    def _results(self) -> StudyResults:
        return StudyResults(self._file, self._meta, self.search)

    # -- pictures and exports

    def view(self, *, port: int = 0, hosts: Collection[str] = ()) -> StudyView:
        """Open the page of the study, where it is watched while it runs, here or elsewhere; see docs/study_page.md.

        Args:
            port: The port of the page on the loopback interface; 0 for any that is free.
            hosts: Host names (with port) under which proxies offer the page.

        Raises:
            PortError: The port is taken.
            ModuleNotFoundError: The extra ``web`` is not installed.
        """
        # A connection of its own: reading must not wait for a transaction of this one.
        return upper_layers.view_study(self.path or self._file, problem=self._problem, port=port, hosts=hosts)

    def plot_history(self) -> Figure:
        """Plot the values of the trials in their order, and the best so far."""
        return upper_layers.plot_history(self)

    def plot_landscape(self, *addresses: str) -> Figure:
        """Plot the quality over one or two parameters (Figure 6); the best value at each if there are more."""
        return upper_layers.plot_landscape(self, *addresses)

    def plot_slices(self) -> Figure:
        """Plot the quality over every single parameter."""
        return upper_layers.plot_slices(self)

    def plot_importances(self) -> Figure:
        """Plot the importance of each parameter for every quality."""
        return upper_layers.plot_importances(self)

    def plot_pareto(self) -> Figure:
        """Plot two qualities against each other, with the Pareto front."""
        return upper_layers.plot_pareto(self)

    def to_optuna(self, storage: str | BaseStorage, name: str) -> optuna.Study:
        """Write the study into Optuna's storage, for ``optuna-dashboard <storage>``, Optuna's plots and importances.

        Every point becomes a trial: complete; failed, if a simulation failed; or pruned, if racing dropped it. The
        values, t*, ends and times of its rollouts are its user attributes; `record` is in the study's attributes.
        Writing it again adds the new points. Optuna takes about 20 ms per point in an SQL database.

        Args:
            storage: A URL, such as ``sqlite:///study.db``, or a storage of Optuna's.
            name: The name of the study there.

        Raises:
            ModuleNotFoundError: Optuna is not installed.
            StudyError: The storage cannot be opened, or has another study of that name.
        """
        from vtbdrake.optimization.optuna_bridge import to_optuna

        return to_optuna(self, storage, name=name)

    def import_optuna(self, storage: str | BaseStorage, name: str) -> int:
        """Add the points of a study in Optuna's storage, as `add` does, whether evaluated or only enqueued there.

        They are evaluated by rollouts of this problem; values in Optuna's storage are ignored. Points that have been
        evaluated, or wait in the queue, are left out, so that importing an export of `to_optuna` costs nothing.

        Args:
            storage: A URL or a storage of Optuna's, see `to_optuna`.
            name: Name of Optuna's study. Its parameters are named by their addresses.

        Returns:
            How many points were given.

        Raises:
            ModuleNotFoundError: Optuna is not installed.
            StudyError: There is no such study, or it varies other parameters.
            ValueError: A point lies outside its range.
        """
        from vtbdrake.optimization.optuna_bridge import points_from_optuna

        points = points_from_optuna(self, storage, name=name)
        self.add(*points)
        return len(points)


def _by_address(parameters: Sequence[Dimension], point: Any) -> dict[str, Any]:
    """Check a point and return its values by address."""
    return {p.address: value for p, value in zip(parameters, checked_point(parameters, point), strict=True)}
