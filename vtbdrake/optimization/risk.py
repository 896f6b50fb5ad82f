"""One number of the qualities under several conditions: how a decision is judged whose outcome is not certain."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from math import ceil

import numpy as np

from vtbdrake.rollout.arguments import as_number


class Risk(ABC):
    """Aggregates qualities h, larger is better, of shape (n,): one decision under n conditions.

    It must not become smaller when one of them becomes larger: racing rests on that.
    """

    @abstractmethod
    def __call__(self, h: np.ndarray) -> float:
        """The one number."""


@dataclass(frozen=True)
class Mean(Risk):
    """The mean: for conditions that are met equally often."""

    def __call__(self, h: np.ndarray) -> float:
        return float(np.mean(h))


@dataclass(frozen=True)
class Worst(Risk):
    """The worst case."""

    def __call__(self, h: np.ndarray) -> float:
        return float(np.min(h))


@dataclass(frozen=True)
class Quantile(Risk):
    """What all but a share ``level`` of the conditions reach: of n sorted h, the one at ceil(level n).

    ``level`` in (0, 1]; 0.5 is the (lower) median.
    """

    level: float

    def __post_init__(self) -> None:
        _check_level(self)

    def __call__(self, h: np.ndarray) -> float:
        # 0.28 * 25 is a little above 7 in floating point, and means 7.
        rank = ceil(self.level * len(h) * (1.0 - 1e-12))
        return float(np.sort(h)[rank - 1])


@dataclass(frozen=True)
class CVaR(Risk):
    """Conditional value at risk: the mean of the worst share ``level`` of the conditions.

    Where ``level`` n is not whole, the last counts with what is left of the share (Rockafellar and Uryasev, 2002).
    ``level`` in (0, 1]; 1 is the mean.
    """

    level: float

    def __post_init__(self) -> None:
        _check_level(self)

    def __call__(self, h: np.ndarray) -> float:
        worst = np.sort(h)
        count = self.level * worst.size
        weights = np.clip(count - np.arange(worst.size), 0.0, 1.0)
        counted = weights > 0.0  # What is not counted may be infinite.
        return float(worst[counted] @ weights[counted] / count)


RISKS: dict[str, Risk] = {"mean": Mean(), "worst": Worst()}


def make_risk(risk: str | Risk) -> Risk:
    """A risk by name, or the one given.

    Raises:
        ValueError: the name is unknown.
    """
    if isinstance(risk, Risk):
        return risk
    if not isinstance(risk, str) or risk not in RISKS:
        raise ValueError(
            f"conditions are aggregated by {', '.join(RISKS)}, Quantile(level) or CVaR(level), not by {risk!r}"
        )
    return RISKS[risk]


def _check_level(risk: Quantile | CVaR) -> None:
    level = as_number(f"the level of {type(risk).__name__}", risk.level)
    if not 0.0 < level <= 1.0:
        raise ValueError(f"the level of {type(risk).__name__} lies in (0, 1], unlike {level}")
    object.__setattr__(risk, "level", level)
