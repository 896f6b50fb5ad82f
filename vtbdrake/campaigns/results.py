"""What a campaign has shown: rates with their intervals, verdicts, and the comparison with a baseline."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import fmean
from typing import TYPE_CHECKING, Any

from vtbdrake.common.json_data import plain
from vtbdrake.rollout.task import FAILED

if TYPE_CHECKING:
    from vtbdrake.campaigns.campaign import Campaign, Criterion

# (condition, seed)
RolloutName = tuple[str, int]

# What a criterion says of a rollout.
PASS = "pass"
FAIL = "fail"
# The simulation, or a function, failed.
ERROR = "error"
NOT_RUN = "not run"
# The verdicts of a cell.
MET = "met"
MISSED = "missed"
# The required rate is neither shown nor refuted.
UNDECIDED = "undecided"
INCOMPLETE = "incomplete"
# No rate is required.
REPORTED = "reported"
ALL = "all conditions"
"""The row of all conditions together."""
SIGNIFICANCE = 0.05
"""The level of McNemar's test below which a difference counts as shown."""


def interval(successes: int, count: int, confidence: float) -> tuple[float, float]:
    """Return the two-sided interval of a rate (Clopper and Pearson, 1934); (0, 1) without any trial.

    Args:
        successes: Number of trials that passed.
        count: Number of all trials.
        confidence: The probability with which such an interval contains the true rate, in (0, 1).
    """
    return _limits(successes, count, confidence, "two-sided")


def least_rate(successes: int, count: int, confidence: float) -> float:
    """Return the lower limit of the one-sided interval of a rate: the rate that is shown.

    Args:
        successes: Number of trials that passed.
        count: Number of all trials; 0 gives 0.
        confidence: The probability with which the true rate is at least the limit, in (0, 1).
    """
    return _limits(successes, count, confidence, "greater")[0]


def largest_rate(successes: int, count: int, confidence: float) -> float:
    """Return the upper limit of the one-sided interval of a rate: larger ones are refuted.

    Args:
        successes: Number of trials that passed.
        count: Number of all trials; 0 gives 1.
        confidence: The probability with which the true rate is at most the limit, in (0, 1).
    """
    return _limits(successes, count, confidence, "less")[1]


def _limits(successes: int, count: int, confidence: float, alternative: str) -> tuple[float, float]:
    from scipy.stats import binomtest  # It takes longer to load than all the rest.

    if not count:
        return 0.0, 1.0
    limits = binomtest(successes, count, alternative=alternative).proportion_ci(confidence, method="exact")
    return float(limits.low), float(limits.high)


@dataclass(frozen=True)
class CampaignRollout:
    """One rollout of a campaign.

    Attributes:
        condition: The name of its condition.
        seed: Its seed.
        end: Why it ended, see `RolloutResult`; empty if it was not run yet.
        message: The reason of a failure.
        values: The number of each criterion; empty if the rollout failed or was not run yet.
    """

    condition: str
    seed: int
    end: str
    message: str
    values: Mapping[str, float]

    @property
    def name(self) -> str:
        """Return condition and seed as the command line takes them."""
        return f"{self.condition}/{self.seed}"

    def status(self, name: str, criterion: Criterion) -> str:
        """Return the status of the rollout by a criterion.

        Args:
            name: Name of the criterion, a key of ``values``.
            criterion: The criterion itself.
        """
        if not self.end:
            return NOT_RUN
        if self.end == FAILED or name not in self.values:
            return ERROR
        return PASS if criterion.passes(self.values[name]) else FAIL


@dataclass(frozen=True)
class Cell:
    """The rollouts of one condition, or of all, under one criterion.

    Attributes:
        name: The name of the criterion.
        criterion: The criterion.
        condition: The name of the condition, or `ALL`.
        rollouts: The rollouts.
    """

    name: str
    criterion: Criterion
    condition: str
    rollouts: tuple[CampaignRollout, ...]

    @property
    def statuses(self) -> list[str]:
        """Return the status of each rollout by the criterion."""
        return [rollout.status(self.name, self.criterion) for rollout in self.rollouts]

    def having(self, *statuses: str) -> list[CampaignRollout]:
        """Return the rollouts of some statuses."""
        return [rollout for rollout, status in zip(self.rollouts, self.statuses, strict=True) if status in statuses]

    @property
    def passed(self) -> int:
        """Return the number of rollouts that passed."""
        return self.statuses.count(PASS)

    @property
    def count(self) -> int:
        """Return the number of rollouts that were run; failed ones count, and have not passed."""
        return len(self.rollouts) - self.statuses.count(NOT_RUN)

    @property
    def is_judged(self) -> bool:
        """Return whether the campaign requires anything of this cell."""
        return self.criterion.is_limited and (self.criterion.over == "all") == (self.condition == ALL)

    @property
    def verdict(self) -> str:
        """Return whether the rollouts show what the criterion requires."""
        criterion, passed, count = self.criterion, self.passed, self.count
        if not self.is_judged:
            return REPORTED
        if criterion.rate == 1.0 and passed < count:
            return MISSED
        if count < len(self.rollouts):
            return INCOMPLETE
        if criterion.rate == 1.0 or least_rate(passed, count, criterion.confidence) >= criterion.rate:
            return MET
        refuted = largest_rate(passed, count, criterion.confidence) < criterion.rate
        return MISSED if refuted else UNDECIDED

    @property
    def numbers(self) -> list[float]:
        """Return the numbers of the rollouts that have one."""
        return [rollout.values[self.name] for rollout in self.rollouts if self.name in rollout.values]

    def to_dict(self) -> dict[str, Any]:
        """Return the cell as plain data."""
        statuses, numbers, confidence = self.statuses, self.numbers, self.criterion.confidence
        plain: dict[str, Any] = {"condition": self.condition, "criterion": self.name, "verdict": self.verdict}
        if self.criterion.is_limited:
            plain |= {status: statuses.count(status) for status in (PASS, FAIL, ERROR, NOT_RUN)}
            plain |= {
                "rate": self.passed / self.count if self.count else None,
                "interval": list(interval(self.passed, self.count, confidence)),
                "shown": least_rate(self.passed, self.count, confidence),
                "confidence": confidence,
            }
        if numbers:
            plain |= {"least": min(numbers), "mean": fmean(numbers), "largest": max(numbers)}
        return plain


@dataclass(frozen=True)
class CampaignResult:
    """The rollouts of a campaign; some may not have been run yet.

    Attributes:
        campaign: The campaign, with its criteria.
        rollouts: The rollouts, one per condition and seed.
    """

    campaign: Campaign
    rollouts: tuple[CampaignRollout, ...]

    def cells(self) -> Iterator[Cell]:
        """Yield the cells by condition, and within it by criterion; the cells of all conditions together come last."""
        conditions = list(self.campaign.conditions)
        for condition in [*conditions, ALL]:
            for name in self.campaign.criteria:
                if (cell := self.cell(condition, name)) is not None:
                    yield cell

    def cell(self, condition: str, name: str) -> Cell | None:
        """Return the cell of a condition, or of `ALL`, and a criterion; None if the criterion leaves it out.

        Args:
            condition: Name of a condition, or `ALL`.
            name: Name of a criterion.
        """
        criterion = self.campaign.criteria[name]
        conditions = criterion.conditions or list(self.campaign.conditions)
        if condition != ALL and condition not in conditions:
            return None
        rows = conditions if condition == ALL else [condition]
        rollouts = tuple(rollout for rollout in self.rollouts if rollout.condition in rows)
        return Cell(name, criterion, condition, rollouts)

    def status(self, rollout: CampaignRollout) -> str:
        """Return the status of a rollout by all criteria: `PASS` if it passes each that applies to it."""
        applied = (
            (name, criterion)
            for name, criterion in self.campaign.criteria.items()
            if criterion.is_limited and rollout.condition in (criterion.conditions or self.campaign.conditions)
        )
        statuses = {rollout.status(name, criterion) for name, criterion in applied}
        return next((status for status in (NOT_RUN, ERROR, FAIL) if status in statuses), PASS)

    @property
    def passed(self) -> int:
        """Return the number of rollouts that pass all criteria."""
        return sum(bool(rollout.end) and self.status(rollout) == PASS for rollout in self.rollouts)

    @property
    def count(self) -> int:
        """Return the number of rollouts that were run."""
        return sum(bool(rollout.end) for rollout in self.rollouts)

    @property
    def unvaried(self) -> list[str]:
        """Return the conditions in which all rollouts have the same numbers: perhaps their seeds change nothing.

        Whole numbers do not count: many rollouts may have the same count, or be right or wrong alike.
        """
        conditions = []
        for condition in self.campaign.conditions:
            numbers = [rollout.values for rollout in self.rollouts if rollout.condition == condition and rollout.values]
            is_fine = any(not number.is_integer() for values in numbers[:1] for number in values.values())
            if len(numbers) > 1 and is_fine and all(values == numbers[0] for values in numbers):
                conditions.append(condition)
        return conditions

    @property
    def is_met(self) -> bool:
        """Return whether all that the campaign requires is shown."""
        return all(cell.verdict == MET for cell in self.cells() if cell.is_judged)

    @property
    def is_complete(self) -> bool:
        """Return whether all rollouts were run."""
        return self.count == len(self.rollouts)

    def compare(self, baseline: CampaignResult) -> list[PairedComparison]:
        """Return the comparisons with a baseline, pair by pair, in the order of `cells`."""
        comparisons = []
        for cell in self.cells():
            other = baseline.cell(cell.condition, cell.name)
            assert other is not None  # The baseline is judged by the criteria of this campaign.
            if cell.criterion.is_limited:
                by_name = dict(zip((r.name for r in other.rollouts), other.statuses, strict=True))
                pairs = [(s, by_name[r.name]) for r, s in zip(cell.rollouts, cell.statuses, strict=True)]
                passes = [(s == PASS, o == PASS) for s, o in pairs if NOT_RUN not in (s, o)]
                counts = (passes.count(pair) for pair in ((True, True), (True, False), (False, True), (False, False)))
                comparisons.append(PairedComparison(cell.condition, cell.name, *counts))
        return comparisons

    def to_dict(self, *, comparisons: Sequence[PairedComparison] = ()) -> dict[str, Any]:
        """Return the results as plain data, which do not depend on when and where the rollouts were run."""
        campaign = self.campaign
        return {
            "campaign": campaign.path.name,
            "scenario": campaign.scenario,
            "met": self.is_met,
            "complete": self.is_complete,
            "conditions": plain(campaign.conditions, nonfinite=repr),
            "seeds": [campaign.seeds.numbers[0], campaign.seeds.numbers[-1]],
            "criteria": {name: asdict(criterion) for name, criterion in campaign.criteria.items()},
            "cells": [cell.to_dict() for cell in self.cells()],
            "rollouts": [{**asdict(rollout), "status": self.status(rollout)} for rollout in self.rollouts],
            "comparisons": [{**asdict(each), "p": each.p, "difference": each.difference} for each in comparisons],
        }

    def to_json(self, *, comparisons: Sequence[PairedComparison] = ()) -> str:
        """Return `to_dict` as JSON."""
        return json.dumps(self.to_dict(comparisons=comparisons), indent=1, allow_nan=False) + "\n"


COMPARED = ("condition", "criterion", "both pass", "only here", "only there", "neither", "p", "difference")
"""The titles of a table of comparisons."""


@dataclass(frozen=True)
class PairedComparison:
    """The pairs of equal rollouts of two campaigns, by whether each passes a criterion.

    Attributes:
        condition: The condition, or `ALL`.
        criterion: The criterion.
        both: The number of pairs that pass in both.
        gained: The number that passes here only.
        lost: The number that passes in the baseline only.
        neither: The number that passes in neither.
    """

    condition: str
    criterion: str
    both: int
    gained: int
    lost: int
    neither: int

    @property
    def row(self) -> list[str]:
        """Return the comparison as texts, below the titles `COMPARED`."""
        counts = map(str, (self.both, self.gained, self.lost, self.neither))
        return [self.condition, self.criterion, *counts, f"{self.p:.3g}", self.difference]

    @property
    def p(self) -> float:
        """Return the probability of a difference at least as large if there is none (McNemar's exact test, two-sided).

        Among the pairs that differ, either would then be gained or lost with probability 1/2.
        """
        from scipy.stats import binomtest

        differing = self.gained + self.lost
        return float(binomtest(self.gained, differing, 0.5).pvalue) if differing else 1.0

    @property
    def difference(self) -> str:
        """Return ``better`` or ``worse`` if that is shown, at the level `SIGNIFICANCE`; else ``none shown``."""
        if self.p >= SIGNIFICANCE:
            return "none shown"
        return "better" if self.gained > self.lost else "worse"
