"""How far may a parameter go? The largest value below which no rollout is unsafe, and how sure that is."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import exp, inf, isinf, log
from typing import TYPE_CHECKING

import numpy as np

from vtbdrake.optimization.parameter import Parameter
from vtbdrake.rollout.arguments import as_number, as_whole
from vtbdrake.rollout.task import TERMINATED

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vtbdrake.optimization.sweep import Sweep

# (index of a value of the fine grid, number of the condition)
Candidate = tuple[int, int]


@dataclass(frozen=True)
class Chance:
    """How often a value was unsafe when its rollout was repeated under one condition with jittered start values.

    Attributes:
        value: the parameter's value.
        condition: number of the condition.
        rollouts: how many there were at this value, the one without jitter included.
        unsafe: how many of them were unsafe.
    """

    value: float
    condition: int
    rollouts: int
    unsafe: int

    @property
    def share(self) -> float:
        """The share of unsafe rollouts."""
        return self.unsafe / self.rollouts

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % confidence interval of the probability of an unsafe rollout (Clopper and Pearson, 1934)."""
        from scipy.stats import binomtest  # It takes longer to load than all the rest.

        found = binomtest(self.unsafe, self.rollouts).proportion_ci(0.95, method="exact")
        return float(found.low), float(found.high)

    def __str__(self) -> str:
        low, high = self.interval
        return f"unsafe in {self.unsafe} of {self.rollouts} rollouts (a chance of {low:.0%} to {high:.0%})"


@dataclass(frozen=True)
class Boundary:
    """The interval in which the parameter's boundary lies: safe up to its lower end, unsafe at its upper end.

    A rollout is unsafe if it exceeds the threshold, violates a constraint, or fails.

    Attributes:
        address: the address of the parameter.
        unit: its unit.
        lower: the largest value examined up to which no rollout was unsafe (-inf if one at the least value was).
        upper: the smallest value examined at which, under some condition, all rollouts were unsafe (inf if there is
            none). There is one rollout per value and condition; close to the boundary there are repeats.
        by_condition: the same interval for each condition alone, shape (conditions, 2).
        examined: the smallest and the largest value examined.
        gap: width of the widest range below ``lower`` in which nothing was examined, over all conditions: an unsafe
            range that is narrower may have been missed.
        step: the smallest distance of two values examined.
        chances: one for each value and condition that was repeated, by value and condition.
        safe_beyond: values above a condition's first unsafe one that were safe all the same: where there are any, the
            outcome is not monotonic, and a bisection could have ended there.
        ended_at: values at which a system of the testbed asked for the end before t_m; such a rollout is safe if it was
            so up to there.
        failed_at: values at which a simulation failed.
        failure: the reason of the first of them.
        sweep: the rollouts without jitter that it rests on.
        repeated: the rollouts with jitter; None without them.
    """

    address: str
    unit: str
    lower: float
    upper: float
    by_condition: np.ndarray = field(compare=False)
    examined: tuple[float, float] = (-inf, inf)
    gap: float = 0.0
    step: float = inf
    chances: tuple[Chance, ...] = ()
    safe_beyond: tuple[float, ...] = ()
    ended_at: tuple[float, ...] = ()
    failed_at: tuple[float, ...] = ()
    failure: str = ""
    sweep: Sweep | None = field(default=None, repr=False, compare=False)
    repeated: Sweep | None = field(default=None, repr=False, compare=False)

    @property
    def worst_chances(self) -> tuple[Chance, ...]:
        """For each value that was repeated, the chance under the condition where it is largest; by value."""
        worst: dict[float, Chance] = {}
        for chance in self.chances:
            if chance.value not in worst or chance.share > worst[chance.value].share:
                worst[chance.value] = chance
        return tuple(worst[value] for value in sorted(worst))

    def plot(self) -> Figure:
        """h over the parameter, with the interval shaded, beside the rollouts over time; see `Sweep.plot`.

        Raises:
            ValueError: it rests on no sweep.
        """
        from vtbdrake.visualization import plot_sweep

        if self.sweep is None:
            raise ValueError("the boundary comes without the sweep that it rests on, so that there is nothing to draw")
        return plot_sweep(self.sweep, boundary=self)

    def __str__(self) -> str:
        missed = ""
        # Where all steps are alike, the interval itself says how fine they are.
        if self.gap > (0.0 if isinf(self.upper) else self.step * (1.0 + 1e-9)):
            missed = f"; an unsafe range below that is narrower than {self.gap:.3g} {self.unit} may have been missed"
        again = [v for v in self.safe_beyond if v > self.upper]
        beyond = f"; not monotonic: safe again at {_listed(again, self.unit)}" if again else ""
        ended = f"; ended early by the testbed at {_listed(self.ended_at, self.unit)}" if self.ended_at else ""
        failed = f" ({len(self.failed_at)} values with failed simulations: {self.failure})" if self.failed_at else ""
        interval = self.interval_text(self.lower, self.upper)
        return f"{self.address}: {interval}{self._undecided()}{missed}{beyond}{ended}{failed}"

    def interval_text(self, lower: float, upper: float) -> str:
        """An interval of this boundary, in words."""
        least, most = self.examined
        if lower == most:
            return f"safe up to {lower:g} {self.unit}, the largest value examined"
        if upper == least:
            return f"not safe at {upper:g} {self.unit}, the smallest value examined"
        begin = f"not always safe at {least:g} {self.unit}" if isinf(lower) else f"safe up to {lower:g} {self.unit}"
        end = f"not always unsafe up to {most:g} {self.unit}" if isinf(upper) else f"not at {upper:g} {self.unit}"
        return f"{begin}, {end}"

    def _undecided(self) -> str:
        between = [c for c in self.worst_chances if self.lower < c.value < self.upper]
        if not between:
            return ""
        counts = ", ".join(f"{c.unsafe} of {c.rollouts} unsafe at {c.value:g} {self.unit}" for c in between)
        return f", undecided between ({counts})"


def _listed(values: Sequence[float], unit: str) -> str:
    shown = ", ".join(f"{value:g}" for value in values[:3])
    return f"{shown} {unit}" + (f" and {len(values) - 3} more values" if len(values) > 3 else "")


def why_no_boundary(sweep: Sweep) -> str:
    """Why the rollouts of a sweep show no boundary; empty if they do."""
    if len(sweep.parameters) != 1:
        return f"a boundary is that of one parameter, but the sweep has {len(sweep.parameters)}"
    if not sweep.complete:
        return "the sweep was interrupted: its boundary could lie where nothing was examined"
    missing = set(range(len(sweep.conditions))) - set(sweep.condition.tolist())
    if missing:
        return f"condition {min(missing)} has no rollouts, so that nothing is known of its boundary"
    finite = bool(np.isfinite([rollout.threshold for rollout in sweep.rollouts]).any())
    return why_never_unsafe(finite_threshold=finite, minimize=sweep.minimize, constraints=len(sweep.constraints))


def why_never_unsafe(*, finite_threshold: bool, minimize: Sequence[bool], constraints: int) -> str:
    """Why no rollout of a problem could be unsafe; empty if one could."""
    if finite_threshold and minimize[0]:
        return (
            "a rollout is unsafe where the quality exceeds its threshold, but that of a cost is a goal to be reached: "
            "state what must not happen as a quality with a threshold, or as a constraint"
        )
    if not finite_threshold and not constraints:
        return "no rollout is unsafe: a boundary takes a finite threshold or a constraint, but the problem has neither"
    return ""


def boundary_of(sweep: Sweep, chances: Sequence[Chance] = (), repeated: Sweep | None = None) -> Boundary:
    """The boundary that the rollouts of a sweep over one parameter show.

    Args:
        sweep: one rollout for each value and condition; `why_no_boundary` has nothing against it.
        chances: of the values that were repeated.
        repeated: the rollouts with jitter that ``chances`` count.
    """
    values = sweep.points[:, 0]
    unsafe = {(float(value), int(c)): bad for value, c, bad in zip(values, sweep.condition, sweep.unsafe, strict=True)}
    shares = {key: float(bad) for key, bad in unsafe.items()} | {(c.value, c.condition): c.share for c in chances}
    own = [sorted((v, share) for (v, c), share in shares.items() if c == k) for k in range(len(sweep.conditions))]
    by_condition = np.array([_interval(outcomes) for outcomes in own])
    first = [min((value for value, share in outcomes if share > 0.0), default=inf) for outcomes in own]
    beyond = {
        v for outcomes, start in zip(own, first, strict=True) for v, share in outcomes if share == 0.0 and v > start
    }
    sweeps = [sweep] if repeated is None else [sweep, repeated]
    rows = [(float(v), r) for each in sweeps for v, r in zip(each.points[:, 0], each.rollouts, strict=True)]
    # Between two conditions' examined values lies nothing that is known of both: the least of each end holds.
    lower, upper = float(by_condition[:, 0].min()), float(by_condition[:, 1].min())
    return Boundary(
        address=sweep.parameters[0].address,
        unit=sweep.units[0],
        lower=lower,
        upper=upper,
        by_condition=by_condition,
        examined=(float(values.min()), float(values.max())),
        gap=max(_widest_gap([value for value, _ in outcomes if value <= lower]) for outcomes in own),
        step=float(np.diff(np.unique(values)).min(initial=inf)),
        chances=tuple(sorted(chances, key=lambda chance: (chance.value, chance.condition))),
        safe_beyond=_distinct(beyond),
        ended_at=_distinct(value for value, rollout in rows if rollout.end == TERMINATED),
        failed_at=_distinct(value for value, rollout in rows if rollout.failed),
        failure=next((rollout.message for _, rollout in rows if rollout.failed), ""),
        sweep=sweep,
        repeated=repeated,
    )


def _interval(outcomes: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """(largest value up to which none was unsafe, smallest at which all were) of ascending (value, unsafe share)."""
    lower = -inf
    for value, share in outcomes:
        if share > 0.0:
            break
        lower = value
    return lower, min((value for value, share in outcomes if share == 1.0), default=inf)


def _distinct(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(sorted({float(value) for value in values}))


def _widest_gap(values: Sequence[float]) -> float:
    return float(np.diff(values).max(initial=0.0))


class Refinement:
    """Which values to examine: a coarse grid, then every fine value around each condition's first failure.

    Near the boundary the outcome is not monotonic in the parameter, so that bisection can be fooled. Here every value
    of the fine grid is examined in the coarse cell that ends in the first failure or contains it, and in the cell
    below; a failure found there moves both down with it, until there is none.

    Args:
        parameter: whose range is searched.
        resolution: step of the fine grid, in the parameter's unit; with a logarithmic range, the ratio of two
            neighbouring values, above 1.
        coarse: the same of the coarse grid; it is rounded to whole steps of the fine one.

    Raises:
        ValueError: the steps do not fit the range, or would give an integer values that are not whole.
    """

    def __init__(self, parameter: Parameter, *, resolution: float, coarse: float) -> None:
        resolution, coarse = as_number("the resolution", resolution), as_number("the coarse step", coarse)
        lower, upper = parameter.lower, parameter.upper
        if parameter.log:
            if parameter.integer:
                raise ValueError(
                    f"steps of one ratio are no whole numbers, but {parameter.address} is an integer with a "
                    "logarithmic range: leave log out"
                )
            if not 1.0 < resolution <= coarse <= upper / lower:
                raise ValueError(
                    f"in a logarithmic range, resolution and coarse are ratios of neighbouring values: it takes 1 < "
                    f"resolution <= coarse <= {upper / lower:g}, the ratio of the range's ends, not {resolution:g} and "
                    f"{coarse:g}"
                )
            width, fine, ratio = log(upper / lower), log(resolution), log(coarse) / log(resolution)
        else:
            if not 0.0 < resolution <= coarse <= upper - lower:
                raise ValueError(
                    f"it takes 0 < resolution <= coarse <= {upper - lower:g}, the width of the range, not a resolution "
                    f"of {resolution:g} and a coarse step of {coarse:g}"
                )
            width, fine, ratio = upper - lower, resolution, coarse / resolution
            if parameter.integer:
                as_whole(f"the resolution of {parameter.address}, an integer,", resolution)
        self.parameter = parameter
        self._count = int(np.ceil(width / fine - 1e-9))
        self._fine = fine
        self._coarse = max(1, round(ratio))

    @property
    def last(self) -> int:
        """The index of the fine grid's last value, the end of the range."""
        return self._count

    def value(self, index: int) -> float:
        """The fine grid's value ``index``; its last is the end of the range."""
        if index >= self._count:
            return self.parameter.upper
        lower = self.parameter.lower
        return lower * exp(index * self._fine) if self.parameter.log else lower + index * self._fine

    def start(self) -> list[int]:
        """The coarse grid, with both ends."""
        return [*range(0, self._count, self._coarse), self._count]

    def next(self, examined: Mapping[int, bool]) -> list[int]:
        """What to examine further under one condition, of which ``examined`` says index -> unsafe."""
        failures = [index for index, failed in examined.items() if failed]
        if not failures:
            return []
        first = min(failures)
        cell = (first - 1) // self._coarse * self._coarse
        return [index for index in range(max(0, cell - self._coarse), first) if index not in examined]


def find_boundary(
    refinement: Refinement, conditions: int, examine: Callable[[Sequence[Candidate]], Sequence[bool]]
) -> list[dict[int, bool]]:
    """Examines candidates, in as few rounds as possible, until the refinement asks for no more.

    ``examine`` says of each whether it was unsafe.

    Returns:
        index -> unsafe, for each condition.
    """
    outcomes: list[dict[int, bool]] = [{} for _ in range(conditions)]
    wanted = [(index, condition) for index in refinement.start() for condition in range(conditions)]
    while wanted:
        for (index, condition), bad in zip(wanted, examine(wanted), strict=True):
            outcomes[condition][index] = bad
        wanted = [(i, condition) for condition in range(conditions) for i in refinement.next(outcomes[condition])]
    return outcomes


def repeat_around(first: int, last: int, count: Callable[[Sequence[int]], Mapping[int, Sequence[float]]]) -> None:
    """Repeats the values around the boundary: downwards to one that is always safe, upwards to one that never is.

    Args:
        first: index of the first value that was unsafe under some condition; above ``last`` if none was.
        last: index of the last value.
        count: repeats some values under all conditions; index -> the share of unsafe rollouts under each condition.
    """
    down, up = min(first - 1, last), first
    wanted = [index for index in (down, up) if 0 <= index <= last]
    while wanted:
        shares = count(wanted)
        below = down - 1 if down in shares and max(shares[down]) > 0.0 else -1
        above = up + 1 if up in shares and max(shares[up]) < 1.0 else last + 1
        down, up = below, above
        wanted = [index for index in (down, up) if 0 <= index <= last]
