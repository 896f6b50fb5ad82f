"""Reading logs, damaged ones included."""

from __future__ import annotations

import logging
import mmap
import os
import struct
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vtbdrake.control.stepping import Change
from vtbdrake.lcm.maps import decode
from vtbdrake.lcm.messages import MalformedError
from vtbdrake.recording.lcm_types.lcmt_vtb_change import lcmt_vtb_change
from vtbdrake.recording.lcm_types.lcmt_vtb_digest import lcmt_vtb_digest
from vtbdrake.recording.lcm_types.lcmt_vtb_end import lcmt_vtb_end
from vtbdrake.recording.lcm_types.lcmt_vtb_fault import lcmt_vtb_fault
from vtbdrake.recording.lcm_types.lcmt_vtb_log import lcmt_vtb_log
from vtbdrake.recording.lcm_types.lcmt_vtb_state import lcmt_vtb_state
from vtbdrake.recording.log import Log, Series
from vtbdrake.recording.log_codec import find_events, whole_cycles
from vtbdrake.recording.log_format import (
    CHANGE,
    COMMANDED,
    CYCLE,
    DIGEST,
    END,
    FAULT,
    LOG,
    OWN_PREFIX,
    SENT,
    STATE,
    CycleLayout,
    LogError,
    LogHeader,
    change_value,
    decode_changes,
)
from vtbdrake.state import Snapshot
from vtbdrake.testbed import Scenario

_log = logging.getLogger(__name__)

CLOCK_JUMP = 0.1
"""Change of the time of day against the loop's clock between two cycles, in seconds, that is reported as a jump."""

_NOT_CLOSED = "the recorder was not closed: later cycles may be missing"
_NO_EVENTS = np.empty((0, 4), np.int64)


class Damage(NamedTuple):
    """Unreadable bytes of a file: their offset and the kind of damage."""

    offset: int
    description: str

    def __str__(self) -> str:
        return f"at byte {self.offset}: {self.description}"


class Gap(NamedTuple):
    """The first and the last of some cycles that are missing in a log."""

    first: int
    last: int

    def __str__(self) -> str:
        return f"cycles {self.first} to {self.last}"


class Message(NamedTuple):
    """A message that came or went: number of its event, time in microseconds since 1970, channel and bytes."""

    event: int
    utime: int
    channel: str
    data: bytes


class LogEvents:
    """The events of an LCM log, damaged or not.

    Attributes:
        damages: Offset and kind of all bytes that are not events.
        content: Bytes of the file.

    Raises:
        OSError: The file cannot be read.
        LogError: The path is not a regular file, or the file has too many channels for a log.
    """

    def __init__(self, path: Path) -> None:
        if path.exists() and not path.is_file():
            raise LogError(f"{path} is not a log: it is a folder, a device or a pipe, not a file")
        with path.open("rb") as file:
            empty = file.seek(0, 2) == 0  # An empty file cannot be mapped.
            self.content: mmap.mmap | bytes = b"" if empty else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        places_by_channel, self.damages = find_events(self.content)
        self._places: dict[str, np.ndarray] = {}
        for channel, places in places_by_channel.items():
            name = channel.decode(errors="replace")
            self._places[name] = np.concatenate([self.places(name), places])

    @property
    def channels(self) -> tuple[str, ...]:
        """Return the channels of the messages, without the recorder's own."""
        return tuple(sorted(name for name in self._places if not name.startswith(OWN_PREFIX)))

    def places(self, channel: str) -> np.ndarray:
        """Return the events of a channel as integers of shape (n, 4).

        The columns are event number, time in microseconds, and begin and end of the data in the file.
        """
        return self._places.get(channel, _NO_EVENTS)

    def on(self, channel: str) -> Sequence[tuple[int, int, int, int]]:
        """Return the rows of `places` as tuples."""
        return [(number, utime, begin, end) for number, utime, begin, end in self.places(channel).tolist()]

    def data(self, begin: int, end: int) -> bytes:
        """Return a range of bytes of the file."""
        return bytes(self.content[begin:end])


@dataclass(frozen=True, eq=False)
class ControlLog:
    """A recorded run of a control loop, as `read_log` returns it; n is the number of cycles that could be read."""

    path: Path  # path of the file
    header: LogHeader  # what was recorded
    start: Snapshot  # state before the first recorded cycle
    numbers: np.ndarray  # numbers of the cycles, shape (n,)
    times: np.ndarray  # times of the DPS at the ends of the cycles, in seconds, (n,)
    now: np.ndarray  # times on the loop's clock, in seconds, (n,)
    utimes: np.ndarray  # times of day in microseconds since 1970, (n,)
    ok: np.ndarray  # whether the DPS's actuator commands were sent, not those of the fallbacks, (n,)
    fed: Mapping[str, np.ndarray]  # newest values by vector sensor signal, (n, size); NaN before the first
    # by sensor signal, where a cycle had a new value, (n,): 0 for none, -1 for a vector, and for an abstract signal the
    # number of the event with its message
    sources: Mapping[str, np.ndarray]
    # actuator commands of the DPS by vector signal, (n, size); NaN where there is none
    actuation: Mapping[str, np.ndarray]
    commanded: Mapping[str, np.ndarray]  # whether the DPS commanded, by actuator signal, (n,)
    sent: Mapping[str, np.ndarray]  # actuator commands that were sent, after the guards, by vector signal, (n, size)
    # changes of the target, each with the index of the cycle before whose step it happened
    changes: Sequence[tuple[int, Change]]
    # present faults, each with the index of the cycle from which on they hold; empty when all are over
    faults: Sequence[tuple[int, tuple[str, ...]]]
    # digests of the DPS's state, each with the index of the cycle after which it was taken
    digests: Sequence[tuple[int, bytes]]
    damages: Sequence[Damage]  # damaged places of the file. Reading resumes at the next whole cycle.
    gaps: Sequence[Gap]  # cycles that are missing, lost by the recorder or damaged
    # indices of cycles whose time of day does not follow the loop's clock, or whose clock ran backwards
    clock_jumps: Sequence[int]
    closed: bool  # whether the recorder was closed. If not, later cycles may be missing.
    events: LogEvents  # all events of the file

    def __len__(self) -> int:
        return len(self.numbers)

    def __str__(self) -> str:
        lines = [
            f"{self.path}: {len(self)} cycles of {self.header.period:g} s, {self.header.record.get('scenario', '')}"
        ]
        lines += _shortened([f"damage {damage}" for damage in self.damages])
        lines += _shortened([f"missing: {gap}" for gap in self.gaps])
        lines += _shortened([f"the clock jumps at cycle {self.numbers[i]}" for i in self.clock_jumps])
        return "\n".join(lines if self.closed else [*lines, _NOT_CLOSED])

    @property
    def incomplete(self) -> str:
        """Return what the log lacks of the recorded run; empty if it is whole."""
        if self.gaps:
            return f"the log lacks {self.gaps[0]}"
        if not self.closed:
            return _NOT_CLOSED
        return f"the log is damaged {self.damages[0]}" if self.damages else ""

    @property
    def scenario(self) -> Scenario:
        """Return the recorded scenario, built from the header.

        Raises:
            LogError: The scenario cannot be found, or has changed since.
        """
        return self.header.make_scenario()

    @property
    def signals(self) -> Log:
        """Return the vector signals, with the times of the DPS when values were fed and commands were sent."""
        # A cycle begins with what is fed, and ends a period later with what is sent. Before the DPS is stepped, its
        # time stands still.
        fed_at = self.times - self.header.period

        def series(times: np.ndarray, values: np.ndarray, present: np.ndarray) -> Series:
            rows = np.flatnonzero(present)
            return Series.with_last_of_equal_times(times[rows], values[rows])

        sense = {name: (fed_at, values, self.sources[name] != 0) for name, values in self.fed.items()}
        act = {name: (self.times, values, np.isfinite(values).all(axis=1)) for name, values in self.sent.items()}
        sensed, sent = ({n: series(*parts) for n, parts in side.items() if parts[2].any()} for side in (sense, act))
        return Log(str(self.path), sensed, sent, [self.incomplete] if self.incomplete else [])

    @property
    def channels(self) -> tuple[str, ...]:
        """Return the channels of the messages."""
        return self.events.channels

    def messages(self, channel: str) -> Iterator[Message]:
        """Yield the messages of a channel in order.

        Raises:
            LogError: The log has no such channel.
        """
        if channel not in self.channels:
            raise LogError(f"{self.path} has no channel {channel!r}; it has: {', '.join(self.channels) or 'none'}")
        for number, utime, begin, end in self.events.on(channel):
            yield Message(number, utime, channel, self.events.data(begin, end))


def _shortened(lines: list[str], limit: int = 20) -> list[str]:
    return lines if len(lines) <= limit else [*lines[:limit], f"... and {len(lines) - limit} more like it"]


def read_log(path: str | os.PathLike[str]) -> ControlLog:
    """Return the log in a file that a `Recorder` has written.

    A file that is cut off or damaged is read, too: `ControlLog.damages` and `ControlLog.gaps` list what is missing, and
    a warning is logged. A cycle counts only if the checksum over all its events is right.

    Args:
        path: Path of the file.

    Raises:
        OSError: The file cannot be read.
        LogError: The file is not a log of a control loop, is one of another version, or is damaged in its first two
            events.
    """
    path = Path(path)
    events = LogEvents(path)
    header, start = _read_start(path, events)
    layout = CycleLayout(header.sense, header.act)
    damages = [Damage(*damage) for damage in events.damages]
    records, frames, wrong = whole_cycles(events.content, events.places(CYCLE), layout.dtype)
    damages += [Damage(*damage) for damage in wrong]
    if not layout.fits(records):
        raise LogError("the cycles of the log have other signals than its header")
    index = {number: i for i, number in enumerate(records["number"].tolist())}
    changes, faults, digests = (
        _of_cycles(events, channel, message_type, damages, frames, index)
        for channel, message_type in ((CHANGE, lcmt_vtb_change), (FAULT, lcmt_vtb_fault), (DIGEST, lcmt_vtb_digest))
    )
    source, act = records["source"], records["act"]
    log = ControlLog(
        path=path,
        header=header,
        start=start,
        numbers=records["number"].astype(int),
        times=records["time"].astype(float),
        now=records["now"].astype(float),
        utimes=records["utime"].astype(int),
        ok=records["ok"].copy(),
        fed=_columns(records["fed"], layout.fed),
        sources={signal.name: source[:, i].astype(int) for i, signal in enumerate(header.sense)},
        actuation=_columns_where(records["commands"], layout, header, act & COMMANDED),
        commanded={signal.name: act[:, i] & COMMANDED != 0 for i, signal in enumerate(header.act)},
        sent=_columns_where(records["sent"], layout, header, act & SENT),
        changes=[(index[number], change) for number, change in decode_changes(changes)],
        faults=[(index[message.number], tuple(message.reasons)) for message in faults],
        digests=[(index[message.number], message.digest) for message in digests],
        damages=damages,
        gaps=_gaps(header, records["number"], _last_numbers(events, damages)),
        clock_jumps=_clock_jumps(records),
        closed=bool(events.on(END)),
        events=events,
    )
    damages.sort()
    if damages or log.gaps or log.clock_jumps or not log.closed:
        # As text: a log record that is kept must not keep the mapped file.
        _log.warning("%s", str(log))
    return log


def _read_start(path: Path, events: LogEvents) -> tuple[LogHeader, Snapshot]:
    if not events.on(LOG):
        where = f"; {events.damages[0][1]} at byte {events.damages[0][0]}" if events.damages else ""
        raise LogError(f"{path} is not a log of a control loop: it has no event on {LOG}{where}")
    try:
        first = decode(lcmt_vtb_log, events.data(*events.on(LOG)[0][2:]))
        if zlib.crc32(first.header.encode()) != first.crc & 0xFFFFFFFF:
            raise LogError(f"{path} cannot be used: its header is damaged")
        # The header comes first: another version may have another state, too.
        header = LogHeader.from_json(first.header)
        if not events.on(STATE):
            raise LogError(f"{path} cannot be used: the state before the first cycle is missing")
        state = decode(lcmt_vtb_state, events.data(*events.on(STATE)[0][2:]))
        if zlib.crc32(state.snapshot) != state.crc & 0xFFFFFFFF:
            raise LogError(f"{path} cannot be used: the state before the first cycle is damaged")
        return header, Snapshot.load(state.snapshot)
    except LogError:
        raise
    except (ValueError, TypeError, LookupError, struct.error) as error:
        raise LogError(f"{path} cannot be used: its beginning is damaged ({error})") from error


def _columns(entries: np.ndarray, parts: dict[str, slice]) -> dict[str, np.ndarray]:
    native = entries.astype(float)
    return {name: np.ascontiguousarray(native[:, part]) for name, part in parts.items()}


def _columns_where(
    entries: np.ndarray, layout: CycleLayout, header: LogHeader, flags: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the columns of actuator signals, NaN where a signal has no flag."""
    columns = _columns(entries, layout.actuation)
    for i, signal in enumerate(header.act):
        if signal.name in columns:
            columns[signal.name][flags[:, i] == 0] = np.nan
    return columns


def _of_cycles(
    events: LogEvents,
    channel: str,
    message_type: Any,
    damages: list[Damage],
    frames: np.ndarray,
    numbers: Collection[int],
) -> list[Any]:
    """Return the messages of a channel that lie in whole cycles and name one of them."""
    places = events.places(channel)
    begins = np.append(frames[:, 0], np.iinfo(np.int64).max)
    within = places[places[:, 2] >= begins[np.searchsorted(frames[:, 1], places[:, 3])]]
    decoded = []
    for begin, message in _decoded(events, channel, message_type, damages, within):
        if message.number in numbers:
            decoded.append(message)
        else:
            damages.append(Damage(begin, f"an event on {channel} is of cycle {message.number}, which is missing"))
    return decoded


def _decoded(
    events: LogEvents, channel: str, message_type: Any, damages: list[Damage], places: np.ndarray
) -> Iterator[tuple[int, Any]]:
    for _, _, begin, end in places.tolist():
        try:
            message = decode(message_type, events.data(begin, end))
            if message_type is lcmt_vtb_change:
                change_value(message)
        except (MalformedError, struct.error, ValueError) as error:
            damages.append(Damage(begin, f"an event on {channel} cannot be read ({error})"))
        else:
            yield begin, message


def _last_numbers(events: LogEvents, damages: list[Damage]) -> list[int]:
    """Return the number of the last cycle that was recorded or lost, if the end of the log is intact."""
    ends = [message for _, message in _decoded(events, END, lcmt_vtb_end, damages, events.places(END))]
    whole = [end.number for end in ends if zlib.crc32(end.encode()[:-4]) == end.crc & 0xFFFFFFFF]
    if len(whole) < len(ends):
        damages.append(Damage(events.on(END)[-1][2], "the checksum of the log's end is wrong"))
    return whole


def _gaps(header: LogHeader, numbers: np.ndarray, ends: Sequence[int]) -> list[Gap]:
    present = np.concatenate([[header.first_cycle - 1], numbers, np.array(ends, int) + 1])
    return [Gap(int(present[i]) + 1, int(present[i + 1]) - 1) for i in np.flatnonzero(np.diff(present) > 1)]


def _clock_jumps(records: np.ndarray) -> list[int]:
    """Return the indices of jumps. A delayed cycle is recorded late once; a jump persists in the cycles after it."""
    if len(records) < 2:
        return []
    offset = 1e-6 * records["utime"] - records["now"]
    step = np.diff(offset)
    ahead, behind = np.append(offset[2:], offset[-1]), np.insert(offset[:-2], 0, offset[0])
    forward = (step > CLOCK_JUMP) & (ahead - offset[:-1] > CLOCK_JUMP)
    backward = (step < -CLOCK_JUMP) & (offset[1:] - behind < -CLOCK_JUMP)
    return [int(i) + 1 for i in np.flatnonzero(forward | backward | (np.diff(records["now"]) < 0.0))]
