"""Studies: solutions of problem (18) that record every rollout, so that they can be interrupted and resumed."""

from __future__ import annotations

import getpass
import logging
import os
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Executor as FuturesExecutor
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from vtbdrake import upper_layers
from vtbdrake.common.argument_checks import all_of, as_flag, as_whole, check_takes, counted
from vtbdrake.common.closing import Closing
from vtbdrake.common.extras import extra_module
from vtbdrake.common.failures import safe_text
from vtbdrake.common.interrupt import interrupt_taken
from vtbdrake.common.summary_html import summary_html
from vtbdrake.optimization.identity import (
    adds_conditions,
    code_changes,
    describe,
    differences,
    plain,
    revision,
    versions,
)
from vtbdrake.optimization.parameter import Choice, Dimension, checked_point, point_text, short_address
from vtbdrake.optimization.pareto import undominated
from vtbdrake.optimization.records import DrivenTrial, Intervention, Outcome, RolloutKey, Trial
from vtbdrake.optimization.statement import statement
from vtbdrake.optimization.study.interventions import (
    CONTROLS,
    PAUSE,
    RESUME,
    STOP,
    TRY,
    FollowedSearch,
    StudySearch,
    check_arguments,
)
from vtbdrake.optimization.study.study_error import StudyError
from vtbdrake.optimization.study.study_file import StudyFile
from vtbdrake.optimization.study.study_run import BUDGET, INTERRUPTED, SOLVER, TARGET, StudyRun, check_budget
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

_log = logging.getLogger(__name__)

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
        self._followed = FollowedSearch(file)
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
        meta = _begun(problem, requested)
        study = cls(StudyFile(path, meta=meta), problem)
        try:
            extended = more_conditions and adds_conditions(study._meta["problem"], meta["problem"])
            if not extended:
                _refuse_other_problem(path, study._meta["problem"], meta["problem"])
            code = code_changes(study._meta["problem"], meta["problem"])
            if code and not allow_changed_code:
                raise StudyError(
                    f"{path} was made with other code ({'; '.join(code)}): give another file, restore the code, or, if "
                    "its rollouts would come out the same, go on with allow_changed_code=True"
                )
            for key, value in requested.items():
                if value is not None and study._meta.get(key) != meta[key]:
                    raise StudyError(
                        f"{path} was begun with {key} {study._meta.get(key)!r}, not {meta[key]!r}: leave {key} out to "
                        "resume it, or give another file"
                    )
            if blind := _unreadable(meta["problem"]):
                _log.warning("%s", blind)
            if code:
                study._file.change_code(meta["problem"], code, versions=meta["versions"], revision=meta["revision"])
            if extended:
                study._file.add_conditions(meta["problem"])
            study._meta = study._file.meta
        except BaseException:
            study.close()
            raise
        return study

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

    # -- running it

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
                self._begin_solver(rollouts, racing=racing)
            study_run = StudyRun(self._file, problem, opened, racing=racing, after_batch=after_batch, **settings)
            self.reason, self.message = study_run.until(**budget)
            return self.reason

        most = rollouts if rollouts is not None else 10**9
        with borrowed(problem, executor, rollouts=most, workers=workers, time_limit=time_limit) as opened:
            self._file.while_claimed(run, versions=versions(), revision=revision(problem.scenario))
        if self.reason == INTERRUPTED:
            interrupt_taken()

    def _begin_solver(self, rollouts: int | None, *, racing: bool) -> None:
        """Let the solver begin from its first batch if the budget is larger than the one for which it was made."""
        self._meta = self._file.meta
        made_for, raced = self._meta.get("budget", 0), self._meta.get("racing")
        # A larger budget may be another sequence of points; a smaller one only ends the same sequence earlier.
        larger = made_for is not None and (rollouts is None or rollouts > made_for)
        if raced is not None and self.search.budget_from is not None:
            larger = False  # The budget comes from an intervention.
        if larger or racing != raced:
            self._file.begin_anew(budget=rollouts if larger else made_for, racing=racing)
            self._meta = self._file.meta

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
        (intervention,) = self._intervene(kind, [payload], by=by)
        return intervention

    def _intervene(self, kind: str, payloads: Sequence[dict[str, Any]], *, by: str | None) -> list[Intervention]:
        for payload in payloads:
            check_arguments(kind, payload)
        self._refuse_if_finished(kind)
        stored = [plain(payload, f"the arguments of {kind}") for payload in payloads]
        return self._file.intervene(kind, stored, name=safe_text(by) if by else _user(), check=self._check_added)

    def _check_added(self, interventions: Sequence[Intervention]) -> None:
        """Check interventions behind all others. Points that wait stay valid: the widest ranges only grow."""
        search = self.search.after(interventions)
        if any(intervention.kind != TRY for intervention in interventions):
            search.check()
        _check_points(search, interventions)

    def _check_changed(self, before: Intervention, after: Intervention | None) -> None:
        """Check what an intervention that waits has become."""
        if before.kind == TRY:
            _check_points(self.search, [] if after is None else [after])
            return
        # Not by what was read before: the change may be taken back.
        search = StudySearch.of(self._file.meta).after(self._file.interventions())
        search.check()
        # A range may not be that wide any more.
        _check_points(search, self._file.interventions(waiting=True))

    def _refuse_if_finished(self, kind: str) -> None:
        if self.is_running:
            return
        if kind == STOP:
            raise StudyError(f"no process runs {self.path or 'the study'}: there is nothing to stop")
        if kind in (RESUME, TRY, "budget") or self._budget_waits():
            return
        session = self._file.last_session()
        reason = session["reason"] if session is not None else None
        if reason not in (BUDGET, TARGET, SOLVER):
            return
        if kind == PAUSE or reason == BUDGET:
            raise StudyError(
                f"{self.path or 'the study'} is finished (its last run ended by {reason}, with {len(self)} rollouts): "
                "give it a larger budget first"
            )

    def _budget_waits(self) -> bool:
        """Return whether the newest budget waits for a batch; if any waits, it does."""
        number = self.search.budget_from
        budget = None if number is None else self._file.intervention(number)
        return budget is not None and budget.batch is None

    def pause(self, *, by: str | None = None) -> None:
        """Let the run finish its batch of points and wait; see `intervene`."""
        self.intervene("pause", by=by)

    def resume(self, *, by: str | None = None) -> None:
        """Let a paused run go on; see `intervene`."""
        self.intervene("resume", by=by)

    def stop(self, *, by: str | None = None) -> None:
        """End the run after the present batch of points; may be called by a callback, or anywhere else."""
        self.intervene(STOP, by=by)

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
        changes = [i for i in self.interventions if i.kind not in CONTROLS and i.batch is not None]
        numbers = [intervention.number for intervention in changes]
        for number in without:
            if number not in numbers:
                raise ValueError(f"no intervention {number} can be left out; those with an effect are: {numbers}")
        changes = [intervention for intervention in changes if intervention.number not in without]
        search = StudySearch.of(meta)
        for intervention in changes:
            search = search.after([intervention])
            if intervention.kind != TRY:
                search.check()
            else:
                checked_point(search.widest, intervention.payload["point"])
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
    def interventions(self) -> tuple[Intervention, ...]:
        """Return all interventions, in their order."""
        return tuple(self._file.interventions())

    @property
    def search(self) -> StudySearch:
        """Return the ranges, regions, solver and budget, as the interventions so far leave them."""
        return self._followed.now()

    @property
    def is_running(self) -> bool:
        """Return whether a process runs the study, this one or another."""
        return self._file.is_running

    @property
    def problem(self) -> Problem:
        """Return the problem, with the widest ranges that the study has had: all its points lie in them.

        Raises:
            StudyError: The study was opened without its problem.
        """
        if self._problem is None:
            raise self._no_problem()
        return self._problem.with_ranges(self.parameters)

    def _no_problem(self) -> StudyError:
        return StudyError(
            f"{self._file.path} was opened without its problem: run problem.study({str(self._file.path)!r})"
        )

    # -- points and attributes given by hand

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
        self._intervene(TRY, [{"point": _by_address(parameters, point)} for point in points], by=by)

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
        return self._file.add_drive(values, Outcome.of(result), course, name=safe_text(by) if by else _user())

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
        number = as_whole("the number of a point in the queue", number)
        self._file.change_waiting(number, payload, kind=TRY, check=self._check_changed)

    def remove(self, number: int) -> None:
        """Remove a point from the `queue`, or another intervention that waits for its batch.

        Raises:
            StudyError: No intervention of that number waits: it had its effect, was removed, or was never made.
            ValueError: A later intervention makes no sense without it.
        """
        self._file.change_waiting(as_whole("the number of an intervention", number), None, check=self._check_changed)

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
    def sessions(self) -> tuple[Mapping[str, Any], ...]:
        """Return every run: started, ended and reason (None if it was killed), versions and git revision."""
        return tuple(self._file.sessions())

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
        return _distinct_names(self._meta["problem"]["qualities"])

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
        if len(self.directions) > 1:
            raise ValueError("several qualities have no single best point: use pareto()")
        candidates = self._candidates()
        if not candidates:
            if not len(self):
                raise ValueError("no rollout is finished yet: call run()")
            feasible = " and keeps the constraints" if self._meta["problem"]["constraints"] else ""
            raise ValueError(f"no point has a quality{feasible}{self._failures()}")
        (sign,) = self.signs
        return max(candidates, key=lambda trial: sign * trial.value)

    def pareto(self) -> tuple[Trial, ...]:
        """Return the points that no other point beats in one quality without losing in another."""
        candidates = self._candidates()
        values = np.array([trial.values for trial in candidates]).reshape(len(candidates), len(self.signs))
        front = undominated(np.array(self.signs) * values)
        return tuple(trial for trial, best in zip(candidates, front, strict=True) if best)

    def _candidates(self) -> list[Trial]:
        allows = self.search.allows
        return [trial for trial in self.trials if trial.counts and allows(trial.point)]

    def _failures(self) -> str:
        messages = [outcome.message for outcome in self.rollouts.values() if outcome.failed]
        if not messages:
            return ""
        first = "" if len(set(messages)) == 1 else ", the first"
        return f"; {counted(len(messages), 'rollout')} failed{first}: {messages[0]}"

    def to_dict(self) -> dict[str, list[Any]]:
        """Return columns by name, one entry per trial.

        The columns are the parameters by address, the qualities, the violations of the constraints, the origin of the
        trial (solver or user, method, batch), and its attributes (None if it does not have one).
        """
        trials = self.trials
        columns: dict[str, list[Any]] = {d.address: [t.parameters[d.address] for t in trials] for d in self.parameters}
        for k, name in enumerate(self.names):
            columns[name if name not in columns else f"{name} {k}"] = [t.values[k] for t in trials]
        for k, constraint in enumerate(self._meta["problem"]["constraints"]):
            name = f"violation of {constraint['name']}"
            columns[name if name not in columns else f"{name} {k}"] = [t.violations[k] for t in trials]
        for name in ("feasible", "exact", "origin", "method", "batch"):
            columns[name] = [getattr(trial, name) for trial in trials]
        for key in dict.fromkeys(key for trial in trials for key in trial.attributes):
            columns[f"attribute {key}"] = [trial.attributes.get(key) for trial in trials]
        return columns

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
        trials, outcomes = self.trials, self.rollouts
        methods = Counter(trial.method for trial in trials)
        lines = [
            f"{counted(len(trials), 'point')}, {counted(len(outcomes), 'rollout')}; solver {self._meta['solver']}, "
            f"seed {self._meta['seed']}{self._width}: "
            + ", ".join(f"{method} ({count})" for method, count in methods.items())
        ]
        for change in self._meta.get("changes", []):
            lines.append(f"the code changed on {change['at'][:10]}: {'; '.join(change['what'])}")
        if blind := _unreadable(self._meta["problem"]):
            lines.append(blind)
        if self.message:
            lines.append(f"ended: {self.message}")
        lines.append(self._result())
        dropped = sum(not trial.exact for trial in trials)
        if dropped:
            saved = len(trials) * len(self._meta["problem"]["conditions"]) - len(outcomes)
            lines.append(
                f"racing dropped {counted(dropped, 'point')} before all conditions had run, "
                f"{counted(saved, 'rollout')} less"
            )
        ends = Counter(outcome.end for outcome in outcomes.values())
        times = sorted(outcome.wall_time for outcome in outcomes.values() if outcome.wall_time == outcome.wall_time)
        if times:
            lines.append(
                f"rollouts took {sum(times):.3g} s in all, the median {times[len(times) // 2]:.3g} s; they ended by "
                + ", ".join(f"{end} ({count})" for end, count in ends.items())
                + self._failures()
            )
        return "\n".join(lines)

    @property
    def _width(self) -> str:
        parallel = self._meta.get("parallel")
        return "" if parallel is None else f", {parallel} rollouts side by side"

    def _result(self) -> str:
        """Return the best point, or the size of the Pareto front, in a line."""
        if len(self.directions) > 1:
            return f"Pareto front of {counted(len(self.pareto()), 'point')}"
        try:
            best = self.best
        except ValueError as error:
            return f"best: {error}"
        return f"best: {self.names[0]} = {best.value:g} at {point_text(self.parameters, best.point, self.units)}"

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


def _distinct_names(qualities: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return the names of the functions; with what they read where names alone are equal, and at last with numbers."""
    names = tuple(str(quality["name"]) for quality in qualities)
    if len(set(names)) == len(names):
        return names
    addresses = {address for quality in qualities for address in quality["of"]}
    read = [", ".join(short_address(address, addresses) for address in quality["of"]) for quality in qualities]
    names = tuple(f"{name} of {variables}" for name, variables in zip(names, read, strict=True))
    if len(set(names)) == len(names):
        return names
    names = tuple(f"{name} ({quality['reading']})" for name, quality in zip(names, qualities, strict=True))
    return names if len(set(names)) == len(names) else tuple(f"{name} {k}" for k, name in enumerate(names, 1))


def _unreadable(problem: Mapping[str, Any]) -> str:
    """Return a text about changes of a problem's code that would go unnoticed; empty if none would."""
    parts = [f"{', '.join(types)} (in {name})" for name, types in problem.get("unreadable", {}).items()]
    return f"changes would go unnoticed inside objects that cannot be read: {'; '.join(parts)}" if parts else ""


def _check_points(search: StudySearch, interventions: Sequence[Intervention]) -> None:
    """Check that the points that interventions try lie within the widest ranges.

    Raises:
        ValueError: One does not.
    """
    for intervention in interventions:
        if intervention.kind == TRY:
            checked_point(search.widest, intervention.payload["point"])


def _by_address(parameters: Sequence[Dimension], point: Any) -> dict[str, Any]:
    """Check a point and return its values by address."""
    return {p.address: value for p, value in zip(parameters, checked_point(parameters, point), strict=True)}


def _begun(problem: Problem, requested: Mapping[str, Any]) -> dict[str, Any]:
    """Return the contents of the file of a new study: the problem, the solver and the software.

    Raises:
        ValueError: The solver is unknown, cannot solve the problem, or does not take what is requested.
    """
    options, parallel, seed = requested["options"], requested["parallel"], requested["seed"]
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"the options of a solver are given as {{name: value, ...}}, not as {options!r}")
    if parallel is not None and as_whole("parallel", parallel) < 1:
        raise ValueError(f"parallel is the number of rollouts side by side, at least one, not {parallel}")
    meta: dict[str, Any] = {
        "problem": describe(problem),
        "solver": "auto" if requested["solver"] is None else requested["solver"],
        "seed": 0 if seed is None else as_whole("a seed", seed),
        "options": plain(options or {}, "the options of its solver"),
        "parallel": None if parallel is None else as_whole("parallel", parallel),
        "versions": versions(),
        "revision": revision(problem.scenario),
        "units": list(problem.units),
        "quality_units": [quality.unit for quality in problem.objectives],
        "statement": statement(problem),
        "limits": _limits(problem),
    }
    solver = StudySearch.of(meta).make_solver()
    solver.close()
    return {**meta, "solver": solver.name}


def _refuse_other_problem(path: Any, theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> None:
    if changed := differences(theirs, ours):
        raise StudyError(
            f"{path} is a study of another problem ({'; '.join(changed)}): give another file, or restore the problem"
        )


def _limits(problem: Problem) -> list[list[float] | None]:
    """Return the bounds of the varied variables; None for a choice, and for a field of the scenario."""
    variables = problem.testbed.variables()
    return [
        None
        if parameter.is_field or isinstance(parameter, Choice)
        else [float(np.asarray(bound)) for bound in variables[parameter.address].bounds]
        for parameter in problem.parameters
    ]


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # A container may have a user without a name.
        return f"user {os.getuid()}"
