"""Problem (18): s^0* = argmax h(s^0), stated in the paper's five steps."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from math import nan
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake import upper_layers
from vtbdrake.common.argument_checks import all_of, as_number, as_whole
from vtbdrake.common.summary_html import summary_html
from vtbdrake.drake_workarounds.lost_interrupts import Interruptible
from vtbdrake.optimization.boundary import Boundary, BoundarySearch, Refinement, checked_jitter, parameter_with_boundary
from vtbdrake.optimization.parameter import Dimension, checked_point, checked_points
from vtbdrake.optimization.risk import Risk, make_risk
from vtbdrake.optimization.solvers.solver import Point
from vtbdrake.optimization.sweep import Sweep, as_points, borrowed, grid, make_sweep, numeric, roll_out
from vtbdrake.rollout import (
    Constraint,
    Executor,
    MotionError,
    Quality,
    RecordedMotion,
    RolloutResult,
    RolloutRunner,
    RolloutTask,
)
from vtbdrake.rollout.executor import WorkerError
from vtbdrake.rollout.pickled_task import pack
from vtbdrake.rollout.recorded_motion import MotionPlayer
from vtbdrake.rollout.task import catches
from vtbdrake.rollout.testbeds import FIELD, Testbeds, split
from vtbdrake.state import Snapshot
from vtbdrake.state.variables import overlap
from vtbdrake.testbed import Scenario, VirtualTestbed

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pydrake.geometry import Meshcat

    from vtbdrake.rollout.repeatability import Check
    from vtbdrake.upper_layers import Scene, Study

Condition = Mapping[str, Any]

PLANT_STATE = "plant.state"
"""The output port with the motion of the simulated world."""


@dataclass(frozen=True)
class Motion:
    """The motion of the simulated world: the plant's states [q; v] at ``times``, shape (n, nq + nv).

    With the quality trajectory f' at the same times, equation (13), and t* of its rollout, equation (16), if any.

    Attributes:
        scenario: The scenario of the testbed.
        times: The times in s, shape (n,).
        states: The plant's states [q; v] at these times, shape (n, nq + nv).
        quality: The quality trajectory f' at these times, equation (13), shape (n,), or None.
        t_star: The time at which equation (16) reads the quality, in s; NaN if the rollout has none.
    """

    scenario: Scenario
    times: np.ndarray
    states: np.ndarray
    quality: np.ndarray | None = None
    t_star: float = nan

    @classmethod
    def of(cls, scenario: Scenario, result: RolloutResult) -> Motion:
        """Return the motion in a rollout that `recording_motion` has prepared.

        Args:
            scenario: The scenario that was rolled out.
            result: The result of its rollout.
        """
        quality = result.quality if len(result.times) and len(result.quality) == len(result.times) else None
        return cls(scenario, result.times, result.record[PLANT_STATE], quality, result.t_star)


def recording_motion(task: RolloutTask, testbed: VirtualTestbed) -> RolloutTask:
    """Return a task whose rollouts record all that a `Motion` needs, to the end.

    Args:
        task: The task whose rollouts are to be shown; it stays as it is.
        testbed: The testbed of its scenario.

    Raises:
        ValueError: The testbed has no plant.
    """
    if testbed.plant is None:
        raise ValueError(
            f"there is no motion to show: {type(task.scenario).__name__} has no MultibodyPlant; plot the quality over "
            "time instead, with plot()"
        )
    return replace(task, record=(PLANT_STATE,), pruning=None)


@dataclass(frozen=True, kw_only=True, repr=False)
class ProblemRollout(RolloutResult):
    """A rollout with a reference to its problem, so that it can be shown.

    Attributes:
        problem: The problem that it belongs to.
        condition: Address -> value of its condition.
    """

    problem: Problem
    condition: Mapping[str, Any] = field(default_factory=dict)

    def _repr_html_(self) -> str:
        """Show the result with the quality trajectory in a notebook."""
        rows = {**{address: np.asarray(value).tolist() for address, value in self.parameters.items()}, "end": self.end}
        rows |= {"message": self.message} if self.message else {}
        drawn = self.quality.size > 0 and not self.failed
        return summary_html(repr(self), rows, self.plot() if drawn else None)

    def show(self, meshcat: Meshcat, *, prefix: str = "rollout") -> Scene:
        """Record the motion in ``meshcat`` under ``prefix``; the returned scene shows itself in a notebook.

        Args:
            meshcat: The Meshcat to record in.
            prefix: Path of the drawing in Meshcat's tree.
        """
        return upper_layers.show_motion(meshcat, self.problem.motion(self.parameters), prefix=prefix)

    def plot(self) -> Figure:
        """Plot the quality trajectory with t* marked (Figure 5); of a cost, the cost itself."""
        return upper_layers.plot_quality([self], quality=self.problem.objectives[0])


class Problem:
    """Problem (18) of a scenario.

    Args:
        scenario: Builds the testbed; its defaults are s0.
        parameters: The parameters s^0, equation (8): the elements of s0, and the fields of the scenario
            (``scenario.gravity``), to be varied. Everything else is held constant (9).
        quality: The quality f and its quality variables, equations (11) and (12); or a cost. Several qualities have a
            Pareto front.
        horizon: The horizon t_m in seconds.
        threshold: The threshold f_m; a rollout ends when f exceeds it strictly, or when a cost falls below it. None:
            never. With several qualities it belongs to the first; the others are read up to the end of the rollout.
        sample_period: Period of the samples of f, in seconds; part of the problem, see `RolloutTask`.
        conditions: Further elements of s0 (address -> value) that a decision must cope with, such as start phases,
            frictions or the seeds of sensors; every point runs under each, so that all points have the same noise
            (common random numbers).
        risk: How the qualities under several conditions become one: ``worst``, ``mean``, `Quantile` or `CVaR`.
        constraints: Constraints that every rollout must keep, under every condition.
        start: Snapshot with s0 instead of the defaults. For a running simulation with error control take it by
            ``testbed.fork(simulator)``: a plain ``testbed.snapshot(context)`` lacks the integrator's memory of its last
            step, so that the forecast differs a little from the future of that simulation.
        motion: Declares that the motion of the testbed does not depend on the parameters (for example the pose of a
            camera that observes): the motion is simulated once for each condition, and candidates are simulated along
            it, with the same result; see `RecordedMotion`.

    Raises:
        ValueError: An address does not exist, a range exceeds its variable's bounds, a condition sets a parameter, the
            horizon, threshold or sample period is invalid, the start is of another scenario or of a DPS alone, the
            motion depends on a parameter (`MotionError`), or an argument is of another type.
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
        motion: RecordedMotion | None = None,
    ) -> None:
        self.parameters: tuple[Dimension, ...] = all_of(
            Dimension, parameters, name="parameters", form="[Parameter(address, lower, upper), ...]"
        )
        mappings = all_of(Mapping, conditions, name="conditions", form="[{address: value, ...}, ...]")
        self.conditions = tuple({**condition} for condition in mappings)
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
            motion=self._with_varied(motion),
        )
        self.scenario = self.task.scenario
        self.testbed: VirtualTestbed = self.scenario.build()
        if start is not None:
            self.testbed.restore(self.testbed.default_context(), start)
        self._testbeds = Testbeds(self.testbed)
        self._check_addresses()

    def __repr__(self) -> str:
        varied = ", ".join(f"{p.address} in {p.range_text}" for p in self.parameters)
        qualities = ", ".join(quality.name for quality in self.objectives)
        return f"Problem({type(self.scenario).__name__}: {qualities} over {varied}, horizon {self.task.horizon:g} s)"

    def _repr_html_(self) -> str:
        """Show the parts of the problem in a notebook."""
        parts = zip(self.parameters, self.units, strict=True)
        rows: dict[str, object] = {p.address: f"{p.range_text} {unit}".strip() for p, unit in parts}
        for quality in self.objectives:
            rows["minimize" if quality.minimize else "maximize"] = f"{quality.name} of {', '.join(quality.of)}"
        rows |= {"horizon": f"{self.task.horizon:g} s", "sample period": f"{self.task.sample_period:g} s"}
        rows |= {"threshold": self.task.threshold} if self.task.threshold is not None else {}
        rows |= {"constraints": ", ".join(c.name for c in self.constraints)} if self.constraints else {}
        rows |= {"conditions": f"{len(self.conditions)} ({self.risk!r})"} if len(self.conditions) > 1 else {}
        return summary_html(f"Problem of {type(self.scenario).__name__}", rows)

    def _with_varied(self, motion: RecordedMotion | None) -> RecordedMotion | None:
        if motion is None:
            return None
        for parameter in self.parameters:
            if parameter.is_field:
                raise MotionError(
                    f"{parameter.address} takes another testbed for each value, with another motion: leave out motion="
                )
        return replace(motion, varied=[parameter.address for parameter in self.parameters])

    def _check_addresses(self) -> None:
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
            if both := overlap(addresses, condition):
                part = "it" if both[0] == both[1] else both[1]
                raise ValueError(f"{both[0]} is a parameter, so that no condition can set {part}")
            if both := overlap(condition, condition):
                raise ValueError(f"a condition sets {both[0]} and {both[1]}, but one is an entry of the other")
        for measure in (*self.objectives, *self.constraints):
            for address in measure.of:
                self.testbed.reader(address)
        if self.task.motion is not None:
            MotionPlayer(self.task.motion, self.testbed)

    def _scenario(self, values: Mapping[str, Any]) -> Scenario:
        fields, _ = split(values)
        if fields and self.task.start is not None:
            raise ValueError(
                f"{', '.join(fields)} cannot be set: s0 is a snapshot (start=) of the scenario; leave start out"
            )
        return self.scenario.with_fields(fields) if fields else self.scenario

    @property
    def units(self) -> tuple[str, ...]:
        """Return the units of the parameters; empty for fields of the scenario."""
        variables = self.testbed.variables()
        return tuple("" if p.is_field else variables[p.address].unit for p in self.parameters)

    def point(self, point: ArrayLike | Mapping[str, Any]) -> Point:
        """Check a point s^0, given as values in the order of the parameters or by address, and return its values.

        Raises:
            ValueError: The point has another number of entries, or one lies outside its range.
        """
        return checked_point(self.parameters, point)

    def points(self, points: Sequence[Point]) -> list[Point]:
        """Check points s^0; see `point`."""
        return checked_points(self.parameters, points)

    def values(self, point: ArrayLike | Mapping[str, Any], *, condition: int | None = None) -> dict[str, Any]:
        """Return the values that a point, and a condition if it is given, set in s0, address -> value.

        Args:
            point: Values of the parameters, (n,), or address -> value.
            condition: Number of a condition, from 0; None for the values of the point alone.

        Raises:
            ValueError: As in `point`, or there is no such condition.
        """
        return self.assigned(self.point(point), condition=condition)

    def assigned(self, point: Point, *, condition: int | None = None) -> dict[str, Any]:
        """Return the same for a point whose values are valid: a study may have widened the ranges.

        Args:
            point: Values of the parameters, in their order.
            condition: Number of a condition, from 0; None for the values of the point alone.
        """
        values = {p.address: value for p, value in zip(self.parameters, point, strict=True)}
        return values if condition is None else {**self._condition(condition), **values}

    def with_ranges(self, parameters: Sequence[Dimension]) -> Problem:
        """Return the problem with other ranges of the same parameters, on the same testbed.

        Raises:
            ValueError: A range exceeds the bounds of its variable, or the parameters are others.
        """
        other = copy(self)
        other.parameters = tuple(parameters)
        if [p.address for p in parameters] != [p.address for p in self.parameters]:
            raise ValueError("the ranges belong to other parameters than the problem's")
        other._check_addresses()
        return other

    def values_in(self, snapshot: Snapshot) -> dict[str, Any]:
        """Return the values of the parameters in a state of the problem's testbed, by address.

        Unlike a point's values, they may lie outside the ranges.

        Raises:
            SnapshotError: The snapshot is of another scenario.
        """
        context, fields = self.testbed.default_context(), self.scenario.record()
        self.testbed.restore(context, snapshot)
        return {
            p.address: fields[p.address.removeprefix(FIELD)] if p.is_field else self.testbed.read(context, p.address)
            for p in self.parameters
        }

    def _condition(self, number: int) -> Condition:
        count, index = len(self.conditions), as_whole("the number of a condition", number)
        if not 0 <= index < count:
            raise ValueError(f"the problem has no condition {number}: it has {count}, counted from 0")
        return self.conditions[index]

    def rollout(
        self,
        point: ArrayLike | Mapping[str, Any],
        *,
        condition: int = 0,
        record: Sequence[str] = (),
        run_on: bool = False,
    ) -> ProblemRollout:
        """Run one rollout, with s(t*).

        Args:
            point: The point s^0, as values in the order of the parameters or by address.
            condition: The number of the condition.
            record: Addresses and ports (``path.port``) to record at the sample times.
            run_on: Whether to simulate to t_m although the threshold was exceeded.
        """
        task = replace(self.task, record=record, run_on=run_on, keep_state=True)
        condition_values = self._condition(condition)
        parameters = {**condition_values, **self.values(point)}
        result = replace(self._runner(task, parameters).run(split(parameters)[1]), parameters=parameters)
        return ProblemRollout(**vars(result), problem=self, condition=condition_values)

    def state(self, point: ArrayLike | Mapping[str, Any], t: float, *, condition: int = 0) -> Snapshot:
        """Return s(t) = Gamma'(s^0, t), equation (10), at a sample time t in seconds.

        Args:
            point: Values of the parameters, (n,), or address -> value.
            t: A sample time, in s since the start.
            condition: Number of the condition, from 0.
        """
        parameters = self.values(point, condition=condition)
        return self._runner(self.task, parameters).state(split(parameters)[1], as_number("the time t", t))

    def motion(self, parameters: Mapping[str, Any]) -> Motion:
        """Return the motion of the simulated world in the rollout with ``parameters`` (address -> value) set in s0.

        Raises:
            ValueError: The testbed has no plant.
        """
        runner = self._runner(recording_motion(self.task, self.testbed), parameters)
        result = runner.run(split(parameters)[1])
        return Motion.of(runner.task.scenario, result)

    def _runner(self, task: RolloutTask, parameters: Mapping[str, Any]) -> RolloutRunner:
        return RolloutRunner(*self.placed(task, parameters))

    def placed(self, task: RolloutTask, values: Mapping[str, Any]) -> tuple[RolloutTask, VirtualTestbed]:
        """Return task and testbed for ``values`` (address -> value), which may set fields of the scenario.

        Args:
            task: The rollout task.
            values: Values by address; ``scenario.<field>`` sets a field.
        """
        scenario = self._scenario(values)
        return replace(task, scenario=scenario), self._testbeds.get(scenario)

    def check_repeatability(self) -> Check:
        """Find obstacles to parallel rollouts: memory outside the Context, values that cannot be sent to workers.

        The first part of a rollout is simulated four times, which takes about a second: twice in a row, beside another
        rollout on the same Diagram, and in another process. The results must be equal. With ``motion``, whole rollouts
        at the ends of the ranges are compared with those along the motion, too. Print the returned findings.

        Raises:
            QualityError: f raises, is negative or NaN.
        """
        from vtbdrake.rollout.repeatability import check_rollouts

        ends = [{p.address: p.ends[k] for p in self.parameters if not p.is_field} for k in (0, -1)]
        points = [{**split(self.conditions[k])[1], **ends[k]} for k in (0, -1)]
        with Interruptible():
            result = check_rollouts(self.task, self.testbed, points)
        findings = list(result.findings)
        for values in (*self.conditions, *({p.address: end} for p in self.parameters for end in p.ends)):
            try:
                pack(values)
            except WorkerError as error:
                findings.append(str(error))
        if self.task.motion is not None:
            findings += self._check_memory()
        return replace(result, findings=tuple(findings))

    def _check_memory(self) -> list[str]:
        """Return a sentence if rollouts along the motion differ from whole ones at the ends of the ranges."""
        assert self.task.motion is not None
        for k in (0, -1):
            point = self.values([p.ends[k] for p in self.parameters], condition=k % len(self.conditions))
            tasks = (self.task, replace(self.task, motion=None))
            along, whole = (self._runner(task, point).run(split(point)[1]) for task in tasks)
            if not along.identical(whole):
                return [
                    f"a rollout along the recorded motion ends with {along}, and the whole one with {whole}: what "
                    f"depends on the parameters has a longer memory than memory={self.task.motion.memory:g} s"
                ]
        return []

    def sweep(
        self,
        points: int | Sequence[int] | None = None,
        *,
        values: ArrayLike | None = None,
        executor: str | Executor = "auto",
        workers: int | None = None,
        record: Sequence[str] = (),
        run_on: bool = False,
        on_error: str = "record",
        progress: bool = True,
    ) -> Sweep:
        """Run a rollout at every point, under every condition. Ctrl-C keeps the finished rollouts.

        Args:
            points: The numbers of points of an equally spaced grid over one or two parameters: one for all or each.
            values: The points themselves instead, shape (n,) for one parameter or (n, p).
            executor: ``auto``, ``serial``, ``threads``, ``processes``, ``dask``, an Executor, any
                ``concurrent.futures`` executor, or a client of Dask; see `make_executor`.
            workers: The number of threads or processes; by default the number of cores.
            record: Addresses and ports to record at the sample times.
            run_on: Whether to simulate to t_m although the threshold was exceeded; then all of G1 is known.
            on_error: What happens if a quality or constraint function raises, is negative or NaN. ``record``: the
                rollout counts as failed, with the message, and the first is logged; ``raise``: the sweep ends.
            progress: Whether to show a progress bar.

        Raises:
            ValueError: A point lies outside the range of a parameter, or the executor is unknown.
            QualityError: f raises, is negative or NaN, and ``on_error`` is ``raise``.
        """
        if (points is None) == (values is None):
            raise ValueError("a sweep takes either the number of points of a grid, or values")
        parameters = numeric(self)
        if values is None:
            assert points is not None
            table = grid(parameters, points)
        else:
            table = as_points(parameters, values)
        checked = [self.point(point.tolist()) for point in table]
        keys = [(point, condition) for point in checked for condition in range(len(self.conditions))]
        task = replace(self.task, record=record, run_on=run_on, catch=catches(on_error))
        with borrowed(self, executor, rollouts=len(keys), workers=workers) as opened:
            return make_sweep(self, keys, roll_out(self, opened, task, keys, name="sweep", progress=progress))

    def boundary(
        self,
        *,
        resolution: float,
        coarse: float,
        repeats: int | None = None,
        jitter: float = 1e-6,
        executor: str | Executor = "auto",
        workers: int | None = None,
        on_error: str = "record",
        progress: bool = True,
    ) -> Boundary:
        """Search the largest value of the parameter below which every rollout examined is safe.

        A rollout is safe if it does not exceed the threshold, keeps all constraints and does not fail. A coarse grid
        over the range is refined below the first unsafe value under each condition; bisection alone could fail, as the
        outcome need not be monotonic. An unsafe range narrower than the coarse step can be missed; the answer says so
        (`Boundary.gap`).

        Close to the boundary, a contact-rich simulation is chaotic: the last digits of s0 decide. So values around the
        boundary are repeated, each time with the parameter moved a little: downwards until a value is safe each time,
        upwards until one is unsafe each time. The values between are undecided, with the chance of an unsafe rollout
        (`Boundary.chances`).

        Args:
            resolution: Step of the fine grid, in the parameter's unit; of a parameter with a logarithmic range, the
                ratio of neighbouring values, above 1.
            coarse: Step of the coarse grid, likewise.
            repeats: The number of rollouts with jitter for each value close to the boundary and each condition. By
                default 5, and 0 for integers and for fields of the scenario, where each takes another Diagram.
            jitter: The largest displacement of the parameter in these rollouts, as a fraction of its range (on its own
                scale).
            executor: See `sweep`.
            workers: See `sweep`.
            on_error: What happens if a quality or constraint function raises, is negative or NaN. ``record``: the
                rollout counts as failed, which is unsafe, and the first of a round is logged; ``raise``: the search
                ends.
            progress: Whether to show a progress bar.

        Raises:
            QualityError: f raises, is negative or NaN, and ``on_error`` is ``raise``.
            ValueError: There is not exactly one parameter, neither a threshold nor a constraint, a threshold of a cost
                (which is a goal, not a danger), or the steps do not fit the range.
            KeyboardInterrupt: The search was interrupted.
        """
        parameter = parameter_with_boundary(self)
        refinement = Refinement(parameter, resolution=resolution, coarse=coarse)
        repeats, jitter = checked_jitter(parameter, repeats, jitter)
        task = replace(self.task, catch=catches(on_error))
        rollouts = len(refinement.start()) * len(self.conditions)
        with borrowed(self, executor, rollouts=rollouts, workers=workers) as opened:
            search = BoundarySearch(self, task, refinement, opened, progress=progress)
            return search.run(repeats=repeats, jitter=jitter)

    def study(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        solver: str | None = None,
        seed: int | None = None,
        options: Mapping[str, Any] | None = None,
        parallel: int | None = None,
        allow_changed_code: bool = False,
        more_conditions: bool = False,
    ) -> Study:
        """Begin a study of the problem, or resume the one in a file.

        Args:
            path: Path of the file; None keeps the study in memory.
            solver: Name of the solver, see `vtbdrake.optimization.solvers`; by default ``auto``, which chooses by the
                problem, or the file's.
            seed: Seed of the solver; 0 by default, or the file's.
            options: Options of the solver.
            parallel: The number of rollouts that can run side by side, at least: the solver asks for enough points at a
                time for as many workers, and racing goes in rounds of as many rollouts. The points depend on it, never
                on the number of workers. By default the solver chooses its batches, which suits about eight cores (see
                docs/studies.md), or as in the file.
            allow_changed_code: Whether to go on although the functions of the problem, the Python code of its testbed,
                the values that they use, or the defaults of its s0 have changed; or the version of Python, with which
                no code can be compared. The file records the changes (`Study.record`, ``changes``). Its rollouts stay,
                but those in which a quality function failed run again. What a function looks up by a computed name
                (``getattr``, ``eval``), a file that it reads, and global state of installed packages are not seen;
                objects that cannot be read are named in a warning, and in `Study.summary`.
            more_conditions: Whether the problem may have further conditions behind the file's. Its rollouts
                stay; its points are evaluated again, by the rollouts that are missing.

        Raises:
            StudyError: The file is no study or is damaged, or was made by another version, problem, solver, seed,
                width or code.
        """
        return upper_layers.Study.of(
            self,
            path,
            solver=solver,
            seed=seed,
            options=options,
            parallel=parallel,
            allow_changed_code=allow_changed_code,
            more_conditions=more_conditions,
        )
