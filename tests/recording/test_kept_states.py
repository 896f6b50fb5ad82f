"""States along a log: a way from one of them ends as one from the beginning, whatever happened to their file."""

from __future__ import annotations

import resource
from dataclasses import replace
from pathlib import Path

import pytest

from tests.control.scripted import ServoScenario
from tests.recording.servo import Servo
from vtbdrake.recording.kept_states import KeptStates
from vtbdrake.recording.log_format import installed_versions
from vtbdrake.recording.log_reader import ControlLog, read_log
from vtbdrake.recording.recorder import Recorder
from vtbdrake.recording.rewindable_replay import RewindableReplay
from vtbdrake.state import Snapshot
from vtbdrake.testbed import VirtualTestbed

CYCLES = 120
PLACES = (0, 1, 57, 58, 119, 120)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("log") / "run.lcm"
    servo = Servo(alone=False)
    with Recorder(servo.runtime, path):
        servo.runtime.write({"u.target": [0.1, 0.2]})
        servo.runtime.run(cycles=CYCLES // 2)
        servo.runtime.write({"u.target": [-0.1, 0.0]})
        servo.runtime.run(cycles=CYCLES // 2)
    return path.read_bytes()


@pytest.fixture
def log(recorded: bytes, tmp_path: Path) -> ControlLog:
    (tmp_path / "run.lcm").write_bytes(recorded)
    return read_log(tmp_path / "run.lcm")


@pytest.fixture(scope="module")
def testbed() -> VirtualTestbed:
    return ServoScenario(rate=0.0).build()


@pytest.fixture
def file(log: ControlLog) -> Path:
    return log.path.with_name("run.lcm.states")


def snapshot(replay: RewindableReplay, testbed: VirtualTestbed) -> Snapshot:
    return testbed.snapshot(replay.context)


@pytest.fixture(scope="module")
def truth(recorded: bytes, testbed: VirtualTestbed, tmp_path_factory: pytest.TempPathFactory) -> dict[int, Snapshot]:
    """The states at some places, each replayed from the beginning."""
    path = tmp_path_factory.mktemp("truth") / "run.lcm"
    path.write_bytes(recorded)
    states = {}
    for place in PLACES:
        with RewindableReplay(read_log(path), testbed, kept_work=float("inf")) as replay:
            replay.go_to(place)
            states[place] = snapshot(replay, testbed)
    assert len({state[address].tobytes() for state in states.values() for address in ["dps.seen"]}) > 3
    return states


def assert_goes_anywhere(log: ControlLog, testbed: VirtualTestbed, truth: dict[int, Snapshot]) -> None:
    with RewindableReplay(log, testbed, kept_work=0.0) as replay:
        for place in (58, 0, 120, 57, 119, 1):
            replay.go_to(place)
            assert replay.index == place and snapshot(replay, testbed) == truth[place]


def prepared(log: ControlLog, testbed: VirtualTestbed) -> None:
    with RewindableReplay(log, testbed, kept_work=0.0) as replay:
        assert replay.prepared == 0.0
        assert replay.prepare() and replay.prepared == 1.0 and replay.index == 0


def test_ways_over_kept_states_end_where_the_log_leads(log, testbed, truth, file):
    assert_goes_anywhere(log, testbed, truth)
    assert file.stat().st_size > 0
    assert_goes_anywhere(log, testbed, truth)


def test_way_to_any_place_is_short_once_the_log_is_prepared(log, testbed, truth, monkeypatch):
    prepared(log, testbed)
    replayed = []
    with RewindableReplay(log, testbed) as replay:
        step = testbed.simulator.__func__  # One simulator for each way, and none is replayed from the beginning.
        monkeypatch.setattr(type(testbed), "simulator", lambda *a, **k: (replayed.append(1), step(*a, **k))[1])
        for place in PLACES:
            before = replay.index
            assert replay.approach(place, deadline=0.0) or abs(place - before) <= 1  # one cycle, or none
            assert snapshot(replay, testbed) == truth[place]
    assert len(replayed) < len(PLACES)


def test_way_is_gone_piece_by_piece(log, testbed, truth):
    with RewindableReplay(log, testbed, kept_work=float("inf")) as replay:
        pieces = 1
        while not replay.approach(58, deadline=0.0):
            pieces += 1
        assert pieces == 58 and snapshot(replay, testbed) == truth[58]
        assert not replay.approach(120, deadline=0.0)
        assert replay.approach(58) and snapshot(replay, testbed) == truth[58]  # from the beginning


@pytest.mark.slow_cases
@pytest.mark.parametrize("lost", [1, 20, 3000])
def test_file_of_a_killed_process_is_cut_to_what_is_whole(log, testbed, truth, file, lost):
    prepared(log, testbed)
    whole = file.read_bytes()
    file.write_bytes(whole[:-lost])
    assert_goes_anywhere(log, testbed, truth)
    prepared_again = file.read_bytes()
    assert len(prepared_again) <= len(whole)
    with RewindableReplay(log, testbed, kept_work=0.0) as replay:
        assert 0.5 < replay.prepared <= 1.0


def test_damaged_state_is_left_out(log, testbed, truth, file, caplog):
    prepared(log, testbed)
    content = bytearray(file.read_bytes())
    for at in range(len(content) // 2, len(content), 997):
        content[at] ^= 0x10
    file.write_bytes(content)
    assert_goes_anywhere(log, testbed, truth)


@pytest.mark.slow
def test_states_of_another_log_are_replaced(log, testbed, truth, file, recorded):
    prepared(log, testbed)
    before = file.read_bytes()
    servo = Servo(alone=False)
    with Recorder(servo.runtime, log.path.with_name("other.lcm")):
        servo.runtime.run(cycles=CYCLES)
    log.path.write_bytes(log.path.with_name("other.lcm").read_bytes())
    other = read_log(log.path)
    assert other.identity != log.identity
    with RewindableReplay(other, testbed, kept_work=0.0) as replay:
        assert replay.prepared == 0.0
    assert file.read_bytes() != before
    copied = log.path.with_name("copy.lcm")
    copied.write_bytes(recorded)
    assert read_log(copied).identity == log.identity


def test_states_of_other_code_are_replaced(log, testbed, truth, file):
    """The user's code has changed: the file is whole, but this replay has other states."""
    prepared(log, testbed)
    kept = KeptStates(log.path, {"log": log.identity, "versions": installed_versions()})
    notes = kept.before(60).notes
    kept.discard()
    kept.add(60, replace(truth[57], notes={**notes, "cycles": 60}))
    kept.close()
    assert_goes_anywhere(log, testbed, truth)


def test_states_are_read_by_those_who_read_the_log(log, testbed, file):
    for mode in (0o600, 0o644):
        log.path.chmod(mode)
        file.unlink(missing_ok=True)
        prepared(log, testbed)
        assert file.stat().st_mode & 0o777 == mode


def test_nothing_can_be_written_beside_the_log(log, testbed, truth, file):
    file.mkdir()
    assert_goes_anywhere(log, testbed, truth)
    assert list(file.iterdir()) == [] and sorted(p.name for p in file.parent.iterdir()) == ["run.lcm", file.name]


def test_two_pages_of_one_log_do_not_disturb_each_other(log, testbed, truth, file):
    with RewindableReplay(log, testbed, kept_work=0.0) as first:
        first.go_to(58)
        size = file.stat().st_size
        assert_goes_anywhere(log, testbed, truth)  # It reads what is there, and appends nothing.
        assert file.stat().st_size == size
        first.go_to(120)
        assert snapshot(first, testbed) == truth[120] and file.stat().st_size > size


def test_full_disk_ends_the_keeping(log, truth, file, caplog):
    states = KeptStates(log.path, {})
    states.add(1, truth[1])
    size, limits = file.stat().st_size, resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 100, limits[1]))
    try:
        states.add(57, truth[57])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert states.cycles == [1] and "no more states of the replay are kept" in caplog.text
    assert file.stat().st_size == size
    states.add(58, truth[58])
    assert states.before(120) == truth[1]
    states.close()
