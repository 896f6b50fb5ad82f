"""One decision under way: candidates are proposed, simulated and compared until the budget is spent."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from math import inf, nan
from time import monotonic
from typing import TYPE_CHECKING, Any

from vtbdrake.drake_workarounds.lost_interrupts import Interruptible
from vtbdrake.optimization.evaluator import Evaluator
from vtbdrake.optimization.records import RolloutKey
from vtbdrake.optimization.risk import Worst
from vtbdrake.optimization.solvers.solver import Evaluation, Point, Solver, ask_within
from vtbdrake.reasoning.decision import (
    CUT_OFF,
    ELIGIBLE,
    FAILED,
    UNFINISHED,
    VIOLATES,
    Budget,
    Candidate,
    Decision,
    Health,
)
from vtbdrake.reasoning.space import same_values
from vtbdrake.reasoning.time_left import TimeLeft
from vtbdrake.rollout import Cutoff, RolloutResult
from vtbdrake.rollout.pruning import PRUNED, STALLED
from vtbdrake.rollout.start import Start
from vtbdrake.rollout.task import FAILED as ROLLOUT_FAILED
from vtbdrake.rollout.task import TERMINATED

if TYPE_CHECKING:
    from vtbdrake.reasoning.reasoner import Reasoner

# Why a decision ended.
ROLLOUTS = "rollouts"
TIME = "time"
METHOD = "method"

# Candidate 0 as a point of the search: it sets nothing, so that the DPS goes on with the plan in use.
KEEP: Point = ()

# With pruning, the value to beat is updated after this many candidates. The number does not depend on the number of
# workers, so that a decision is the same with any.
_ROUND = 8

# The decision ends after this many batches in a row with candidates only that were tried before.
_MAX_SILENT_BATCHES = 50

# The plan in use may finish up to this time after the budget of wall time, in seconds: without it there is nothing to
# compare.
_GRACE = 0.5

# A decision is late if it took more than this many times its budget of wall time.
_LATE = 1.5

# Rollouts end early if a system ends them before this share of the horizon.
_EARLY = 0.25


class _BudgetSpentError(Exception):
    """The end of a decision in the middle of a batch."""

    def __init__(self, end: str, message: str) -> None:
        super().__init__(message)
        self.end = end


class DecisionRun:
    """One decision of a reasoner.

    Args:
        reasoner: The reasoner that decides.
        budget: How much the decision may take.
        starts: Where the rollouts begin, one per sample of the belief.
        plan_in_use: Address -> value of the plan in use.
        user_plan: The user's plan as a point of the search, or None.
        requested_at: When the decision was requested, by `time.monotonic`.
    """

    def __init__(
        self,
        reasoner: Reasoner,
        budget: Budget,
        starts: Sequence[Start],
        plan_in_use: Mapping[str, Any],
        user_plan: Point | None,
        requested_at: float,
    ) -> None:
        self._reasoner = reasoner
        self._budget = budget
        deadline = inf if budget.seconds is None else requested_at + budget.seconds
        self._time_left = TimeLeft(deadline, side_by_side=reasoner.executor.side_by_side, clock=monotonic)
        self._problem = reasoner.problem
        self._sign = reasoner.problem.objectives[0].sign
        self._starts = starts
        self._time = starts[0].time
        self._plan_in_use = plan_in_use
        self._user_plan = user_plan
        self._requested_at = requested_at
        self._interruptible = Interruptible()
        self._results: dict[RolloutKey, RolloutResult] = {}
        self._evaluator = Evaluator(self._problem, self._results, self._roll_out)
        self._count = 0
        self._evaluations: dict[Point, Evaluation] = {}
        # What each candidate sets, address -> value, in the order in which they were proposed.
        self._planned: dict[Point, dict[str, Any]] = {KEEP: {}}
        # The plan in use as a point of the search, if it is one.
        self._point_in_use: Point | None = None

    def decision(self) -> Decision:
        """Try candidates until the budget is spent or the method has finished."""
        with self._interruptible:
            try:
                end, message = METHOD, self._search()
            except _BudgetSpentError as spent:
                end, message = spent.end, str(spent)
            return self._conclude(end, message)

    def _search(self) -> str:
        """Try candidates; return how the method ended."""
        reasoner, rollouts = self._reasoner, self._budget.rollouts
        start = self._user_plan or self._in_use()
        if start is not None and same_values(self._values([start])[0], self._plan_in_use):
            self._point_in_use = start
        first = [KEEP] if start is None else [KEEP, start]
        # The plan in use is never simulated twice.
        taken = len(first) - (self._point_in_use is not None)
        affordable = None if rollouts is None else rollouts // reasoner.samples - taken
        evaluations: list[Evaluation] = []
        timed = self._budget.seconds is not None
        if timed or reasoner.task.pruning is not None or (affordable is not None and affordable <= 0):
            # Otherwise they run beside the first batch of the method, which keeps the workers busy. In a budget of
            # wall time, they tell how many more fit.
            evaluations, first = self._try(first)[1:], []
        if affordable is not None and affordable <= 0:
            raise _BudgetSpentError(ROLLOUTS, _spent(rollouts))
        solver = reasoner.solver(self._time, budget=affordable, start=start)
        try:
            return self._iterate(solver, first, evaluations)
        finally:
            solver.close()

    def _in_use(self) -> Point | None:
        """Return the plan in use as a point of the search; None if it lies outside the ranges."""
        try:
            return self._reasoner.space.point(self._plan_in_use, self._time)
        except ValueError:
            return None

    def _values(self, points: Sequence[Point]) -> list[dict[str, Any]]:
        """Return the values that candidates set, address -> value for each of them."""
        new = [point for point in dict.fromkeys(points) if point not in self._planned]
        if new:
            values = self._reasoner.space.values(new, self._plan_in_use, self._time)
            self._planned |= zip(new, values, strict=True)
        return [self._planned[point] for point in points]

    def _iterate(self, solver: Solver, first: Sequence[Point], evaluated: Sequence[Evaluation]) -> str:
        """Try the candidates that a method asks for; return how it ended.

        Args:
            solver: The method.
            first: Points to try beside the first batch: `KEEP`, which the method is not told, and perhaps a plan.
            evaluated: Evaluations to tell the method with its first batch.
        """
        silent, rollouts = 0, self._budget.rollouts
        while silent < _MAX_SILENT_BATCHES:
            proposals = ask_within(solver, inf if solver.is_prompt else self._time_left.seconds)
            if proposals is None:
                raise _BudgetSpentError(TIME, f"{self._time_spent()}, before {solver.name} proposed more candidates")
            points = self._problem.points(proposals)
            before = self._count
            evaluations = self._try([*first, *points])
            if not points and rollouts is not None and rollouts - self._count < self._reasoner.samples:
                raise _BudgetSpentError(ROLLOUTS, _spent(rollouts))
            if not points:
                return f"{solver.name}: {solver.message}"
            beside = [*evaluated, *evaluations[1 : len(first)]]
            # Their rollouts are not charged to the method.
            solver.tell([*evaluations[len(first) :], *(replace(evaluation, effort=0.0) for evaluation in beside)])
            first, evaluated = [], []
            silent = 0 if self._count > before else silent + 1
        return f"{solver.name} asks for known candidates only"

    def _try(self, points: Sequence[Point]) -> list[Evaluation]:
        count = max(1, len(points)) if self._reasoner.task.pruning is None else _ROUND
        evaluations = []
        for k in range(0, len(points), count):
            evaluations += self._evaluator.evaluate(points[k : k + count])
        self._evaluations |= zip(points, evaluations, strict=True)
        return evaluations

    def _roll_out(self, keys: Sequence[RolloutKey]) -> None:
        rollouts = self._budget.rollouts
        new = [key for key in keys if key[0] != self._point_in_use]
        allowed = waiting = new if rollouts is None else new[: rollouts - self._count]
        while waiting:
            fitting = waiting[: self._fitting(waiting)]
            if fitting:
                self._run_together(fitting)
            if not fitting or any(key not in self._results for key in fitting):
                raise _BudgetSpentError(TIME, self._time_spent())
            waiting = waiting[len(fitting) :]
        if len(keys) > len(new):
            # Setting the plan in use once more changes nothing.
            in_use = {sample: result for (point, sample), result in self._results.items() if point == KEEP}
            self._results |= {(point, sample): in_use[sample] for point, sample in keys if point == self._point_in_use}
        if len(allowed) < len(new):
            raise _BudgetSpentError(ROLLOUTS, _spent(rollouts))

    def _fitting(self, keys: Sequence[RolloutKey]) -> int:
        """Return the number of rollouts to run together: the plan in use, in any case, or what fits into the time."""
        if keys[0][0] == KEEP and self._budget.seconds is not None:
            return sum(point == KEEP for point, _ in keys)
        return self._time_left.affordable(len(keys), together=min(self._reasoner.samples, len(keys)))

    def _run_together(self, keys: Sequence[RolloutKey]) -> None:
        executor, points = self._reasoner.executor, self._values([point for point, _ in keys])
        starts = [self._starts[sample] for _, sample in keys]
        grace = _GRACE if keys[0][0] == KEEP else 0.0
        self._time_left.begin()
        self._collect(executor.run(self._reasoner.task, points, start=starts, **self._cutoff(grace)), keys)
        self._time_left.end(len(keys))

    def _collect(self, results: Iterator[tuple[int, RolloutResult]], keys: Sequence[RolloutKey]) -> None:
        try:
            for index, result in results:
                self._results[keys[index]] = result
                self._count += 1
                self._interruptible.raise_interrupt()
        finally:
            results.close()  # type: ignore[attr-defined]

    def _cutoff(self, grace: float) -> dict[str, Cutoff]:
        """Return the argument ``cutoff`` for an executor that can end rollouts early; else none."""
        if not self._reasoner.executor.cancels:
            return {}
        best, risk = self._evaluator.best, self._problem.risk
        # Under any other risk, a better candidate may have a worse sample.
        comparable = self._reasoner.samples == 1 or isinstance(risk, Worst)
        to_beat = nan if best is None or not comparable else self._evaluator.in_user_terms(best)[0]
        return {"cutoff": Cutoff(deadline=self._time_left.deadline + grace, to_beat=to_beat)}

    def _time_spent(self) -> str:
        return f"the budget of {self._budget.seconds:g} s is spent"

    # -- the answer

    def _conclude(self, end: str, message: str) -> Decision:
        problem = self._problem
        begun = {point for point, _ in self._results} - {self._point_in_use} | {KEEP}
        tried = [point for point in self._planned if point in begun]
        candidates = tuple(self._candidate(number, point) for number, point in enumerate(tried))
        eligible = [candidate for candidate in candidates if candidate.status == ELIGIBLE]
        sign = self._sign
        ranked = sorted(eligible, key=lambda candidate: (-sign * candidate.quality, candidate.number))
        best = ranked[0] if ranked else None
        improvement = margin = nan
        if best is not None and candidates[0].status == ELIGIBLE:
            improvement = sign * (best.quality - candidates[0].quality) + 0.0
        if len(ranked) > 1:
            margin = sign * (ranked[0].quality - ranked[1].quality) + 0.0
        elapsed = monotonic() - self._requested_at
        results = [result for candidate in candidates for result in candidate.rollouts]
        ends = Counter(result.end for result in results)
        budget = self._budget
        health = Health(
            rollouts=len(results),
            failed=ends[ROLLOUT_FAILED],
            cut_off=ends[PRUNED] + ends[STALLED],
            rollout_time=sum(result.wall_time for result in results) / len(results) if results else nan,
            elapsed=elapsed,
            used=max(len(results) / (budget.rollouts or inf), elapsed / (budget.seconds or inf)),
            improvement=improvement,
            margin=margin,
            spread=nan if best is None else best.spread,
        )
        return Decision(
            values={} if best is None else best.values,
            quality=nan if best is None else best.quality,
            chosen=None if best is None else best.number,
            candidates=candidates,
            health=health,
            end=end,
            message=message if best is not None else f"no candidate is eligible ({_why_none(candidates)}); {message}",
            time=self._time,
            warnings=tuple(_warnings(candidates, ranked, results, elapsed, budget, problem.task.horizon)),
            name=problem.objectives[0].name,
            minimize=problem.objectives[0].minimize,
            starts=tuple(self._starts),
        )

    def _candidate(self, number: int, point: Point) -> Candidate:
        results = [self._results.get((point, sample)) for sample in range(self._reasoner.samples)]
        evaluation = self._evaluations.get(point) or self._evaluator.evaluation(point)
        finished = tuple(result for result in results if result is not None)
        if len(finished) == len(results) and evaluation.feasible:
            status = ELIGIBLE if evaluation.exact else CUT_OFF
        elif evaluation.failed:
            status = FAILED
        else:
            status = UNFINISHED if len(finished) < len(results) else VIOLATES
        has_quality = status in (ELIGIBLE, VIOLATES, CUT_OFF)
        return Candidate(
            number=number,
            values=self._planned[point] or dict(self._plan_in_use),
            status=status,
            quality=self._sign * evaluation.values[0] + 0.0 if has_quality else nan,  # No negative zero.
            violations=evaluation.violations,
            rollouts=finished,
        )


def _spent(rollouts: int | None) -> str:
    return f"the budget of {rollouts} rollouts is spent"


def _why_none(candidates: Sequence[Candidate]) -> str:
    counts = Counter(candidate.status for candidate in candidates)
    phrases = {
        FAILED: "failed",
        CUT_OFF: "were cut off",
        VIOLATES: "violated a constraint",
        UNFINISHED: "did not finish",
    }
    reasons = [f"{counts[status]} {text}" for status, text in phrases.items() if counts[status]]
    messages = [rollout.message for candidate in candidates for rollout in candidate.rollouts if rollout.failed]
    return ", ".join(reasons) + (f"; the first failure: {messages[0]}" if messages else "")


def _warnings(
    candidates: Sequence[Candidate],
    ranked: Sequence[Candidate],
    results: Sequence[RolloutResult],
    elapsed: float,
    budget: Budget,
    horizon: float,
) -> Iterator[str]:
    """Yield reasons not to trust a decision.

    Args:
        candidates: All candidates.
        ranked: The eligible ones, from the best to the worst.
        results: All rollouts that have finished.
        elapsed: The wall time of the decision, in seconds.
        budget: Budget of the decision.
        horizon: The longest duration of a rollout, in seconds.
    """
    failures = [result.message for result in results if result.failed]
    if failures:
        yield f"{len(failures)} of {len(results)} rollouts failed, the first: {failures[0]}"
    if not results:
        yield "no rollout has finished, not even of the plan in use: the budget is too small, or one is too slow"
    elif len(candidates) == 1:
        yield "nothing but the plan in use was tried: the budget is too small, or a rollout too slow"
    if budget.seconds is not None and elapsed > _LATE * budget.seconds:
        yield (
            f"it took {elapsed:.3g} s, but its budget is {budget.seconds:g} s: a rollout takes too long, or the time "
            "from one sample to the next, or a worker hangs"
        )
    if {result.end for result in results} == {TERMINATED}:
        latest = max(float(result.times[-1]) for result in results)
        if latest < _EARLY * horizon:
            yield (
                f"all {len(results)} rollouts were ended within {latest:.3g} s of {horizon:g} s, the first: "
                f"{results[0].message}; either nothing helps where they begin, or the horizon is far too long"
            )
    if len(ranked) > 1 and ranked[0].quality == ranked[-1].quality:
        yield f"all {len(ranked)} eligible candidates are equally good: within the horizon, the quality ignores them"
