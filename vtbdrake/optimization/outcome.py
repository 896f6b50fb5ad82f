"""What is known of rollouts and of points, as plain data: the rows of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, isnan
from typing import Any

import numpy as np

from vtbdrake.optimization.risk import Risk
from vtbdrake.optimization.solvers.solver import Judged, Point
from vtbdrake.rollout import RolloutResult

# (point, number of the condition)
Row = tuple[Point, int]


@dataclass(frozen=True)
class Outcome:
    """What a study keeps of one rollout; the meaning of the fields is that of `RolloutResult`."""

    h: float
    value: float
    measures: tuple[float, ...]
    t_star: float
    end: str
    message: str
    wall_time: float

    @classmethod
    def of(cls, result: RolloutResult) -> Outcome:
        """Return what is kept of a result: all but its trajectories."""
        return cls(**{name: getattr(result, name) for name in cls.__dataclass_fields__})


def aggregate(
    outcomes: Sequence[Outcome | RolloutResult | None],
    *,
    risk: Risk,
    minimize: Sequence[bool],
    constraints: int,
    bounds: Sequence[float],
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """What the outcomes of one point under several conditions say together.

    Args:
        outcomes: one per condition, none of them failed; None where a condition was not tried.
        risk: how the qualities under several conditions become one.
        minimize: whether a quality is a cost, for each of them.
        constraints: how many there are.
        bounds: the best that each quality can be, in the user's terms; it stands in for what was not tried.

    Returns:
        The qualities, larger is better (a cost appears negated), and the worst violation of each constraint.
    """
    values = []
    for k, (cost, bound) in enumerate(zip(minimize, bounds, strict=True)):
        own = [bound if o is None else o.value if k == 0 else o.measures[k - 1] for o in outcomes]
        # A risk of the user's may make NaN of infinities, where nothing bounds what was not tried.
        with np.errstate(invalid="ignore"):
            value = float(risk(np.array([-number if cost else number for number in own])))
        values.append(inf if isnan(value) and None in outcomes else value)
    tried = [outcome for outcome in outcomes if outcome is not None]
    first = len(values) - 1
    violations = [max((o.measures[first + k] for o in tried), default=-inf) for k in range(constraints)]
    return tuple(values), tuple(violations)


@dataclass(frozen=True)
class Trial(Judged):
    """A point s^0 of a study, and how good it is.

    Attributes:
        number: in the order of the study.
        parameters: the point, address -> value.
        values: one per quality, aggregated over the conditions, in the user's terms: a cost as a cost. NaN if a
            simulation failed.
        violations: one per constraint, the worst over the conditions: at most 0 where it holds.
        exact: False if racing dropped the point, so that ``values`` only says that it is no better than that; infinite
            if nothing is known of it but that it breaks a constraint.
        origin: who asked for it: ``solver`` or ``user``.
        method: what the solver worked with.
        batch: the number of the batch of points that were judged together.
        attributes: what users said of the point, see `Study.set_attribute`.
    """

    number: int
    parameters: Mapping[str, Any]
    values: tuple[float, ...]
    violations: tuple[float, ...]
    exact: bool
    origin: str
    method: str
    batch: int
    attributes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def value(self) -> float:
        """The value of the first quality."""
        return self.values[0]
