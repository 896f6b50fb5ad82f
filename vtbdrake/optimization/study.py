"""A study: problem (18) solved, recorded rollout by rollout, interrupted and resumed at will."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor as FuturesExecutor
from typing import TYPE_CHECKING, Any, Self

from vtbdrake.optimization.identity import code_changes, describe, differences, plain, plain_options, revision, versions
from vtbdrake.optimization.outcome import Trial
from vtbdrake.optimization.parameter import checked_point
from vtbdrake.optimization.solvers.catalogue import make_solver
from vtbdrake.optimization.solvers.solver import Point, Solver
from vtbdrake.optimization.study_error import StudyError
from vtbdrake.optimization.study_file import StudyFile
from vtbdrake.optimization.study_record import StudyRecord
from vtbdrake.optimization.study_run import StudyRun, check_budget
from vtbdrake.rollout import Executor, make_executor
from vtbdrake.rollout.arguments import as_whole

if TYPE_CHECKING:
    from optuna.storages import BaseStorage

    from vtbdrake.optimization.problem import Problem


# What is called with a study and each of its new trials.
Callback = Callable[["Study", Trial], Any]


class Study(StudyRecord):
    """The rollouts and points of one problem, in one file or in memory.

    A study is made by `Problem.study`, which also resumes it, or opened to be read, and be given points, by `open`,
    while another process runs it.

    What it examines depends on the problem, the solver, the seed and the budget that the solver was made for, and not
    on the executor: a study that is resumed makes its solver anew and tells it what is known, so that it goes on as if
    it had not been interrupted. For a larger budget than before, the solver is made anew; what it asks for again is
    known, and costs nothing.

    Attributes:
        reason: why the last run in this process ended: ``budget``, ``time``, ``target``, ``solver``, ``stopped``,
            ``interrupted``.
    """

    def __init__(self, file: StudyFile, problem: Problem | None = None) -> None:
        super().__init__(file)
        self._problem = problem
        self._stopped = False

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Self:
        """Open a study file to be read and to be given points.

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
        allow_changed_code: bool = False,
    ) -> Self:
        """Begin or resume the study of a problem; see `Problem.study`."""
        meta: dict[str, Any] = {
            "problem": describe(problem),
            "solver": "auto" if solver is None else solver,
            "seed": 0 if seed is None else as_whole("a seed", seed),
            "options": plain_options(options or {}),
            "versions": versions(),
            "revision": revision(problem.scenario),
            "units": list(problem.units),
        }
        # An unknown solver, or one that cannot solve the problem, is told before there is a file.
        made = _solver(problem, meta, rollouts=None)
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
            code = code_changes(study._meta["problem"], meta["problem"])
            if code and not allow_changed_code:
                raise StudyError(
                    f"{path} was made with other code ({'; '.join(code)}): give another file, restore the code, or, if "
                    "its rollouts would come out the same, go on with allow_changed_code=True"
                )
            for key, value in given.items():
                if value is not None and study._meta[key] != meta[key]:
                    raise StudyError(
                        f"{path} was begun with {key} {study._meta[key]!r}, not {meta[key]!r}: leave {key} out to "
                        "resume it, or give another file"
                    )
            if code:
                study._file.change_code(meta["problem"], code, versions=meta["versions"], revision=meta["revision"])
                study._meta = study._file.meta
        except BaseException:
            study.close()
            raise
        return study

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
        on_error: str = "record",
        callbacks: Sequence[Callback] = (),
        progress: bool = True,
    ) -> Self:
        """Run rollouts until the budget is spent, the target is reached, or the solver is finished. Ctrl-C keeps all.

        Args:
            rollouts: how many the study has in the end, those of former runs included.
            seconds: the wall time of this run.
            target: ends as soon as a point is at least as good: a quality as large, a cost as small. With several
                workers, others may be finished by then.
            racing: drop points that can no longer win before all their conditions have run (see `Judge`). By default,
                where there are several conditions and one quality.
            executor, workers: see `Problem.sweep`.
            time_limit: in seconds; a rollout that takes longer fails.
            on_error: what becomes of a rollout in which a quality or constraint function raises, is negative or NaN.
                ``record``: it counts as failed, with the message, and the first of a run is logged; ``raise``: the run
                ends there.
            callbacks: each is called with the study and a trial when that is judged and recorded for the first time,
                batch by batch, in this thread. It may set attributes, add points, or `stop` the run; what it raises
                ends the run.
            progress: show a progress bar: rollouts per second, the best so far, the time left. Where there is neither a
                terminal nor a notebook, log it every half minute instead, at the level INFO.

        Raises:
            ValueError: there is no budget at all, or it makes no sense; an executor or solver is unknown.
            StudyError: another process runs the study, or it was opened without its problem.
            QualityError: f raises, is negative or NaN, and ``on_error`` is ``raise``. What was finished is kept.
        """
        problem = self._problem
        if problem is None:
            raise StudyError(
                f"{self._file.path} was opened without its problem: run problem.study({str(self._file.path)!r})"
            )
        check_budget(problem, rollouts=rollouts, seconds=seconds, target=target)
        if on_error not in ("record", "raise"):
            raise ValueError(f"on_error is 'record' or 'raise', not {on_error!r}")
        for callback in callbacks:
            if not callable(callback):
                raise ValueError(f"a callback is a function of a study and a trial, not {callback!r}")

        def after_batch(batch: int) -> bool:
            for trial in self._trials_of(batch) if callbacks else ():
                for callback in callbacks:
                    callback(self, trial)
            return self._stopped

        self._stopped = False
        racing = len(problem.conditions) > 1 and len(problem.objectives) == 1 if racing is None else racing
        budget = rollouts if rollouts is not None else 10**9
        chosen = make_executor(
            executor, testbed=problem.testbed, rollouts=budget, workers=workers, time_limit=time_limit
        )
        try:
            with self._file.running(versions=versions(), revision=revision(problem.scenario)) as reason:
                solver = self._make_solver(problem, rollouts, racing=racing)
                run = StudyRun(
                    self._file,
                    problem,
                    solver,
                    chosen,
                    racing=racing,
                    catch=on_error == "record",
                    progress=progress,
                    after_batch=after_batch,
                )
                self.reason, self.message = run.until(rollouts=rollouts, seconds=seconds, target=target)
                reason.append(self.reason)
        finally:
            if chosen is not executor:
                chosen.close()
        return self

    def stop(self) -> None:
        """End the run when the batch of points that is being judged is complete.

        It may be called by a callback, or in another thread.
        """
        self._stopped = True

    def _make_solver(self, problem: Problem, rollouts: int | None, *, racing: bool) -> Solver:
        self._meta = self._file.meta
        made_for, raced = self._meta.get("budget", 0), self._meta.get("racing")
        # Another budget may be another sequence: a smaller one only ends the same one earlier.
        larger = made_for is not None and (rollouts is None or rollouts > made_for)
        if larger or racing != raced:
            self._file.begin_anew(budget=rollouts if larger else made_for, racing=racing)
            self._meta = self._file.meta
        return _solver(problem, self._meta, rollouts=self._meta["budget"])

    def add(self, *points: Any) -> None:
        """Give points by hand, each a mapping address -> value or values in the order of the parameters.

        They are judged before anything else that the study asks for next, in whatever process runs it, and the solver
        is told of them.

        Raises:
            ValueError: a point has other entries than the study, or one lies outside its range.
        """
        self._file.give([self._checked(point) for point in points])

    def edit(self, number: int, point: Any) -> None:
        """Put another point in the place of one of the `queue`.

        Raises:
            StudyError: no point of that number waits: it was judged, removed, or never given.
            ValueError: as in `add`.
        """
        self._file.change_queue(as_whole("the number of a point in the queue", number), self._checked(point))

    def remove(self, number: int) -> None:
        """Take a point out of the `queue`: it is not judged.

        Raises:
            StudyError: no point of that number waits: it was judged, removed, or never given.
        """
        self._file.change_queue(as_whole("the number of a point in the queue", number), None)

    def set_attribute(self, key: str, value: Any, *, point: Any = None) -> None:
        """Set an attribute of the study, or of a point: who ran it, why the point looks odd. It changes no result.

        Args:
            key: its name; an attribute of the same name is replaced.
            value: a number, a word, or lists and dicts of these.
            point: as in `add`; None for the study itself.

        Raises:
            ValueError: the value cannot be kept, or the point is none of the study's space.
        """
        if not isinstance(key, str) or not key:
            raise ValueError(f"an attribute has a name, such as 'operator', not {key!r}")
        (kept,) = plain({key: value}, "attributes").values()
        self._file.set_attribute(None if point is None else self._checked(point), key, kept)

    def _checked(self, point: Any) -> Point:
        return checked_point(self.parameters, point)

    def import_optuna(self, storage: str | BaseStorage, name: str) -> int:
        """Gives the points of a study in Optuna's storage, as `add` does: evaluated by whomever, or only enqueued.

        They are judged by rollouts of this problem: a value from elsewhere says nothing about it. Points that are
        judged already, or wait in the queue, are left out, so that what `to_optuna` wrote costs nothing when it comes
        back.

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


def _solver(problem: Problem, meta: Mapping[str, Any], *, rollouts: int | None) -> Solver:
    """The solver of a study, made for a budget of rollouts."""
    budget = None if rollouts is None else -(-rollouts // len(problem.conditions))
    return make_solver(
        meta["solver"],
        problem.parameters,
        objectives=len(problem.objectives),
        constraints=len(problem.constraints),
        seed=meta["seed"],
        budget=budget,
        **meta["options"],
    )
