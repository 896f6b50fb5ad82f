"""Risks: how the qualities of a point under several conditions become one number."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, inf, isnan
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from vtbdrake.common.argument_checks import as_number, as_result

if TYPE_CHECKING:
    from vtbdrake.optimization.records import Outcome
    from vtbdrake.rollout import RolloutResult


class Risk(ABC):
    """A function of the qualities h of one point under n conditions, shape (n,); larger is better.

    The function must not fall when one of the qualities rises: racing relies on it.

    Attributes:
        keeps_one: Whether the risk of a single quality is that quality.
    """

    keeps_one: ClassVar[bool] = False

    @abstractmethod
    def __call__(self, h: np.ndarray) -> float:
        """Return one number for h, shape (n,)."""


@dataclass(frozen=True)
class Mean(Risk):
    """The mean, for conditions that occur equally often."""

    keeps_one = True

    def __call__(self, h: np.ndarray) -> float:
        return float(np.mean(h))


@dataclass(frozen=True)
class Worst(Risk):
    """The worst case."""

    keeps_one = True

    def __call__(self, h: np.ndarray) -> float:
        return float(np.min(h))


@dataclass(frozen=True)
class _Level(Risk):
    level: float

    keeps_one = True

    def __post_init__(self) -> None:
        level = as_number(f"the level of {type(self).__name__}", self.level)
        if not 0.0 < level <= 1.0:
            raise ValueError(f"the level of {type(self).__name__} lies in (0, 1], unlike {level}")
        object.__setattr__(self, "level", level)


@dataclass(frozen=True)
class Quantile(_Level):
    """The quantile ``level``, in (0, 1]: of n sorted h, the one at ceil(level n); 0.5 is the (lower) median."""

    def __call__(self, h: np.ndarray) -> float:
        # 0.28 * 25 is a little above 7 in floating point, and means 7.
        rank = ceil(self.level * len(h) * (1.0 - 1e-12))
        return float(np.sort(h)[rank - 1])


@dataclass(frozen=True)
class CVaR(_Level):
    """The conditional value at risk: the mean of the worst share ``level`` of the conditions.

    If ``level`` n is not whole, the last of them has the rest as its weight (Rockafellar and Uryasev, 2002).
    ``level`` in (0, 1]; 1 is the mean.
    """

    def __call__(self, h: np.ndarray) -> float:
        worst = np.sort(h)
        count = self.level * worst.size
        weights = np.clip(count - np.arange(worst.size), 0.0, 1.0)
        counted = weights > 0.0  # Values of weight zero may be infinite.
        return float(worst[counted] @ weights[counted] / count)


RISKS: dict[str, Risk] = {"mean": Mean(), "worst": Worst()}
_LEVELS: dict[str, Callable[[float], Risk]] = {"quantile": Quantile, "cvar": CVaR}


def make_risk(risk: str | Risk) -> Risk:
    """Return the risk that a text names, such as ``mean`` or ``cvar:0.5``, or the one given.

    Raises:
        ValueError: The name is unknown, or the level is no number in (0, 1].
    """
    if isinstance(risk, Risk):
        return risk
    name, colon, level = risk.partition(":") if isinstance(risk, str) else ("", "", "")
    if colon and name in _LEVELS:
        try:
            return _LEVELS[name](float(level))
        except ValueError as error:
            raise ValueError(f"the level of {name} is a number in (0, 1], not {level!r}") from error
    if colon or name not in RISKS:
        raise ValueError(
            f"conditions are aggregated by {', '.join(RISKS)}, quantile:LEVEL or cvar:LEVEL (Quantile and CVaR in "
            f"Python), not by {risk!r}"
        )
    return RISKS[name]


def _of_risk(risk: Risk, h: np.ndarray, *, complete: bool) -> float:
    """Return the risk of qualities, shape (n,); infinity if it is NaN while conditions are still to run."""
    returned = risk(h)
    try:
        value = as_result(returned)
    except ValueError as error:
        raise ValueError(f"the risk {type(risk).__name__} {error}") from None
    if isnan(value) and complete:
        raise ValueError(f"the risk {type(risk).__name__} is NaN for the qualities {h.tolist()}: return a number")
    return inf if isnan(value) else value


def aggregate(
    outcomes: Sequence[Outcome | RolloutResult | None],
    *,
    risk: Risk,
    minimize: Sequence[bool],
    constraints: int,
    bounds: Sequence[float],
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Aggregate the outcomes of one point under several conditions.

    Args:
        outcomes: One per condition, none of them failed; None if a condition has not run.
        risk: How the qualities under several conditions become one.
        minimize: Whether a quality is a cost, for each of them.
        constraints: The number of constraints.
        bounds: The best that each quality can be, in the user's terms; used for conditions that have not run.

    Returns:
        The qualities, larger is better (a cost is negated), and the worst violation of each constraint.
    """
    outcome = outcomes[0]
    if len(outcomes) == 1 and outcome is not None and risk.keeps_one:
        qualities = [outcome.value, *outcome.measures[: len(minimize) - 1]]
        signed = (-quality if cost else quality for quality, cost in zip(qualities, minimize, strict=True))
        return tuple(signed), tuple(outcome.measures[len(minimize) - 1 :][:constraints])
    values = []
    for k, (cost, bound) in enumerate(zip(minimize, bounds, strict=True)):
        qualities = [bound if o is None else o.value if k == 0 else o.measures[k - 1] for o in outcomes]
        # A user's risk may make NaN of infinities if nothing bounds the conditions that have not run.
        with np.errstate(invalid="ignore"):
            h = np.array([-number if cost else number for number in qualities])
            values.append(_of_risk(risk, h, complete=None not in outcomes))
    tried = [outcome for outcome in outcomes if outcome is not None]
    first = len(values) - 1
    violations = [max((o.measures[first + k] for o in tried), default=-inf) for k in range(constraints)]
    return tuple(values), tuple(violations)
