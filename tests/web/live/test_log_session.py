"""Tests of sessions that replay logs: what is shown, and the simulations that leave a log."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.control.scripted import PERIOD, ServoScenario
from tests.recording.servo import Servo
from tests.web.live.test_session import frame
from vtbdrake.recording.log_format import LogError
from vtbdrake.recording.log_reader import read_log
from vtbdrake.recording.recorder import Recorder
from vtbdrake.recording.replay import replay
from vtbdrake.web import SessionConfig, SessionError
from vtbdrake.web.live.log_session import LogSession

SEEN, WORLD, GAIN = "dps.seen", "sim.sys.axes.discrete_state_0", "dps.gain"
CONFIG = SessionConfig(step=10 * PERIOD)


def record(path: Path, *, alone: bool = True, cycles: int = 400) -> Path:
    """Record a servo that follows two targets; its sensor values come from a machine."""
    servo = Servo(alone=alone)
    with Recorder(servo.runtime, path, digest_period=0.1):
        servo.runtime.write({"u.target": [0.1, 0.2]})
        servo.runtime.run(cycles=cycles // 2)
        servo.runtime.write({"u.target": [-0.1, 0.0]})
        servo.runtime.run(cycles=cycles // 2)
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("log") / "run.lcm")


@pytest.fixture
def session(log: Path) -> Iterator[LogSession]:
    with LogSession(log, config=CONFIG) as running:
        yield running


def read(session: LogSession, address: str) -> Any:
    return session.snapshot().values[address]


def recorded(log: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    report = replay(log, record=[SEEN, "u.target"])
    assert report.identical
    return report.times, dict(report.record)


@pytest.mark.slow_cases
@pytest.mark.parametrize("alone", [True, False], ids=["dps", "testbed"])
def test_session_shows_what_the_dps_did(tmp_path: Path, alone: bool) -> None:
    log = record(tmp_path / "run.lcm", alone=alone)
    with LogSession(log, config=CONFIG) as session:
        times, values = recorded(log)
        session.watch("test", [SEEN, WORLD])
        shown = frame(session, lambda shown: shown.log is not None)
        assert shown.history[0] <= 0.001 and shown.history[1] == times[-1]
        assert shown.log["recorded"] and shown.log["left"] is None
        session.advance(12)
        k = int(np.searchsorted(times, 0.12 + 1e-9)) - 1
        shown = frame(session, lambda shown: shown.time == times[k])
        assert shown.values[SEEN] == values[SEEN][k].tolist() == shown.values[WORLD]
        assert shown.positions == {"sense": {"position": "real", "speed": "real"}, "act": {"velocity": "real"}}
        for when in (0.3, 0.05, 0.2345):
            session.seek(when)
            k = int(np.searchsorted(times, when + 1e-9, side="right")) - 1
            assert np.array_equal(read(session, SEEN), values[SEEN][k])
            assert np.array_equal(read(session, "u.target"), values["u.target"][k])


def test_log_ends_with_a_message(session: LogSession) -> None:
    session.set_speed(float("inf"))
    session.play()
    shown = frame(session, lambda shown: not shown.playing and shown.log["notice"] != "")
    assert shown.time == shown.history[1] and shown.log["notice"] == "the log ends here"
    with pytest.raises(SessionError, match="the log ends here: go back, or go on in simulation"):
        session.play()
    session.go_on()
    session.advance(1)
    session.reset()
    assert frame(session, lambda shown: shown.log["recorded"]).time <= 0.001


def test_dps_runs_on_a_log_of_another_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    log = read_log(record(tmp_path / "run.lcm", cycles=100)).signals
    with LogSession(log, scenario=ServoScenario(rate=0.0), config=CONFIG) as session:
        session.seek(0.05)
        assert read(session, SEEN).tolist() in log.sense["position"].between(0.046, 0.054).values.tolist()
        assert "the DPS was not recorded" in frame(session, lambda shown: not shown.playing).log["notice"]
        assert [*tmp_path.glob("vtbdrake-log-*")]
    assert not [*tmp_path.glob("vtbdrake-log-*")]
    with pytest.raises(SessionError, match="does not name its scenario, whose DPS runs on it: give scenario="):
        LogSession(log)


def test_changed_gain_goes_on_from_the_recorded_state(session: LogSession, log: Path) -> None:
    times, values = recorded(log)
    session.seek(0.25)
    k = int(np.searchsorted(times, 0.25 + 1e-9)) - 1
    session.write({GAIN: 12.0})
    start = session.snapshot()
    assert start.time == times[k]
    assert np.array_equal(start[SEEN], values[SEEN][k]) and np.array_equal(start[WORLD], values[SEEN][k])
    shown = frame(session, lambda shown: not shown.log["recorded"])
    assert shown.positions == {"sense": {"position": "sim", "speed": "sim"}, "act": {"velocity": "sim"}}
    assert shown.log["left"] == times[k]
    session.advance(10)
    # The same by hand: the axes follow the first-order law of the new gain, from where the DPS saw them.
    testbed = ServoScenario(rate=0.0).build()
    context = testbed.default_context()
    testbed.restore(context, start)
    simulator = testbed.simulator(context, restored=True)
    simulator.AdvanceTo(session.snapshot().time)
    assert np.array_equal(read(session, WORLD), testbed.read(context, WORLD))
    target = np.array([-0.1, 0.0])
    elapsed = session.snapshot().time - start.time
    expected = target + (values[SEEN][k] - target) * np.exp(-12.0 * elapsed)
    assert read(session, WORLD) == pytest.approx(expected, abs=0.01)
    # The recorded course goes on beside it.
    shown = frame(session, lambda shown: shown.time > times[k] + 0.09)
    assert dict(shown.comparison["differences"])[GAIN] == pytest.approx(0.26)


def test_going_back_returns_to_the_log_or_into_the_simulation(session: LogSession, log: Path) -> None:
    times, values = recorded(log)
    session.seek(0.1)
    session.go_on()
    for _ in range(4):
        session.advance(1)
        session.wait_for_frame(session.latest.number, 60.0)
    left = frame(session, lambda shown: not shown.log["recorded"])
    session.seek(left.history[1])
    assert not frame(session, lambda shown: not shown.playing).log["recorded"]
    session.seek(0.05)
    k = int(np.searchsorted(times, 0.05 + 1e-9)) - 1
    shown = frame(session, lambda shown: shown.log["recorded"])
    assert shown.comparison is None and np.array_equal(read(session, SEEN), values[SEEN][k])


def test_preview_and_drive_leave_the_log_only_when_they_count(session: LogSession) -> None:
    session.seek(0.1)
    session.preview({GAIN: 1.0})
    preview = frame(session, lambda shown: shown.preview is not None and shown.preview["time"] >= shown.preview["end"])
    assert preview.log["recorded"] and not preview.preview["refused"]
    session.cancel_preview()
    with pytest.raises(ValueError, match="must lie in"):
        session.write({GAIN: -1.0})
    with pytest.raises(SessionError, match="these are the recorded switches: go on in simulation first"):
        session.switch("sim")
    assert frame(session, lambda shown: shown.preview is None).log["recorded"]
    session.drive(["u.target"])
    session.deflect({"u.target": [1.0, 0.0]})
    session.advance(10)
    session.end_drive(keep=False)
    shown = frame(session, lambda shown: shown.drive is None)
    assert not shown.log["recorded"] and shown.time == pytest.approx(0.1) and shown.comparison is not None


def test_damaged_log_is_replayed_up_to_the_damage(tmp_path: Path) -> None:
    path = record(tmp_path / "run.lcm")
    content = bytearray(path.read_bytes())
    at = read_log(path).events.on("VTB_CYCLE")[300][2]
    content[at + 40] ^= 0xFF
    path.write_bytes(bytes(content))
    with LogSession(path, config=CONFIG) as session:
        session.seek(10.0)
        shown = frame(session, lambda shown: shown.time > 0.2 and shown.log["seeking"] is None)
        assert "the replay ends where the log lacks cycles 301 to 301" in shown.log["notice"]
        session.go_on()
        session.advance(3)
    path.write_bytes(path.read_bytes()[:-20_000])
    with LogSession(path, config=CONFIG) as session:
        session.seek(10.0)
        notice = frame(session, lambda shown: shown.log["notice"] != "").log["notice"]
        assert notice == "the recorder was not closed: later cycles may be missing"


def long_way(session: LogSession) -> float:
    """Begin a way that takes many steps of the session, and return where it leads."""
    end = session.latest.history[1]
    assert not session.seek(end, wait=False)
    return end


@pytest.fixture(scope="module")
def long_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("log") / "long.lcm", cycles=6000)


@pytest.fixture
def fresh(long_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[LogSession]:
    """A session of a log that nobody has opened, each of whose ways is gone a few cycles at a time."""
    path = tmp_path / "long.lcm"
    path.write_bytes(long_log.read_bytes())
    monkeypatch.setattr("vtbdrake.web.live.log_player.AT_ONCE", 0.0)
    monkeypatch.setattr("vtbdrake.web.live.player.STEPPING_SHARE", 0.001)
    with LogSession(path, config=CONFIG) as running:
        yield running


@pytest.mark.slow
def test_long_way_tells_its_progress_and_can_be_ended(fresh: LogSession) -> None:
    fresh.seek(0.001)
    end = long_way(fresh)
    on_the_way = frame(fresh, lambda shown: shown.log["seeking"] is not None)
    assert on_the_way.log["seeking"] == end and 0.0 <= on_the_way.log["progress"] < 1.0
    for refused in (fresh.play, fresh.go_on, lambda: fresh.write({GAIN: 1.0}), lambda: fresh.preview({GAIN: 1.0})):
        with pytest.raises(SessionError, match=r"on its way to .* s: wait, or pause"):
            refused()
    fresh.pause()
    shown = frame(fresh, lambda shown: shown.log["seeking"] is None)
    assert shown.log["progress"] is None and 0.0 < shown.time < end and shown.log["recorded"]
    fresh.advance(1)  # It goes on from there.


@pytest.mark.slow
def test_newest_way_takes_the_place_of_an_older_one(fresh: LogSession) -> None:
    long_way(fresh)
    assert fresh.seek(0.1)
    shown = frame(fresh, lambda shown: shown.log["seeking"] is None)
    assert shown.time == pytest.approx(0.1, abs=PERIOD)


def test_replaced_way_says_that_it_did_not_arrive(fresh: LogSession) -> None:
    with ThreadPoolExecutor(1) as other:
        fresh.seek(0.001)
        way = other.submit(fresh.seek, 1e3)
        frame(fresh, lambda shown: shown.log["seeking"] is not None)
        fresh.pause()
        assert way.result(60.0) is False


def test_session_ends_in_the_middle_of_a_way(fresh: LogSession) -> None:
    long_way(fresh)
    fresh.close()
    assert fresh.latest.time < fresh.latest.history[1]


def test_log_that_stands_still_is_prepared_to_its_end(log: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.lcm"
    path.write_bytes(log.read_bytes())
    with LogSession(path, config=CONFIG) as session:
        frame(session, lambda shown: shown.log["prepared"] == 1.0)
    assert (tmp_path / "run.lcm.states").is_file()


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = record(tmp_path / "run.lcm", cycles=20)
    (tmp_path / "text.lcm").write_text("no log")
    with pytest.raises(LogError, match="is not a log of a control loop"):
        LogSession(tmp_path / "text.lcm")
    with pytest.raises(OSError):
        LogSession(tmp_path / "none.lcm")
    (tmp_path / "cut.lcm").write_bytes(path.read_bytes()[:600])
    with pytest.raises(LogError):
        LogSession(tmp_path / "cut.lcm")


def test_simulation_that_left_a_log_is_saved_as_a_test(session: LogSession, tmp_path: Path) -> None:
    session.seek(0.2)
    session.write({GAIN: 3.0})
    session.advance(10)
    session.save_test(tmp_path / "test_gain.py")
    namespace: dict[str, Any] = {"__file__": str(tmp_path / "test_gain.py")}
    exec((tmp_path / "test_gain.py").read_text(), namespace)
    namespace["test_gain"]()
    assert namespace["EXPECTED"] == {WORLD: read(session, WORLD).tolist()}


def test_course_that_begins_in_a_log_is_saved_for_its_owner_alone(session: LogSession, tmp_path: Path) -> None:
    session.advance(3)
    session.write({"u.target": [0.3, 0.0]})
    session.advance(3)
    session.save_test(tmp_path / "test_target.py")
    files = sorted(tmp_path.iterdir())
    assert [file.name for file in files] == ["test_target.py", "test_target.vtb"]
    assert {file.stat().st_mode & 0o777 for file in files} == {0o600}
