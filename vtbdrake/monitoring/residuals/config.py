"""How residuals are made and judged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.testbed import Scenario

SHADOW, TWIN = "shadow", "twin"
MODES = (SHADOW, TWIN)


@dataclass(frozen=True, kw_only=True)
class ResidualConfig:
    """What the prediction of a machine needs to know beside its scenario, and what is an alarm.

    A scenario has its own in `Scenario.deployment`.

    Attributes:
        scenario: of the predicted world; None is that of the loop's target. It has the latencies of the sensors, and
            none of what happens in them by chance.
        period: of the machine's cycles and the DPS's, in seconds.
        horizon: of a prediction, in periods: so often it begins anew from the belief.
        delay: periods from the instant of a sample until the command that answers it acts: 0 where it is answered at
            once and obeys at once, as in lock-step; 1 for a machine by the clock, which obeys from its next period on.
        settle: windows that are predicted but not judged at first, and after a gap: what the belief does not say (the
            currents of drives, samples in transit) follows from the commands alone, after some time.
        values: of variables of the predicted world, by address: the payload that the machine is thought to carry, say.
        tolerance: by signal (``sense.<name>``, ``act.<name>``), what a residual's scale is at least, for all entries or
            each; persistent residuals below half of it are no finding.
        allowance: k of `Cusum`, in scales.
        false_alarm_interval: mean time between two false alarms, in seconds, of all signals together.

    Raises:
        ValueError: a value is out of its range.
    """

    scenario: Scenario | None = None
    period: float = 1e-3
    horizon: int = 10
    delay: int = 0
    settle: int = 10
    values: Mapping[str, Any] = field(default_factory=dict)
    tolerance: Mapping[str, ArrayLike] = field(default_factory=dict)
    allowance: float = 0.5
    false_alarm_interval: float = 3.6e6

    def __post_init__(self) -> None:
        for name in ("period", "allowance", "false_alarm_interval"):
            if not 0.0 < getattr(self, name) < inf:
                raise ValueError(f"{name} of residuals is positive and finite, not {getattr(self, name)!r}")
        for name, least in (("horizon", 1), ("delay", 0), ("settle", 0)):
            if int(getattr(self, name)) != getattr(self, name) or getattr(self, name) < least:
                raise ValueError(f"{name} of residuals is a whole number from {least} on, not {getattr(self, name)!r}")
        for signal, tolerance in self.tolerance.items():
            if not (np.asarray(tolerance) >= 0.0).all():
                raise ValueError(f"the tolerance of {signal} is not negative, not {tolerance!r}")

    @property
    def window(self) -> float:
        """The length of a prediction, in seconds."""
        return self.horizon * self.period


def check_mode(mode: str) -> None:
    """
    Raises:
        ValueError: residuals are not made in this mode.
    """
    if mode not in MODES:
        raise ValueError(f"residuals are of one of the modes {', '.join(MODES)}, not of {mode!r}")
