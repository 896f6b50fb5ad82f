"""Sweeps: a rollout at every point, under every condition."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from math import inf, nan, prod
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake import upper_layers
from vtbdrake.common.argument_checks import all_of, as_array, as_whole, check_plain, counted
from vtbdrake.common.extras import extra_module
from vtbdrake.common.json_data import plain
from vtbdrake.common.summary_html import summary_html
from vtbdrake.optimization.parameter import Parameter, point_text
from vtbdrake.optimization.records import RolloutKey, Trial
from vtbdrake.optimization.risk import CVaR, Mean, Quantile, Risk, Worst, aggregate
from vtbdrake.optimization.solvers.solver import Evaluation
from vtbdrake.rollout import Executor, RolloutResult, RolloutTask, make_executor
from vtbdrake.rollout.executor import run_rollouts
from vtbdrake.state.archive import read_archive, write_archive

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from vtbdrake.optimization.boundary import Boundary
    from vtbdrake.optimization.problem import Problem

KIND = "vtbdrake sweep"
VERSION = 3
# The largest number of points of a grid: the results of as many rollouts fill the memory of most computers.
MOST_POINTS = 10_000_000

# The risks that a file can hold.
_RISKS: dict[str, type[Risk]] = {kind.__name__: kind for kind in (Mean, Worst, Quantile, CVaR)}


@dataclass(frozen=True, repr=False)
class Sweep:
    """The rollouts of a problem at several points, one row per point and condition.

    Attributes:
        parameters: What was varied; p of them.
        units: The units of the parameters.
        conditions: Address -> value of each condition.
        points: The points, shape (n, p).
        condition: Number of the condition in each row, shape (n,).
        rollouts: The n results, in the order in which the points were given.
        scenario: The scenario's name and fields.
        complete: False if it was interrupted; it then holds the finished rollouts.
        minimize: Whether a quality is a cost, for each quality of the problem.
        constraints: The name of each of the problem's constraints.
        risk: How a quality under several conditions becomes one; None after loading a sweep whose risk is of a user's
            class, which a file cannot hold.
    """

    parameters: tuple[Parameter, ...]
    units: tuple[str, ...]
    conditions: tuple[Mapping[str, Any], ...]
    points: np.ndarray
    condition: np.ndarray
    rollouts: tuple[RolloutResult, ...]
    scenario: Mapping[str, Any] = field(default_factory=dict)
    complete: bool = True
    minimize: tuple[bool, ...] = (False,)
    constraints: tuple[str, ...] = ()
    risk: Risk | None = field(default_factory=Worst)

    def __len__(self) -> int:
        return len(self.rollouts)

    def __repr__(self) -> str:
        ranges = ", ".join(f"{p.address} in {p.range_text}" for p in self.parameters)
        interrupted = "" if self.complete else ", interrupted"
        return f"Sweep({counted(len(self), 'rollout')} over {ranges}{interrupted})"

    def _repr_html_(self) -> str:
        """Show a summary with a plot in a notebook."""
        try:
            best = f"{self.best.value:g} at {point_text(self.parameters, self.best.point, self.units)}"
        except ValueError as error:
            best = str(error)
        rows: dict[str, object] = {p.address: p.range_text for p in self.parameters}
        rows |= {"conditions": len(self.conditions), "best": best}
        rows |= {
            name: count for name in ("exceeded", "violated", "failed") if (count := int(getattr(self, name).sum()))
        }
        drawn = len(self) > 0 and len(self.parameters) <= 2
        return summary_html(repr(self), rows, self.plot() if drawn else None)

    @property
    def h(self) -> np.ndarray:
        """Return the quality of each rollout, equation (17), shape (n,); NaN where the rollout failed."""
        return np.array([rollout.h for rollout in self.rollouts])

    @property
    def t_star(self) -> np.ndarray:
        """Return t*, equation (16), in seconds, shape (n,); NaN where the rollout failed."""
        return np.array([rollout.t_star for rollout in self.rollouts])

    @property
    def exceeded(self) -> np.ndarray:
        """Return whether the threshold was exceeded (G1, equation (14), has an element), shape (n,)."""
        return np.array([rollout.exceedances.size > 0 for rollout in self.rollouts], dtype=bool)

    @property
    def violated(self) -> np.ndarray:
        """Return whether a constraint of the problem was violated, shape (n,); False where the rollout failed."""
        first = len(self.minimize) - 1
        return np.array([max(rollout.measures[first:], default=0.0) > 0.0 for rollout in self.rollouts], dtype=bool)

    @property
    def unsafe(self) -> np.ndarray:
        """Return whether the threshold was exceeded, a constraint violated, or the rollout failed, shape (n,)."""
        return self.exceeded | self.violated | self.failed

    @property
    def failed(self) -> np.ndarray:
        """Return whether the simulation, or the function of a quality or constraint, failed, shape (n,)."""
        return np.array([rollout.failed for rollout in self.rollouts], dtype=bool)

    @property
    def evaluations(self) -> tuple[Evaluation, ...]:
        """Return the evaluation of each point that has finished all its conditions, as in a study.

        Raises:
            ValueError: The sweep was loaded from a file that could not hold its risk.
        """
        risk = self.risk
        if risk is None:
            raise ValueError(
                "the file of the sweep could not hold its risk, which is of a class of your own: set it by "
                "dataclasses.replace(sweep, risk=...)"
            )
        rows: dict[tuple[float, ...], dict[int, RolloutResult]] = {}
        for point, condition, rollout in zip(self.points, self.condition, self.rollouts, strict=True):
            rows.setdefault(tuple(point.tolist()), {})[int(condition)] = rollout
        return tuple(
            self._evaluation(point, [results[c] for c in sorted(results)], risk)
            for point, results in rows.items()
            if len(results) == len(self.conditions)
        )

    def _evaluation(self, point: tuple[float, ...], results: Sequence[RolloutResult], risk: Risk) -> Evaluation:
        count = len(self.minimize), len(self.constraints)
        if any(result.failed for result in results):
            return Evaluation(point, (nan,) * count[0], (nan,) * count[1])
        values, violations = aggregate(
            results, risk=risk, minimize=self.minimize, constraints=count[1], bounds=(nan,) * count[0]
        )
        return Evaluation(point, values, violations)

    @property
    def best(self) -> Trial:
        """Return s^0*, equation (18), among the points examined: the best that keeps all constraints; as `Study.best`.

        The problem's risk aggregates several conditions. The trial's number counts the points in their order.

        Raises:
            ValueError: There are several qualities; no point has finished all its conditions and keeps the constraints;
                or the sweep was loaded from a file that could not hold its risk.
        """
        if len(self.minimize) > 1:
            raise ValueError("several qualities have no single best point: use problem.study() and its pareto()")
        candidates = {n: evaluation for n, evaluation in enumerate(self.evaluations) if evaluation.feasible}
        if not candidates:
            feasible = " and keeps the constraints" if self.constraints else ""
            raise ValueError(
                f"no point of the sweep has a quality under all conditions{feasible}{self._first_failure()}"
            )
        number, best = max(candidates.items(), key=lambda item: item[1].values[0])
        value = -best.values[0] if self.minimize[0] else best.values[0]
        return Trial(
            parameters={p.address: v for p, v in zip(self.parameters, best.point, strict=True)},
            values=(value + 0.0,),  # adding 0 makes 0 of -0
            violations=best.violations,
            exact=True,
            origin="user",
            method="sweep",
            batch=0,
            number=number,
        )

    def boundary(self) -> Boundary:
        """Return the boundary: the largest parameter value below which every rollout examined here was safe.

        A rollout is safe if it did not exceed the threshold, kept all constraints and did not fail.

        Raises:
            ValueError: The sweep has several parameters or no rollouts, was interrupted, or has neither a threshold nor
                a constraint.
        """
        from vtbdrake.optimization.boundary import boundary_of, why_no_boundary

        reason = why_no_boundary(self)
        if reason:
            raise ValueError(reason)
        return boundary_of(self)

    def _first_failure(self) -> str:
        messages = [rollout.message for rollout in self.rollouts if rollout.failed]
        return f"; the first failure: {messages[0]}" if messages else ""

    def to_dict(self) -> dict[str, list[Any]]:
        """Return columns by name, one entry per row.

        The columns are the parameters, the condition, h, t*, end, message and wall time; further qualities
        (``quality 1``, ...) and violations of constraints (``violation 0``, ...), NaN where the rollout failed.
        """
        columns: dict[str, list[Any]] = {
            parameter.address: self.points[:, i].tolist() for i, parameter in enumerate(self.parameters)
        }
        columns["condition"] = self.condition.tolist()
        for name in ("h", "t_star", "end", "message", "wall_time"):
            columns[name] = [getattr(rollout, name) for rollout in self.rollouts]
        further = len(self.minimize) - 1
        names = [f"quality {k + 1}" for k in range(further)] + [f"violation {k}" for k in range(len(self.constraints))]
        for k, name in enumerate(names):
            columns[name] = [rollout.measures[k] if rollout.measures else nan for rollout in self.rollouts]
        return columns

    def to_dataframe(self) -> DataFrame:
        """Return `to_dict` as a pandas DataFrame."""
        frame: DataFrame = extra_module("pandas", purpose="a DataFrame", extra="dataframe").DataFrame(self.to_dict())
        return frame

    def plot(self) -> Figure:
        """Plot h over the parameters (Figure 6); for one parameter also the quality trajectories with t* (Figure 5).

        Raises:
            ValueError: There are more than two parameters.
        """
        return upper_layers.plot_sweep(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the sweep to a file; recordings of abstract ports cannot be saved.

        Raises:
            ValueError: A recording is not numeric.
        """
        arrays = {"points": self.points, "condition": self.condition}
        rows = []
        for i, rollout in enumerate(self.rollouts):
            for key, value in rollout.record.items():
                if not isinstance(value, np.ndarray):
                    raise ValueError(f"the recording of {key} is not an array, and cannot be saved")
                arrays[f"record/{i}/{key}"] = value
            for name in ("times", "quality", "exceedances"):
                arrays[f"{name}/{i}"] = getattr(rollout, name)
            scalars = ("end", "message", "t_star", "h", "value", "threshold", "wall_time")
            row = {name: getattr(rollout, name) for name in scalars}
            rows.append(plain({**row, "measures": rollout.measures}, nonfinite=repr))
        header = {
            "parameters": [asdict(parameter) for parameter in self.parameters],
            "units": list(self.units),
            "conditions": [{k: np.asarray(v).tolist() for k, v in c.items()} for c in self.conditions],
            "scenario": dict(check_plain(self.scenario)),
            "complete": self.complete,
            "minimize": list(self.minimize),
            "constraints": list(self.constraints),
            "risk": _risk_to_file(self.risk),
            "rollouts": rows,
        }
        write_archive(path, kind=KIND, version=VERSION, header=header, arrays=arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Sweep:
        """Read a sweep that `save` wrote.

        Raises:
            ArchiveError: The file is not a sweep, is damaged, or was written by another version.
        """
        return read_archive(path, kind=KIND, version=VERSION, make=cls._from_parts)

    @classmethod
    def _from_parts(cls, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Sweep:
        parameters = tuple(Parameter(**parameter) for parameter in header["parameters"])
        conditions = tuple(header["conditions"])
        points, condition = arrays["points"], arrays["condition"]
        records: list[dict[str, np.ndarray]] = [{} for _ in header["rollouts"]]
        for name, array in arrays.items():
            kind, _, rest = name.partition("/")
            if kind == "record":
                number, _, key = rest.partition("/")
                records[int(number)][key] = array
        rollouts = []
        for i, (row, record) in enumerate(zip(header["rollouts"], records, strict=True)):
            values = {p.address: float(v) for p, v in zip(parameters, points[i], strict=True)}
            rollouts.append(
                RolloutResult(
                    parameters={**conditions[condition[i]], **values},
                    times=arrays[f"times/{i}"],
                    quality=arrays[f"quality/{i}"],
                    exceedances=arrays[f"exceedances/{i}"],
                    record=record,
                    measures=tuple(_number(number) for number in row.pop("measures")),
                    **{name: _number(value) for name, value in row.items()},
                )
            )
        return cls(
            parameters=parameters,
            units=tuple(header["units"]),
            conditions=conditions,
            points=points,
            condition=condition,
            rollouts=tuple(rollouts),
            scenario=header["scenario"],
            complete=header["complete"],
            minimize=tuple(header["minimize"]),
            constraints=tuple(header["constraints"]),
            risk=_risk_from_file(header["risk"]),
        )


def _risk_to_file(risk: Risk | None) -> dict[str, Any] | None:
    kind = type(risk).__name__
    return {"kind": kind, "options": vars(risk)} if _RISKS.get(kind) is type(risk) else None


def _risk_from_file(data: Mapping[str, Any] | None) -> Risk | None:
    return None if data is None else _RISKS[data["kind"]](**data["options"])


def _number(value: Any) -> Any:
    return {"inf": inf, "nan": np.nan}.get(value, value) if isinstance(value, str) else value


def grid(parameters: Sequence[Parameter], points: int | Sequence[int]) -> np.ndarray:
    """Return all combinations of equally spaced values of one or two parameters, ends included; shape (n, p).

    Logarithmic ranges are spaced on that scale; values of integers are rounded to whole numbers.

    Args:
        parameters: One or two parameters.
        points: The number of values per parameter, or one number for all, each at least 2.

    Raises:
        ValueError: There are more than two parameters, too few points for one of them, more than an integer has values,
            or more in all than `MOST_POINTS`.
    """
    if not 1 <= len(parameters) <= 2:
        raise ValueError(f"a sweep goes over one or two parameters, not {len(parameters)}")
    each = [points] * len(parameters) if isinstance(points, int | float | np.number) else points
    form = "one whole number, or one for each parameter"
    counts = [as_whole("a number of points", count) for count in all_of(object, each, name="points", form=form)]
    if prod(counts) > MOST_POINTS:
        raise ValueError(
            f"a sweep of {prod(counts):,} points is larger than the largest, {MOST_POINTS:,}: take fewer points, or "
            "let a study search"
        )
    if len(counts) != len(parameters) or min(counts) < 2:
        raise ValueError(f"a sweep has at least two points for each of its {len(parameters)} parameters, not {points}")
    for parameter, count in zip(parameters, counts, strict=True):
        if parameter.integer and len(_axis(parameter, min(count, 10**6))) < count:
            raise ValueError(
                f"{parameter.address} is an integer in {parameter.range_text}, which does not have {count} different "
                "whole numbers in equal steps: take fewer points, or give values"
            )
    axes = [_axis(parameter, count) for parameter, count in zip(parameters, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(parameters))


def _axis(parameter: Parameter, count: int) -> np.ndarray:
    spaced = np.geomspace if parameter.log else np.linspace
    values = spaced(parameter.lower, parameter.upper, count)
    return np.unique(np.round(values)) if parameter.integer else values


def as_points(parameters: Sequence[Parameter], values: ArrayLike) -> np.ndarray:
    """Return given points, shape (n, p) or (n,) of a single parameter, as shape (n, p).

    Args:
        parameters: The p parameters.
        values: The points, numbers in the parameters' units.

    Raises:
        ValueError: They have another shape, or are no numbers.
    """
    try:
        table = as_array("the values of a sweep", values)
    except ValueError:
        raise ValueError(f"the values of a sweep are numbers of shape (n, p), not {values!r}") from None
    count = len(parameters)
    if table.ndim < 2 and (count == 1 or not table.size):
        table = table.reshape(-1, count)
    if table.ndim != 2 or table.shape[1] != count:
        raise ValueError(f"the values of {count} parameters have shape (n, {count}), not {table.shape}")
    return table


def numeric(problem: Problem) -> tuple[Parameter, ...]:
    """Return the parameters of a problem; all must be numbers.

    Raises:
        ValueError: One is a choice.
    """
    for parameter in problem.parameters:
        if not isinstance(parameter, Parameter):
            raise ValueError(
                f"a sweep goes over numbers, but {parameter.address} is a choice: use problem.study(solver='grid')"
            )
    return tuple(parameter for parameter in problem.parameters if isinstance(parameter, Parameter))


@contextmanager
def borrowed(problem: Problem, executor: Any, *, rollouts: int, **settings: Any) -> Iterator[Executor]:
    """Provide what `make_executor` returns, and close it afterwards unless it is the user's.

    Args:
        problem: The problem whose testbed runs the rollouts.
        executor: The name of an executor, or an executor, pool or client of the user, see `make_executor`.
        rollouts: The number of rollouts that it will run at most.
        settings: ``workers`` and ``time_limit`` of `make_executor`.
    """
    borrowed_executor = make_executor(executor, testbed=problem.testbed, rollouts=rollouts, **settings)
    try:
        yield borrowed_executor
    finally:
        if borrowed_executor is not executor:
            borrowed_executor.close()


def roll_out(
    problem: Problem, executor: Executor, task: RolloutTask, keys: Sequence[RolloutKey], *, name: str, progress: bool
) -> list[RolloutResult | None]:
    """Run the rollouts of some points and conditions; those that were interrupted are None.

    Args:
        problem: The problem, which turns points and conditions into values by address.
        executor: Runs the rollouts.
        task: The task of the rollouts.
        keys: (point, number of the condition) of each rollout.
        name: The text before the progress bar.
        progress: Whether to show a progress bar in a terminal or a notebook.
    """
    points = [problem.values(point, condition=condition) for point, condition in keys]
    return run_rollouts(executor, task, points, progress=progress, description=name)


def make_sweep(problem: Problem, keys: Sequence[RolloutKey], results: Sequence[RolloutResult | None]) -> Sweep:
    """Return the sweep of the results that are finished.

    Args:
        problem: The problem.
        keys: (point, number of the condition) of each rollout.
        results: The result of each rollout, or None where it is not finished.
    """
    finished = [(*key, result) for key, result in zip(keys, results, strict=True) if result is not None]
    return Sweep(
        parameters=numeric(problem),
        units=problem.units,
        conditions=problem.conditions,
        points=np.array([point for point, _, _ in finished], dtype=float).reshape(-1, len(problem.parameters)),
        condition=np.array([condition for _, condition, _ in finished], dtype=int),
        rollouts=tuple(result for _, _, result in finished),
        scenario=problem.scenario.record(),
        complete=len(finished) == len(keys),
        minimize=tuple(quality.minimize for quality in problem.objectives),
        constraints=tuple(constraint.name for constraint in problem.constraints),
        risk=problem.risk,
    )
