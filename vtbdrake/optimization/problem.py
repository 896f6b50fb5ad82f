"""Problem (18): s^0* = argmax h(s^0), stated in the paper's five steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.optimization.boundary import Boundary, Refinement, Trial, find_boundary
from vtbdrake.optimization.parameter import Parameter
from vtbdrake.optimization.sweep import Sweep, grid
from vtbdrake.rollout import Executor, Quality, RolloutResult, RolloutRunner, RolloutTask, make_executor
from vtbdrake.rollout.many import run_rollouts
from vtbdrake.state import Snapshot
from vtbdrake.testbed import Scenario, VirtualTestbed

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pydrake.geometry import Meshcat

Condition = Mapping[str, ArrayLike]
# (point, number of the condition)
Row = tuple[tuple[float, ...], int]


@dataclass(frozen=True)
class Motion:
    """How the simulated world moved: the plant's states [q; v] at ``times``, shape (n, nq + nv)."""

    scenario: Scenario
    times: np.ndarray
    states: np.ndarray


@dataclass(frozen=True, kw_only=True)
class ProblemRollout(RolloutResult):
    """A rollout that knows its problem, so that it can be looked at."""

    problem: Problem = field(repr=False)
    condition: Condition = field(default_factory=dict)

    def show(self, meshcat: Meshcat, *, prefix: str = "rollout") -> None:
        """Puts the motion into ``meshcat`` as a recording under ``prefix``."""
        from vtbdrake.visualization import show_motion

        show_motion(meshcat, self.problem.motion(self.parameters), prefix=prefix)

    def plot(self) -> Figure:
        """The quality trajectory with t* marked (Figure 5)."""
        from vtbdrake.visualization import plot_quality

        return plot_quality([self])


class Problem:
    """Problem (18) of a scenario.

    Args:
        scenario: builds the testbed; its defaults are s0.
        parameters: s^0, equation (8): the elements of s0 that are varied. All else is held constant (9).
        quality: f and its quality variables, equations (11) and (12).
        horizon: t_m in seconds.
        threshold: f_m; a rollout whose f exceeds it, strictly, ends there.
        sample_period: of f, in seconds; part of the problem, see `RolloutTask`.
        conditions: further elements of s0 (address -> value) that a decision must cope with, such as start phases;
            every point is tried under each.
        start: s0 from a snapshot instead of the defaults.

    Raises:
        ValueError: an address does not exist, a range exceeds its variable's bounds, a condition sets what is varied,
            or the horizon, threshold or sample period makes no sense.
    """

    def __init__(
        self,
        *,
        scenario: Scenario,
        parameters: Sequence[Parameter],
        quality: Quality,
        horizon: float,
        threshold: float = inf,
        sample_period: float = 0.05,
        conditions: Sequence[Condition] = ({},),
        start: Snapshot | None = None,
    ) -> None:
        self.parameters = tuple(parameters)
        self.conditions = tuple({**condition} for condition in conditions)
        self.task = RolloutTask(
            scenario=scenario,
            horizon=horizon,
            quality=quality,
            threshold=threshold,
            sample_period=sample_period,
            start=start,
        )
        self.scenario = self.task.scenario
        self.testbed: VirtualTestbed = self.scenario.build()
        self._check()

    def _check(self) -> None:
        if not self.conditions:
            raise ValueError("a problem has at least one condition; {} is the scenario as it is")
        variables = self.testbed.variables()
        addresses = [parameter.address for parameter in self.parameters]
        if len(set(addresses)) < len(addresses):
            raise ValueError(f"a parameter is given twice: {', '.join(addresses)}")
        for parameter in self.parameters:
            parameter.find(variables)
        for condition in self.conditions:
            for address, value in condition.items():
                variables[address].check(value)
                if address in addresses:
                    raise ValueError(f"{address} is a parameter, so that no condition can set it")
        assert self.task.quality is not None
        for address in self.task.quality.of:
            self.testbed.reader(address)

    def values(self, point: ArrayLike | Mapping[str, float]) -> dict[str, float]:
        """A point s^0, given as numbers in the order of the parameters or by address, as address -> value.

        Raises:
            ValueError: it has another number of entries, or one lies outside its range.
        """
        if isinstance(point, Mapping):
            unknown = set(point) ^ {parameter.address for parameter in self.parameters}
            if unknown:
                raise ValueError(f"a point sets each parameter once; this one is wrong about {', '.join(unknown)}")
            point = [point[parameter.address] for parameter in self.parameters]
        numbers = np.atleast_1d(np.asarray(point, dtype=float))
        if numbers.shape != (len(self.parameters),):
            raise ValueError(f"a point has {len(self.parameters)} entries, but the one given has shape {numbers.shape}")
        for parameter, value in zip(self.parameters, numbers, strict=True):
            if not parameter.lower <= value <= parameter.upper:
                raise ValueError(
                    f"{parameter.address} = {value:g} lies outside its range [{parameter.lower:g}, {parameter.upper:g}]"
                )
        return {p.address: float(value) for p, value in zip(self.parameters, numbers, strict=True)}

    def rollout(
        self,
        point: ArrayLike | Mapping[str, float],
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
        chosen = self.conditions[condition]
        task = replace(self.task, record=tuple(record), run_on=run_on, keep_state=True)
        result = RolloutRunner(task, self.testbed).run({**chosen, **self.values(point)})
        return ProblemRollout(**vars(result), problem=self, condition=chosen)

    def state(self, point: ArrayLike | Mapping[str, float], t: float, *, condition: int = 0) -> Snapshot:
        """s(t) = Gamma'(s^0, t), equation (10), at a sample time."""
        parameters = {**self.conditions[condition], **self.values(point)}
        snapshot: Snapshot = RolloutRunner(self.task, self.testbed).state(parameters, t)
        return snapshot

    def motion(self, parameters: Mapping[str, Any]) -> Motion:
        """The motion of the simulated world in the rollout with ``parameters`` (address -> value) set in s0."""
        task = replace(self.task, record=("plant.state",))
        result = RolloutRunner(task, self.testbed).run(parameters)
        return Motion(self.scenario, result.times, result.record["plant.state"])

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
            executor: ``auto``, ``serial``, ``threads``, ``processes`` or an Executor.
            workers: threads or processes; the number of cores if left out.
            record: addresses and ports to record at the sample times.
            run_on: simulate to t_m although the threshold was exceeded, so that all of G1 is known.
            progress: show a progress bar.

        Raises:
            ValueError: a point lies outside the range of a parameter, or the executor is unknown.
            QualityError: f raises, is negative or NaN.
        """
        if (points is None) == (values is None):
            raise ValueError("a sweep takes either the number of points of a grid, or values")
        if values is None:
            assert points is not None
            table = grid(self.parameters, points)
        else:
            table = np.asarray(values, dtype=float).reshape(-1, len(self.parameters))
        rows = [(tuple(point), condition) for point in table for condition in range(len(self.conditions))]
        task = replace(self.task, record=tuple(record), run_on=run_on)
        chosen = make_executor(executor, testbed=self.testbed, rollouts=len(rows), workers=workers)
        try:
            results = run_rollouts(chosen, task, self._trials(rows), progress=progress, description="sweep")
        finally:
            if chosen is not executor:
                chosen.close()
        return self._table(rows, results)

    def boundary(
        self,
        *,
        resolution: float,
        coarse: float,
        executor: str | Executor = "auto",
        workers: int | None = None,
        progress: bool = True,
    ) -> Boundary:
        """How far may the parameter go: the largest value below which every rollout examined has an empty G1.

        A coarse grid over the range is refined below the first failure under each condition; bisection alone could be
        fooled, as the outcome need not be monotonic.

        Args:
            resolution: width of the interval to be found, in the parameter's unit.
            coarse: step of the coarse grid.

        Raises:
            ValueError: there is not exactly one parameter, no threshold, or the steps do not fit the range.
            KeyboardInterrupt: it was interrupted, so that nothing can be said.
        """
        if len(self.parameters) != 1 or self.task.threshold == inf:
            raise ValueError(
                "a boundary is that of one parameter under a finite threshold, but the problem has "
                f"{len(self.parameters)} parameters and a threshold of {self.task.threshold:g}"
            )
        parameter = self.parameters[0]
        refinement = Refinement(parameter.lower, parameter.upper, resolution=resolution, coarse=coarse)
        rows: list[Row] = []
        results: list[RolloutResult] = []
        trials = len(refinement.start()) * len(self.conditions)
        chosen = make_executor(executor, testbed=self.testbed, rollouts=trials, workers=workers)

        def examine(wanted: Sequence[Trial]) -> list[bool]:
            new = [((value,), condition) for value, condition in wanted]
            found = run_rollouts(chosen, self.task, self._trials(new), progress=progress, description="boundary")
            finished = [result for result in found if result is not None]
            if len(finished) < len(found):
                raise KeyboardInterrupt
            rows.extend(new)
            results.extend(finished)
            return [result.failed or result.exceedances.size > 0 for result in finished]

        try:
            find_boundary(refinement, len(self.conditions), examine)
        finally:
            if chosen is not executor:
                chosen.close()
        return self._table(rows, results).boundary()

    def _trials(self, rows: Sequence[Row]) -> list[dict[str, Any]]:
        return [{**self.conditions[condition], **self.values(point)} for point, condition in rows]

    def _table(self, rows: Sequence[Row], results: Sequence[RolloutResult | None]) -> Sweep:
        finished = [(*row, result) for row, result in zip(rows, results, strict=True) if result is not None]
        finished.sort(key=lambda row: row[:2])
        variables = self.testbed.variables()
        return Sweep(
            parameters=self.parameters,
            units=tuple(variables[parameter.address].unit for parameter in self.parameters),
            conditions=self.conditions,
            points=np.array([point for point, _, _ in finished], dtype=float).reshape(-1, len(self.parameters)),
            condition=np.array([condition for _, condition, _ in finished], dtype=int),
            rollouts=tuple(result for _, _, result in finished),
            scenario=self.scenario.record(),
            complete=len(finished) == len(rows),
        )
