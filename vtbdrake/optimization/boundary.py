"""How far may a parameter go? The largest value below which no rollout exceeds the threshold."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import inf, isinf
from typing import TYPE_CHECKING

import numpy as np

from vtbdrake.rollout.arguments import as_number

if TYPE_CHECKING:
    from vtbdrake.optimization.sweep import Sweep

# (value, number of the condition)
Candidate = tuple[float, int]


@dataclass(frozen=True)
class Boundary:
    """The boundary of the values for which G1 is empty under every condition, as an interval.

    Attributes:
        address: of the parameter.
        unit: its unit.
        lower: the largest value examined up to which no rollout exceeded the threshold (-inf if the least one did).
        upper: the smallest value examined at which one did (inf if none did).
        by_condition: the same interval for each condition alone: shape (conditions, 2).
        safe_beyond: values above a condition's own interval that were safe all the same: where there are any, the
            outcome is not monotonic, and a bisection could have ended there.
        undecided: values at which a simulation failed; they count as exceeded.
        failure: the reason of the first of them.
        sweep: the rollouts that it rests on.
    """

    address: str
    unit: str
    lower: float
    upper: float
    by_condition: np.ndarray = field(compare=False)
    safe_beyond: tuple[float, ...] = ()
    undecided: tuple[float, ...] = ()
    failure: str = ""
    sweep: Sweep | None = field(default=None, repr=False, compare=False)

    def __str__(self) -> str:
        failed = f" ({len(self.undecided)} values with failed simulations: {self.failure})" if self.undecided else ""
        return self._interval() + failed

    def _interval(self) -> str:
        if isinf(self.upper):
            return f"{self.address}: safe up to {self.lower:g} {self.unit}, the largest value examined"
        if isinf(self.lower):
            return f"{self.address}: not safe at {self.upper:g} {self.unit}, the smallest value examined"
        return f"{self.address}: safe up to {self.lower:g} {self.unit}, not at {self.upper:g} {self.unit}"


def boundary_of(sweep: Sweep) -> Boundary:
    """The boundary that the rollouts of a sweep over one parameter show.

    Raises:
        ValueError: the sweep has several parameters, or a condition has no rollouts.
    """
    if len(sweep.parameters) != 1:
        raise ValueError(f"a boundary is that of one parameter, but the sweep has {len(sweep.parameters)}")
    values, bad = sweep.points[:, 0], sweep.exceeded | sweep.failed
    intervals, beyond = [], set()
    for condition in range(len(sweep.conditions)):
        mine = sweep.condition == condition
        if not mine.any():
            raise ValueError(f"condition {condition} has no rollouts, so that nothing is known of its boundary")
        upper = values[mine & bad].min(initial=inf)
        lower = values[mine & (values < upper)].max(initial=-inf)
        intervals.append((lower, upper))
        beyond |= set(values[mine & ~bad & (values > upper)])
    by_condition = np.array(intervals)
    return Boundary(
        address=sweep.parameters[0].address,
        unit=sweep.units[0],
        # Between two conditions' examined values lies nothing that is known of both: the least of each end holds.
        lower=float(by_condition[:, 0].min()),
        upper=float(by_condition[:, 1].min()),
        by_condition=by_condition,
        safe_beyond=tuple(sorted(float(value) for value in beyond)),
        undecided=tuple(sorted({float(value) for value in values[sweep.failed]})),
        failure=next((rollout.message for rollout in sweep.rollouts if rollout.failed), ""),
        sweep=sweep,
    )


class Refinement:
    """Which values to examine: a coarse grid, then every fine value around each condition's first failure.

    Near the boundary the outcome is not monotonic in the parameter, so that bisection can be fooled. Here every value
    of the fine grid is examined in the coarse cell that ends in the first failure or contains it, and in the cell
    below; a failure found there moves both down with it, until there is none.
    """

    def __init__(self, lower: float, upper: float, *, resolution: float, coarse: float) -> None:
        resolution, coarse = as_number("the resolution", resolution), as_number("the coarse step", coarse)
        if not 0.0 < resolution <= coarse <= upper - lower:
            raise ValueError(
                f"it takes 0 < resolution <= coarse <= {upper - lower:g}, the width of the range, not a resolution of "
                f"{resolution:g} and a coarse step of {coarse:g}"
            )
        self._lower, self._upper = float(lower), float(upper)
        self._count = int(np.ceil((upper - lower) / resolution - 1e-9))
        self._resolution = resolution
        self._coarse = max(1, round(coarse / resolution))

    def value(self, index: int) -> float:
        """The fine grid's value ``index``; its last is the end of the range."""
        return self._upper if index >= self._count else self._lower + index * self._resolution

    def start(self) -> list[int]:
        """The coarse grid, with both ends."""
        return [*range(0, self._count, self._coarse), self._count]

    def next(self, examined: dict[int, bool]) -> list[int]:
        """What to examine further under one condition, of which ``examined`` says index -> failed."""
        failures = [index for index, failed in examined.items() if failed]
        if not failures:
            return []
        first = min(failures)
        cell = (first - 1) // self._coarse * self._coarse
        return [index for index in range(max(0, cell - self._coarse), first) if index not in examined]


def find_boundary(
    refinement: Refinement, conditions: int, examine: Callable[[Sequence[Candidate]], Sequence[bool]]
) -> None:
    """Examines candidates, in as few rounds as possible, until the refinement asks for no more.

    ``examine`` says of each whether it failed.
    """
    outcomes: list[dict[int, bool]] = [{} for _ in range(conditions)]
    wanted = [(index, condition) for index in refinement.start() for condition in range(conditions)]
    while wanted:
        failed = examine([(refinement.value(index), condition) for index, condition in wanted])
        for (index, condition), bad in zip(wanted, failed, strict=True):
            outcomes[condition][index] = bad
        wanted = [(i, condition) for condition in range(conditions) for i in refinement.next(outcomes[condition])]
