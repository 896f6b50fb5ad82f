"""Reading of whole and of damaged logs."""

from __future__ import annotations

import gc
import json
import os
import random
import signal
import struct
import subprocess
import sys
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest

from tests.control.scripted import PERIOD
from tests.recording.servo import Servo
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.stepping import Change
from vtbdrake.lcm.maps import decode
from vtbdrake.recording.lcm_types.lcmt_vtb_cycle import lcmt_vtb_cycle
from vtbdrake.recording.lcm_types.lcmt_vtb_log import lcmt_vtb_log
from vtbdrake.recording.log_events import LogEvents
from vtbdrake.recording.log_format import (
    CHANGE,
    CYCLE,
    DIGEST,
    END,
    EVENT,
    FAULT,
    LOG,
    STATE,
    SYNC,
    VERSION,
    CycleLayout,
    LogError,
    encode_changes,
    event,
)
from vtbdrake.recording.log_reader import ControlLog, read_log
from vtbdrake.recording.recorder import Recorder
from vtbdrake.recording.replay import IDENTICAL, replay

ROOT = Path(__file__).resolve().parents[2]
CYCLES = 20
OF_A_RECORDER = (LOG, STATE, CYCLE, CHANGE, FAULT, DIGEST, END)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A log with changes, faults and digests."""
    path = tmp_path_factory.mktemp("log") / "run.lcm"
    servo = Servo()
    with Recorder(servo.runtime, path, digest_period=5 * PERIOD):
        servo.runtime.run(cycles=CYCLES // 2)
        servo.runtime.write({"u.target": [0.1, 0.2], "dps.trouble": 1.0})
        servo.runtime.run(cycles=CYCLES // 2)
    return path.read_bytes()


@pytest.fixture
def reference(whole: bytes, tmp_path: Path) -> ControlLog:
    (tmp_path / "whole.lcm").write_bytes(whole)
    return read_log(tmp_path / "whole.lcm")


def ends(log: ControlLog) -> list[int]:
    """Return the ends of the cycles' events in the file."""
    return [end for *_, end in log.events.on("VTB_CYCLE")]


def read(tmp_path: Path, content: bytes) -> ControlLog:
    path = tmp_path / "damaged.lcm"
    path.write_bytes(content)
    return read_log(path)


def assert_same(log: ControlLog, reference: ControlLog, rows: list[int]) -> None:
    """Check that the log has these rows of the reference and nothing else."""
    assert log.numbers.tolist() == reference.numbers[rows].tolist()
    for name in ("times", "now", "utimes", "ok"):
        assert np.array_equal(getattr(log, name), getattr(reference, name)[rows])
    for name in ("fed", "actuation", "sent"):
        for signal_name, values in getattr(log, name).items():
            assert np.array_equal(values, getattr(reference, name)[signal_name][rows], equal_nan=True)


def test_cycle_matches_its_lcm_type(reference: ControlLog) -> None:
    for i, message in enumerate(reference.events.on("VTB_CYCLE")):
        cycle = lcmt_vtb_cycle.decode(reference.events.data(*message[2:]))
        assert (cycle.number, cycle.time, cycle.now, cycle.ok, cycle.utime) == (
            reference.numbers[i], reference.times[i], reference.now[i], reference.ok[i], reference.utimes[i],
        )  # fmt: skip
        assert np.array_equal(cycle.fed, [*reference.fed["position"][i], *reference.fed["speed"][i]])
        assert np.array_equal(cycle.sent, reference.sent["velocity"][i])
        assert cycle.source[1] == reference.sources["speed"][i]


def test_truncated_log_is_read_up_to_its_end(whole: bytes, reference: ControlLog, tmp_path: Path) -> None:
    bounds = ends(reference)
    begin = reference.events.on("VTB_STATE")[0][3]
    cuts = sorted({*random.Random(0).sample(range(begin, len(whole)), 60), *bounds, *(b - 1 for b in bounds)})
    for cut in cuts:
        log = read(tmp_path, whole[:cut])
        complete = sum(bound <= cut for bound in bounds)
        assert_same(log, reference, list(range(complete)))
        assert not log.closed
        torn = cut not in [end for channel in OF_A_RECORDER for *_, end in log.events.on(channel)]
        assert [damage.description for damage in log.damages] == ["the file ends in the middle of an event"] * torn
        assert not torn or log.damages[0].offset < cut


def test_damaged_byte_costs_one_cycle(
    whole: bytes, reference: ControlLog, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bounds = ends(reference)
    begin = reference.events.on("VTB_STATE")[0][3]
    chosen = random.Random(1)
    for place in chosen.sample(range(begin, bounds[-1]), 60):
        content = bytearray(whole)
        content[place] ^= 1 << chosen.randrange(8)
        log = read(tmp_path, bytes(content))
        hit = next(i for i, bound in enumerate(bounds) if place < bound)
        assert_same(log, reference, [i for i in range(CYCLES) if i != hit])
        number = reference.numbers[hit]
        assert log.gaps == [(number, number)]
        assert f"missing: cycles {number} to {number}" in caplog.text
        caplog.clear()


def test_reading_resumes_behind_a_hole(whole: bytes, reference: ControlLog, tmp_path: Path) -> None:
    bounds = ends(reference)
    log = read(tmp_path, whole[: bounds[3] + 50] + whole[bounds[6] + 70 :])
    assert_same(log, reference, [0, 1, 2, 3, *range(8, CYCLES)])
    assert log.gaps == [(reference.numbers[4], reference.numbers[7])]
    assert log.damages[0].offset == bounds[3] and log.closed


def test_replay_ends_at_a_gap(whole: bytes, reference: ControlLog, tmp_path: Path) -> None:
    bounds = ends(reference)
    report = replay(read(tmp_path, whole[: bounds[5]] + whole[bounds[6] :]))
    assert report.outcome == "identical" and not report.identical
    assert report.cycles == 6 and "the log lacks cycles 7 to 7" in report.ended


def test_log_that_was_not_closed_is_reported(
    whole: bytes, reference: ControlLog, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    log = read(tmp_path, whole[: ends(reference)[9]])
    assert not log.closed and not log.damages and len(log) == 10
    assert "the recorder was not closed" in caplog.text
    report = replay(log)
    assert report.outcome == IDENTICAL and "the recorder was not closed" in str(report) and not report.identical


def test_cycles_lost_at_the_end_are_a_gap(whole: bytes, reference: ControlLog, tmp_path: Path) -> None:
    bounds = ends(reference)
    log = read(tmp_path, whole[: bounds[14]] + whole[bounds[-1] :])
    assert log.closed and log.gaps == [(reference.numbers[15], reference.numbers[-1])]


def test_repeated_cycle_counts_once(whole: bytes, reference: ControlLog, tmp_path: Path) -> None:
    bounds = ends(reference)
    log = read(tmp_path, whole[: bounds[5]] + whole[bounds[2] :])
    assert_same(log, reference, list(range(CYCLES)))
    assert [damage.description for damage in log.damages] == [f"cycle {n} follows cycle 6" for n in (4, 5, 6)]


def test_events_of_a_repeated_cycle_count_once(whole: bytes, reference: ControlLog, tmp_path: Path) -> None:
    bounds = ends(reference)
    log = read(tmp_path, whole[: bounds[13]] + whole[bounds[7] :])
    assert [i for i, _ in log.changes] == [i for i, _ in reference.changes] == [0, 10]
    assert log.faults == reference.faults and log.digests == reference.digests
    report = replay(log)
    assert len(log.damages) == 6 and report.outcome == IDENTICAL
    assert report.ended == f"the log is damaged {log.damages[0]}" and not report.identical


def test_damaged_end_is_ignored(whole: bytes, reference: ControlLog, tmp_path: Path) -> None:
    [(_, _, begin, end)] = reference.events.on("VTB_END")
    number = begin + 16
    log = read(tmp_path, whole[:number] + (CYCLES + 1000).to_bytes(8, "big") + whole[number + 8 :])
    assert_same(log, reference, list(range(CYCLES)))
    assert not log.gaps
    assert [(damage.offset, damage.description) for damage in log.damages] == [
        (begin, "the checksum of the log's end is wrong")
    ]


def test_change_of_a_damaged_cycle_is_dropped(whole: bytes, reference: ControlLog, tmp_path: Path) -> None:
    content = bytearray(whole)
    for _, _, begin, _ in reference.events.on("VTB_CHANGE")[-2:]:  # of cycle 11; the number follows the time
        content[begin + 16 : begin + 24] = (5).to_bytes(8, "big")
    log = read(tmp_path, bytes(content))
    assert log.gaps == [(11, 11)] and [i for i, _ in log.changes] == [0]


def shifted(content: bytes, reference: ControlLog, first: int, seconds: float) -> bytes:
    """Return the log with other times of day from a cycle on, as if the clock had been set, and right checksums."""
    data = bytearray(content)
    begin = 0
    for i, (_, _, start, end) in enumerate(reference.events.on("VTB_CYCLE")):
        if i >= first:
            utime = int(reference.utimes[i] + 1e6 * seconds)
            data[start + 8 : start + 16] = utime.to_bytes(8, "big")
            size = int.from_bytes(data[end - 8 : end - 4], "big")
            begin = end - size
            data[end - 4 : end] = zlib.crc32(data[begin : end - 4]).to_bytes(4, "big")
    return bytes(data)


@pytest.mark.parametrize("seconds", [3600.0, -3600.0])
def test_clock_jump_is_reported_and_harmless(
    whole: bytes, reference: ControlLog, tmp_path: Path, seconds: float, caplog: pytest.LogCaptureFixture
) -> None:
    log = read(tmp_path, shifted(whole, reference, 7, seconds))
    assert list(log.clock_jumps) == [7] and not log.damages and not log.gaps
    assert f"the clock jumps at cycle {reference.numbers[7]}" in caplog.text
    assert replay(log).identical


@pytest.mark.parametrize("first", [6, 7, 8, CYCLES - 1])
def test_log_is_read_part_by_part(
    whole: bytes, reference: ControlLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first: int
) -> None:
    monkeypatch.setattr("vtbdrake.recording.log_reader.RECORDS_TOGETHER", 3)
    log = read(tmp_path, shifted(whole, reference, first, 3600.0))
    assert list(log.clock_jumps) == [first] and not log.damages and not log.gaps
    fed, sources = log.fed_in(first - 2, first + 1)
    for name, values in reference.fed.items():
        assert np.array_equal(fed[name], values[first - 2 : first + 1], equal_nan=True)
        assert np.array_equal(sources[name], reference.sources[name][first - 2 : first + 1])
    log = read(tmp_path, whole)
    assert_same(log, reference, list(range(CYCLES)))


def test_opening_a_log_takes_less_memory_than_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vtbdrake.recording.log_reader.RECORDS_TOGETHER", 128)
    servo = Servo()
    with Recorder(servo.runtime, tmp_path / "run.lcm"):
        servo.runtime.run(cycles=1500)
    read_log(tmp_path / "run.lcm")  # What is imported and kept by it does not count.
    tracemalloc.start()
    log = read_log(tmp_path / "run.lcm")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # A number, a time and some places for each cycle, and one part of the log; its columns alone are as large as the
    # file, and are read when they are asked for.
    assert len(log) == 1500 and peak < 0.8 * len(log.events.content)


def test_memory_of_an_open_log_does_not_grow_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("log_reader.RECORDS_TOGETHER", "log_events.ROWS_TOGETHER", "disk_array.ROWS_TOGETHER"):
        monkeypatch.setattr(f"vtbdrake.recording.{name}", 128)
    held, most = [], []
    for k, cycles in enumerate((500, 500, 2000)):  # What is imported and kept by the first does not count.
        servo, path = Servo(), tmp_path / f"{k}.lcm"
        with Recorder(servo.runtime, path, digest_period=100.0):
            servo.runtime.run(cycles=cycles)
        gc.collect()
        tracemalloc.start()
        log = read_log(path)
        for memory, value in zip((held, most), tracemalloc.get_traced_memory(), strict=True):
            memory.append(value)
        tracemalloc.stop()
        assert log.numbers.tolist() == list(range(1, cycles + 1)) and len(log.events.on(CYCLE)) == cycles
    assert len(list(tmp_path.iterdir())) == 3  # The index has no name.
    # Less than half a number for each of 1500 more cycles.
    assert abs(held[2] - held[1]) < 4 * 1500 and abs(most[2] - most[1]) < 4 * 1500


def test_delayed_cycle_is_no_clock_jump(tmp_path: Path) -> None:
    servo = Servo()
    clock = servo.runtime.clock
    assert isinstance(clock, SimulatedClock)
    servo.runtime.watch(lambda cycle: clock.advance(0.3) if cycle.number == 5 else None)
    with Recorder(servo.runtime, tmp_path / "run.lcm"):
        servo.runtime.run(cycles=CYCLES)
    log = read_log(tmp_path / "run.lcm")
    assert np.diff(log.utimes).max() > 0.2e6 and not log.clock_jumps


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 something else", bytes(5000)], ids=["empty", "short", "zeros"])
def test_file_that_is_not_a_log_is_rejected(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(LogError, match="is not a log of a control loop: it has no event on VTB_LOG"):
        read(tmp_path, content)


def test_log_of_other_software_is_rejected(tmp_path: Path) -> None:
    event = EVENT.pack(SYNC, 0, 1, 4, 3) + b"POSEabc"
    with pytest.raises(LogError, match="no event on VTB_LOG"):
        read(tmp_path, 5 * event)


def test_damaged_beginning_is_rejected(whole: bytes, reference: ControlLog, tmp_path: Path) -> None:
    for channel in ("VTB_LOG", "VTB_STATE"):
        _, _, begin, end = reference.events.on(channel)[0]
        for place in random.Random(2).sample(range(begin - EVENT.size - len(channel), end), 60):
            content = bytearray(whole)
            content[place] ^= 0x04
            try:
                log = read(tmp_path, bytes(content))
            except LogError as error:
                assert "cannot be used" in str(error) or "no event on VTB_LOG" in str(error)
            else:
                # In the event's number or time, or the zero after the header's text.
                assert place < begin + 16 or (channel, place) == ("VTB_LOG", end - 5)
                assert log.header == reference.header
                assert log.start.to_bytes() == reference.start.to_bytes()


def test_log_of_another_version_is_rejected(whole: bytes, reference: ControlLog, tmp_path: Path) -> None:
    _, _, begin, end = reference.events.on("VTB_LOG")[0]
    content = bytearray(whole)
    at = whole.index(b'"version": %d' % VERSION, begin)
    content[at + 11 : at + 12] = b"7"
    text = content[begin + 20 : end - 5]
    content[end - 4 : end] = zlib.crc32(text).to_bytes(4, "big")
    with pytest.raises(LogError, match=f"the log has the format 7, this version of vtbdrake reads {VERSION}"):
        read(tmp_path, bytes(content))


def test_events_inside_a_wrong_length_are_found(tmp_path: Path) -> None:
    def event(number: int, length: int) -> bytes:
        return EVENT.pack(SYNC, number, 5, 1, length) + b"A" + bytes(20)

    path = tmp_path / "events"
    path.write_bytes(event(0, 20) + event(1, 60) + event(2, 20) + event(3, 20))
    events = LogEvents(path)
    assert [number for number, *_ in events.on("A")] == [0, 2, 3]
    assert events.damages == [(49, "no event")]


KILLED = """
import os, signal, sys
from pathlib import Path
from tests.recording.servo import Servo
from vtbdrake.recording.recorder import Recorder

servo = Servo()
recorder = Recorder(servo.runtime, Path(sys.argv[1]))
servo.runtime.run(cycles=500)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_killed_loop_leaves_its_recording(tmp_path: Path) -> None:
    """The worker process notices it and writes what has arrived."""
    path = tmp_path / "run.lcm"
    done = subprocess.run([sys.executable, "-c", KILLED, path], cwd=ROOT, capture_output=True, timeout=120)
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()
    # The worker process holds the other end of this pipe, too: it ends when both processes have ended.
    log = read_log(path)
    assert not log.closed and not log.gaps and not log.damages
    assert len(log) == 500 and os.path.getsize(path) == len(log.events.content)
    assert replay(log).outcome == IDENTICAL


# -- impossible logs whose checksums are right


def with_header(whole: bytes, reference: ControlLog, **fields: object) -> bytes:
    """Return the log with other values in its header."""
    _, utime, begin, end = reference.events.on("VTB_LOG")[0]
    message = decode(lcmt_vtb_log, whole[begin:end])
    message.header = json.dumps({**json.loads(message.header), **fields})
    message.crc = signed_crc(message.header.encode())
    return event(0, utime, b"VTB_LOG", message.encode()) + whole[end:]


def signed_crc(data: bytes) -> int:
    return struct.unpack(">i", zlib.crc32(data).to_bytes(4, "big"))[0]


@pytest.mark.parametrize(
    "fields",
    [
        {"sense": [["position", 10**12, "m"]]},
        {"sense": [["position", -1, "m"]]},
        {"sense": [["position", "2", "m"]]},
        {"sense": [["position", 1 << 20, "m"], ["speed", 1, "m"]]},
        {"sense": "abc"},
        {"sense": 3},
        {"sense": [[1, 2]]},
        {"act": None},
        {"period": 0.0},
        {"period": "fast"},
        {"period": float("nan")},
        {"start_time": float("inf")},
        {"steps": -1},
        {"steps": 10**30},
        {"first_cycle": True},
        {"first_cycle": 10**30},
        {"target": "elsewhere"},
        {"record": [1]},
        {"record": None},
        {"scenario": 7},
        {"positions": {"sense": 3}},
        {"versions": "mine"},
        {"unknown": 1},
    ],
)
def test_impossible_header_is_rejected(
    whole: bytes, reference: ControlLog, tmp_path: Path, fields: dict[str, object]
) -> None:
    assert read(tmp_path, with_header(whole, reference)).numbers.tolist() == reference.numbers.tolist()
    with pytest.raises(LogError, match="the log's header cannot be read"):
        read(tmp_path, with_header(whole, reference, **fields))


def test_memory_is_limited_by_the_file_size(whole: bytes, reference: ControlLog, tmp_path: Path) -> None:
    """The header describes cycles of 8 MiB; the file has 1,000 cycles of one byte."""
    content = with_header(whole, reference, sense=[["position", 1 << 20, "m"]])
    path = tmp_path / "large.lcm"
    path.write_bytes(content + b"".join(event(i, 0, b"VTB_CYCLE", b"x") for i in range(1000)))
    code = """
import resource, sys
from vtbdrake.recording.log_reader import read_log
limit = 4 << 30
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
log = read_log(sys.argv[1])
print(len(log), len(log.damages))
"""
    done = subprocess.run([sys.executable, "-c", code, path], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.split() == ["0", str(1000 + CYCLES)], done.stderr[-2000:]
    assert len(done.stderr) < 10_000


def framed(number: int, *messages: tuple[str, bytes], reference: ControlLog, whole: bytes) -> bytes:
    """Return a whole cycle with these messages before it, as the recorder writes it."""
    _, _, begin, end = reference.events.on("VTB_CYCLE")[-1]
    before = b"".join(event(0, 0, channel.encode(), data) for channel, data in messages)
    layout = CycleLayout(reference.header.sense, reference.header.act)
    record = np.frombuffer(whole[begin:end], layout.dtype).copy()
    head = EVENT.pack(SYNC, 0, 0, len("VTB_CYCLE"), layout.dtype.itemsize) + b"VTB_CYCLE"
    record["number"] = number
    record["size"] = len(before) + len(head) + layout.dtype.itemsize
    data = before + head + record.tobytes()
    return data[:-4] + zlib.crc32(data[:-4]).to_bytes(4, "big")


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"dtype": "O"}, "array of type 'O'"),
        ({"dtype": "nonsense"}, "array of type 'nonsense'"),
        ({"dtype": "(1000000,)f8"}, "array of type"),
        ({"dtype": "<U0"}, "itemsize"),
        ({"shape": (-1,)}, "shape"),
        ({"shape": (3,)}, "cannot reshape"),
        ({"shape": ()}, "cannot reshape"),
        ({"data": b"123", "size": 3}, "buffer size"),
        ({"number": 1000}, "is of cycle 1000, which is missing"),
        ({"number": -(1 << 63)}, "which is missing"),
    ],
)
def test_impossible_change_is_damage(
    whole: bytes, reference: ControlLog, tmp_path: Path, fields: dict[str, object], told: str
) -> None:
    [good] = encode_changes([Change("write", {"u.target": np.array([1.0, 2.0])})], 100, 0)
    for name, value in fields.items():
        setattr(good, name, value)
    good.ndim = len(good.shape)
    log = read(tmp_path, whole + framed(100, ("VTB_CHANGE", good.encode()), reference=reference, whole=whole))
    assert log.numbers[-1] == 100
    [damage] = log.damages
    assert told in damage.description
    assert all(index < len(log) - 1 for index, _ in log.changes)


def test_many_damages_are_summarized(
    whole: bytes, reference: ControlLog, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    log = read(tmp_path, whole + SYNC.to_bytes(4, "big") * 50_000)
    assert len(log) == CYCLES and len(log.damages) == 1001
    assert "the last of 49000 more" in str(log.damages[-1])
    assert len(caplog.records[-1].getMessage()) < 5000


def test_too_many_channels_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="more than 10000 channels"):
        read(tmp_path, b"".join(event(i, 0, b"CHANNEL_%d" % i, b"") for i in range(10_001)))


def test_pipe_and_folder_are_rejected(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        with pytest.raises(LogError, match="not a file"):
            read_log(path)


def test_random_damage_is_reported(whole: bytes, reference: ControlLog, tmp_path: Path) -> None:
    chosen, numbers = random.Random(7), set(reference.numbers.tolist())
    first, read_again = reference.events.on("VTB_STATE")[0][3], 0
    for k in range(150):
        content = bytearray(whole)
        for _ in range(chosen.randrange(1, 6)):
            at = chosen.randrange(0 if k % 3 == 0 else first, len(content))
            size = chosen.choice([1, 4, 50, 3000])
            kind = chosen.randrange(4)
            if kind == 0:
                content[at : at + size] = chosen.randbytes(size)
            elif kind == 1:
                del content[at : at + size]
            elif kind == 2:
                content[at:at] = chosen.randbytes(size)
            else:
                content[at:at] = content[chosen.randrange(len(content)) :][:size]
        try:
            log = read(tmp_path, bytes(content))
        except LogError:
            continue
        read_again += 1
        assert set(log.numbers.tolist()) <= numbers
        missing = numbers - set(log.numbers.tolist())
        told = {n for gap in log.gaps for n in range(gap.first, gap.last + 1)}
        assert missing <= told or not log.closed
        assert log.damages or not missing
    assert read_again >= 100


def test_earlier_log_of_this_version_is_read() -> None:
    """5 idle cycles, 10 on real, 10 with other values, 5 in which the DPS raised, 5 latched, 5 after a reset."""
    log = read_log(Path(__file__).parent / "data" / "version3.lcm")
    assert log.closed and not log.damages and not log.gaps
    assert log.numbers.tolist() == list(range(40)) and len(log.digests) == 8
    assert [(i, change.kind) for i, change in log.changes] == [
        (5, "switch"), (15, "write"), (25, "write"), (30, "write"), (35, "reset"),
    ]  # fmt: skip
    assert log.changes[1][1].values["u.target"].tolist() == [0.3, 0.1] and log.start["dps.gain"] == 5.0
    expected = 7.0 * (np.array([0.3, 0.1]) - log.fed["position"][15:25])
    assert np.array_equal(log.actuation["velocity"][15:25], expected)
    assert [i for i, _ in log.faults] == [25, 30] and log.ok.tolist() == [True] * 25 + [False] * 10 + [True] * 5
