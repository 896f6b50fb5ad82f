"""Faults that the guards of a loop detect."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class FaultKind(StrEnum):
    """The kinds of faults."""

    # Faults of a sensor signal.
    STALE = "stale"
    IMPLAUSIBLE = "implausible"
    JUMP = "jump"
    # Faults of an actuator signal: of its command, or of its effect.
    MISSING = "missing"
    SIZE = "size"
    NOT_FINITE = "not finite"
    NOT_STARTED = "not started"
    NOT_SENT = "not sent"
    NOT_ACTING = "not acting"
    FALLBACK = "fallback"
    # Faults of the DPS, the loop or the machine.
    RAISED = "raised"
    MISSED = "missed"
    PACE = "pace"
    BLOCKED = "blocked"
    COMMAND = "command"  # messages with a command u were rejected: an alarm, which stops nothing
    TOLD = "told"  # the guards were told to latch, for a reason from outside


@dataclass(frozen=True, slots=True)
class Fault:
    """A detected reason why the machine must not get the DPS's commands.

    Attributes:
        time: Time of detection on the loop's clock, in seconds.
        signal: Name of the faulty signal; None if the fault concerns all.
        kind: The kind of the fault.
        reason: Description in one sentence.
    """

    time: float
    signal: str | None
    kind: FaultKind
    reason: str

    def __str__(self) -> str:
        return self.reason
