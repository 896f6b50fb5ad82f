"""What is known of a finished rollout, of a point with all its rollouts, and of an intervention."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from datetime import datetime
from math import isnan, nan
from typing import Any

from vtbdrake.common.failures import safe_text
from vtbdrake.common.summary_html import summary_html
from vtbdrake.optimization.solvers.solver import Point, PointValues
from vtbdrake.rollout import RolloutResult
from vtbdrake.rollout.course import Course
from vtbdrake.rollout.task import FAILED

# How a point came out beside `FAILED`.
# It keeps the constraints.
FEASIBLE = "feasible"
# It breaks a constraint.
BROKEN = "broken"
# Racing dropped it.
DROPPED = "dropped"

# Kinds of interventions that more than their own function knows; see `Study.intervene` for all.
PAUSE = "pause"
RESUME = "resume"
STOP = "stop"
TRY = "try"
# What a person tells the process that runs the study; the points do not depend on these.
CONTROLS = (PAUSE, RESUME, STOP)

# (point, number of the condition)
RolloutKey = tuple[Point, int]


@dataclass(frozen=True)
class Outcome:
    """The record of one finished rollout in a study; see `RolloutResult` for its fields.

    Attributes:
        h: The value of h, equation (17).
        value: The quality of the rollout.
        measures: The values of the other measures: further qualities and constraints.
        t_star: The instant t*, equation (16), in s.
        end: Why the rollout ended.
        message: The error of a rollout that failed; empty otherwise.
        wall_time: The wall time that the rollout took, in seconds.
    """

    h: float
    value: float
    measures: tuple[float, ...]
    t_star: float
    end: str
    message: str
    wall_time: float

    @property
    def failed(self) -> bool:
        """Return whether the rollout failed."""
        return self.end == FAILED

    @classmethod
    def of(cls, result: RolloutResult) -> Outcome:
        """Return the part of a result that is stored: everything but its trajectories."""
        values = {field.name: getattr(result, field.name) for field in fields(cls)}
        return cls(**{**values, "message": safe_text(result.message)})


@dataclass(frozen=True, repr=False)
class Trial(PointValues):
    """A point s^0 of a study or a sweep with its values.

    Attributes:
        parameters: The point, address -> value.
        values: One per quality, aggregated over the conditions, in the user's terms: a cost as a cost. NaN if a
            simulation failed.
        violations: One per constraint, the worst over the conditions: at most 0 where it holds.
        exact: False if racing dropped the point: it is no better than ``values``, which are infinite if nothing is
            known but that the point violates a constraint.
        origin: ``solver`` or ``user``, whichever asked for the point.
        method: The solver's method at that time; of a sweep, ``sweep``.
        batch: The number of the batch of points that were evaluated together.
        number: Number in the order of the study, counted by the study file; or of the sweep.
        attributes: The user's notes on the point, see `Study.set_attribute`.
    """

    parameters: Mapping[str, Any]
    values: tuple[float, ...]
    violations: tuple[float, ...]
    exact: bool
    origin: str
    method: str
    batch: int
    number: int = 0
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        values = ", ".join(f"{value:.6g}" for value in self.values)
        return f"<Trial {self.number}: {values} ({self.kind}) at {dict(self.parameters)}>"

    def _repr_html_(self) -> str:
        """Show the point in a notebook."""
        values = {f"value of quality {k}" if k else "value": f"{value:.6g}" for k, value in enumerate(self.values)}
        violations = {f"violation of constraint {k}": f"{value:.6g}" for k, value in enumerate(self.violations)}
        origin = f"{self.method}, batch {self.batch}" + (", by hand" if self.origin == "user" else "")
        rows = {**self.parameters, **values, **violations, "asked for by": origin, **self.attributes}
        return summary_html(f"Trial {self.number}: {self.kind}", rows)

    @property
    def point(self) -> Point:
        """Return the values of the parameters, in their order."""
        return tuple(self.parameters.values())

    @property
    def kind(self) -> str:
        """Return the outcome of the point: `FEASIBLE`, `BROKEN`, `DROPPED` or `FAILED`."""
        # The bound of a dropped point may be infinite; only a failed simulation gives NaN.
        if any(isnan(value) for value in self.values):
            return FAILED
        if not self.exact:
            return DROPPED
        return FEASIBLE if self.feasible else BROKEN

    @property
    def value(self) -> float:
        """Return the value of the first quality."""
        return self.values[0]


@dataclass(frozen=True)
class Intervention:
    """A change of a study by a person, as a row of the study's file.

    Attributes:
        number: Number in the file.
        time: When it was written, in UTC.
        name: Who wrote it.
        kind: See `Study.intervene`.
        payload: The arguments of its kind, as JSON data.
        batch: The number of the first batch on which it had an effect; None while it waits for one.
    """

    number: int
    time: datetime
    name: str
    kind: str
    payload: Mapping[str, Any]
    batch: int | None = None

    @property
    def text(self) -> str:
        """Return kind and payload in a line."""
        return " ".join([self.kind, *(f"{name}={json.dumps(value)}" for name, value in self.payload.items())])

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON data."""
        return {**asdict(self), "time": self.time.isoformat(), "payload": dict(self.payload)}


@dataclass(frozen=True)
class DrivenTrial:
    """A rollout of a study's problem that somebody has driven; no solver learns from it.

    Attributes:
        number: Number in the file.
        time: When it was stored, in UTC.
        name: Who stored it.
        parameters: The values of the study's parameters where it began, address -> value.
        outcome: Its outcome.
        course: What was set when: ``course.rollout(problem.task)`` computes the rollout again, bit for bit.
    """

    number: int
    time: datetime
    name: str
    parameters: Mapping[str, Any]
    outcome: Outcome
    course: Course

    def values(self, qualities: int) -> tuple[float, ...]:
        """Return the values of the study's ``qualities`` qualities, in the user's terms."""
        values = (self.outcome.value, *self.outcome.measures)[:qualities]
        return values if len(values) == qualities else (nan,) * qualities

    def kind(self, qualities: int) -> str:
        """Return its outcome, as `Trial.kind` does: `FEASIBLE`, `BROKEN` or `FAILED`."""
        if any(isnan(value) for value in self.values(qualities)):
            return FAILED
        return FEASIBLE if all(v <= 0.0 for v in self.outcome.measures[qualities - 1 :]) else BROKEN
