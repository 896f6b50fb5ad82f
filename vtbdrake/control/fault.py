"""Faults that the guards of a loop detect."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class FaultKind(StrEnum):
    """The kinds of faults."""

    # Of a sensor signal.
    STALE = "stale"
    IMPLAUSIBLE = "implausible"
    JUMP = "jump"
    # Of an actuator signal: its command, or what became of it.
    MISSING = "missing"
    SIZE = "size"
    NOT_FINITE = "not finite"
    NOT_STARTED = "not started"
    NOT_SENT = "not sent"
    FALLBACK = "fallback"
    # Of the DPS, the loop or the machine.
    RAISED = "raised"
    MISSED = "missed"
    PACE = "pace"
    BLOCKED = "blocked"
    TOLD = "told"  # the guards were told to latch, for a reason from outside


@dataclass(frozen=True, slots=True)
class Fault:
    """A detected reason why the machine must not get the DPS's commands."""

    time: float  # time of detection on the loop's clock, in seconds
    signal: str | None  # name of the faulty signal; None if the fault concerns all
    kind: FaultKind
    reason: str  # description in one sentence

    def __str__(self) -> str:
        return self.reason
