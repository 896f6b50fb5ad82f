"""One run of a study: ask the solver, evaluate and record its points, tell the solver."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from math import inf, isfinite, isnan
from types import MappingProxyType
from typing import TYPE_CHECKING

from vtbdrake.common.argument_checks import as_number, as_whole
from vtbdrake.drake_workarounds.lost_interrupts import Interruptible
from vtbdrake.optimization.evaluator import ROUND, Evaluator, Gradients
from vtbdrake.optimization.problem import Problem
from vtbdrake.optimization.records import CONTROLS, STOP, TRY, Intervention, Outcome, RolloutKey, Trial
from vtbdrake.optimization.solvers.solver import Evaluation, Point, ask_within
from vtbdrake.optimization.study.interventions import FollowedSearch, search_after
from vtbdrake.optimization.study.study_file import (
    BUDGET,
    INTERRUPTED,
    REPLAYED,
    SOLVER,
    STOPPED,
    TARGET,
    TIME,
    StudyFile,
)
from vtbdrake.optimization.study.study_search import StudySearch
from vtbdrake.optimization.study.study_solver import StudySolver
from vtbdrake.rollout import Executor
from vtbdrake.rollout.executor import watched
from vtbdrake.rollout.task import quality_warning

if TYPE_CHECKING:
    from tqdm.auto import tqdm

_log = logging.getLogger(__name__)

# A solver of a small space may ask for known points for ever; the run ends after this many such batches in a row.
_KNOWN_BATCHES = 50

# A paused run looks this often whether it may go on, in seconds.
POLL_PERIOD = 0.1

# The period of log messages about the progress without a terminal, in seconds.
LOG_PERIOD = 30.0


class _RunEnd(Exception):  # noqa: N818
    """The end of a run in the middle of a batch."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason
        self.message = message


class StudyRun:
    """One run of a study. The solver is first told the recorded evaluations, batch by batch.

    Before every batch it looks for interventions in the file. A new one has its effect on a batch that has not begun,
    and the file says on which.

    Args:
        file: The file of the study; this process has claimed it.
        problem: The problem to solve.
        executor: Runs the rollouts.
        racing: See `Evaluator`.
        catch: Whether a failed quality function fails its rollout only; see `RolloutTask`.
        progress: Show a progress bar in a terminal or a notebook, and log the progress elsewhere.
        after_batch: Called with the number of every batch that is recorded for the first time.
        outcomes: Outcomes of another study of the problem, which are recorded instead of rollouts.
        batches: The number of batches after which the run ends; None: any number.
    """

    def __init__(
        self,
        file: StudyFile,
        problem: Problem,
        executor: Executor,
        *,
        racing: bool,
        catch: bool,
        progress: bool,
        after_batch: Callable[[int], None],
        outcomes: Mapping[RolloutKey, Outcome] = MappingProxyType({}),
        batches: int | None = None,
    ) -> None:
        self._file = file
        self._problem = problem
        self._task = replace(problem.task, catch=True) if catch else problem.task
        self._warned = False
        self._executor = executor
        self._finished_elsewhere = outcomes
        self._last_batch = inf if batches is None else batches
        self._outcomes: dict[RolloutKey, Outcome] = file.outcomes()
        interventions = file.interventions()
        begun = StudySearch.of(file.meta)
        self._solver = StudySolver(begun, racing=racing)
        # The changes with an effect on a batch, by its number.
        self._changes: dict[int | None, list[Intervention]] = {}
        self._add_changes(intervention for intervention in interventions if intervention.kind not in CONTROLS)
        self._followed = FollowedSearch(file)
        self._newest = self._followed.now()
        # Their run has ended in another way.
        stops = [i for i in interventions if i.kind == STOP and i.batch is None]
        file.begin(stops, batch=file.completed_batches())
        # Not the budget of this run: how points are evaluated must not depend on where a study is interrupted.
        budget, parallel = file.meta["budget"], file.meta.get("parallel")
        self._evaluator = Evaluator(
            problem,
            self._outcomes,
            self._roll_out,
            racing=racing,
            budget=inf if budget is None else budget,
            round_size=max(ROUND, parallel or 1),
        )
        self._gradients = Gradients(problem) if self._solver.wants_gradient else None
        self._slopes = file.gradients()
        self._completed = file.completed_batches()
        # The trials of earlier solvers, made for other budgets: point -> whether one of them is exact.
        self._earlier: dict[Point, bool] = {}
        self._new_from = self._completed
        for trial in file.earlier_trials():
            self._earlier[trial.point] = trial.exact or self._earlier.get(trial.point, False)
            self._new_from = max(self._new_from, trial.batch + 1)
        self._progress = progress
        self._after_batch = after_batch
        self._next_log = inf
        self._bar: tqdm | None = None  # type: ignore[type-arg]
        self._requested: float = inf
        self._limit: float = inf
        self._deadline = inf
        self._target: float | None = None

    def until(
        self, *, rollouts: int | None, seconds: float | None = None, target: float | None = None
    ) -> tuple[str, str]:
        """Run the study; return the reason of the end, in a word and in a sentence.

        Args:
            rollouts: The number of rollouts of the study at the end, those so far included; None: no limit.
            seconds: The longest wall time of this run, in seconds; None: no limit.
            target: The value of the quality at which the run ends, in its unit; None: none.
        """
        from tqdm.auto import tqdm  # Here, because worker processes need none.

        self._requested = inf if rollouts is None else rollouts
        self._set_limit()
        if self._newest.budget_from is not None and self._limit != self._requested:
            _log.warning("%s holds, not the budget of this run", self._budget_text)
        self._deadline = inf if seconds is None else time.monotonic() + seconds
        if target is not None:
            self._target = self._problem.objectives[0].sign * target
        shown = self._progress and watched()
        name = f"study ({self._solver.name})"
        if self._progress and not shown:
            self._next_log = time.monotonic() + LOG_PERIOD
        with tqdm(
            total=None if self._limit == inf else self._limit,
            initial=len(self._outcomes),
            desc=name,
            unit="rollout",
            disable=not shown,
        ) as self._bar:
            try:
                return self._batches()
            except _RunEnd as end:
                return end.reason, end.message
            except KeyboardInterrupt:
                _log.warning("interrupted: the %d rollouts that are finished are kept", len(self._outcomes))
                return INTERRUPTED, "it was interrupted"
            finally:
                self._solver.close()

    def _batches(self) -> tuple[str, str]:
        if self._completed < self._new_from:
            self._obey(self._new_from)
            self._roll_out_queue()
        batch, silent = 0, 0
        while silent < _KNOWN_BATCHES:
            if batch >= self._last_batch:
                return REPLAYED, f"the {batch} batches of the other study are replayed"
            points_by_hand = self._intervene(batch)
            before = len(self._outcomes)
            if not self._one_batch(batch, points_by_hand):
                return self._end_of_solver()
            if batch >= self._completed:
                self._after_batch(batch)
            if batch >= self._new_from:
                new = len(self._outcomes) > before or not self._solver.circles
                silent = 0 if new else silent + 1
            self._show_best()
            batch += 1
        return SOLVER, f"{self._solver.name} asks only for points that are known"

    def _intervene(self, batch: int) -> list[Point]:
        """Make the changes that have an effect on a batch; return the points to try in it."""
        if batch >= self._completed:
            waiting = self._obey(batch)
            if waiting and batch >= self._new_from and not self._has_begun(batch):
                begun = self._file.begin(waiting, batch=batch)
                self._add_changes(begun)
                tried = [self._tried(intervention) for intervention in begun if intervention.kind == TRY]
                # Whoever tried a point may have run its rollouts.
                self._outcomes |= self._file.outcomes_of(tried)
        changes = self._changes.get(batch, [])
        # Points that are tried change no search.
        if any(intervention.kind != TRY for intervention in changes):
            search = search_after(self._solver.search, changes)
            # Once more than needed changes nothing: the best point may have been forbidden, or allowed again.
            self._solver.change(search)
            self._evaluator.restrict(search.allows, self._solver.evaluations, budget=search.budget)
        return [self._tried(intervention) for intervention in changes if intervention.kind == TRY]

    def _add_changes(self, changes: Iterable[Intervention]) -> None:
        for intervention in changes:
            self._changes.setdefault(intervention.batch, []).append(intervention)

    def _obey(self, batch: int) -> list[Intervention]:
        """Wait as long as the study is paused; return the changes that wait for a batch.

        Raises:
            _RunEnd: Someone has stopped the study, or the time is over.
        """
        logged = False
        while True:
            waiting = self._file.interventions(waiting=True)
            controls = [intervention for intervention in waiting if intervention.kind in CONTROLS]
            if waiting:
                self._newest = self._followed.now()
                self._set_limit()
            if controls:
                self._file.begin(controls, batch=batch)
            for control in controls:
                if control.kind == STOP:
                    raise _RunEnd(STOPPED, f"{control.name} stopped it (intervention {control.number})")
                _log.info("%s by %s (intervention %d)", control.kind, control.name, control.number)
            if not self._newest.paused:
                return [intervention for intervention in waiting if intervention.kind not in CONTROLS]
            if not logged:
                _log.warning("the study is paused, and waits for resume() or `vtbdrake study intervene FILE resume`")
            logged = True
            self._end_at_deadline()
            time.sleep(POLL_PERIOD)

    def _has_begun(self, batch: int) -> bool:
        """Return whether rollouts of a batch were finished by a run that was interrupted in it."""
        if batch > self._new_from:
            return False
        # Points that wait may have been run elsewhere.
        tried = {self._tried(i) for i in self._file.interventions(waiting=True) if i.kind == TRY}
        since = islice(self._outcomes, self._file.rollouts_before(), None)
        return any(key not in self._evaluator.needed and key[0] not in tried for key in since)

    def _tried(self, intervention: Intervention) -> Point:
        values = intervention.payload["point"]
        return tuple(values[parameter.address] for parameter in self._problem.parameters)

    def _set_limit(self) -> None:
        """Take the newest budget: it limits the rollouts at once, also in a batch that was interrupted."""
        search = self._newest
        budget = self._requested if search.budget_from is None else search.budget
        self._limit = inf if budget is None else budget

    @property
    def _budget_text(self) -> str:
        number = self._newest.budget_from
        return f"the budget of {self._limit:g} rollouts" + ("" if number is None else f" (intervention {number})")

    def _one_batch(self, batch: int, points_by_hand: Sequence[Point]) -> bool:
        """Evaluate the points given by hand, then the solver's; return whether there were any."""
        proposed: list[Point] = []
        try:
            # By hand first: a solver may ask for all that the budget allows.
            by_hand = self._evaluate(points_by_hand, tell=self._solver.tell_by_hand)
            proposed = self._ask()
            evaluations = self._evaluate(proposed, tell=self._solver.tell)
        except BaseException:
            # It is evaluated again in the next run. Until then, the complete points can be seen.
            so_far = ([self._evaluator.evaluation(point) for point in points] for points in (points_by_hand, proposed))
            self._record(batch, *so_far, complete=False)
            raise
        if batch >= self._completed and (points_by_hand or proposed):
            self._record(batch, by_hand, evaluations, complete=True)
        return bool(points_by_hand or proposed)

    def _roll_out_queue(self) -> None:
        """Run the points given by hand before a new solver, which repeats known points, reaches new ones.

        The solver learns of these points where the study continues. Before that, it would ask for known points and, in
        the same batch, for more than the budget allows.
        """
        points = [self._tried(i) for i in self._file.interventions(waiting=True) if i.kind == TRY]
        keys = [(point, condition) for point in points for condition in range(len(self._problem.conditions))]
        try:
            self._roll_out([key for key in dict.fromkeys(keys) if key not in self._outcomes])
        finally:
            evaluations = [self._evaluator.evaluation(point) for point in points]
            self._record(self._new_from, evaluations, [], complete=False)

    def _evaluate(self, points: Sequence[Point], *, tell: Callable[[Sequence[Evaluation]], None]) -> list[Evaluation]:
        """Evaluate points and tell the solver."""
        if not points:
            return []
        self._end_at_target(points)
        evaluations = self._evaluator.evaluate(points)
        tell([self._with_gradient(evaluation) for evaluation in evaluations])
        return evaluations

    def _ask(self) -> list[Point]:
        """Return the points that the solver asks for; wait until the time limit at most."""
        points = ask_within(self._solver, self._deadline - time.monotonic())
        if points is None:
            raise _RunEnd(TIME, f"the time is over, before {self._solver.name} asked for more points")
        return points

    def _end_of_solver(self) -> tuple[str, str]:
        left, point = self._limit - len(self._outcomes), len(self._problem.conditions)
        rest = f" but for {left:g}, fewer than the {point} that a point takes" if 0 < left < point else ""
        spent = f"{self._budget_text} is spent{rest}"
        if self._solver.success is False and left < point:
            return BUDGET, spent
        how = {True: "is finished", False: "has ended without success", None: "has ended"}[self._solver.success]
        parts = [f"{self._solver.name} {how}", self._solver.message, spent if rest else ""]
        return SOLVER, ": ".join(part for part in parts if part)

    def _roll_out(self, keys: Sequence[RolloutKey]) -> None:
        now = keys[: max(0, int(min(self._limit - len(self._outcomes), len(keys))))]
        # In a replayed study, finished rollouts are not simulated again.
        for key in now:
            if (outcome := self._finished_elsewhere.get(key)) is not None:
                self._finish(key, outcome)
                self._end_at_target([key[0]])
        limited = len(now) < len(keys)
        now = [key for key in now if key not in self._finished_elsewhere]
        points = [self._problem.assigned(point, condition=condition) for point, condition in now]
        self._end_at_deadline()
        results = self._executor.run(self._task, points) if points else iter(())
        try:
            with Interruptible() as interruptible:
                for index, result in results:
                    self._finish(now[index], Outcome.of(result))
                    self._end_at_target([now[index][0]])
                    self._end_at_deadline()
                    interruptible.raise_interrupt()
        finally:
            if points:
                results.close()  # type: ignore[attr-defined]
        if limited:
            raise _RunEnd(BUDGET, f"{self._budget_text} is spent")

    def _finish(self, key: RolloutKey, outcome: Outcome) -> None:
        point, condition = key
        self._outcomes[key] = outcome
        self._file.add(point, condition, outcome)
        self._warn(outcome)
        if time.monotonic() >= self._next_log:
            self._next_log += LOG_PERIOD
            self._log_progress()
        assert self._bar is not None
        self._bar.update()

    def _warn(self, outcome: Outcome) -> None:
        """Log once in a run that the quality function fails."""
        if not self._warned and (warning := quality_warning(outcome.message)):
            self._warned = True
            _log.warning("%s", warning)

    def _log_progress(self) -> None:
        of = "" if self._limit == inf else f" of {self._limit:g}"
        best = self._evaluator.best
        best_text = "" if best is None else f", best {self._evaluator.in_user_terms(best)[0]:.6g}"
        _log.info("study (%s): %d%s rollouts%s", self._solver.method, len(self._outcomes), of, best_text)

    def _with_gradient(self, evaluation: Evaluation) -> Evaluation:
        if self._gradients is None or not self._solver.wants_gradient or evaluation.failed:
            return evaluation
        point = evaluation.point
        if point not in self._slopes:
            self._slopes[point] = self._gradients.at(point)
            self._file.add_gradient(point, self._slopes[point])
        return replace(evaluation, gradient=self._slopes[point])

    def _end_at_target(self, points: Sequence[Point]) -> None:
        if self._target is None:
            return
        for point in points:
            evaluation = self._evaluator.evaluation(point)
            if evaluation.counts and evaluation.values[0] >= self._target:
                (value,) = self._evaluator.in_user_terms(evaluation)
                raise _RunEnd(TARGET, f"the target is reached: {value:g}")

    def _end_at_deadline(self) -> None:
        if time.monotonic() >= self._deadline:
            raise _RunEnd(TIME, "the time is over")

    def _record(
        self, batch: int, by_hand: Sequence[Evaluation], proposed: Sequence[Evaluation], *, complete: bool
    ) -> None:
        """Record the evaluated points; an incomplete batch is evaluated again in the next run."""
        origins = [*(("user", "by hand") for _ in by_hand), *(("solver", self._solver.method) for _ in proposed)]
        addresses = [parameter.address for parameter in self._problem.parameters]
        trials = {
            position: Trial(
                parameters=dict(zip(addresses, evaluation.point, strict=True)),
                values=self._evaluator.in_user_terms(evaluation),
                violations=evaluation.violations,
                exact=evaluation.exact,
                origin=origin,
                method=method,
                batch=batch,
            )
            for position, (evaluation, (origin, method)) in enumerate(zip([*by_hand, *proposed], origins, strict=True))
            if (complete or evaluation.exact)
            and not self._recorded(evaluation)
            and not (origin == "solver" and self._solver.repeats(evaluation))
        }
        self._file.save_trials(batch, trials, complete=complete)

    def _recorded(self, evaluation: Evaluation) -> bool:
        """Return whether a trial of an earlier solver already tells as much of the point."""
        exact = self._earlier.get(evaluation.point)
        return exact is not None and (exact or not evaluation.exact)

    def _show_best(self) -> None:
        if self._evaluator.best is not None:
            assert self._bar is not None
            (value,) = self._evaluator.in_user_terms(self._evaluator.best)
            self._bar.set_postfix_str(f"best {value:.6g}", refresh=False)


def renew_solver(file: StudyFile, search: StudySearch, *, rollouts: int | None, racing: bool) -> None:
    """Let the solver begin from its first batch if the budget is larger than the one for which it was made.

    Args:
        file: The file of the study; this process has claimed it.
        search: The search as the interventions leave it.
        rollouts: The number of rollouts of the study at the end of the run; None: no limit.
        racing: Whether points race in the run; a solver goes on only with points that race, or do not, as before.
    """
    meta = file.meta
    made_for, raced = meta.get("budget", 0), meta.get("racing")
    # A larger budget may be another sequence of points; a smaller one only ends the same sequence earlier.
    larger = made_for is not None and (rollouts is None or rollouts > made_for)
    if raced is not None and search.budget_from is not None:
        larger = False  # The budget comes from an intervention.
    if larger or racing != raced:
        file.begin_anew(budget=rollouts if larger else made_for, racing=racing)


def check_budget(problem: Problem, *, rollouts: int | None, seconds: float | None, target: float | None) -> None:
    """Check the budget of a run.

    Args:
        problem: The problem.
        rollouts: The number of rollouts of the study at the end; None: no limit.
        seconds: The longest wall time of the run, in seconds; None: no limit.
        target: The value of the quality at which the run ends, in its unit; None: none.

    Raises:
        ValueError: There is no budget at all, one is not positive or NaN, or a target is given for several qualities.
    """
    if rollouts is None and seconds is None and target is None:
        raise ValueError("a study runs until its budget is spent: give rollouts=, seconds= or target=")
    if rollouts is not None and as_whole("a budget of rollouts", rollouts) < 1:
        raise ValueError(f"a budget is at least one rollout, not {rollouts}")
    if target is not None and isnan(as_number("a target", target)):
        raise ValueError("a target is a number, not nan: no point would ever reach it")
    if seconds is not None and not (isfinite(as_number("a budget of wall time", seconds)) and seconds > 0.0):
        raise ValueError(f"a budget of wall time is positive and finite, not {seconds} s")
    if target is not None and len(problem.objectives) > 1:
        raise ValueError("a target belongs to one quality, but the problem has several")
