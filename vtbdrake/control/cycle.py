"""What is known of one cycle of the loop, for those who watch: a recorder, a plot, residuals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vtbdrake.control.guard import Verdict

WRITE, SWITCH, RESET, RESULT = "write", "switch", "reset", "result"


class Change(NamedTuple):
    """Something beside time and sensor values that changed what is stepped, before a cycle's step.

    Attributes:
        kind: ``write`` (variables), ``switch``, ``reset`` (of the guards) or ``result`` (of a slow part).
        values: of ``write`` the new values by address; of ``switch`` the positions, by ``sense.<signal>`` and
            ``act.<signal>``; of ``result`` one entry: path of the slow part -> ``{"tick": number of the sample (int),
            name: array, ...}``, where the arrays (of any dtype and shape; none, if the result is declared missing) are
            what `SlowPart.deliver` takes besides the tick.
    """

    kind: str
    values: Mapping[str, Any]


class Cycle(NamedTuple):
    """What happened in one cycle.

    From the state before the first cycle, ``changes`` and ``fed`` of every cycle determine all that the DPS does.

    Attributes:
        number: of the cycle, from 0.
        time: of the DPS, in seconds, at the end of the cycle; that of the cycle before if it raised or is idle.
        now: on the runtime's clock, when the cycle's messages had been taken in.
        changes: what changed the target before the step, in order.
        fed: the sensor values that are new to the DPS in this cycle, by signal.
        commands: what the DPS commanded, by signal; empty if it raised.
        verdict: what the guards made of it; `Verdict.commands` is what was sent.
    """

    number: int
    time: float
    now: float
    changes: tuple[Change, ...]
    fed: Mapping[str, Any]
    commands: Mapping[str, Any]
    verdict: Verdict


def time_after(steps: int, *, start: float, period: float) -> float:
    """The DPS's time after some steps, in seconds.

    Where it starts at a multiple of the period, all are multiples: samples are due at those, and a rounding error off
    them a step would have none or two of an update now and then.
    """
    first = round(start / period)
    if steps and abs(first * period - start) <= _ON_GRID * period:
        return (first + steps) * period
    return start + steps * period


def times_after(steps: NDArray[np.int64], *, start: float, period: float) -> NDArray[np.float64]:
    """`time_after` of every entry, to the last bit."""
    first = round(start / period)
    on_grid = abs(first * period - start) <= _ON_GRID * period
    return np.where(steps, (first + steps) * period if on_grid else start + steps * period, start)


_ON_GRID = 1e-6
