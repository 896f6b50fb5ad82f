"""Pruning: when a rollout ends before its horizon because it cannot win any more."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, isnan, nan

from vtbdrake.common.argument_checks import as_addresses, as_number, as_result, check_takes
from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.rollout.quality import Constraint, Measure, Quality, QualityError

# How a rollout ends that cannot win any more.
PRUNED = "pruned"
# How a rollout ends whose quality has not improved for too long.
STALLED = "stalled"


@dataclass(frozen=True, kw_only=True)
class Cutoff:
    """Limits that end rollouts early, known only when the rollouts begin.

    Attributes:
        deadline: A time of `time.monotonic`, which all processes of a computer share. A rollout that is not finished
            by then is cancelled at its next sample, and has no result.
        to_beat: A value of the task's quality, in the user's terms. A rollout of a task with `Pruning` ends when it
            can no longer be better. NaN: no such value.
    """

    deadline: float = inf
    to_beat: float = nan

    @property
    def is_over(self) -> bool:
        """Return whether the deadline has passed."""
        return time.monotonic() >= self.deadline


@dataclass(frozen=True)
class Pruning:
    """When the rollout of a candidate that cannot win any more ends.

    The rollout ends as ``pruned`` when it has violated a constraint with the reading ``worst``, or when its quality can
    no longer be better than `Cutoff.to_beat`, by its bounds. Neither changes which candidate is the best. The rollout
    ends as ``stalled``, with the value reached so far, when its quality has not improved for ``patience`` seconds; it
    is assumed, and not known, that the quality would not improve later.

    Attributes:
        bound: Function (remaining time in seconds, values of ``of``...) that returns the best f (or the lowest cost)
            that is still possible, now and later. It must be optimistic. None: `Quality.upper`, or 0 for a cost.
        of: Addresses of variables or vector output ports.
        patience: Simulated time in seconds; for qualities with the reading ``best``.
        gain: The least improvement that restarts the patience, in the unit of the quality.

    Raises:
        ValueError: A number is out of range, or ``of`` and ``bound`` do not go together.
    """

    bound: Callable[..., float] | None = None
    of: Sequence[str] = ()
    patience: float = inf
    gain: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "of", as_addresses("what a bound is a function of", self.of))
        for name in ("patience", "gain"):
            object.__setattr__(self, name, as_number(f"the {name} of a pruning", getattr(self, name)))
        if self.bound is None and self.of:
            raise ValueError("a pruning has addresses (of=), but no bound that is a function of them: give bound=")
        if self.bound is not None:
            check_takes(self.bound, ["the remaining time", *self.of], name="the bound of a pruning")
        if not self.patience > 0.0:
            raise ValueError(f"patience is a time in seconds, above 0, not {self.patience}")
        if not self.gain >= 0.0:
            raise ValueError(f"gain is at least 0, in the unit of the quality, not {self.gain}")


class Prospect:
    """The best value that one rollout can still reach, updated at each sample.

    Args:
        pruning: When to end the rollout.
        quality: Quality f.
        measures: The task's other measures; a violated constraint among them ends the rollout.
        horizon: Horizon t_m in seconds.
        to_beat: See `Cutoff`.

    Attributes:
        reachable: The best value that the rollout can still have, in the user's terms.
    """

    def __init__(
        self, pruning: Pruning, quality: Quality, measures: Sequence[Measure], horizon: float, to_beat: float
    ) -> None:
        self._pruning = pruning
        self._quality = quality
        self._watched = [
            (index, measure)
            for index, measure in enumerate(measures)
            if isinstance(measure, Constraint) and measure.reading == "worst"
        ]
        self._horizon = horizon
        self._sign = quality.sign
        self._to_beat = -inf if isnan(to_beat) else self._sign * to_beat
        self._best, self._worst, self._integral = -inf, inf, 0.0
        self._last: tuple[float, float] | None = None
        self._gained = (0.0, -inf)
        self.reachable = nan

    def update(self, t: float, samples: Sequence[float], values: Sequence[object]) -> tuple[str, str] | None:
        """Return the end of the rollout and its reason at these samples; None if it goes on, or ends at its horizon.

        Args:
            t: Time of the sample in seconds from t0.
            samples: Samples of f, and of the other measures.
            values: Values of the arguments of the bound.

        Raises:
            QualityError: The bound raises, or returns NaN.
        """
        f = self._sign * samples[0]
        if self._last is not None:
            self._integral += (t - self._last[0]) * (f + self._last[1]) / 2.0
        self._last = t, f
        self._best, self._worst = max(self._best, f), min(self._worst, f)
        if self._best > self._gained[1] + self._pruning.gain:
            self._gained = t, self._best
        if t >= self._horizon:
            return None
        reachable = self._reachable(t, f, values)
        self.reachable = self._sign * reachable
        for index, constraint in self._watched:
            sample = samples[1 + index]
            if not constraint.at_least <= sample <= constraint.at_most:
                return PRUNED, f"the constraint {constraint.name} is violated: {sample:g} at t = {t:g} s"
        if reachable <= self._to_beat:
            return PRUNED, f"it can reach {self.reachable:g} at best, and {self._sign * self._to_beat:g} is known"
        if t - self._gained[0] > self._pruning.patience:
            return STALLED, f"the quality has not improved for {self._pruning.patience:g} s"
        return None

    def _reachable(self, t: float, f: float, values: Sequence[object]) -> float:
        """Return the best reading of f (of a cost, negated) that is still possible."""
        left = self._horizon - t
        ahead = 0.0 if self._quality.minimize else self._quality.upper
        if self._pruning.bound is not None:
            ahead = min(ahead, self._sign * self._bound(left, values))
        ahead = max(ahead, f)
        readings = {
            "best": max(self._best, ahead),
            "worst": min(self._worst, ahead),
            "end": ahead,
            # The sum of the trapezoidal rule has another order of rounding.
            "integral": self._integral + 1e-9 * abs(self._integral) + ahead * left,
        }
        return readings[self._quality.reading]

    def _bound(self, left: float, values: Sequence[object]) -> float:
        assert self._pruning.bound is not None
        try:
            value = self._pruning.bound(left, *values)
        except FAILURES as error:
            raise QualityError(f"the bound of a pruning raises {error_text(error)}") from error
        try:
            bound = as_result(value)
        except ValueError as error:
            raise QualityError(f"the bound of a pruning {error}") from None
        if isnan(bound):
            raise QualityError(f"the bound of a pruning is NaN with {left:g} s left, for {values}")
        return bound
