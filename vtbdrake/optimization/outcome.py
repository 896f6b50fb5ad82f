"""What is known of rollouts and of points, as plain data: the rows of a study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

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
        """Without its trajectories."""
        return cls(**{name: getattr(result, name) for name in cls.__dataclass_fields__})


@dataclass(frozen=True)
class Trial(Judged):
    """A point s^0 of a study, and how good it is.

    Attributes:
        number: in the order of the study.
        parameters: the point, address -> value.
        values: one per quality, aggregated over the conditions, in the user's terms: a cost as a cost. NaN if a
            simulation failed.
        violations: one per constraint, the worst over the conditions: at most 0 where it holds.
        exact: False if racing dropped the point, so that ``values`` only says that it is no better than that.
        origin: who asked for it: ``solver`` or ``user``.
        method: what the solver worked with.
        batch: the number of the batch of points that were judged together.
    """

    number: int
    parameters: Mapping[str, Any]
    values: tuple[float, ...]
    violations: tuple[float, ...]
    exact: bool
    origin: str
    method: str
    batch: int

    @property
    def value(self) -> float:
        """Of the first quality."""
        return self.values[0]
