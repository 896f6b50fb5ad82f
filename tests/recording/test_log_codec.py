"""The compiled search for events and cycles in damaged files, compared with plain Python."""

from __future__ import annotations

import random
import zlib
from collections.abc import Iterator

import numpy as np
import pytest

from vtbdrake.lcm.maps import LONGEST_CHANNEL_NAME
from vtbdrake.recording.log_codec import find_events, whole_cycles
from vtbdrake.recording.log_format import CYCLE, EVENT, SYNC, CycleLayout, LoggedSignal, event

SYNC_WORD = SYNC.to_bytes(4, "big")
LAYOUT = CycleLayout([LoggedSignal("position", 2, "m")], [LoggedSignal("force", 1, "N")])
EXTREMES = (0, 1, 3, 27, 28, 63, 64, 2**16, 2**31 - 1, 2**31, 2**32 - 29, 2**32 - 1)
"""Lengths where a sum or a sign might go wrong."""

Event = tuple[bytes, int, int, int, int]


def events_of(content: bytes) -> tuple[list[Event], list[tuple[int, str]]]:
    """Return channel, number, time, begin and end of all events, and the damages."""
    events: list[Event] = []
    damages: list[tuple[int, str]] = []
    at = 0
    while at < len(content):
        following = content.find(SYNC_WORD, at + 1)
        told = event_at(content, at)
        if told is not None and told[-1] < len(content) and not content.startswith(SYNC_WORD, told[-1]):
            told = None if at < following < told[-1] else told
        if told is None:
            begins = len(content) - at < EVENT.size or content.startswith(SYNC_WORD, at)
            torn = following == -1 and begins
            damages.append((at, "the file ends in the middle of an event" if torn else "no event"))
            at = len(content) if following == -1 else following
            continue
        events.append(told)
        at = told[-1]
    return events, damages


def event_at(content: bytes, at: int) -> Event | None:
    if len(content) - at < EVENT.size:
        return None
    sync, number, utime, name, length = EVENT.unpack_from(content, at)
    begin = at + EVENT.size + name
    if sync != SYNC or name not in range(1, LONGEST_CHANNEL_NAME + 1) or begin + length > len(content):
        return None
    return content[at + EVENT.size : begin], number, utime, begin, begin + length


def cycles_of(content: bytes, places: list[tuple[int, int]]) -> tuple[list[bytes], list[tuple[int, int]], list[int]]:
    """Return bytes and frames of the whole cycles, and where the others begin."""
    cycles: list[bytes] = []
    frames: list[tuple[int, int]] = []
    wrong = []
    newest = -1
    for begin, end in places:
        data = content[begin:end]
        if len(data) == LAYOUT.dtype.itemsize:
            [record] = np.frombuffer(data, LAYOUT.dtype)
            size, number = int(record["size"]), int(record["number"])
            frame = content[end - size : end - 4] if LAYOUT.dtype.itemsize < size <= end else None
            if frame is not None and zlib.crc32(frame) == record["crc"] and number > newest:
                newest = number
                cycles.append(data)
                frames.append((end - size, end))
                continue
        wrong.append(begin)
    return cycles, frames, wrong


def log(chosen: random.Random) -> bytes:
    """Return a log with messages and cycles; some messages look like a part of a log."""
    content = b""
    for number in range(chosen.randrange(1, 12)):
        frame = b""
        for _ in range(chosen.randrange(3)):
            data = chosen.randbytes(chosen.randrange(30)) + SYNC_WORD * (chosen.random() < 0.2)
            if chosen.random() < 0.1:
                data += event(chosen.randrange(9), 7, b"INNER", b"inner")
            channel = chosen.choice([b"A", b"STATUS", b"\xff\x00", b"N" * LONGEST_CHANNEL_NAME])
            frame += event(chosen.getrandbits(62), -chosen.getrandbits(40), channel, data)
        record = LAYOUT.blank()
        record["number"] = number - chosen.choice((0, 0, 0, 1, 2))
        frame += event(number, number, CYCLE.encode(), record.tobytes())
        record["size"] = len(frame)
        frame = frame[: -LAYOUT.dtype.itemsize] + record.tobytes()
        content += frame[:-4] + zlib.crc32(frame[:-4]).to_bytes(4, "big")
    return content


def damaged(content: bytes, chosen: random.Random) -> bytes:
    data = bytearray(content)
    for _ in range(chosen.randrange(4)):
        at = chosen.randrange(len(data) + 1)
        end = min(at + chosen.randrange(60), len(data))
        starts = [i for i in range(len(data) - EVENT.size) if data.startswith(SYNC_WORD, i)]
        match chosen.randrange(6):
            case 0 if at < len(data):
                data[at] ^= 1 << chosen.randrange(8)
            case 1:
                del data[at:end]
            case 2:
                data[at:at] = data[at:end]
            case 3:
                data[at:at] = SYNC_WORD
            case 4:
                del data[at:]
            case 5 if starts:
                field = chosen.choice(starts) + chosen.choice((20, 24))
                data[field : field + 4] = chosen.choice(EXTREMES).to_bytes(4, "big")
    return bytes(data)


def files() -> Iterator[bytes]:
    chosen = random.Random(0)
    yield from (damaged(log(chosen), chosen) for _ in range(1500))
    yield from (chosen.randbytes(chosen.randrange(40)) for _ in range(100))


def found_in(content: bytes) -> tuple[dict[bytes, np.ndarray], list[tuple[int, str]]]:
    """Return the events of each channel, and the damages; two events are kept together, so that parts are joined."""
    parts: dict[bytes, list[np.ndarray]] = {}
    damages = find_events(content, lambda channel, places: parts.setdefault(channel, []).append(places), 2)
    return {channel: np.concatenate(places) for channel, places in parts.items()}, damages


def test_find_events_matches_plain_search() -> None:
    damages = 0
    for content in files():
        places, wrong = found_in(content)
        expected, expected_wrong = events_of(content)
        found = [(channel, *place) for channel, rows in places.items() for place in rows.tolist()]
        assert sorted(found, key=lambda event: event[-1]) == expected
        assert wrong == expected_wrong
        damages += len(wrong)
    assert damages > 500


def test_whole_cycles_matches_plain_search() -> None:
    good = bad = 0
    for content in files():
        places = found_in(content)[0].get(CYCLE.encode(), np.empty((0, 4), np.int64))
        records, frames, wrong = whole_cycles(content, places, LAYOUT.dtype)
        cycles, expected, expected_wrong = cycles_of(content, [(begin, end) for _, _, begin, end in places.tolist()])
        assert [record.tobytes() for record in records] == cycles
        assert [tuple(frame) for frame in frames.tolist()] == expected
        assert [offset for offset, _ in wrong] == expected_wrong
        good, bad = good + len(cycles), bad + len(wrong)
    assert good > 1000 and bad > 500


@pytest.mark.parametrize("size", [-(2**31), -1, 0, 4, LAYOUT.dtype.itemsize, 2**31 - 1])
def test_frame_beyond_file_is_wrong_checksum(size: int) -> None:
    record = LAYOUT.blank()
    record["number"], record["size"] = 5, size
    content = event(0, 0, CYCLE.encode(), record.tobytes())
    places = found_in(content)[0][CYCLE.encode()]
    records, frames, wrong = whole_cycles(content, places, LAYOUT.dtype)
    assert not len(records) and not len(frames)
    assert wrong == [(places[0, 2], "the checksum of cycle 5 is wrong")]


@pytest.mark.parametrize(("begin", "end"), [(-1, 3), (2, 1), (3, 11), (2**62, 2**62 + 1)])
def test_place_outside_file_is_rejected(begin: int, end: int) -> None:
    with pytest.raises(IndexError, match=f"bytes {begin} to {end} are outside the file, which has 10"):
        whole_cycles(bytes(10), np.array([[0, 0, begin, end]]), LAYOUT.dtype)


@pytest.mark.parametrize("columns", [0, 1, 3, 5])
def test_place_must_have_four_numbers(columns: int) -> None:
    with pytest.raises(ValueError, match=f"not {columns} numbers"):
        whole_cycles(bytes(10), np.zeros((1, columns), np.int64), LAYOUT.dtype)
