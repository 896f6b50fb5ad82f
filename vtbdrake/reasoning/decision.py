"""A decision: the budget at which it ends, and the answer: the candidates that were tried, the best, and the end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite, isnan, nan
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake import upper_layers
from vtbdrake.common.argument_checks import as_number, as_whole
from vtbdrake.common.summary_html import summary_html
from vtbdrake.rollout import RolloutResult
from vtbdrake.rollout.start import Start
from vtbdrake.testbed.addressed import AddressedDiagram

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# What became of a candidate.
ELIGIBLE = "eligible"
VIOLATES = "violates"
CUT_OFF = "cut off"
FAILED = "failed"
UNFINISHED = "unfinished"


@dataclass(frozen=True)
class Budget:
    """A Budget limits a decision by rollouts, by time, or by both: the decision ends at the first limit it reaches.

    `DecisionRun` (``decision_run.py``) spends the budget, and ends the decision.

    Attributes:
        rollouts: Number of rollouts. A decision with this budget alone can be repeated exactly, with any executor.
        seconds: Wall time. When it is over, the rollouts under way are cancelled, and the best candidate that has
            finished is the decision.

    Raises:
        ValueError: Neither is given, or one is not positive.
    """

    rollouts: int | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        if self.rollouts is None and self.seconds is None:
            raise ValueError("a budget is given as Budget(rollouts=70), Budget(seconds=2.0) or both")
        if self.rollouts is not None:
            object.__setattr__(self, "rollouts", as_whole("a budget of rollouts", self.rollouts))
            if self.rollouts < 1:
                raise ValueError(f"a budget is at least one rollout, not {self.rollouts}")
        if self.seconds is not None:
            object.__setattr__(self, "seconds", as_number("a budget of wall time", self.seconds))
            if not (isfinite(self.seconds) and self.seconds > 0.0):
                raise ValueError(f"a budget of wall time is positive and finite, not {self.seconds} s")


def check_budget(budget: Budget, samples: int) -> None:
    """Check that a budget suffices for one candidate.

    Args:
        budget: The budget of a decision.
        samples: The number of samples of the belief; each takes one rollout per candidate.

    Raises:
        ValueError: The budget does not suffice, or is not a `Budget`.
    """
    if not isinstance(budget, Budget):
        raise ValueError(f"a budget is Budget(rollouts=...) or Budget(seconds=...), not {budget!r}")
    if budget.rollouts is not None and budget.rollouts < samples:
        raise ValueError(
            f"a budget of {budget.rollouts} rollouts does not suffice for one candidate, which takes {samples}, one "
            "per sample of the belief"
        )


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One alternative that was tried.

    Attributes:
        number: Position in the order of trying; 0 is the plan in use.
        values: Address -> value that the candidate sets; for candidate 0 the values that are set already.
        status: ``eligible``, ``violates`` (a constraint), ``cut off`` (it could not win any more), ``failed`` (a
            simulation did), ``unfinished`` (the budget ended before all its samples were simulated).
        quality: Quality over all samples, in the user's terms: a cost as a cost. NaN if a simulation failed or is
            missing. For a candidate that was cut off, the best that it could still have reached.
        violations: One per constraint, the worst over the samples: at most 0 where it holds.
        rollouts: The finished rollouts, at most one per sample of the belief.
    """

    number: int
    values: Mapping[str, Any]
    status: str
    quality: float
    violations: tuple[float, ...] = ()
    rollouts: tuple[RolloutResult, ...] = field(default=(), repr=False)

    @property
    def spread(self) -> float:
        """Return the standard deviation of the quality over the samples; 0 for one sample."""
        values = [rollout.value for rollout in self.rollouts]
        if len(values) > 1:
            return float(np.std(values))
        return 0.0 if values and isfinite(values[0]) else nan

    @property
    def has_trajectory(self) -> bool:
        """Return whether the quality over time is known, from the first sample of the belief at least."""
        return bool(self.rollouts) and self.rollouts[0].quality.size > 0

    @property
    def text(self) -> str:
        """Return the values as text."""
        return ", ".join(f"{address} = {_short(value)}" for address, value in self.values.items())


@dataclass(frozen=True, kw_only=True)
class Health:
    """How a decision was reached, to tell a planner that is too slow from a quality that is wrong.

    Attributes:
        rollouts: Number of finished rollouts.
        failed: Number of rollouts that failed.
        cut_off: Number of rollouts that ended early, see `Pruning`.
        rollout_time: The mean wall time of a rollout, in seconds.
        elapsed: The wall time of the decision, in seconds.
        used: The share of the budget that was used, of rollouts or of time, whichever is larger.
        improvement: By how much the quality is better than the quality of the plan in use, in the unit of the quality;
            at least 0. NaN without a decision, or if the plan in use is not eligible.
        margin: By how much the quality is better than the second best eligible candidate's; NaN if there is none.
        spread: The standard deviation of the quality over the samples of the belief.
    """

    rollouts: int
    failed: int
    cut_off: int
    rollout_time: float
    elapsed: float
    used: float
    improvement: float
    margin: float
    spread: float


@dataclass(frozen=True, kw_only=True, repr=False)
class Decision:
    """The answer of a reasoner; false if no candidate is eligible.

    Attributes:
        values: Address -> value of the chosen candidate; empty if none is eligible.
        quality: Quality of the chosen candidate, over all samples, in the user's terms; NaN if none is eligible.
        chosen: The number of the chosen candidate; None if none is eligible.
        candidates: The plan in use, and every other candidate with at least one finished rollout.
        health: How the decision was reached.
        end: Why the search ended: ``rollouts`` or ``time`` (the budget was spent), ``method`` (the method has
            finished).
        message: The end in a sentence; without a decision, why no candidate is eligible.
        time: The DPS's time at which the decision begins, in seconds.
        warnings: Reasons not to trust the decision, one sentence each; empty if there are none.
        name: Name of the quality.
        minimize: Whether the quality is a cost.
        starts: Where the rollouts began, one per sample of the belief.
    """

    values: Mapping[str, Any]
    quality: float
    chosen: int | None
    candidates: tuple[Candidate, ...]
    health: Health
    end: str
    message: str
    time: float
    warnings: tuple[str, ...]
    name: str
    minimize: bool = False
    starts: tuple[Start, ...] = field(default=(), repr=False)

    def __bool__(self) -> bool:
        return self.chosen is not None

    @property
    def poor(self) -> bool:
        """Return whether there are reasons not to trust the decision, see ``warnings``."""
        return bool(self.warnings)

    @property
    def keeps_plan(self) -> bool:
        """Return whether the plan in use is the best."""
        return self.chosen == 0

    def apply(self, testbed: AddressedDiagram, context: Context) -> None:
        """Set the chosen values in a context of the running testbed, or of its DPS alone.

        Args:
            testbed: The running testbed, or its DPS alone.
            context: Its root context, which is changed.

        Raises:
            ValueError: No candidate is eligible.
        """
        if not self:
            raise ValueError(
                f"there is no decision to apply ({self.message}): ask `if decision:` first, and keep the plan in use "
                "or fall back"
            )
        testbed.write(context, self.values)

    def __repr__(self) -> str:
        tried = f"{len(self.candidates)} candidates, {self.health.rollouts} rollouts, {self.health.elapsed:.3g} s"
        if self.chosen is None:
            return f"Decision(none at t = {self.time:g} s: {self.message}; {tried})"
        plan = ", the plan in use" if self.keeps_plan else ""
        poor = ", poor" if self.poor else ""
        values = self.candidates[self.chosen].text
        return f"Decision({values}{plan}: {self.name} = {self.quality:.6g}{poor}; {tried})"

    def __str__(self) -> str:
        """Show the best candidates, the health and the warnings as text."""
        shown, marks = self.ranked[:_SHOWN], {self.chosen: "*"}
        table = [("candidate", "values", self.name, "status")]
        table += [(f"{c.number}{marks.get(c.number, '')}", c.text, _number(c), c.status) for c in shown]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in table]
        if len(self.candidates) > len(shown):
            lines.append(f"... and {len(self.candidates) - len(shown)} more")
        facts = [f"{name}: {text}" for name, text in self._facts().items()]
        return "\n".join([repr(self), *lines, *facts])

    @property
    def ranked(self) -> list[Candidate]:
        """Return the candidates: the chosen one, the other eligible ones by their quality, then the rest by number."""
        better = 1.0 if self.minimize else -1.0

        def key(candidate: Candidate) -> tuple[bool, bool, float, int]:
            eligible = candidate.status == ELIGIBLE
            value = better * candidate.quality if eligible else 0.0
            return candidate.number != self.chosen, not eligible, value, candidate.number

        return sorted(self.candidates, key=key)

    def _facts(self) -> dict[str, str]:
        health = self.health
        facts = {
            "rollouts": f"{health.rollouts} ({health.failed} failed, {health.cut_off} ended early); "
            f"{health.rollout_time * 1e3:.3g} ms each",
            "time": f"{health.elapsed:.3g} s, {health.used:.0%} of the budget",
            "end": f"{self.end}: {self.message}",
        }
        if not isnan(health.improvement):
            facts["improvement over the plan in use"] = f"{health.improvement:.4g}"
        if not isnan(health.margin):
            facts["margin to the second best"] = f"{health.margin:.4g}"
        if health.spread > 0.0:
            facts["spread over the samples"] = f"{health.spread:.4g}"
        return facts | ({"warnings": "; ".join(self.warnings)} if self.warnings else {})

    def _repr_html_(self) -> str:
        """Show the facts and the quality trajectories of the candidates in a notebook."""
        rows = {c.text or "none": f"{_number(c)} ({c.status})" for c in self.ranked[:_SHOWN]}
        drawn = any(candidate.has_trajectory for candidate in self.candidates)
        return summary_html(repr(self), {**rows, **self._facts()}, self.plot() if drawn else None)

    def plot(self) -> Figure:
        """Plot the quality of the candidates over time (Figure 5), and over the decided values (Figure 6).

        Raises:
            ValueError: No rollout has a quality.
        """
        return upper_layers.plot_decision(self)


# The largest number of candidates shown.
_SHOWN = 10


def _number(candidate: Candidate) -> str:
    return "-" if isnan(candidate.quality) else f"{candidate.quality:.6g}"


def _short(value: Any) -> str:
    if isinstance(value, str | bool):
        return repr(value)
    with np.printoptions(precision=4, threshold=6, edgeitems=2):
        return f"{value:.6g}" if np.ndim(value) == 0 else " ".join(str(np.asarray(value)).split())
