"""The reasoner: tries alternatives in a mental copy of the testbed, within a budget, and answers with the best."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import inf, isfinite, nan
from types import TracebackType
from typing import Any, Self

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.argument_checks import as_number, as_whole
from vtbdrake.optimization.evaluator import Evaluator
from vtbdrake.optimization.problem import Motion, Problem
from vtbdrake.optimization.risk import Risk
from vtbdrake.optimization.solvers import Solver, make_solver, solver_type
from vtbdrake.optimization.solvers.solver import Evaluation, Point
from vtbdrake.optimization.study_file import RolloutKey
from vtbdrake.reasoning.decision import ELIGIBLE, FAILED, UNFINISHED, VIOLATES, Candidate, Decision, Health
from vtbdrake.reasoning.space import DecisionSpace, Element, same_values
from vtbdrake.rollout import Constraint, Executor, Quality, RolloutResult, RolloutRunner, make_executor
from vtbdrake.rollout.executor import checked_workers, choose_executor
from vtbdrake.rollout.start import Start
from vtbdrake.testbed import Scenario, VirtualTestbed
from vtbdrake.testbed.interrupt import Interruptible

# Why a decision ended.
ROLLOUTS, TIME, METHOD = "rollouts", "time", "method"

# Candidate 0 as a point of the search: it sets nothing, so that the DPS goes on with the plan in use.
KEEP: Point = ()

# A method that asks so often in a row for known candidates only has nothing more to try.
_KNOWN_BATCHES = 50


class ReasonerError(RuntimeError):
    """A decision that was asked for at the wrong time: while another one is under way, or after the end."""


@dataclass(frozen=True)
class Budget:
    """How much a decision may take; whichever ends first, if both are given.

    Attributes:
        rollouts: how many rollouts. Such a decision can be repeated exactly, with any executor.
        seconds: of wall time. When it ends, the rollouts under way are cancelled, and the best candidate of those that
            have finished is the decision.

    Raises:
        ValueError: neither is given, or one is not positive.
    """

    rollouts: int | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        if self.rollouts is None and self.seconds is None:
            raise ValueError("a budget is given as Budget(rollouts=70), Budget(seconds=2.0) or both")
        if self.rollouts is not None:
            object.__setattr__(self, "rollouts", as_whole("a budget of rollouts", self.rollouts))
            if self.rollouts < 1:
                raise ValueError(f"a budget is at least one rollout, not {self.rollouts}")
        if self.seconds is not None:
            object.__setattr__(self, "seconds", as_number("a budget of wall time", self.seconds))
            if not (isfinite(self.seconds) and self.seconds > 0.0):
                raise ValueError(f"a budget of wall time is positive and finite, not {self.seconds} s")


class Reasoner:
    """Decides what a running DPS should do, by rollouts of its own testbed (section 5).

    Each decision begins at the DPS's state as it stands, in the world as the DPS believes it to be. Candidate 0 is the
    plan in use: nothing is set, and the DPS goes on. The method proposes the others; problem (18) is solved over what
    is decided, until the budget is spent. The rollouts run in workers that keep their testbeds from decision to
    decision.

    A decision is a function of the state from which it begins (its time included), the plan and the seed: nothing is
    remembered. What warms up the method is the plan in use, which is part of that state.

    Args:
        scenario: that of the running testbed; its `Scenario.mental` is what is simulated.
        decision: what is decided: commands (``u.<name>``) and other elements of the DPS: `Parameter`, `Choice` or
            `Trajectory`.
        quality: f, larger is better, or a cost.
        horizon: of a rollout, in seconds.
        budget: how much a decision may take.
        method: a name from `vtbdrake.optimization.solvers` (``CEM``, ``predictive-sampling``, ``MPPI``, ``grid``,
            ``random``, ``CMA-ES``, ...), or a class derived from `Solver`.
        options: of the method.
        constraints: what the rollouts of an eligible candidate keep.
        samples: how many samples of an uncertain belief each candidate is simulated from; one is the belief itself.
        risk: how the qualities under several samples become one: ``worst``, ``mean``, `Quantile` or `CVaR`.
        threshold: f_m: a rollout ends when f exceeds it.
        sample_period: of f, in seconds.
        executor: where the rollouts run, see `Problem.sweep`. ``auto`` takes processes if a system in Python has work
            to do, else threads.
        workers: how many threads or processes; by default the number of cores.
        time_limit: the longest wall time of one rollout in a process, in seconds: a worker that hangs is ended then. By
            default the horizon, but at least 10 s.
        seed: of the method; in each decision it is combined with the time at which that begins.

    Attributes:
        problem: problem (18) in the mental testbed, one condition per sample.
        task: what its rollouts have in common.
        executor: where they run.
        space: what is decided.
        budget: how much a decision may take.
        samples: how many samples of the belief each candidate is simulated from.

    Raises:
        ValueError: an address is not part of the DPS, the mental scenario has other commands, the budget does not
            suffice for one candidate, the method is unknown or cannot decide this, or an argument of `Problem` is
            invalid.
    """

    def __init__(
        self,
        *,
        scenario: Scenario,
        decision: Sequence[Element],
        quality: Quality,
        horizon: float,
        budget: Budget,
        method: str | type[Solver] = "CEM",
        options: Mapping[str, Any] | None = None,
        constraints: Sequence[Constraint] = (),
        samples: int = 1,
        risk: str | Risk = "worst",
        threshold: float | None = None,
        sample_period: float = 0.05,
        executor: str | Executor = "auto",
        workers: int | None = None,
        time_limit: float | None = None,
        seed: int = 0,
    ) -> None:
        if not isinstance(budget, Budget):
            raise ValueError(f"a budget is Budget(rollouts=...) or Budget(seconds=...), not {budget!r}")
        if not isinstance(quality, Quality):
            raise ValueError(f"a decision has one quality, Quality(f, of=[address, ...]), not {quality!r}")
        self.samples = as_whole("the number of samples", samples)
        if self.samples < 1:
            raise ValueError(f"a belief has at least one sample, not {samples}")
        if budget.rollouts is not None and budget.rollouts < self.samples:
            raise ValueError(
                f"a budget of {budget.rollouts} rollouts does not suffice for one candidate, which takes "
                f"{self.samples}, one per sample of the belief"
            )
        self.budget = budget
        self.space = DecisionSpace(decision)
        mental = scenario.mental() if hasattr(scenario, "mental") else scenario
        _check_commands(scenario, mental)
        self.problem = Problem(
            scenario=mental,
            parameters=self.space.parameters,
            quality=quality,
            horizon=horizon,
            threshold=threshold,
            sample_period=sample_period,
            conditions=[{}] * self.samples,
            risk=risk,
            constraints=constraints,
        )
        self.space.find(self.problem.testbed.variables())
        # A quality that fails is a reason against a candidate, and no end of the DPS.
        self.task = replace(self.problem.task, catch=True)
        self._method = method
        self._options = dict(options or {})
        self._seed = as_whole("a seed", seed)
        # A method that cannot decide this is refused here. Candidate 0 is not its own.
        affordable = None if budget.rollouts is None else max(budget.rollouts // self.samples - 1, 1)
        self.solver(0.0, budget=affordable).close()
        if executor == "auto":
            executor = "serial" if checked_workers(workers) == 1 else choose_executor(self.problem.testbed)
            workers = None if executor == "serial" else workers
        if executor == "processes" and time_limit is None:
            time_limit = max(10.0, self.problem.task.horizon)
        self._owned = not isinstance(executor, Executor)
        self.executor = make_executor(
            executor,
            testbed=self.problem.testbed,
            rollouts=budget.rollouts or 10**9,
            workers=workers,
            time_limit=time_limit,
        )
        self._alone = threading.Lock()
        self._closed = False

    def __repr__(self) -> str:
        return f"Reasoner({self.problem!r}, {self.budget!r})"

    def solver(self, time: float, *, budget: int | None, start: Point | None = None) -> Solver:
        """Return the method of a decision that begins at ``time``.

        Args:
            time: in seconds; with the seed it determines the random numbers.
            budget: how many candidates it may ask for; None: any number.
            start: where it starts, if it starts at a point.
        """
        entropy = [self._seed, int(np.float64(time).view(np.uint64))]
        return make_solver(
            self._method,
            self.space.parameters,
            constraints=len(self.problem.constraints),
            seed=int(np.random.SeedSequence(entropy).generate_state(1)[0]),
            budget=budget,
            start=start if solver_type(self._method).takes_start else None,
            **self._options,
        )

    def decide(self, testbed: VirtualTestbed, context: Context, *, plan: Mapping[str, Any] | None = None) -> Decision:
        """Return the best candidate for a DPS that stands as it does in ``context``.

        Args:
            testbed: the running testbed.
            context: of ``testbed``; it stays as it is.
            plan: address -> value of a plan from which the method starts, tried beside the one in use.

        Raises:
            ReasonerError: a decision is under way (in another thread), or the reasoner is closed.
            ValueError: the plan sets what is not decided, or lies outside its ranges.
        """
        begin = time.monotonic()
        with self._only_one():
            start = Start.of(testbed, context)
            held = {address: testbed.read(context, address) for address in self.space.addresses}
            given = None if plan is None else self.space.point(plan, start.time)
            return _Thinking(self, [start] * self.samples, held, given, begin).decision()

    def motion(self, decision: Decision, candidate: int) -> Motion:
        """Return the motion of the mental world under a candidate, from the first sample of the belief.

        Its rollout is simulated again, with the same result.

        Args:
            decision: a decision of this reasoner.
            candidate: the number of the candidate.
        """
        task = replace(self.task, record=("plant.state",))
        values = decision.candidates[candidate].values if candidate else {}
        result = RolloutRunner(task, self.problem.testbed).run(values, start=decision.starts[0])
        return Motion(task.scenario, result.times, result.record["plant.state"])

    @contextmanager
    def _only_one(self) -> Iterator[None]:
        if not self._alone.acquire(blocking=False):
            raise ReasonerError("a decision is under way in another thread: wait for it, or use a second reasoner")
        try:
            if self._closed:
                raise ReasonerError("the reasoner is closed: make a new one")
            yield
        finally:
            self._alone.release()

    def close(self) -> None:
        """End the workers. A decision that is under way is finished first."""
        with self._alone:
            self._closed = True
            if self._owned:
                self.executor.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _check_commands(scenario: Scenario, mental: Scenario) -> None:
    """Check that a mental scenario has the commands of its scenario.

    Raises:
        ValueError: one is missing, added or of another size.
    """
    here, there = ({c.name: c.size for c in s.interface().commands} for s in (scenario, mental))
    differing = sorted(name for name in here.keys() | there.keys() if here.get(name) != there.get(name))
    if differing:
        raise ValueError(
            f"the mental scenario {type(mental).__name__} has other commands than {type(scenario).__name__} "
            f"({', '.join(differing)}), so that a decision would not fit: give both the same interface"
        )


class _BudgetSpentError(Exception):
    """The end of a decision in the middle of a batch."""

    def __init__(self, end: str, message: str) -> None:
        super().__init__(message)
        self.end = end


class _Thinking:
    """One decision under way.

    Args:
        reasoner: whose decision it is.
        starts: where the rollouts begin, one per sample of the belief.
        held: address -> value of the plan in use.
        given: a plan as a point of the search, or None.
        begin: when the decision was asked for, by `time.monotonic`.
    """

    def __init__(
        self, reasoner: Reasoner, starts: Sequence[Start], held: Mapping[str, Any], given: Point | None, begin: float
    ) -> None:
        self._reasoner = reasoner
        self._problem = reasoner.problem
        self._starts = starts
        self._time = starts[0].time
        self._held = held
        self._given = given
        self._begin = begin
        self._results: dict[RolloutKey, RolloutResult] = {}
        self._evaluator = Evaluator(self._problem, self._results, self._roll_out)
        self._count = 0
        # The candidates in the order in which they were proposed; the plan in use is the first.
        self._proposed: dict[Point, None] = {KEEP: None}

    def decision(self) -> Decision:
        """Think until the budget is spent or the method has finished."""
        try:
            end, message = METHOD, self._think()
        except _BudgetSpentError as spent:
            end, message = spent.end, str(spent)
        return self._conclude(end, message)

    def _think(self) -> str:
        """Try candidates; return how the method ended."""
        reasoner = self._reasoner
        self._evaluator.evaluate([KEEP])
        start, known = self._given or self._in_use(), []
        if start is not None and same_values(self._values(start), self._held):
            # To set what is set already changes nothing.
            self._results |= {(start, sample): self._results[KEEP, sample] for sample in range(reasoner.samples)}
            known = self._evaluator.evaluate([start])
        elif start is not None:
            known = self._try([start])
        solver = reasoner.solver(self._time, budget=self._affordable(), start=start)
        try:
            # They are paid for.
            solver.tell([replace(evaluation, effort=0.0) for evaluation in known])
            return self._iterate(solver)
        finally:
            solver.close()

    def _in_use(self) -> Point | None:
        """Return the plan in use as a point of the search; None if it lies outside the ranges."""
        try:
            return self._reasoner.space.point(self._held, self._time)
        except ValueError:
            return None

    def _values(self, point: Point) -> dict[str, Any]:
        """Return what a candidate sets, address -> value."""
        return {} if point == KEEP else self._reasoner.space.values(point, self._held, self._time)

    def _iterate(self, solver: Solver) -> str:
        silent = 0
        while silent < _KNOWN_BATCHES:
            points = [self._problem.point(point) for point in solver.ask()]
            if not points:
                return f"{solver.name}: {solver.message}"
            before = self._count
            solver.tell(self._try(points))
            silent = 0 if self._count > before else silent + 1
        return f"{solver.name} asks for known candidates only"

    def _try(self, points: Sequence[Point]) -> list[Evaluation]:
        self._proposed |= dict.fromkeys(point for point in points if (point, 0) not in self._results)
        return self._evaluator.evaluate(points)

    def _affordable(self) -> int | None:
        """Return how many more candidates the budget of rollouts allows; None: any number."""
        rollouts = self._reasoner.budget.rollouts
        if rollouts is None:
            return None
        count = (rollouts - self._count) // self._reasoner.samples
        if count == 0:
            raise _BudgetSpentError(ROLLOUTS, _spent(rollouts))
        return count

    def _roll_out(self, keys: Sequence[RolloutKey]) -> None:
        reasoner = self._reasoner
        rollouts = reasoner.budget.rollouts
        now = keys if rollouts is None else keys[: rollouts - self._count]
        points = [self._values(point) for point, _ in now]
        starts = [self._starts[sample] for _, sample in now]
        self._count += len(now)
        results = reasoner.executor.run(reasoner.task, points, start=starts) if points else iter(())
        try:
            with Interruptible() as interruptible:
                for index, result in results:
                    self._results[now[index]] = result
                    interruptible.check()
        finally:
            if points:
                results.close()  # type: ignore[attr-defined]
        if rollouts is not None and len(now) < len(keys):
            raise _BudgetSpentError(ROLLOUTS, _spent(rollouts))

    # -- the answer

    def _conclude(self, end: str, message: str) -> Decision:
        problem, reasoner = self._problem, self._reasoner
        candidates = tuple(self._candidate(*item) for item in enumerate(self._proposed))
        eligible = [candidate for candidate in candidates if candidate.status == ELIGIBLE]
        sign = 1.0 if problem.objectives[0].minimize else -1.0
        ranked = sorted(eligible, key=lambda candidate: (sign * candidate.quality, candidate.number))
        best = ranked[0] if ranked else None
        improvement = margin = nan
        if best is not None and candidates[0].status == ELIGIBLE:
            improvement = sign * (candidates[0].quality - best.quality) + 0.0
        if len(ranked) > 1:
            margin = sign * (ranked[1].quality - ranked[0].quality) + 0.0
        elapsed = time.monotonic() - self._begin
        results = [self._results[point, sample] for point, sample in self._keys() if (point, sample) in self._results]
        budget = reasoner.budget
        health = Health(
            rollouts=len(results),
            failed=sum(result.failed for result in results),
            cut_off=0,
            rollout_time=float(np.mean([result.wall_time for result in results])) if results else nan,
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
            doubts=tuple(_doubts(candidates, ranked, results)),
            name=problem.objectives[0].name,
            minimize=problem.objectives[0].minimize,
            starts=tuple(self._starts),
        )

    def _keys(self) -> Iterator[RolloutKey]:
        return ((point, sample) for point in self._proposed for sample in range(self._reasoner.samples))

    def _candidate(self, number: int, point: Point) -> Candidate:
        results = [self._results.get((point, sample)) for sample in range(self._reasoner.samples)]
        evaluation = self._evaluator.evaluation(point)
        finished = tuple(result for result in results if result is not None)
        if evaluation.failed:
            status = FAILED
        elif len(finished) < len(results):
            status = UNFINISHED
        else:
            status = ELIGIBLE if evaluation.feasible else VIOLATES
        known = status in (ELIGIBLE, VIOLATES)
        return Candidate(
            number=number,
            values=self._values(point) or dict(self._held),
            status=status,
            quality=self._evaluator.in_user_terms(evaluation)[0] if known else nan,
            violations=evaluation.violations,
            rollouts=finished,
        )


def _spent(rollouts: int) -> str:
    return f"the budget of {rollouts} rollouts is spent"


def _why_none(candidates: Sequence[Candidate]) -> str:
    counts = Counter(candidate.status for candidate in candidates)
    what = {FAILED: "failed", VIOLATES: "violated a constraint", UNFINISHED: "did not finish"}
    reasons = [f"{counts[status]} {text}" for status, text in what.items() if counts[status]]
    messages = [rollout.message for candidate in candidates for rollout in candidate.rollouts if rollout.failed]
    return ", ".join(reasons) + (f"; the first failure: {messages[0]}" if messages else "")


def _doubts(
    candidates: Sequence[Candidate], ranked: Sequence[Candidate], results: Sequence[RolloutResult]
) -> Iterator[str]:
    """Yield what speaks against a decision.

    Args:
        candidates: all.
        ranked: the eligible ones, from the best to the worst.
        results: all rollouts that have finished.
    """
    failures = [result.message for result in results if result.failed]
    if failures:
        yield f"{len(failures)} of {len(results)} rollouts failed, the first: {failures[0]}"
    if len(candidates) == 1:
        yield "nothing but the plan in use was tried: the budget is too small, or a rollout too slow"
    unfinished = sum(candidate.status == UNFINISHED for candidate in candidates)
    if unfinished:
        yield f"{unfinished} of {len(candidates)} candidates did not finish"
    if len(ranked) > 1 and ranked[0].quality == ranked[-1].quality:
        yield f"all {len(ranked)} eligible candidates are equally good: within the horizon, the quality ignores them"
