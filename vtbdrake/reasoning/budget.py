"""The budget of a decision: how many rollouts, or how much time, it may take."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from vtbdrake.argument_checks import as_number, as_whole


@dataclass(frozen=True)
class Budget:
    """A Budget limits a decision by rollouts, by time, or by both: the decision ends at the first limit it reaches.

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
