"""Rollouts over a set of points: h over the parameters, to be read, plotted, saved and asked for the boundary."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from math import inf, prod
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.optimization.boundary import Boundary, boundary_of
from vtbdrake.optimization.parameter import Parameter
from vtbdrake.rollout import RolloutResult
from vtbdrake.rollout.arguments import all_of, as_whole
from vtbdrake.state.archive import read_archive, write_archive

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

KIND = "vtbdrake sweep"
VERSION = 2


@dataclass(frozen=True)
class Sweep:
    """The rollouts of a problem at several points, one row per point and condition.

    Attributes:
        parameters: what was varied; p of them.
        units: theirs.
        conditions: address -> value of each condition.
        points: shape (n, p).
        condition: number of the condition in each row, shape (n,).
        rollouts: n results.
        scenario: the scenario's name and fields.
        complete: False if it was interrupted; what is here is finished.
    """

    parameters: tuple[Parameter, ...]
    units: tuple[str, ...]
    conditions: tuple[Mapping[str, Any], ...]
    points: np.ndarray
    condition: np.ndarray
    rollouts: tuple[RolloutResult, ...]
    scenario: Mapping[str, Any] = field(default_factory=dict)
    complete: bool = True

    def __len__(self) -> int:
        return len(self.rollouts)

    @property
    def h(self) -> np.ndarray:
        """h(s^0), equation (17), shape (n,); NaN where the rollout failed."""
        return np.array([rollout.h for rollout in self.rollouts])

    @property
    def t_star(self) -> np.ndarray:
        """t*, equation (16), in seconds, shape (n,); NaN where the rollout failed."""
        return np.array([rollout.t_star for rollout in self.rollouts])

    @property
    def exceeded(self) -> np.ndarray:
        """Whether G1, equation (14), has an element, shape (n,)."""
        return np.array([rollout.exceedances.size > 0 for rollout in self.rollouts], dtype=bool)

    @property
    def failed(self) -> np.ndarray:
        """Whether the simulation failed, shape (n,)."""
        return np.array([rollout.failed for rollout in self.rollouts], dtype=bool)

    def best(self) -> tuple[dict[str, float], float]:
        """(s^0*, h(s^0*)), equation (18), over the points examined; of several conditions, the worst counts.

        Of a cost, its value stands in the place of h.

        Raises:
            ValueError: no point has finished all its conditions.
        """
        # By point and condition, (h, the same in the user's terms).
        scores: dict[tuple[float, ...], dict[int, tuple[float, float]]] = {}
        for point, condition, rollout in zip(self.points, self.condition, self.rollouts, strict=True):
            scores.setdefault(tuple(point.tolist()), {})[int(condition)] = rollout.h, rollout.value
        finished = {
            point: min(pairs.values())
            for point, pairs in scores.items()
            if len(pairs) == len(self.conditions) and not np.isnan(list(pairs.values())).any()
        }
        if not finished:
            raise ValueError("no point of the sweep has a quality under all conditions" + self._first_failure())
        best = max(finished, key=lambda point: finished[point])
        return {p.address: value for p, value in zip(self.parameters, best, strict=True)}, finished[best][1]

    def boundary(self) -> Boundary:
        """The largest parameter value below which every rollout examined here has an empty G1.

        Raises:
            ValueError: the sweep has several parameters or no rollouts, or was interrupted.
        """
        if not self.complete:
            raise ValueError("the sweep was interrupted: its boundary could lie where nothing was examined")
        return boundary_of(self)

    def _first_failure(self) -> str:
        messages = [rollout.message for rollout in self.rollouts if rollout.failed]
        return f"; the first failure: {messages[0]}" if messages else ""

    def to_dict(self) -> dict[str, list[Any]]:
        """Columns by name, one entry per row: the parameters, the condition, h, t*, end, message, wall time."""
        columns: dict[str, list[Any]] = {
            parameter.address: self.points[:, i].tolist() for i, parameter in enumerate(self.parameters)
        }
        columns["condition"] = self.condition.tolist()
        for name in ("h", "t_star", "end", "message", "wall_time"):
            columns[name] = [getattr(rollout, name) for rollout in self.rollouts]
        return columns

    def to_dataframe(self) -> DataFrame:
        """`to_dict` as a pandas DataFrame."""
        try:
            import pandas
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("this needs pandas: pip install 'vtbdrake[dataframe]'") from error
        return pandas.DataFrame(self.to_dict())

    def plot(self) -> Figure:
        """h over the parameters (Figure 6), and for one parameter the quality trajectories with t* marked (Figure 5).

        Raises:
            ValueError: there are more than two parameters.
        """
        from vtbdrake.visualization import plot_sweep

        return plot_sweep(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes one file; recordings of abstract ports cannot be saved.

        Raises:
            ValueError: a recording is not numeric.
        """
        arrays = {"points": self.points, "condition": self.condition}
        rows = []
        for i, rollout in enumerate(self.rollouts):
            for key, value in rollout.record.items():
                if not isinstance(value, np.ndarray):
                    raise ValueError(f"the recording of {key} is not an array, and cannot be saved")
                arrays[f"record/{i}/{key}"] = value
            arrays |= {f"times/{i}": rollout.times, f"quality/{i}": rollout.quality}
            scalars = ("end", "message", "t_star", "h", "value", "threshold", "wall_time")
            row = {name: _plain(getattr(rollout, name)) for name in scalars}
            rows.append({**row, "measures": [_plain(number) for number in rollout.measures]})
        header = {
            "parameters": [asdict(parameter) for parameter in self.parameters],
            "units": list(self.units),
            "conditions": [{k: np.asarray(v).tolist() for k, v in c.items()} for c in self.conditions],
            "scenario": dict(self.scenario),
            "complete": self.complete,
            "rollouts": rows,
        }
        write_archive(path, kind=KIND, version=VERSION, header=header, arrays=arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Sweep:
        """Reads what `save` wrote.

        Raises:
            ArchiveError: the file is not a sweep, is damaged, or was written by another version.
        """
        header, arrays = read_archive(path, kind=KIND, version=VERSION)
        parameters = tuple(Parameter(**parameter) for parameter in header["parameters"])
        conditions = tuple(header["conditions"])
        points, condition = arrays["points"], arrays["condition"]
        rollouts = []
        for i, row in enumerate(header["rollouts"]):
            prefix = f"record/{i}/"
            values = {p.address: float(v) for p, v in zip(parameters, points[i], strict=True)}
            rollouts.append(
                RolloutResult(
                    parameters={**conditions[condition[i]], **values},
                    times=arrays[f"times/{i}"],
                    quality=arrays[f"quality/{i}"],
                    record={k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)},
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
        )


def _plain(value: Any) -> Any:
    # JSON has no inf and no nan.
    return repr(value) if isinstance(value, float) and not np.isfinite(value) else value


def _number(value: Any) -> Any:
    return {"inf": inf, "nan": np.nan}.get(value, value) if isinstance(value, str) else value


def grid(parameters: Sequence[Parameter], points: int | Sequence[int]) -> np.ndarray:
    """Every combination of equally spaced values of one or two parameters, ends included; shape (n, p).

    Raises:
        ValueError: there are more than two parameters, too few points for one of them, or more in all than there is
            memory for.
    """
    if not 1 <= len(parameters) <= 2:
        raise ValueError(f"a sweep goes over one or two parameters, not {len(parameters)}")
    each = [points] * len(parameters) if isinstance(points, int | float | np.number) else points
    form = "one whole number, or one for each parameter"
    counts = [as_whole("a number of points", count) for count in all_of(object, each, name="points", form=form)]
    if len(counts) != len(parameters) or min(counts) < 2:
        raise ValueError(f"a sweep has at least two points for each of its {len(parameters)} parameters, not {points}")
    try:
        axes = [np.linspace(p.lower, p.upper, count) for p, count in zip(parameters, counts, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(parameters))
    except (MemoryError, ValueError, OverflowError):
        raise ValueError(f"a sweep of {prod(counts):.3g} points does not fit into memory: take fewer") from None


def as_points(parameters: Sequence[Parameter], values: ArrayLike) -> np.ndarray:
    """Points that are given, shape (n, p) or, of a single parameter, (n,); shape (n, p).

    Raises:
        ValueError: they have another shape, or are no numbers.
    """
    try:
        table = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"the values of a sweep are numbers of shape (n, p), not {values!r}") from error
    count = len(parameters)
    if table.ndim < 2 and (count == 1 or not table.size):
        table = table.reshape(-1, count)
    if table.ndim != 2 or table.shape[1] != count:
        raise ValueError(f"the values of {count} parameters have shape (n, {count}), not {table.shape}")
    return table
