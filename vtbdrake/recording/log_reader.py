"""Reads what a recorder wrote, as far as it is undamaged."""

from __future__ import annotations

import logging
import os
import struct
import zlib
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vtbdrake.lcm.wire import MalformedError, decode
from vtbdrake.recording.changes import changes_of, value_of
from vtbdrake.recording.control_log import ControlLog, Damage, Gap
from vtbdrake.recording.lcm_types.lcmt_vtb_change import lcmt_vtb_change
from vtbdrake.recording.lcm_types.lcmt_vtb_digest import lcmt_vtb_digest
from vtbdrake.recording.lcm_types.lcmt_vtb_end import lcmt_vtb_end
from vtbdrake.recording.lcm_types.lcmt_vtb_fault import lcmt_vtb_fault
from vtbdrake.recording.lcm_types.lcmt_vtb_log import lcmt_vtb_log
from vtbdrake.recording.lcm_types.lcmt_vtb_state import lcmt_vtb_state
from vtbdrake.recording.log_events import LogEvents
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
)
from vtbdrake.recording.log_header import LogHeader
from vtbdrake.recording.scan import whole_cycles
from vtbdrake.state import Snapshot

_log = logging.getLogger(__name__)

JUMP = 0.1
"""Seconds by which the time of day may change against the loop's clock from one cycle to the next."""


def read_log(path: str | os.PathLike[str]) -> ControlLog:
    """The log in a file that a `Recorder` wrote.

    A file that is cut off or damaged is read all the same: `ControlLog.damages` and `ControlLog.gaps` say what is not
    there, and a warning is logged. A cycle counts only if the checksum over all its events is right.

    Raises:
        OSError: the file cannot be read.
        LogError: it is no log of a control loop, of another version, or damaged in its first two events.
    """
    path = Path(path)
    events = LogEvents(path)
    header, start = _begin(path, events)
    layout = CycleLayout(header.sense, header.act)
    damages = [Damage(*damage) for damage in events.damages]
    records, frames = _cycles(events, layout, damages)
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
        commands=_where(records["commands"], layout, header, act & COMMANDED),
        commanded={signal.name: act[:, i] & COMMANDED != 0 for i, signal in enumerate(header.act)},
        sent=_where(records["sent"], layout, header, act & SENT),
        changes=[(index[number], change) for number, change in changes_of(changes)],
        faults=[(index[message.number], tuple(message.reasons)) for message in faults],
        digests=[(index[message.number], message.digest) for message in digests],
        damages=damages,
        gaps=_gaps(header, records["number"], _last(events, damages)),
        clock_jumps=_jumps(records),
        closed=bool(events.on(END)),
        events=events,
    )
    damages.sort()
    if damages or log.gaps or log.clock_jumps or not log.closed:
        # As text: whoever keeps it must not keep the file.
        _log.warning("%s", str(log))
    return log


def _begin(path: Path, events: LogEvents) -> tuple[LogHeader, Snapshot]:
    if not events.on(LOG):
        where = f"; {events.damages[0][1]} at byte {events.damages[0][0]}" if events.damages else ""
        raise LogError(f"{path} is no log of a control loop: it has no event on {LOG}{where}")
    try:
        told = decode(lcmt_vtb_log, events.data(*events.on(LOG)[0][2:]))
        if zlib.crc32(told.header.encode()) != told.crc & 0xFFFFFFFF:
            raise LogError(f"{path} cannot be used: its header is damaged")
        # First of all: another version may have another state, too.
        header = LogHeader.from_json(told.header)
        if not events.on(STATE):
            raise LogError(f"{path} cannot be used: the state before the first cycle is not there")
        state = decode(lcmt_vtb_state, events.data(*events.on(STATE)[0][2:]))
        if zlib.crc32(state.snapshot) != state.crc & 0xFFFFFFFF:
            raise LogError(f"{path} cannot be used: the state before the first cycle is damaged")
        return header, Snapshot.load(state.snapshot)
    except LogError:
        raise
    except (ValueError, TypeError, LookupError, struct.error) as error:
        raise LogError(f"{path} cannot be used: its beginning is damaged ({error})") from error


def _cycles(events: LogEvents, layout: CycleLayout, damages: list[Damage]) -> tuple[np.ndarray, np.ndarray]:
    """The cycles that are whole, in order, and which bytes of the file belong to each; see `whole_cycles`."""
    records, frames, wrong = whole_cycles(events.content, events.places(CYCLE), layout.dtype)
    damages += [Damage(*damage) for damage in wrong]
    if not layout.fits(records).all():
        raise LogError("the log's cycles do not have the signals that its header tells of")
    return records, frames


def _columns(entries: np.ndarray, parts: dict[str, slice]) -> dict[str, np.ndarray]:
    native = entries.astype(float)
    return {name: np.ascontiguousarray(native[:, part]) for name, part in parts.items()}


def _where(entries: np.ndarray, layout: CycleLayout, header: LogHeader, flags: np.ndarray) -> dict[str, np.ndarray]:
    """The columns of actuator signals; NaN where a signal has no value."""
    columns = _columns(entries, layout.commands)
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
    """The messages of a channel that belong to the cycles that count: of another cycle, nothing does."""
    found = []
    for begin, message in _decoded(events, channel, message_type, damages, _within(frames, events.places(channel))):
        if message.number in numbers:
            found.append(message)
        else:
            damages.append(Damage(begin, f"an event on {channel} is of cycle {message.number}, which is not there"))
    return found


def _decoded(
    events: LogEvents, channel: str, message_type: Any, damages: list[Damage], places: np.ndarray
) -> Iterator[tuple[int, Any]]:
    for _, _, begin, end in places.tolist():
        try:
            message = decode(message_type, events.data(begin, end))
            if message_type is lcmt_vtb_change:
                value_of(message)
        except (MalformedError, struct.error, ValueError) as error:
            damages.append(Damage(begin, f"an event on {channel} cannot be read ({error})"))
        else:
            yield begin, message


def _last(events: LogEvents, damages: list[Damage]) -> list[int]:
    """The number of the last cycle that was recorded or lost, where the end of the log tells it."""
    ends = [message for _, message in _decoded(events, END, lcmt_vtb_end, damages, events.places(END))]
    whole = [end.number for end in ends if zlib.crc32(end.encode()[:-4]) == end.crc & 0xFFFFFFFF]
    if len(whole) < len(ends):
        damages.append(Damage(events.on(END)[-1][2], "the checksum of the log's end is wrong"))
    return whole


def _within(frames: np.ndarray, places: np.ndarray) -> np.ndarray:
    i = np.searchsorted(frames[:, 1], places[:, 3])
    begins = np.append(frames[:, 0], np.iinfo(np.int64).max)
    return places[places[:, 2] >= begins[i]]


def _gaps(header: LogHeader, numbers: np.ndarray, ends: Sequence[int]) -> list[Gap]:
    known = np.concatenate([[header.first_cycle - 1], numbers, np.array(ends, int) + 1])
    return [Gap(int(known[i]) + 1, int(known[i + 1]) - 1) for i in np.flatnonzero(np.diff(known) > 1)]


def _jumps(records: np.ndarray) -> list[int]:
    """A cycle that was held up comes to its entry late; a jump goes on in the cycles that follow."""
    if len(records) < 2:
        return []
    offset = 1e-6 * records["utime"] - records["now"]
    step = np.diff(offset)
    ahead, behind = np.append(offset[2:], offset[-1]), np.insert(offset[:-2], 0, offset[0])
    forward = (step > JUMP) & (ahead - offset[:-1] > JUMP)
    backward = (step < -JUMP) & (offset[1:] - behind < -JUMP)
    return [int(i) + 1 for i in np.flatnonzero(forward | backward | (np.diff(records["now"]) < 0.0))]
