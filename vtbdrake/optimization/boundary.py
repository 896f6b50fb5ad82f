"""Boundaries: the largest value of a parameter below which no rollout is unsafe, and how sure that is."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import exp, inf, isinf, log
from typing import TYPE_CHECKING

import numpy as np

from vtbdrake import upper_layers
from vtbdrake.common.argument_checks import as_number, as_whole
from vtbdrake.common.summary_html import summary_html
from vtbdrake.optimization.parameter import Parameter
from vtbdrake.optimization.records import RolloutKey
from vtbdrake.optimization.sweep import MOST_POINTS, Sweep, make_sweep, numeric, roll_out
from vtbdrake.rollout import Executor, RolloutResult, RolloutTask
from vtbdrake.rollout.task import TERMINATED
from vtbdrake.state.variables import with_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vtbdrake.optimization.problem import Problem

# (index of a value of the fine grid, number of the condition)
Candidate = tuple[int, int]

# The default number of rollouts with jitter of each value close to a boundary, under each condition.
_REPEATS = 5
# The largest number of them.
_MOST_REPEATS = 1_000_000


@dataclass(frozen=True)
class Chance:
    """The share of unsafe rollouts of one value, repeated under one condition with jittered start values.

    Attributes:
        value: The parameter's value.
        condition: Number of the condition.
        rollouts: The number of rollouts at this value, the one without jitter included.
        unsafe: The number of unsafe ones.
    """

    value: float
    condition: int
    rollouts: int
    unsafe: int

    @property
    def share(self) -> float:
        """Return the share of unsafe rollouts."""
        return self.unsafe / self.rollouts

    @property
    def interval(self) -> tuple[float, float]:
        """Return the 95 % confidence interval of the probability of an unsafe rollout (Clopper and Pearson, 1934)."""
        from scipy.stats import binomtest  # It takes longer to load than all the rest.

        interval = binomtest(self.unsafe, self.rollouts).proportion_ci(0.95, method="exact")
        return float(interval.low), float(interval.high)

    def __str__(self) -> str:
        low, high = self.interval
        return f"unsafe in {self.unsafe} of {self.rollouts} rollouts (a chance of {low:.0%} to {high:.0%})"


@dataclass(frozen=True, repr=False)
class Boundary:
    """The interval in which the parameter's boundary lies: safe up to its lower end, unsafe at its upper end.

    A rollout is unsafe if it exceeds the threshold, violates a constraint, or fails.

    Attributes:
        address: The address of the parameter.
        unit: The unit of the parameter.
        lower: The largest value examined up to which no rollout was unsafe (-inf if one at the least value was).
        upper: The smallest value examined at which, under some condition, all rollouts were unsafe (inf if there is
            none). There is one rollout per value and condition, and repeats close to the boundary.
        by_condition: The same interval for each condition alone, shape (conditions, 2).
        examined: The smallest and the largest value examined.
        gap: Width of the widest unexamined range below ``lower``, over all conditions: a narrower unsafe range may have
            been missed.
        step: The smallest distance of two values examined.
        chances: One for each value and condition that was repeated, by value and condition.
        safe_beyond: Values above a condition's first unsafe one that were safe nevertheless: the outcome is not
            monotonic, and a bisection could have ended there.
        ended_at: Values at which a system of the testbed asked for the end before t_m; such a rollout is safe if it was
            safe up to there.
        failed_at: Values at which a simulation, or the function of a quality or constraint, failed.
        failure: The reason of the first failure.
        sweep: The rollouts without jitter.
        repeated: The rollouts with jitter; None if there are none.
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
    sweep: Sweep | None = field(default=None, compare=False)
    repeated: Sweep | None = field(default=None, compare=False)

    @property
    def worst_chances(self) -> tuple[Chance, ...]:
        """Return the chance of each repeated value under its worst condition, in the order of the values."""
        worst: dict[float, Chance] = {}
        for chance in self.chances:
            if chance.value not in worst or chance.share > worst[chance.value].share:
                worst[chance.value] = chance
        return tuple(worst[value] for value in sorted(worst))

    def plot(self) -> Figure:
        """Plot h over the parameter, with the interval shaded, beside the rollouts over time; see `Sweep.plot`.

        Raises:
            ValueError: The boundary has no sweep.
        """
        if self.sweep is None:
            raise ValueError("the boundary has no sweep to draw: take one of Problem.boundary or Sweep.boundary")
        return upper_layers.plot_sweep(self.sweep, boundary=self)

    def __repr__(self) -> str:
        return f"Boundary({self})"

    def _repr_html_(self) -> str:
        """Show the interval, the chances in between and a plot in a notebook."""
        rows = {self._amount(chance.value): str(chance) for chance in self.worst_chances}
        return summary_html(str(self), rows, None if self.sweep is None else self.plot())

    def __str__(self) -> str:
        missed = ""
        # If all steps are alike, the interval itself shows how fine they are.
        if self.gap > (0.0 if isinf(self.upper) else self.step * (1.0 + 1e-9)):
            gap = self._amount(self.gap, digits=3)
            missed = f"; an unsafe range below that is narrower than {gap} may have been missed"
        again = [v for v in self.safe_beyond if v > self.upper]
        beyond = f"; not monotonic: safe again at {self._listed(again)}" if again else ""
        ended = f"; ended early by the testbed at {self._listed(self.ended_at)}" if self.ended_at else ""
        failed = f" ({len(self.failed_at)} values with failed rollouts: {self.failure})" if self.failed_at else ""
        interval = self.interval_text(self.lower, self.upper)
        return f"{self.address}: {interval}{self._undecided()}{missed}{beyond}{ended}{failed}"

    def interval_text(self, lower: float, upper: float) -> str:
        """Return an interval of this boundary in words.

        Args:
            lower: The lower end, in the parameter's unit.
            upper: The upper end, in the parameter's unit.
        """
        least, most = self.examined
        if lower == most:
            return f"safe up to {self._amount(lower)}, the largest value examined"
        if upper == least:
            return f"not safe at {self._amount(upper)}, the smallest value examined"
        begin = f"not always safe at {self._amount(least)}" if isinf(lower) else f"safe up to {self._amount(lower)}"
        end = f"not always unsafe up to {self._amount(most)}" if isinf(upper) else f"not at {self._amount(upper)}"
        return f"{begin}, {end}"

    def _undecided(self) -> str:
        between = [c for c in self.worst_chances if self.lower < c.value < self.upper]
        if not between:
            return ""
        counts = ", ".join(f"{c.unsafe} of {c.rollouts} unsafe at {self._amount(c.value)}" for c in between)
        return f", undecided between ({counts})"

    def _listed(self, values: Sequence[float]) -> str:
        shown = with_unit(", ".join(f"{value:g}" for value in values[:3]), self.unit)
        return shown + (f" and {len(values) - 3} more values" if len(values) > 3 else "")

    def _amount(self, value: float, *, digits: int = 6) -> str:
        return with_unit(f"{value:.{digits}g}", self.unit)


def why_no_boundary(sweep: Sweep) -> str:
    """Return the reason why a sweep has no boundary; empty if it has one."""
    if len(sweep.parameters) != 1:
        return f"a boundary has one parameter, but the sweep has {len(sweep.parameters)}"
    if not sweep.complete:
        return "the sweep was interrupted: its boundary could lie where nothing was examined"
    missing = set(range(len(sweep.conditions))) - set(sweep.condition.tolist())
    if missing:
        return f"condition {min(missing)} has no rollouts: its boundary is unknown"
    finite = bool(np.isfinite([rollout.threshold for rollout in sweep.rollouts]).any())
    return why_never_unsafe(finite_threshold=finite, minimize=sweep.minimize, constraints=len(sweep.constraints))


def why_never_unsafe(*, finite_threshold: bool, minimize: Sequence[bool], constraints: int) -> str:
    """Return the reason why no rollout of a problem could be unsafe; empty if one could.

    Args:
        finite_threshold: Whether the problem has a finite threshold.
        minimize: Whether each quality is a cost, in the order of the qualities; only the first one has the threshold.
        constraints: The number of constraints.
    """
    if finite_threshold and minimize[0]:
        return (
            "a rollout is unsafe where the quality exceeds its threshold, but the threshold of a cost is a goal to be "
            "reached: state what must not happen as a quality with a threshold, or as a constraint"
        )
    if not finite_threshold and not constraints:
        return "no rollout is unsafe: a boundary needs a finite threshold or a constraint, but the problem has neither"
    return ""


def boundary_of(sweep: Sweep, chances: Sequence[Chance] = (), repeated: Sweep | None = None) -> Boundary:
    """Return the boundary that the rollouts of a sweep over one parameter determine.

    Args:
        sweep: A sweep for which `why_no_boundary` is empty.
        chances: Chances of the repeated values.
        repeated: The rollouts with jitter that ``chances`` count.
    """
    values = sweep.points[:, 0]
    unsafe = {(float(value), int(c)): bad for value, c, bad in zip(values, sweep.condition, sweep.unsafe, strict=True)}
    shares = {key: float(bad) for key, bad in unsafe.items()} | {(c.value, c.condition): c.share for c in chances}
    by_number = [sorted((v, share) for (v, c), share in shares.items() if c == k) for k in range(len(sweep.conditions))]
    by_condition = np.array([_interval(outcomes) for outcomes in by_number])
    first = [min((value for value, share in outcomes if share > 0.0), default=inf) for outcomes in by_number]
    beyond = {
        v
        for outcomes, start in zip(by_number, first, strict=True)
        for v, share in outcomes
        if share == 0.0 and v > start
    }
    sweeps = [sweep] if repeated is None else [sweep, repeated]
    rows = [(float(v), r) for each in sweeps for v, r in zip(each.points[:, 0], each.rollouts, strict=True)]
    # The least of each end over the conditions holds for all of them.
    lower, upper = float(by_condition[:, 0].min()), float(by_condition[:, 1].min())
    return Boundary(
        address=sweep.parameters[0].address,
        unit=sweep.units[0],
        lower=lower,
        upper=upper,
        by_condition=by_condition,
        examined=(float(values.min()), float(values.max())),
        gap=max(float(np.diff([v for v, _ in outcomes if v <= lower]).max(initial=0.0)) for outcomes in by_number),
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
    """Return the largest value up to which no rollout was unsafe, and the smallest at which all were.

    ``outcomes`` are pairs (value, share of unsafe rollouts), sorted.
    """
    lower = -inf
    for value, share in outcomes:
        if share > 0.0:
            break
        lower = value
    return lower, min((value for value, share in outcomes if share == 1.0), default=inf)


def _distinct(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(sorted({float(value) for value in values}))


class Refinement:
    """The values to examine: a coarse grid, then every fine value around each condition's first failure.

    Near the boundary the outcome is not monotonic in the parameter, so that bisection can fail. Here every value of the
    fine grid is examined in the coarse cell that ends in the first failure or contains it, and in the cell below; a
    failure found there moves both cells down, until there is none.

    Args:
        parameter: Its range is searched.
        resolution: Step of the fine grid, in the parameter's unit; with a logarithmic range, the ratio of two
            neighbouring values, above 1.
        coarse: Step of the coarse grid, likewise; it is rounded to whole steps of the fine one.

    Raises:
        ValueError: The steps do not fit the range, or are not whole for an integer.
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
                    "in a logarithmic range, resolution and coarse are ratios of neighbouring values, 1 < resolution "
                    f"<= coarse <= {upper / lower:g} (the ratio of the range's ends), not {resolution:g} and {coarse:g}"
                )
            width, fine, ratio = log(upper / lower), log(resolution), log(coarse) / log(resolution)
        else:
            if not 0.0 < resolution <= coarse <= upper - lower:
                raise ValueError(
                    f"the steps must satisfy 0 < resolution <= coarse <= {upper - lower:g} (the width of the range), "
                    f"unlike a resolution of {resolution:g} and a coarse step of {coarse:g}"
                )
            width, fine, ratio = upper - lower, resolution, coarse / resolution
            if parameter.integer:
                as_whole(f"the resolution of {parameter.address}, an integer,", resolution)
        self.parameter = parameter
        # The index of the fine grid's last value, the end of the range.
        self.last = int(np.ceil(width / fine - 1e-9))
        self._fine = fine
        self._coarse = max(1, round(ratio))
        if max(self.last // self._coarse, 2 * self._coarse) > MOST_POINTS:
            raise ValueError(
                f"a search with a resolution of {resolution:g} and a coarse step of {coarse:g} in "
                f"{parameter.range_text} may examine {max(self.last // self._coarse, 2 * self._coarse):,} values, more "
                f"than {MOST_POINTS:,}: take larger steps"
            )

    def value(self, index: int) -> float:
        """Return a value of the fine grid."""
        if index >= self.last:
            return self.parameter.upper
        lower = self.parameter.lower
        return lower * exp(index * self._fine) if self.parameter.log else lower + index * self._fine

    def start(self) -> list[int]:
        """Return the indices of the coarse grid, with both ends."""
        return [*range(0, self.last, self._coarse), self.last]

    def next(self, examined: Mapping[int, bool]) -> list[int]:
        """Return the indices to examine next under one condition, whose outcomes so far are index -> unsafe."""
        failures = [index for index, failed in examined.items() if failed]
        if not failures:
            return []
        first = min(failures)
        cell = (first - 1) // self._coarse * self._coarse
        return [index for index in range(max(0, cell - self._coarse), first) if index not in examined]


def find_boundary(
    refinement: Refinement, conditions: int, examine: Callable[[Sequence[Candidate]], Sequence[bool]]
) -> list[dict[int, bool]]:
    """Examine candidates, in as few rounds as possible, until the refinement asks for no more.

    Args:
        refinement: Chooses the values to examine, as indices of its fine grid.
        conditions: The number of conditions; each has a first unsafe value of its own.
        examine: Function of candidates, (index, number of the condition) each, that returns whether each is unsafe.

    Returns:
        index -> unsafe, for each condition.
    """
    outcomes: list[dict[int, bool]] = [{} for _ in range(conditions)]
    candidates = [(index, condition) for index in refinement.start() for condition in range(conditions)]
    while candidates:
        for (index, condition), bad in zip(candidates, examine(candidates), strict=True):
            outcomes[condition][index] = bad
        candidates = [(i, condition) for condition in range(conditions) for i in refinement.next(outcomes[condition])]
    return outcomes


def repeat_around(first: int, last: int, count: Callable[[Sequence[int]], Mapping[int, Sequence[float]]]) -> None:
    """Repeat the values around the boundary: downwards to one that is always safe, upwards to one that never is.

    Args:
        first: Index of the first value that was unsafe under some condition; above ``last`` if none was.
        last: Index of the last value.
        count: Repeats values under all conditions; returns index -> the share of unsafe rollouts by condition.
    """
    down, up = min(first - 1, last), first
    indices = [index for index in (down, up) if 0 <= index <= last]
    while indices:
        shares = count(indices)
        below = down - 1 if down in shares and max(shares[down]) > 0.0 else -1
        above = up + 1 if up in shares and max(shares[up]) < 1.0 else last + 1
        down, up = below, above
        indices = [index for index in (down, up) if 0 <= index <= last]


def parameter_with_boundary(problem: Problem) -> Parameter:
    """Return the parameter of a problem whose boundary can be searched.

    Raises:
        ValueError: There is not exactly one, or no rollout could be unsafe.
    """
    if len(problem.parameters) != 1:
        raise ValueError(f"a boundary has one parameter, but the problem has {len(problem.parameters)}")
    (parameter,) = numeric(problem)
    reason = why_never_unsafe(
        finite_threshold=problem.task.threshold is not None,
        minimize=[quality.minimize for quality in problem.objectives],
        constraints=len(problem.constraints),
    )
    if reason:
        raise ValueError(reason)
    return parameter


def checked_jitter(parameter: Parameter, repeats: int | None, jitter: float) -> tuple[int, float]:
    """Return the number of repeats, by default that for this parameter, and their jitter.

    Args:
        parameter: The parameter that is displaced.
        repeats: The number of rollouts with jitter for each value and condition; None: 5 (integer or field: 0).
        jitter: The largest displacement, as a fraction of the parameter's range, in (0, 0.5].

    Raises:
        ValueError: One is out of range, or the parameter cannot be jittered.
    """
    if repeats is None:
        repeats = 0 if parameter.integer or parameter.is_field else _REPEATS
    repeats, jitter = as_whole("the number of repeats", repeats), as_number("the jitter", jitter)
    if repeats > _MOST_REPEATS:
        raise ValueError(f"a value is repeated {_MOST_REPEATS:,} times at most, not {repeats:,}: take fewer")
    if repeats < 0 or not 0.0 < jitter <= 0.5:
        raise ValueError(f"repeats >= 0 and 0 < jitter <= 0.5 are required, not {repeats} and {jitter:g}")
    if repeats and parameter.integer:
        raise ValueError(f"{parameter.address} is an integer, which cannot be jittered: leave repeats out")
    return repeats, jitter


class BoundarySearch:
    """The rollouts of a search for a boundary: one at each value, and repeats with jitter close to the boundary.

    Args:
        problem: The problem.
        task: The task of a rollout.
        refinement: The values and repeats that are asked for.
        executor: Where rollouts run.
        progress: Whether a progress bar is shown.
    """

    def __init__(
        self, problem: Problem, task: RolloutTask, refinement: Refinement, executor: Executor, *, progress: bool
    ) -> None:
        self._problem = problem
        self._task = task
        self._refinement = refinement
        self._executor = executor
        self._progress = progress
        self._results: list[tuple[RolloutKey, RolloutResult]] = []
        self._repeated: list[tuple[RolloutKey, RolloutResult]] = []
        # Candidate -> (rollouts, unsafe ones).
        self._counts: dict[Candidate, tuple[int, int]] = {}
        self._chances: set[Candidate] = set()

    def run(self, *, repeats: int, jitter: float) -> Boundary:
        """Search the boundary, with ``repeats`` rollouts with jitter for each value around it.

        Args:
            repeats: The number of rollouts with jitter for each value and condition; 0 for none.
            jitter: The largest displacement of the parameter in them, as a fraction of its range.
        """
        outcomes = find_boundary(self._refinement, len(self._problem.conditions), self.examine)
        if repeats:
            last = self._refinement.last
            unsafe = [index for outcome in outcomes for index, bad in outcome.items() if bad]
            repeat_around(min(unsafe, default=last + 1), last, partial(self.repeat, repeats=repeats, jitter=jitter))
        value = self._refinement.value
        chances = [Chance(value(i), c, *self._counts[i, c]) for i, c in self._chances]
        return boundary_of(
            self._sorted(self._results), chances, self._sorted(self._repeated) if self._chances else None
        )

    def examine(self, candidates: Sequence[Candidate]) -> list[bool]:
        """Run one rollout for each candidate; return whether it was unsafe."""
        keys: list[RolloutKey] = [((self._refinement.value(index),), condition) for index, condition in candidates]
        unsafe: list[bool] = self._roll(keys, self._results).tolist()
        self._counts.update({candidate: (1, int(bad)) for candidate, bad in zip(candidates, unsafe, strict=True)})
        return unsafe

    def repeat(self, indices: Sequence[int], *, repeats: int, jitter: float) -> dict[int, list[float]]:
        """Repeat values under all conditions; return index -> the share of unsafe rollouts under each condition.

        Args:
            indices: The values, as indices of the fine grid.
            repeats: The number of rollouts with jitter for each value and condition.
            jitter: The largest displacement of the parameter in them, as a fraction of its range.
        """
        count = len(self._problem.conditions)
        candidates = [(index, condition) for index in indices for condition in range(count)]
        new = [candidate for candidate in candidates if candidate not in self._counts]
        if new:
            self.examine(new)
        keys: list[RolloutKey] = [
            ((value,), candidate[1]) for candidate in candidates for value in self._jittered(candidate, repeats, jitter)
        ]
        unsafe = self._roll(keys, self._repeated).reshape(-1, repeats).sum(axis=1)
        shares = []
        for candidate, more in zip(candidates, unsafe.tolist(), strict=True):
            rollouts, bad = self._counts[candidate]
            self._counts[candidate] = rollouts + repeats, bad + more
            shares.append((bad + more) / (rollouts + repeats))
        self._chances.update(candidates)
        return {index: shares[k * count : (k + 1) * count] for k, index in enumerate(indices)}

    def _jittered(self, candidate: Candidate, repeats: int, jitter: float) -> list[float]:
        """Return values beside a candidate's; the same ones in every search."""
        parameter, (index, _) = self._refinement.parameter, candidate
        u = parameter.to_unit(self._refinement.value(index))
        moved = np.abs(u + np.random.default_rng(candidate).uniform(-jitter, jitter, repeats))
        # Values beyond an end of the range are reflected at it.
        return [float(parameter.from_unit(1.0 - abs(1.0 - v))) for v in moved.tolist()]

    def _roll(self, keys: Sequence[RolloutKey], results: list[tuple[RolloutKey, RolloutResult]]) -> np.ndarray:
        """Run rollouts and keep their results; return whether each was unsafe."""
        rolled_out = roll_out(self._problem, self._executor, self._task, keys, name="boundary", progress=self._progress)
        finished = [result for result in rolled_out if result is not None]
        if len(finished) < len(rolled_out):
            raise KeyboardInterrupt
        results += zip(keys, finished, strict=True)
        return make_sweep(self._problem, keys, finished).unsafe

    def _sorted(self, results: list[tuple[RolloutKey, RolloutResult]]) -> Sweep:
        ordered = sorted(results, key=lambda pair: pair[0])
        return make_sweep(self._problem, [key for key, _ in ordered], [result for _, result in ordered])
