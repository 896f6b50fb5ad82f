"""The reasoner: simulates alternatives in a mental copy of the testbed, within a budget, and returns the best."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from math import inf
from time import monotonic
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.common.argument_checks import as_whole, counted
from vtbdrake.common.validity_domain import ValidityDomain
from vtbdrake.optimization.problem import Motion, Problem, recording_motion
from vtbdrake.optimization.solvers import Solver, make_solver, solver_type
from vtbdrake.optimization.solvers.solver import BudgetTooSmallError, Point, SolverError
from vtbdrake.reasoning.belief import Belief, BeliefConfig, BeliefError, BeliefToStart
from vtbdrake.reasoning.decision import Budget, Decision, check_budget
from vtbdrake.reasoning.decision_run import DecisionRun
from vtbdrake.reasoning.default_method import default_method
from vtbdrake.reasoning.space import DecisionSpace, Element
from vtbdrake.reasoning.unbelieved import UnbelievedReadings
from vtbdrake.rollout import Constraint, Executor, Pruning, Quality, RolloutRunner, StartError, make_executor
from vtbdrake.rollout.executor import checked_workers
from vtbdrake.rollout.executor_choice import choose_executor
from vtbdrake.rollout.start import Start, StartContext
from vtbdrake.testbed import Scenario
from vtbdrake.testbed.addressed import AddressedDiagram

_log = logging.getLogger(__name__)

_Config = TypeVar("_Config")

# The time limit of a rollout in a process, if none is given, is at least this, in seconds.
_LEAST_TIME_LIMIT = 10.0


class ReasonerError(RuntimeError):
    """A decision was requested while another one is under way, or after the reasoner was closed."""


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """How a reasoner searches: the method that proposes candidates, and where their rollouts run.

    Attributes:
        method: Name of a solver from `vtbdrake.optimization.solvers` (``MPPI``, ``CEM``, ``predictive-sampling``,
            ``grid``, ``random``, ``CMA-ES``, ...), or a class derived from `Solver`. By default it follows from the
            kind of decision: ``grid`` for few choices, ``CMA-ES`` with words, ``auto`` for up to four numbers in a
            budget of rollouts without pruning, and else ``MPPI``.
        options: Options of the method, which is named then.
        pruning: When to end the rollout of a candidate that cannot win any more. A quality is compared with the best
            one before its round of 8 candidates, if there is one sample or the risk is ``worst``. Methods that learn
            from all points, such as CEM and MPPI, propose other candidates with pruning than without.
        executor: Where the rollouts run, see `Problem.sweep`. ``auto`` compiles the mental testbed if that is possible
            and equal to Drake's as far as is checked; else it takes processes if a system in Python has work to do,
            and threads otherwise. The log tells, and ``RolloutResult.computed``. ``compiled`` insists: what cannot be
            compiled is an error when the reasoner is made.
        workers: Number of threads or processes; by default the number of cores.
        time_limit: The longest wall time of one rollout in a process, in seconds; a worker that takes longer is killed.
            By default the horizon, but at least 10 s.

    Raises:
        ValueError: The options are no mapping, or belong to no method.
    """

    method: str | type[Solver] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    pruning: Pruning | None = None
    executor: str | Executor = "auto"
    workers: int | None = None
    time_limit: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.options, Mapping):
            raise ValueError(f"options are given by name, such as {{'samples': 24}}, not as {self.options!r}")
        if self.options and self.method is None:
            raise ValueError(f"options belong to a method: name it by method=, beside options={dict(self.options)!r}")


class Reasoner:
    """Decides what a running DPS should do, by rollouts of its own testbed (section 5).

    Each decision begins at the DPS's present state, in the world as the DPS believes it to be. Candidate 0 is the plan
    in use: nothing is set, and the DPS goes on. The method proposes the other candidates, and so solves problem (18)
    over the decided elements until the budget is spent. The rollouts run in workers that keep their testbeds from
    decision to decision.

    A decision is a function of the state from which it begins (its time included), the plan and the seed: nothing is
    remembered. The method starts at the plan in use, which is part of that state.

    Args:
        scenario: Scenario of the running testbed. The rollouts simulate its `Scenario.mental`.
        decision: The elements of the DPS that are decided, commands (``u.<name>``) and others, each a `Parameter`, a
            `Choice` or a `Trajectory`.
        quality: Quality f, larger is better, or a cost.
        horizon: Length of a rollout, in seconds.
        budget: How much a decision may take.
        constraints: Constraints that the rollouts of an eligible candidate keep.
        threshold: Threshold f_m: a rollout ends when f exceeds it.
        sample_period: Sample period of f, in seconds.
        search: How candidates are proposed, and where their rollouts run.
        belief: How the belief is used: samples, uncertainty, age, risk.
        domain: The validity domain of the mental model: a decision whose plan leaves it says so. To decide for no such
            plan, give a ``Constraint(domain.excess, of=domain.addresses, at_most=1.0)``, too.
        seed: Seed of the method and of the samples; for the method combined with the time at which a decision begins.

    Attributes:
        problem: Problem (18) in the mental testbed, one condition per sample.
        task: The data that all rollouts share.
        executor: Where the rollouts run.
        belief_to_start: Turns beliefs into starts of rollouts.
        space: The decided elements.
        budget: How much a decision may take.
        samples: Number of samples of the belief from which each candidate is simulated.

    Raises:
        ValueError: An address is not part of the DPS, the mental scenario has other commands, the budget does not
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
        constraints: Sequence[Constraint] = (),
        threshold: float | None = None,
        sample_period: float = 0.05,
        search: SearchConfig | None = None,
        belief: BeliefConfig | None = None,
        domain: ValidityDomain | None = None,
        seed: int = 0,
    ) -> None:
        if not isinstance(quality, Quality):
            raise ValueError(f"a decision has one quality, Quality(f, of=[address, ...]), not {quality!r}")
        search, belief = _checked_config(search, SearchConfig), _checked_config(belief, BeliefConfig)
        self.samples = belief.samples
        check_budget(budget, self.samples)
        self.budget = budget
        self.space = DecisionSpace(decision)
        self.problem = Problem(
            scenario=_mental(scenario),
            parameters=self.space.parameters,
            quality=quality,
            horizon=horizon,
            threshold=threshold,
            sample_period=sample_period,
            conditions=[{}] * self.samples,
            risk=belief.risk,
            constraints=constraints,
        )
        testbed = self.problem.testbed
        self.space.find(testbed.variables())
        # A quality that fails is a reason against a candidate, and no end of the DPS.
        self._domain = domain
        record = () if domain is None else domain.addresses
        self.task = replace(self.problem.task, catch=True, pruning=search.pruning, record=record)
        self.belief_to_start = BeliefToStart(testbed, uncertainty=belief.uncertainty, seed=seed, max_age=belief.max_age)
        self._unbelieved = UnbelievedReadings(testbed, uncertain=self.belief_to_start.uncertain)
        # Reads values from a start.
        self._start_context = StartContext(testbed, testbed.default_context(), testbed.copier_from(testbed))
        self._readers = {address: testbed.reader(address) for address in self.space.addresses}
        self._search = search
        self._seed = as_whole("a seed", seed)
        self._check_method()
        self._workers = checked_workers(search.workers)
        self._owned = not isinstance(search.executor, Executor)
        self.executor = self._compiled_executor() or _make_executor(search, self.problem, budget)
        if search.pruning is not None or budget.seconds is not None:
            self._check_executor()
        # A Ctrl-C between two lines may leave it locked: the same thread takes it again.
        self._alone = threading.RLock()
        self._warm = False
        self._has_warned = False
        self._closed = False

    def _check_method(self) -> None:
        """Refuse a method that cannot decide this."""
        allowed = self.budget.rollouts
        # Candidate 0 does not count: the method does not propose it.
        affordable = None if allowed is None else max(allowed // self.samples - 1, 1)
        try:
            self.solver(0.0, budget=affordable).close()
        except BudgetTooSmallError as error:
            rollouts = counted(self.samples, "rollout")
            raise SolverError(f"{error}: of the {allowed} rollouts, the plan in use takes {rollouts}") from None

    def _compiled_executor(self) -> Executor | None:
        """Return the executor of the compiled testbed, if it is equal to the mental testbed as far as was checked.

        Otherwise, ``auto`` does without it, and ``compiled`` raises the error. No other search has one.
        """
        if self._search.executor not in ("auto", "compiled") or self._search.time_limit is not None:
            return None
        # Imported here: without it, a reasoner needs no CasADi.
        from vtbdrake.rollout.compiled_executor import CompiledExecutor

        executor = CompiledExecutor(self.problem.testbed, workers=self._search.workers)
        points = [dict.fromkeys([*self.space.addresses, *self.belief_to_start.uncertain])]
        if self._search.executor == "compiled":
            executor.prepare(self.task, points)
        elif not executor.suits(self.task, points):
            executor.close()
            return None
        _log.info("decisions are computed in the compiled testbed, which was compared with Drake's")
        return executor

    def __repr__(self) -> str:
        return f"Reasoner({self.problem!r}, {self.budget!r})"

    def solver(self, time: float, *, budget: int | None, start: Point | None = None) -> Solver:
        """Return the method of a decision that begins at ``time``.

        Args:
            time: Time of the DPS in seconds; with the seed it determines the random numbers.
            budget: Number of candidates that the method may propose; None: any number.
            start: Where the method starts, if it starts at a point.
        """
        timed = self.budget.seconds is not None or self._search.pruning is not None
        method = self._search.method or default_method(self.space.elements, candidates=None if timed else budget)
        entropy = [self._seed, int(np.float64(time).view(np.uint64))]
        return make_solver(
            method,
            self.space.parameters,
            constraints=len(self.problem.constraints),
            seed=int(np.random.SeedSequence(entropy).generate_state(1)[0]),
            budget=budget,
            start=start if solver_type(method).takes_start else None,
            **self._search.options,
        )

    def warm_up(self) -> None:
        """Let every worker build its testbed, or compile what decisions at any time take, so that none has to wait.

        The first decision with a budget of wall time warms up before its budget begins; so does the first one after a
        decision that was interrupted (Ctrl-C), which ends the workers that had rollouts.

        Raises:
            ReasonerError: a decision is under way (in another thread), or the reasoner is closed.
        """
        with self._only_one():
            self._warm_up()

    def _warm_up(self) -> None:
        if not self._warm:
            self.executor.warm_up(self.task, self._workers)
        self._warm = True

    def decide(
        self,
        believer: AddressedDiagram | Belief | Start,
        context: Context | None = None,
        *,
        plan: Mapping[str, Any] | None = None,
        budget: Budget | None = None,
        now: float = -inf,
    ) -> Decision:
        """Return the best candidate for a DPS in its present state, in the world as the DPS believes it to be.

        Args:
            believer: The running testbed, or its DPS alone; or a belief; or where the mental rollouts begin.
            context: Context of the running testbed or DPS; not changed.
            plan: Address -> value of a plan from which the method starts, tried beside the one in use.
            budget: Budget of this decision; None: the reasoner's.
            now: The present time of the DPS in seconds, from which the age of a belief follows (``max_age``).

        Raises:
            ReasonerError: a decision is under way (in another thread), or the reasoner is closed.
            BeliefError: No rollout can begin from the belief.
            ValueError: The plan sets what is not decided, or lies outside its ranges; the budget does not suffice for
                one candidate; or a context is missing.
        """
        with self._only_one():
            budget = self.budget if budget is None else budget
            check_budget(budget, self.samples)
            if budget.seconds is not None:
                self._check_executor()
                self._warm_up()
            requested_at = monotonic()
            if isinstance(believer, AddressedDiagram):
                if context is None:
                    raise ValueError("a decision begins at a state: decide(testbed, context), or decide(belief)")
                believer, now = Belief.of(believer, context), max(now, context.get_time())
            try:
                starts = self._starts(believer, now)
                plan_in_use = self._plan_in_use(starts[0])
                user_plan = None if plan is None else self.space.point(plan, starts[0].time)
                try:
                    decision = DecisionRun(self, budget, starts, plan_in_use, user_plan, requested_at).decision()
                except BaseException:
                    self._warm = False  # Workers that are interrupted are ended, and others take their place.
                    raise
            except StartError as error:
                raise BeliefError(f"no rollout can begin from {believer!r}: {error}") from error
            doubts = self._unbelieved.warnings(believer) if isinstance(believer, Belief) else ()
            doubts += self._departures(decision)
            if doubts and not self._has_warned:
                _log.warning("the decision at t = %g s: %s", decision.time, doubts[0])
                self._has_warned = True
            return replace(decision, warnings=(*decision.warnings, *doubts)) if doubts else decision

    def _departures(self, decision: Decision) -> tuple[str, ...]:
        """Return a sentence about where the plan of a decision first leaves the validity domain, if it does."""
        if self._domain is None or decision.chosen is None:
            return ()
        rollouts = [each for each in decision.candidates[decision.chosen].rollouts if not each.failed]
        departures = [departure for each in rollouts if (departure := self._domain.departure(each)) is not None]
        if not departures:
            return ()
        first = min(departures, key=lambda departure: departure.time)
        return (f"with this plan {first._replace(time=decision.time + first.time)}",)

    def _starts(self, believer: Belief | Start, now: float) -> Sequence[Start]:
        if isinstance(believer, Start):
            return [believer] * self.samples
        return self.belief_to_start.starts(believer, samples=self.samples, now=now)

    def _plan_in_use(self, start: Start) -> dict[str, Any]:
        """Return the values of the decided elements in a start, address -> value."""
        if self._readers.keys() <= start.values.keys():
            # Usually so: commands. Setting a context to the start would take a fifth of the time before the rollouts.
            arrays = {address: np.asarray(start.values[address], dtype=float) for address in self._readers}
            return {address: value if value.shape else value.item() for address, value in arrays.items()}
        self._start_context.set(start)
        return {address: read(self._start_context.context) for address, read in self._readers.items()}

    def motion(self, decision: Decision, candidate: int) -> Motion:
        """Return the motion of the mental world under a candidate, from the first sample of the belief.

        Its rollout is simulated again, without pruning.

        Args:
            decision: a decision of this reasoner.
            candidate: The number of the candidate.

        Raises:
            ValueError: The decision has no such candidate, or the mental testbed has no plant.
        """
        if not 0 <= candidate < len(decision.candidates):
            raise ValueError(
                f"the decision has the candidates 0 to {len(decision.candidates) - 1}, and no {candidate!r}"
            )
        task = recording_motion(self.task, self.problem.testbed)
        values = decision.candidates[candidate].values if candidate else {}
        result = RolloutRunner(task, self.problem.testbed).run(values, start=decision.starts[0])
        return Motion.of(task.scenario, result)

    def _check_executor(self) -> None:
        """Raise a ValueError if the executor cannot end a rollout early."""
        if not self.executor.cancels:
            raise ValueError(
                f"{type(self.executor).__name__} cannot end a rollout early, as a budget of wall time and pruning need "
                "it: use executor='processes'"
            )

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
        """End the workers, after a decision that is under way."""
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


def _make_executor(search: SearchConfig, problem: Problem, budget: Budget) -> Executor:
    executor, workers, time_limit = search.executor, search.workers, search.time_limit
    if executor == "auto":
        executor = "serial" if checked_workers(workers) == 1 else choose_executor(problem.testbed)
        workers = None if executor == "serial" else workers
    if executor == "processes" and time_limit is None:
        time_limit = max(_LEAST_TIME_LIMIT, problem.task.horizon)
    return make_executor(
        executor,
        testbed=problem.testbed,
        rollouts=budget.rollouts or 10**9,
        workers=workers,
        time_limit=time_limit,
    )


def _checked_config(config: _Config | None, kind: type[_Config]) -> _Config:
    """Return a configuration, by default one of this kind; refuse another kind."""
    config = kind() if config is None else config
    if not isinstance(config, kind):
        raise ValueError(f"a reasoner is configured by a {kind.__name__}(...), not by {config!r}")
    return config


def _mental(scenario: Scenario) -> Scenario:
    """Return the mental scenario of a scenario.

    Raises:
        ValueError: There is none, or it lacks a command, has another one, or one of another size.
    """
    if not isinstance(scenario, Scenario):
        raise ValueError(
            f"a reasoner is for the scenario of the running testbed, testbed.scenario say, not {scenario!r}"
        )
    mental = scenario.mental()
    if not isinstance(mental, Scenario):
        raise ValueError(f"{type(scenario).__name__}.mental() returns a Scenario, not {mental!r}")
    here, there = ({c.name: c.size for c in s.interface().commands} for s in (scenario, mental))
    differing = sorted(name for name in here.keys() | there.keys() if here.get(name) != there.get(name))
    if differing:
        raise ValueError(
            f"the mental scenario {type(mental).__name__} has other commands than {type(scenario).__name__} "
            f"({', '.join(differing)}), so that a decision would not fit: give both the same interface"
        )
    return mental
