"""What a log says, in arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vtbdrake.control.cycle import Change
from vtbdrake.recording.log_events import LogEvents
from vtbdrake.recording.log_format import LogError
from vtbdrake.recording.log_header import LogHeader
from vtbdrake.state import Snapshot
from vtbdrake.testbed import Scenario


class Damage(NamedTuple):
    """Bytes of a file that say nothing: where they begin, and what is wrong with them."""

    offset: int
    what: str

    def __str__(self) -> str:
        return f"at byte {self.offset}: {self.what}"


class Gap(NamedTuple):
    """Cycles that are not in a log: the first and the last; the last is None if nobody knows."""

    first: int
    last: int | None

    def __str__(self) -> str:
        return f"cycles {self.first} to {'?' if self.last is None else self.last}"


class Message(NamedTuple):
    """A message that came or went: number of its event, time in microseconds since 1970, channel and bytes."""

    event: int
    utime: int
    channel: str
    data: bytes


@dataclass(frozen=True, eq=False)
class ControlLog:
    """A recorded run of a control loop; `read_log` makes it. n is the number of cycles that could be read.

    Attributes:
        path: of the file.
        header: what was recorded.
        start: the state before the first recorded cycle.
        numbers: of the cycles, of shape (n,).
        times: of the DPS at their ends, in seconds, (n,).
        now: on the loop's clock, in seconds, (n,).
        utimes: in microseconds since 1970, (n,).
        ok: whether the DPS's commands were sent, and not the fallbacks', (n,).
        fed: by vector sensor signal the newest values, (n, size); NaN before the first.
        sources: by sensor signal where a cycle had a new value, (n,): 0 if it had none, for a vector -1, for an
            abstract signal the event of the message that it comes from.
        commands: by vector actuator signal what the DPS commanded, (n, size); NaN where it did not.
        commanded: by actuator signal whether it did, (n,).
        sent: likewise what was sent, after the guards.
        changes: what changed the target, with the index of the cycle before whose step it did.
        faults: what was wrong, from the index of a cycle on; empty where nothing is any more.
        digests: of the DPS's state, with the index of the cycle after which it was taken.
        damages: where the file is damaged. What lies behind a damage is read again from the next whole cycle on.
        gaps: cycles that are missing, lost by the recorder or in a damage.
        clock_jumps: indices of cycles whose time of day does not follow the loop's clock, or whose clock ran backwards.
        closed: whether the recorder was closed. If not, the log ends somewhere.
        events: all events of the file.
    """

    path: Path
    header: LogHeader
    start: Snapshot
    numbers: np.ndarray
    times: np.ndarray
    now: np.ndarray
    utimes: np.ndarray
    ok: np.ndarray
    fed: Mapping[str, np.ndarray]
    sources: Mapping[str, np.ndarray]
    commands: Mapping[str, np.ndarray]
    commanded: Mapping[str, np.ndarray]
    sent: Mapping[str, np.ndarray]
    changes: Sequence[tuple[int, Change]]
    faults: Sequence[tuple[int, tuple[str, ...]]]
    digests: Sequence[tuple[int, bytes]]
    damages: Sequence[Damage]
    gaps: Sequence[Gap]
    clock_jumps: Sequence[int]
    closed: bool
    events: LogEvents

    def __len__(self) -> int:
        return len(self.numbers)

    def __str__(self) -> str:
        lines = [
            f"{self.path}: {len(self)} cycles of {self.header.period:g} s, {self.header.record.get('scenario', '')}"
        ]
        lines += _first([f"damage {damage}" for damage in self.damages])
        lines += _first([f"missing: {gap}" for gap in self.gaps])
        lines += _first([f"the clock jumps at cycle {self.numbers[i]}" for i in self.clock_jumps])
        return "\n".join(lines if self.closed else [*lines, "the recorder was not closed: what followed is not known"])

    @property
    def scenario(self) -> Scenario:
        """What was recorded, built anew from the header.

        Raises:
            LogError: it cannot be found, or is another one by now.
        """
        return self.header.make_scenario()

    @property
    def channels(self) -> tuple[str, ...]:
        """Of the messages."""
        return self.events.channels

    def messages(self, channel: str) -> Iterator[Message]:
        """The messages of a channel, in order.

        Raises:
            LogError: the log has no such channel.
        """
        if channel not in self.channels:
            raise LogError(f"{self.path} has no channel {channel!r}; it has: {', '.join(self.channels) or 'none'}")
        for number, utime, begin, end in self.events.on(channel):
            yield Message(number, utime, channel, self.events.data(begin, end))


def _first(lines: list[str], most: int = 20) -> list[str]:
    return lines if len(lines) <= most else [*lines[:most], f"... and {len(lines) - most} more like it"]
