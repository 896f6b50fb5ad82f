"""Reading logs, damaged ones included."""

from __future__ import annotations

import hashlib
import logging
import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vtbdrake.control.stepping import Change
from vtbdrake.lcm.maps import decode
from vtbdrake.lcm.messages import MalformedError
from vtbdrake.recording.disk_array import DiskArray
from vtbdrake.recording.lcm_types.lcmt_vtb_change import lcmt_vtb_change
from vtbdrake.recording.lcm_types.lcmt_vtb_digest import lcmt_vtb_digest
from vtbdrake.recording.lcm_types.lcmt_vtb_end import lcmt_vtb_end
from vtbdrake.recording.lcm_types.lcmt_vtb_fault import lcmt_vtb_fault
from vtbdrake.recording.lcm_types.lcmt_vtb_log import lcmt_vtb_log
from vtbdrake.recording.lcm_types.lcmt_vtb_state import lcmt_vtb_state
from vtbdrake.recording.log import Log, Series
from vtbdrake.recording.log_codec import whole_cycles
from vtbdrake.recording.log_events import NO_LCM_LOG, Damage, LogEvents, Message
from vtbdrake.recording.log_format import (
    CHANGE,
    COMMANDED,
    CYCLE,
    DIGEST,
    END,
    FAULT,
    LOG,
    SENT,
    STATE,
    CycleLayout,
    LogError,
    LoggedSignal,
    LogHeader,
    change_value,
    decode_changes,
)
from vtbdrake.recording.protocol_reader import read_by_protocol
from vtbdrake.state import Snapshot
from vtbdrake.testbed import Scenario

_log = logging.getLogger(__name__)

CLOCK_JUMP = 0.1
"""Change of the time of day against the loop's clock between two cycles, in seconds, that is reported as a jump."""

# Cycles that are read together.
RECORDS_TOGETHER = 4096
_NOT_CLOSED = "the recorder was not closed: later cycles may be missing"


class Gap(NamedTuple):
    """The first and the last of some cycles that are missing in a log.

    Attributes:
        first: The number of the first missing cycle.
        last: The number of the last missing cycle.
    """

    first: int
    last: int

    def __str__(self) -> str:
        return f"cycles {self.first} to {self.last}"


class Cycles:
    """The cycles of a log that are whole, in order. What they carry is read from the file when it is asked for.

    Args:
        events: The events of the log.

    Attributes:
        layout: The layout of a cycle.
        numbers: The numbers of the cycles, shape (n,).
        times: The times of the DPS at the ends of the cycles, in seconds, shape (n,).
        begins: Where in the file the bytes of each cycle begin, with the events before it, shape (n,).
        ends: Where they end, shape (n,).
        damages: Offset and kind of the cycles that do not count, see `whole_cycles`.
        clock_jumps: The indices of cycles whose time of day does not follow the loop's clock, or whose clock ran
            backwards.
        digest: The SHA-256 of their numbers and checksums.
    """

    def __init__(self, events: LogEvents, layout: CycleLayout) -> None:
        self.layout = layout
        self._events = events
        self._bytes = np.frombuffer(events.content, np.uint8)
        places, digest = events.places(CYCLE), hashlib.sha256()
        numbers, times, begins, ends = (DiskArray(kind, (), events.folder) for kind in (int, float, int, int))
        jumps = _ClockJumps()
        self.damages: list[tuple[int, str]] = []
        newest = -1
        for begin in range(0, len(places), RECORDS_TOGETHER):
            chunk = np.ascontiguousarray(places[begin : begin + RECORDS_TOGETHER])
            records, chunk_frames, wrong = whole_cycles(events.content, chunk, layout.dtype)
            if not layout.fits(records):
                raise LogError("the cycles of the log have other signals than its header")
            self.damages += wrong
            late = records["number"] <= newest
            self.damages += [
                (int(end) - layout.dtype.itemsize, f"cycle {number} follows cycle {newest}")
                for number, end in zip(records["number"][late].tolist(), chunk_frames[late, 1].tolist(), strict=True)
            ]
            records, chunk_frames = records[~late], chunk_frames[~late]
            if len(records):
                newest = int(records["number"][-1])
                digest.update(records["number"].tobytes() + records["crc"].tobytes())
                jumps.add(1e-6 * records["utime"] - records["now"], records["now"].astype(float))
                numbers.append(records["number"])
                times.append(records["time"])
                begins.append(chunk_frames[:, 0])
                ends.append(chunk_frames[:, 1])
            events.release()
        self.numbers, self.times = numbers.array(), times.array()
        self.begins, self.ends = begins.array(), ends.array()
        self.clock_jumps = jumps.indices()
        self.digest = digest.digest()

    def records(self, first: int, last: int) -> np.ndarray:
        """Return the records of the cycles from ``first`` to below ``last``, of the type of the layout.

        Args:
            first: Index of the first cycle, from 0 on.
            last: Index behind the last cycle.
        """
        size = self.layout.dtype.itemsize
        begins = self.ends[first:last] - size
        if not len(begins):
            return np.empty(0, self.layout.dtype)
        return sliding_window_view(self._bytes, size)[begins].reshape(-1).view(self.layout.dtype)

    def column(self, name: str, kind: type) -> np.ndarray:
        """Return a field of all cycles as an array of its own, of a type of Python.

        Args:
            name: The name of a field of the layout's type.
            kind: The type of the entries, such as float, to which the field is converted.
        """
        column = np.empty((len(self.numbers), *self.layout.dtype[name].shape), kind)
        for first in range(0, len(column), RECORDS_TOGETHER):
            column[first : first + RECORDS_TOGETHER] = self.records(first, first + RECORDS_TOGETHER)[name]
            self._events.release()
        return column

    @staticmethod
    def split(entries: np.ndarray, parts: Mapping[str, slice]) -> dict[str, np.ndarray]:
        """Return the entries of each signal, an array of its own, from the entries of all.

        Args:
            entries: The entries of all signals in every cycle, shape (cycles, size).
            parts: The slice of each signal among the entries, by its name.
        """
        return {name: np.ascontiguousarray(entries[:, part]) for name, part in parts.items()}


class _ClockJumps:
    """Finds the jumps of the time of day against the loop's clock, from part to part of a log.

    A delayed cycle is recorded late once; a jump persists in the cycles after it.
    """

    def __init__(self) -> None:
        self._indices: list[int] = []
        # The last cycles so far, which have neighbours in the next part, and the index of the first of them.
        self._offset, self._now, self._first = np.empty(0), np.empty(0), 0

    def add(self, offset: np.ndarray, now: np.ndarray) -> None:
        """Add the time of day less the clock's time, and the latter, of the next cycles, in seconds."""
        self._offset, self._now = np.append(self._offset, offset), np.append(self._now, now)
        # The step into a cycle is judged by the cycle behind it, too, which must have come.
        self._look(len(self._offset) - 2)
        keep = min(3, len(self._offset))
        self._first += len(self._offset) - keep
        self._offset, self._now = self._offset[-keep:], self._now[-keep:]

    def indices(self) -> list[int]:
        """Return the indices of the cycles with a jump, when all were added."""
        self._look(len(self._offset) - 1)
        return self._indices

    def _look(self, last: int) -> None:
        """Judge the steps into the cycles up to ``last`` that were not judged yet."""
        for k in self._steps_that_jump(last):
            if not self._indices or self._indices[-1] < self._first + k:
                self._indices.append(self._first + k)

    def _steps_that_jump(self, last: int) -> list[int]:
        offset = self._offset
        if len(offset) < 2:
            return []
        step = np.diff(offset)
        ahead, behind = np.append(offset[2:], offset[-1]), np.insert(offset[:-2], 0, offset[0])
        forward = (step > CLOCK_JUMP) & (ahead - offset[:-1] > CLOCK_JUMP)
        backward = (step < -CLOCK_JUMP) & (offset[1:] - behind < -CLOCK_JUMP)
        jumps = np.flatnonzero(forward | backward | (np.diff(self._now) < 0.0)) + 1
        # Behind the first of the cycles that were kept: only then is its neighbour behind known.
        return [k for k in jumps.tolist() if k <= last and (k > 1 or self._first == 0)]


@dataclass(frozen=True, eq=False)
class ControlLog:
    """A recorded run of a control loop, as `read_log` returns it; n is the number of cycles that could be read.

    The columns (`now`, `fed`, `sent` and so on) are read from the file when they are asked for, and kept then.
    `numbers` and `times` cannot be changed.

    Attributes:
        path: Path of the file.
        header: What was recorded.
        start: State before the first recorded cycle.
        cycles: Where its cycles lie; their columns are read when they are asked for.
        changes: Changes of the target, each with the index of the cycle before whose step it happened.
        faults: Present faults, each with the index of the cycle from which on they hold; empty when all are over.
        digests: Digests of the DPS's state, each with the index of the cycle after which it was taken.
        damages: Damaged places of the file. Reading resumes at the next whole cycle.
        gaps: Cycles that are missing, lost by the recorder or damaged.
        clock_jumps: Indices of cycles whose time of day does not follow the loop's clock, or whose clock ran backwards.
        closed: Whether the recorder was closed. If not, later cycles may be missing.
        events: All events of the file.
        identity: A digest of what was recorded, which two different logs do not share.
    """

    path: Path
    header: LogHeader
    start: Snapshot
    cycles: Cycles
    changes: Sequence[tuple[int, Change]]
    faults: Sequence[tuple[int, tuple[str, ...]]]
    digests: Sequence[tuple[int, bytes]]
    damages: Sequence[Damage]
    gaps: Sequence[Gap]
    clock_jumps: Sequence[int]
    closed: bool
    events: LogEvents
    identity: str

    def __len__(self) -> int:
        return len(self.cycles.numbers)

    @property
    def numbers(self) -> np.ndarray:
        """Return the numbers of the cycles, shape (n,)."""
        return self.cycles.numbers

    @property
    def times(self) -> np.ndarray:
        """Return the times of the DPS at the ends of the cycles, in seconds, shape (n,)."""
        return self.cycles.times

    @cached_property
    def now(self) -> np.ndarray:
        """Return the times on the loop's clock, in seconds, shape (n,)."""
        return self.cycles.column("now", float)

    @cached_property
    def utimes(self) -> np.ndarray:
        """Return the times of day in microseconds since 1970, shape (n,)."""
        return self.cycles.column("utime", int)

    @cached_property
    def ok(self) -> np.ndarray:
        """Return a mask (n,) of the cycles in which the DPS's actuator commands were sent, not the fallbacks'."""
        return self.cycles.column("ok", bool)

    @cached_property
    def fed(self) -> Mapping[str, np.ndarray]:
        """Return the newest values by vector sensor signal, (n, size); NaN before the first."""
        return self.cycles.split(self.cycles.column("fed", float), self.cycles.layout.fed)

    @cached_property
    def sources(self) -> Mapping[str, np.ndarray]:
        """Return by sensor signal where a cycle had a new value, shape (n,).

        It is 0 for none, -1 for a vector, and for an abstract signal the number of the event with its message.
        """
        return _by_signal(self.header.sense, self.cycles.column("source", int))

    @cached_property
    def actuation(self) -> Mapping[str, np.ndarray]:
        """Return the actuator commands of the DPS by vector signal, (n, size); NaN where there is none."""
        return self._where("commands", COMMANDED)

    @cached_property
    def commanded(self) -> Mapping[str, np.ndarray]:
        """Return whether the DPS commanded, by actuator signal, shape (n,)."""
        return _by_signal(self.header.act, self.cycles.column("act", int) & COMMANDED != 0)

    @cached_property
    def sent(self) -> Mapping[str, np.ndarray]:
        """Return the actuator commands that were sent, after the guards, by vector signal, (n, size)."""
        return self._where("sent", SENT)

    def _where(self, name: str, flag: int) -> dict[str, np.ndarray]:
        """Return the columns of the vector actuator signals, NaN where a signal does not have the flag."""
        columns = self.cycles.split(self.cycles.column(name, float), self.cycles.layout.actuation)
        flags = _by_signal(self.header.act, self.cycles.column("act", int) & flag)
        for signal, values in columns.items():
            values[flags[signal] == 0] = np.nan
        return columns

    def fed_in(self, first: int, last: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Return `fed` and `sources` of the cycles from ``first`` to below ``last``, read from the file.

        Args:
            first: Index of the first cycle.
            last: Index behind the last cycle.
        """
        records = self.cycles.records(first, last)
        fed = self.cycles.split(records["fed"].astype(float), self.cycles.layout.fed)
        return fed, _by_signal(self.header.sense, records["source"].astype(int))

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
        """Return a text about the parts of the recorded run that the log lacks; empty if it is whole."""
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


@overload
def read_log(path: str | os.PathLike[str]) -> ControlLog: ...
@overload
def read_log(path: str | os.PathLike[str], scenario: Scenario) -> Log: ...
def read_log(path: str | os.PathLike[str], scenario: Scenario | None = None) -> ControlLog | Log:
    """Return the log in a file that a `Recorder` has written, or the signals in any LCM log.

    A file that is cut off or damaged is read, too: `ControlLog.damages` and `ControlLog.gaps` list what is missing, and
    a warning is logged. A cycle counts only if the checksum over all its events is right.

    With a scenario, the `Log` of its vector signals is returned. What a `Recorder` has written is in
    `ControlLog.signals`; a log of another program, such as lcm-logger, is read through the `Protocol` of the scenario,
    by the rules of `LcmBridge`. The times are when the logger received a message, in s since the first event. It has no
    switches and no state of the DPS. `Log.remarks` say what else is missing: signals without messages, damaged events,
    messages that were rejected.

    Args:
        path: Path of the file.
        scenario: The scenario of the machine that was recorded.

    Raises:
        OSError: The file cannot be read.
        LogError: The file is not a log of a control loop, is one of another version, or is damaged in its first two
            events; with a scenario, no message of the file has a sample of its signals.
        ProtocolError: The scenario has no protocol for its machine.
    """
    path = Path(path)
    events = LogEvents(path)
    if scenario is not None:
        return _control_log(path, events).signals if events.of_loop else read_by_protocol(events, str(path), scenario)
    return _control_log(path, events)


def _control_log(path: Path, events: LogEvents) -> ControlLog:
    header, start = _read_start(path, events)
    cycles = Cycles(events, CycleLayout(header.sense, header.act))
    damages = [Damage(*damage) for damage in (*events.damages, *cycles.damages)]
    changes, faults, digests = (
        _of_cycles(events, channel, message_type, damages, cycles)
        for channel, message_type in ((CHANGE, lcmt_vtb_change), (FAULT, lcmt_vtb_fault), (DIGEST, lcmt_vtb_digest))
    )

    def index(number: int) -> int:
        return int(np.searchsorted(cycles.numbers, number))

    log = ControlLog(
        path=path,
        header=header,
        start=start,
        cycles=cycles,
        changes=[(index(number), change) for number, change in decode_changes(changes)],
        faults=[(index(message.number), tuple(message.reasons)) for message in faults],
        digests=[(index(message.number), message.digest) for message in digests],
        damages=damages,
        gaps=_gaps(header, cycles.numbers, _last_numbers(events, damages)),
        clock_jumps=cycles.clock_jumps,
        closed=bool(len(events.places(END))),
        events=events,
        identity=_identity(events, cycles),
    )
    damages.sort()
    if damages or log.gaps or log.clock_jumps or not log.closed:
        # As text: a log record that is kept must not keep the mapped file.
        _log.warning("%s", str(log))
    return log


def _read_start(path: Path, events: LogEvents) -> tuple[LogHeader, Snapshot]:
    if not events.of_loop:
        where = f"; {events.damages[0][1]} at byte {events.damages[0][0]}" if events.damages else ""
        remedy = (
            "an LCM log of another program is read through the protocol of its machine: read_log(path, scenario)"
            if events.channels
            else NO_LCM_LOG
        )
        raise LogError(f"{path} is not a log of a control loop: it has no event on {LOG}{where}; {remedy}")
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


def _identity(events: LogEvents, cycles: Cycles) -> str:
    # The checksum of a cycle covers all its events.
    parts = *(events.data(*events.on(channel)[0][2:]) for channel in (LOG, STATE)), cycles.digest
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()


def _by_signal(signals: Sequence[LoggedSignal], entries: np.ndarray) -> dict[str, np.ndarray]:
    """Return the entry of each signal, an array of its own, from the entries of all."""
    return {signal.name: np.ascontiguousarray(entries[:, i]) for i, signal in enumerate(signals)}


def _of_cycles(
    events: LogEvents,
    channel: str,
    message_type: Any,
    damages: list[Damage],
    cycles: Cycles,
) -> list[Any]:
    """Return the messages of a channel that lie in whole cycles and name one of them."""
    places, numbers = events.places(channel), cycles.numbers
    at = np.searchsorted(cycles.ends, places[:, 3])
    places, at = places[at < len(numbers)], at[at < len(numbers)]
    within = places[places[:, 2] >= cycles.begins[at]]
    decoded = []
    for begin, message in _decoded(events, channel, message_type, damages, within):
        at = np.searchsorted(numbers, message.number)
        if at < len(numbers) and numbers[at] == message.number:
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
    gaps, last = [], header.first_cycle - 1
    parts = [numbers[k : k + RECORDS_TOGETHER] for k in range(0, len(numbers), RECORDS_TOGETHER)]
    for part in (*parts, np.array(ends, int) + 1):
        present = np.concatenate([[last], part])
        gaps += [Gap(int(present[i]) + 1, int(present[i + 1]) - 1) for i in np.flatnonzero(np.diff(present) > 1)]
        last = int(present[-1])
    return gaps
