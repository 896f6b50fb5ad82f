"""Problem (18): s^0* = argmax h(s^0), stated in the paper's five steps."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from vtbdrake.optimization.boundary import Boundary
from vtbdrake.optimization.motion import Motion, ProblemRollout
from vtbdrake.optimization.parameter import Dimension, checked_point
from vtbdrake.optimization.risk import Risk, make_risk
from vtbdrake.optimization.solvers.solver import Point
from vtbdrake.optimization.sweep import Sweep, as_points, grid
from vtbdrake.rollout import Constraint, Executor, Quality, RolloutRunner, RolloutTask
from vtbdrake.rollout.arguments import all_of, as_number, as_whole
from vtbdrake.rollout.executor import WorkerError
from vtbdrake.rollout.pickled_task import pack
from vtbdrake.rollout.runner import Testbeds, split
from vtbdrake.state import Snapshot
from vtbdrake.testbed import Scenario, VirtualTestbed
from vtbdrake.testbed.interrupt import Interruptible

if TYPE_CHECKING:
    from vtbdrake.optimization.casadi_function import ProblemFunction
    from vtbdrake.optimization.study import Study
    from vtbdrake.rollout.check import Check

Condition = Mapping[str, Any]


class Problem:
    """Problem (18) of a scenario.

    Args:
        scenario: builds the testbed; its defaults are s0.
        parameters: s^0, equation (8): the elements of s0, and the fields of the scenario (``scenario.gravity``), to be
            varied. All else is held constant (9).
        quality: f and its quality variables, equations (11) and (12); or a cost. Several ask for their Pareto front.
        horizon: t_m in seconds.
        threshold: f_m; a rollout whose f exceeds it, strictly, ends there. Of a cost: below which it ends. None: never.
        sample_period: of f, in seconds; part of the problem, see `RolloutTask`.
        conditions: further elements of s0 (address -> value) that a decision must cope with, such as start phases,
            frictions or the seeds of sensors; every point is tried under each, so that all points meet the same noise
            (common random numbers).
        risk: how the qualities under several conditions become one: ``worst``, ``mean``, `Quantile` or `CVaR`.
        constraints: what every rollout has to keep, under every condition.
        start: s0 from a snapshot instead of the defaults. Of a running simulation with error control take it by
            ``testbed.fork(simulator)``: after a plain ``testbed.snapshot(context)``, the forecast differs a little from
            what follows, as the integrator's memory of its last step is no part of s.

    Raises:
        ValueError: an address does not exist, a range exceeds its variable's bounds, a condition sets what is varied,
            the horizon, threshold or sample period makes no sense, the start is of another scenario or of a DPS alone,
            or an argument is of another kind than it says.
    """

    def __init__(
        self,
        *,
        scenario: Scenario,
        parameters: Sequence[Dimension],
        quality: Quality | Sequence[Quality],
        horizon: float,
        threshold: float | None = None,
        sample_period: float = 0.05,
        conditions: Sequence[Condition] = ({},),
        risk: str | Risk = "worst",
        constraints: Sequence[Constraint] = (),
        start: Snapshot | None = None,
    ) -> None:
        self.parameters: tuple[Dimension, ...] = all_of(
            Dimension, parameters, name="parameters", form="[Parameter(address, lower, upper), ...]"
        )
        given = all_of(Mapping, conditions, name="conditions", form="[{address: value, ...}, ...]")
        self.conditions = tuple({**condition} for condition in given)
        qualities = (quality,) if isinstance(quality, Quality) else quality
        self.objectives = all_of(Quality, qualities, name="quality", form="Quality(f, of=[address, ...]) or several")
        self.constraints = all_of(
            Constraint, constraints, name="constraints", form="[Constraint(f, of=[address, ...], at_most=...), ...]"
        )
        self.risk = make_risk(risk)
        if not self.objectives:
            raise ValueError("a problem has at least one quality")
        self.task = RolloutTask(
            scenario=scenario,
            horizon=horizon,
            quality=self.objectives[0],
            measures=(*self.objectives[1:], *self.constraints),
            threshold=threshold,
            sample_period=sample_period,
            start=start,
        )
        if self.task.threshold is not None and len(self.objectives) > 1:
            raise ValueError("a threshold ends a rollout for the sake of one quality, but the problem has several")
        self.scenario = self.task.scenario
        self.testbed: VirtualTestbed = self.scenario.build()
        if start is not None:
            self.testbed.restore(self.testbed.default_context(), start)
        self._testbeds = Testbeds(self.testbed)
        self._check()

    def _check(self) -> None:
        if not self.conditions:
            raise ValueError("a problem has at least one condition; {} is the scenario as it is")
        variables = self.testbed.variables()
        addresses = [parameter.address for parameter in self.parameters]
        if len(set(addresses)) < len(addresses):
            raise ValueError(f"a parameter is given twice: {', '.join(addresses)}")
        for parameter in self.parameters:
            if parameter.is_field:
                for value in parameter.ends:
                    self._scenario({parameter.address: value})
            else:
                parameter.find(variables)
        for condition in self.conditions:
            self._scenario(condition)
            for address, value in split(condition)[1].items():
                variables[address].check(value)
            both = [address for address in condition if address in addresses]
            if both:
                raise ValueError(f"{both[0]} is a parameter, so that no condition can set it")
        for measure in (*self.objectives, *self.constraints):
            for address in measure.of:
                self.testbed.reader(address)

    def _scenario(self, values: Mapping[str, Any]) -> Scenario:
        fields, _ = split(values)
        if fields and self.task.start is not None:
            raise ValueError(
                f"{', '.join(fields)} cannot change where s0 is a snapshot, which is of the scenario as it was"
            )
        return self.scenario.with_fields(fields) if fields else self.scenario

    @property
    def units(self) -> tuple[str, ...]:
        """Of the parameters; those of scenario fields are not known."""
        variables = self.testbed.variables()
        return tuple("" if p.is_field else variables[p.address].unit for p in self.parameters)

    def point(self, point: ArrayLike | Mapping[str, Any]) -> Point:
        """A point s^0, given as values in the order of the parameters or by address, checked.

        Raises:
            ValueError: it has another number of entries, or one lies outside its range.
        """
        return checked_point(self.parameters, point)

    def values(self, point: ArrayLike | Mapping[str, Any], *, condition: int | None = None) -> dict[str, Any]:
        """What `point` sets in s0, as address -> value; and what the condition sets, if one is named.

        Raises:
            ValueError: as `point`, or there is no such condition.
        """
        chosen = {p.address: value for p, value in zip(self.parameters, self.point(point), strict=True)}
        return chosen if condition is None else {**self._condition(condition), **chosen}

    def _condition(self, number: int) -> Condition:
        count = len(self.conditions)
        if not 0 <= as_whole("the number of a condition", number) < count:
            raise ValueError(f"the problem has no condition {number}: it has {count}, counted from 0")
        return self.conditions[number]

    def rollout(
        self,
        point: ArrayLike | Mapping[str, Any],
        *,
        condition: int = 0,
        record: Sequence[str] = (),
        run_on: bool = False,
    ) -> ProblemRollout:
        """One rollout at ``point``, with s(t*).

        Args:
            condition: which of the problem's conditions.
            record: addresses and ports (``path.port``) to record at the sample times.
            run_on: simulate to t_m although the threshold was exceeded.
        """
        task = replace(self.task, record=record, run_on=run_on, keep_state=True)
        parameters = self.values(point, condition=condition)
        result = replace(self._runner(task, parameters).run(split(parameters)[1]), parameters=parameters)
        return ProblemRollout(**vars(result), problem=self, condition=self.conditions[condition])

    def state(self, point: ArrayLike | Mapping[str, Any], t: float, *, condition: int = 0) -> Snapshot:
        """s(t) = Gamma'(s^0, t), equation (10), at a sample time, in seconds."""
        parameters = self.values(point, condition=condition)
        return self._runner(self.task, parameters).state(split(parameters)[1], as_number("the time t", t))

    def motion(self, parameters: Mapping[str, Any]) -> Motion:
        """The motion of the simulated world in the rollout with ``parameters`` (address -> value) set in s0."""
        runner = self._runner(replace(self.task, record=("plant.state",)), parameters)
        result = runner.run(split(parameters)[1])
        return Motion(runner.task.scenario, result.times, result.record["plant.state"])

    def _runner(self, task: RolloutTask, parameters: Mapping[str, Any]) -> RolloutRunner:
        return RolloutRunner(*self.placed(task, parameters))

    def placed(self, task: RolloutTask, values: Mapping[str, Any]) -> tuple[RolloutTask, VirtualTestbed]:
        """The task and the testbed for ``values`` (address -> value), which may set fields of the scenario."""
        scenario = self._scenario(values)
        return replace(task, scenario=scenario), self._testbeds.get(scenario)

    def check(self) -> Check:
        """Look for what executors cannot cope with: memory outside the Context, values that do not travel to workers.

        It takes about a second: the first part of a rollout is simulated four times, which must agree: twice in a row,
        beside another rollout on the same Diagram, and in another process. Print what it returns.

        Raises:
            QualityError: f raises, is negative or NaN.
        """
        from vtbdrake.rollout.check import check_rollouts

        ends = [{p.address: p.ends[k] for p in self.parameters if not p.is_field} for k in (0, -1)]
        points = [{**split(self.conditions[k])[1], **ends[k]} for k in (0, -1)]
        with Interruptible():
            found = check_rollouts(self.task, self.testbed, points)
        travelling = []
        for values in (*self.conditions, *({p.address: end} for p in self.parameters for end in p.ends)):
            try:
                pack(values)
            except WorkerError as error:
                travelling.append(str(error))
        return replace(found, findings=(*found.findings, *travelling))

    def sweep(
        self,
        points: int | Sequence[int] | None = None,
        *,
        values: ArrayLike | None = None,
        executor: str | Executor = "auto",
        workers: int | None = None,
        record: Sequence[str] = (),
        run_on: bool = False,
        progress: bool = True,
    ) -> Sweep:
        """A rollout at every point, under every condition. Ctrl-C keeps what is finished.

        Args:
            points: of an equally spaced grid over one or two parameters, for all of them or one by one.
            values: the points themselves instead, shape (n,) for one parameter or (n, p).
            executor: ``auto``, ``serial``, ``threads``, ``processes``, ``dask``, an Executor, any
                ``concurrent.futures`` executor, or a client of Dask; see `make_executor`.
            workers: threads or processes; the number of cores if left out.
            record: addresses and ports to record at the sample times.
            run_on: simulate to t_m although the threshold was exceeded, so that all of G1 is known.
            progress: show a progress bar.

        Raises:
            ValueError: a point lies outside the range of a parameter, or the executor is unknown.
            QualityError: f raises, is negative or NaN.
        """
        from vtbdrake.optimization import examine

        if (points is None) == (values is None):
            raise ValueError("a sweep takes either the number of points of a grid, or values")
        numeric = examine.numeric(self)
        if values is None:
            assert points is not None
            table = grid(numeric, points)
        else:
            table = as_points(numeric, values)
        task = replace(self.task, record=record, run_on=run_on)
        return examine.sweep(self, task, table, executor=executor, workers=workers, progress=progress)

    def boundary(
        self,
        *,
        resolution: float,
        coarse: float,
        repeats: int | None = None,
        jitter: float = 1e-6,
        executor: str | Executor = "auto",
        workers: int | None = None,
        progress: bool = True,
    ) -> Boundary:
        """How far may the parameter go: the largest value below which every rollout examined is safe.

        A rollout is safe if it does not exceed the threshold, keeps all constraints and does not fail. A coarse grid
        over the range is refined below the first unsafe value under each condition; bisection alone could be fooled, as
        the outcome need not be monotonic. An unsafe range narrower than the coarse step can be missed; the answer says
        so (`Boundary.gap`).

        Close to the boundary, a contact-rich simulation is chaotic: the last digits of s0 decide. So values around the
        boundary are repeated, each time with the parameter moved a little: downwards until a value is safe each time,
        upwards until one is unsafe each time. What lies between is undecided, and comes with the chance of an unsafe
        rollout (`Boundary.chances`).

        Args:
            resolution: step of the fine grid, in the parameter's unit; of a parameter with a logarithmic range, the
                ratio of neighbouring values, above 1.
            coarse: step of the coarse grid, likewise.
            repeats: rollouts with jitter for each value close to the boundary and each condition; 0 for none. By
                default 5, and none for integers, and for fields of the scenario, where each takes another Diagram.
            jitter: how far the parameter is moved at most in these, as a fraction of its range (on its own scale).

        Raises:
            ValueError: there is not exactly one parameter, neither a threshold nor a constraint, a threshold of a cost
                (which is a goal, not a danger), or the steps do not fit the range.
            KeyboardInterrupt: it was interrupted, so that nothing can be said.
        """
        from vtbdrake.optimization import examine

        return examine.boundary(
            self,
            resolution=resolution,
            coarse=coarse,
            repeats=repeats,
            jitter=jitter,
            executor=executor,
            workers=workers,
            progress=progress,
        )

    def casadi_function(self, **options: Any) -> ProblemFunction:
        """h(s^0) as a ``casadi.Function`` with derivatives, for ``Opti`` and ``nlpsol``; see `ProblemFunction`."""
        from vtbdrake.optimization.casadi_function import ProblemFunction

        return ProblemFunction(self, **options)

    def study(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        solver: str | None = None,
        seed: int | None = None,
        options: Mapping[str, Any] | None = None,
        allow_changed_code: bool = False,
    ) -> Study:
        """A study of the problem: begins a new one, or resumes the one in the file.

        Args:
            path: of the file; None keeps the study in memory.
            solver: by name, see `vtbdrake.optimization.solvers`; by default ``auto``, which chooses by the problem,
                or that of the file.
            seed: of the solver; 0 by default, or that of the file.
            options: of the solver.
            allow_changed_code: go on although the functions of the problem, or the Python code of its testbed, are not
                those that the study began with. The file notes what has changed (`Study.record`, ``changes``). Its
                rollouts stay as they are, but those in which a quality function failed run again.

        Raises:
            StudyError: the file is no study, is damaged, of another version, problem, solver or seed, or of other code.
        """
        from vtbdrake.optimization.study import Study

        return Study.of(self, path, solver=solver, seed=seed, options=options, allow_changed_code=allow_changed_code)
