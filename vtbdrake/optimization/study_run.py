"""One run of a study: asks the solver, judges, records, tells, until it is enough."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf, isfinite, isnan
from queue import Empty, SimpleQueue

from tqdm.auto import tqdm

from vtbdrake.optimization.gradient import Gradients
from vtbdrake.optimization.judge import Judge
from vtbdrake.optimization.outcome import Outcome, Row
from vtbdrake.optimization.problem import Problem
from vtbdrake.optimization.solvers.solver import Evaluation, Point, Solver
from vtbdrake.optimization.study_file import StudyFile, TrialRow
from vtbdrake.rollout import Executor
from vtbdrake.rollout.arguments import as_number, as_whole
from vtbdrake.rollout.executor import watched
from vtbdrake.rollout.task import QUALITY_FAILED
from vtbdrake.testbed.interrupt import Interruptible

_log = logging.getLogger(__name__)

BUDGET, TIME, TARGET, SOLVER, INTERRUPTED, STOPPED = "budget", "time", "target", "solver", "interrupted", "stopped"

# A solver of a small space may ask for ever for what is known; so many batches in a row without news are enough.
_WITHOUT_NEWS = 50

# Without a terminal, the progress is logged so often, in seconds.
LOG_PERIOD = 30.0


class _SpentError(Exception):
    """The run is over, in the middle of a batch."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason
        self.message = message


class StudyRun:
    """Runs a study in a file once. What the file holds is told to the solver first, batch by batch as it was found.

    Args:
        file: of the study; this process has claimed it.
        problem: what is asked.
        solver: made for the budget that the file names.
        executor: runs the rollouts.
        racing: see `Judge`.
        catch: a quality function that fails fails its rollout; see `RolloutTask`.
        progress: show a progress bar in a terminal or a notebook, and log the progress elsewhere.
        after_batch: is called with the number of every batch that is judged and recorded for the first time; returns
            whether the run is to end.
    """

    def __init__(
        self,
        file: StudyFile,
        problem: Problem,
        solver: Solver,
        executor: Executor,
        *,
        racing: bool,
        catch: bool,
        progress: bool,
        after_batch: Callable[[int], bool],
    ) -> None:
        self._file = file
        self._problem = problem
        self._task = replace(problem.task, catch=True) if catch else problem.task
        self._warned = False
        self._solver = solver
        self._executor = executor
        self._known: dict[Row, Outcome] = file.outcomes()
        # Not that of this run: how points are judged must not depend on where a study is interrupted.
        budget = file.meta["budget"]
        self._judge = Judge(
            problem, self._known, self._roll_out, racing=racing, budget=inf if budget is None else budget
        )
        self._gradients = Gradients(problem) if solver.wants_gradient else None
        self._slopes = file.gradients()
        self._told = file.told()
        # What the solver had asked for before it was made for a larger budget: point -> whether it is exact.
        earlier = [row for row in file.trials() if row[1] < 0]
        self._earlier = {row[2]: row[5] for row in sorted(earlier, key=lambda row: row[5])}
        self._new_from = max([self._told, *(row[0] + 1 for row in earlier)])
        self._progress = progress
        self._after_batch = after_batch
        self._next_log = inf
        self._bar: tqdm | None = None  # type: ignore[type-arg]
        self._limit: float = inf
        self._deadline = inf
        self._target: float | None = None

    def until(self, *, rollouts: int | None, seconds: float | None, target: float | None) -> tuple[str, str]:
        """Run, and return why it ended, in a word and in a sentence."""
        self._limit = inf if rollouts is None else rollouts
        self._deadline = inf if seconds is None else time.monotonic() + seconds
        if target is not None:
            self._target = -target if self._problem.objectives[0].minimize else target
        shown = self._progress and watched()
        name = f"study ({self._solver.name})"
        if self._progress and not shown:
            self._next_log = time.monotonic() + LOG_PERIOD
        with tqdm(total=rollouts, initial=len(self._known), desc=name, unit="rollout", disable=not shown) as self._bar:
            try:
                return self._batches()
            except _SpentError as spent:
                return spent.reason, spent.message
            except KeyboardInterrupt:
                _log.warning("interrupted: the %d rollouts that are finished are kept", len(self._known))
                return INTERRUPTED, "it was interrupted"
            finally:
                self._solver.close()

    def _batches(self) -> tuple[str, str]:
        if self._told < self._new_from:
            self._roll_out_queue()
        batch, silent = self._resume(), 0
        while silent < _WITHOUT_NEWS:
            before = len(self._known)
            if not self._one_batch(batch):
                return self._solvers_end()
            if batch >= self._told and self._after_batch(batch):
                return STOPPED, "it was told to stop"
            if batch >= self._new_from:
                silent = 0 if len(self._known) > before else silent + 1
            self._show()
            batch += 1
        return SOLVER, f"{self._solver.name} asks only for points that are known"

    def _one_batch(self, batch: int) -> bool:
        """Judge the points given by hand, then what the solver asks for; return whether there were any."""
        # A batch that was told before gets no new points by hand: it is to be what it was.
        given = self._file.take(batch, new=batch >= self._new_from)
        asked: list[Point] = []
        try:
            # By hand first: a solver may ask for all that the budget allows.
            by_hand = self._judge_given(given)
            asked = [self._problem.point(point) for point in self._ask()]
            evaluations = self._judge_asked(asked)
        except BaseException:
            # It is judged again in the next run. What is complete can be seen until then.
            self._record(
                batch, *([self._judge.evaluation(p) for p in points] for points in (given, asked)), ended=False
            )
            raise
        if batch >= self._told and (given or asked):
            self._record(batch, by_hand, evaluations, ended=True)
        return bool(given or asked)

    def _roll_out_queue(self) -> None:
        """Run the points given by hand before a solver that was made anew comes to what is new.

        It is told of them where the study goes on. Until then it would ask for what is known and, in the same batch,
        for more than the budget allows.
        """
        points = list(self._file.queue().values())
        rows = [(point, condition) for point in points for condition in range(len(self._problem.conditions))]
        try:
            self._roll_out([row for row in dict.fromkeys(rows) if row not in self._known])
        finally:
            self._record(self._new_from, [self._judge.evaluation(point) for point in points], [], ended=False)

    def _judge_given(self, points: Sequence[Point]) -> list[Evaluation]:
        if not points:
            return []
        self._refuse_success(points)
        evaluations = self._judge.judge(points)
        self._solver.tell(evaluations)
        return evaluations

    def _judge_asked(self, points: Sequence[Point]) -> list[Evaluation]:
        if not points:
            return []
        self._refuse_success(points)
        evaluations = self._judge.judge(points)
        self._solver.tell([self._with_gradient(evaluation) for evaluation in evaluations])
        return evaluations

    def _ask(self) -> list[Point]:
        """Return what the solver asks for. It is not waited for beyond the time limit, however long it thinks."""
        if self._deadline == inf:
            return self._solver.ask()
        answer: SimpleQueue[list[Point] | BaseException] = SimpleQueue()
        # A daemon, so that a solver that never answers does not keep the program from its end.
        threading.Thread(target=_think, args=(self._solver, answer), name="study: solver thinks", daemon=True).start()
        try:
            points = answer.get(timeout=max(0.0, self._deadline - time.monotonic()))
        except Empty:
            raise _SpentError(TIME, f"the time is over, while {self._solver.name} was thinking") from None
        if isinstance(points, BaseException):
            raise points
        return points

    def _resume(self) -> int:
        """Return the batch to begin with: the first, or where the study is if its solver cannot be told again."""
        if self._solver.reproducible or not self._told:
            return 0
        # Of those that racing has dropped, more would have to be rolled out.
        points = list(dict.fromkeys(row[2] for row in self._file.trials() if row[5]))
        evaluations = self._judge.judge(points)
        self._solver.tell(evaluations)
        self._show()
        return self._told

    def _solvers_end(self) -> tuple[str, str]:
        if self._solver.success is False and self._limit - len(self._known) < len(self._problem.conditions):
            return BUDGET, self._budget_is_spent
        how = {True: "is finished", False: "has ended without success", None: "has ended"}[self._solver.success]
        return SOLVER, f"{self._solver.name} {how}" + (f": {self._solver.message}" if self._solver.message else "")

    def _roll_out(self, rows: Sequence[Row]) -> None:
        now = rows[: max(0, int(min(self._limit - len(self._known), len(rows))))]
        points = [self._problem.values(point, condition=condition) for point, condition in now]
        self._refuse_lateness()
        results = self._executor.run(self._task, points) if points else iter(())
        try:
            with Interruptible() as interruptible:
                for index, result in results:
                    outcome = Outcome.of(result)
                    self._known[now[index]] = outcome
                    self._file.add(*now[index], outcome)
                    self._warn(outcome)
                    if time.monotonic() >= self._next_log:
                        self._next_log += LOG_PERIOD
                        self._log_progress()
                    assert self._bar is not None
                    self._bar.update()
                    self._refuse_success([now[index][0]])
                    self._refuse_lateness()
                    interruptible.check()
        finally:
            if points:
                results.close()  # type: ignore[attr-defined]
        if len(now) < len(rows):
            raise _SpentError(BUDGET, self._budget_is_spent)

    @property
    def _budget_is_spent(self) -> str:
        return f"the budget of {self._limit:g} rollouts is spent"

    def _warn(self, outcome: Outcome) -> None:
        """Log once in a run that the quality function fails: it may be wrong, and all that follows in vain."""
        if outcome.message.startswith(QUALITY_FAILED) and not self._warned:
            self._warned = True
            _log.warning(
                "%s. The rollout counts as failed, and so do others of this kind; on_error='raise' ends the run",
                outcome.message.removeprefix(QUALITY_FAILED),
            )

    def _log_progress(self) -> None:
        of = "" if self._limit == inf else f" of {self._limit:g}"
        best = self._judge.best
        found = "" if best is None else f", best {self._judge.in_the_users_terms(best)[0]:.6g}"
        _log.info("study (%s): %d%s rollouts%s", self._solver.method, len(self._known), of, found)

    def _with_gradient(self, evaluation: Evaluation) -> Evaluation:
        if self._gradients is None:
            return evaluation
        known = len(self._slopes)
        filled = self._gradients.fill(evaluation, self._slopes)
        if len(self._slopes) > known and filled.gradient is not None:
            self._file.add_gradient(evaluation.point, filled.gradient)
        return filled

    def _refuse_success(self, points: Sequence[Point]) -> None:
        """End the run as soon as a point is good enough."""
        if self._target is None:
            return
        for point in points:
            evaluation = self._judge.evaluation(point)
            if evaluation.counts and evaluation.values[0] >= self._target:
                (value,) = self._judge.in_the_users_terms(evaluation)
                raise _SpentError(TARGET, f"the target is reached: {value:g}")

    def _refuse_lateness(self) -> None:
        if time.monotonic() >= self._deadline:
            raise _SpentError(TIME, "the time is over")

    def _record(self, batch: int, given: Sequence[Evaluation], asked: Sequence[Evaluation], *, ended: bool) -> None:
        """Record the points that are judged; a batch that has not ended is judged again in the next run."""
        origins = [*(("user", "by hand") for _ in given), *(("solver", self._solver.method) for _ in asked)]
        rows: list[TrialRow] = [
            (
                batch,
                position,
                evaluation.point,
                self._judge.in_the_users_terms(evaluation),
                evaluation.violations,
                evaluation.exact,
                *origin,
            )
            for position, (evaluation, origin) in enumerate(zip([*given, *asked], origins, strict=True))
            if (ended or evaluation.exact) and not self._recorded(evaluation)
        ]
        self._file.save_trials(rows, told=batch + 1 if ended else None)

    def _recorded(self, evaluation: Evaluation) -> bool:
        """Return whether a trial so far, of a solver for a smaller budget, already says as much of the point."""
        exact = self._earlier.get(evaluation.point)
        return exact is not None and (exact or not evaluation.exact)

    def _show(self) -> None:
        if self._judge.best is not None:
            assert self._bar is not None
            (value,) = self._judge.in_the_users_terms(self._judge.best)
            self._bar.set_postfix_str(f"best {value:.6g}", refresh=False)


def _think(solver: Solver, answer: SimpleQueue[list[Point] | BaseException]) -> None:
    """Put what a solver asks for, or the exception that it raises, into ``answer``."""
    try:
        answer.put(solver.ask())
    except BaseException as error:
        answer.put(error)


def check_budget(problem: Problem, *, rollouts: int | None, seconds: float | None, target: float | None) -> None:
    """
    Raises:
        ValueError: there is no budget at all, one is not positive or NaN, or a target is given for several qualities.
    """
    if rollouts is None and seconds is None and target is None:
        raise ValueError("a study needs to know when it is enough: give rollouts=, seconds= or target=")
    if rollouts is not None and as_whole("a budget of rollouts", rollouts) < 1:
        raise ValueError(f"a budget is at least one rollout, not {rollouts}")
    if target is not None and isnan(as_number("a target", target)):
        raise ValueError("a target is a number, not nan: no point would ever reach it")
    if seconds is not None and not (isfinite(as_number("a budget of wall time", seconds)) and seconds > 0.0):
        raise ValueError(f"a budget of wall time is positive and finite, not {seconds} s")
    if target is not None and len(problem.objectives) > 1:
        raise ValueError("a target belongs to one quality, but the problem has several")
