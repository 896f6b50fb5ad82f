"""The recorder: what it writes, and how the loop goes on when it cannot."""

from __future__ import annotations

import os
import re
import resource
import signal
import subprocess
import sys
import threading
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import lcm
import numpy as np
import pytest

from tests.control.scripted import PERIOD, ServoScenario
from tests.control.slow import SlowScenario
from tests.control.test_loop import PATIENCE, Loop
from tests.recording.servo import Servo
from vtbdrake.lcm.hub import Hub
from vtbdrake.recording.log_reader import read_log
from vtbdrake.recording.recorder import Recorder, StateDigest
from vtbdrake.testbed import DpsAlone


def test_every_cycle_is_recorded_to_the_last_bit(tmp_path: Path) -> None:
    servo = Servo(begun=False)
    with Recorder(servo.runtime, tmp_path / "run.lcm") as recorder:
        servo.runtime.run(cycles=3)
        servo.runtime.switch("real")
        servo.runtime.run(cycles=40)
    assert recorder.lost == 0
    log = read_log(tmp_path / "run.lcm")
    cycles = servo.cycles
    assert log.closed and not log.damages and not log.gaps and not log.clock_jumps
    assert log.numbers.tolist() == [cycle.number for cycle in cycles] == list(range(43))
    assert log.times.tolist() == [cycle.time for cycle in cycles]
    assert log.now.tolist() == [cycle.now for cycle in cycles]
    assert log.ok.tolist() == [cycle.verdict.ok for cycle in cycles]
    assert np.array_equal(log.actuation["velocity"], servo.commands, equal_nan=True)
    sent = [cycle.verdict.actuation.get("velocity", [np.nan, np.nan]) for cycle in cycles]
    assert np.array_equal(log.sent["velocity"], sent, equal_nan=True)
    assert (log.sources["position"] != 0).tolist() == ["position" in cycle.fed for cycle in cycles]
    for i, cycle in enumerate(cycles):
        for name, value in cycle.fed.items():
            assert np.array_equal(log.fed[name][i], value)


def test_changes_between_cycles_are_recorded(tmp_path: Path) -> None:
    servo = Servo(begun=False)
    with Recorder(servo.runtime, tmp_path / "run.lcm"):
        servo.runtime.run(cycles=2)
        servo.runtime.switch("real")
        servo.runtime.write({"dps.gain": 3.0, "u.target": [0.1, 1.0 / 3.0]})
        servo.runtime.cycle()
        servo.runtime.reset()
        servo.runtime.cycle()
    (_, switch), (_, write), (at, reset) = (changes := read_log(tmp_path / "run.lcm").changes)
    assert [i for i, _ in changes] == [2, 2, 3] and at == 3
    assert switch.kind == "switch" and switch.values["act.velocity"] == "real"
    assert write.kind == "write" and write.values["dps.gain"] == 3.0
    assert write.values["u.target"].tolist() == [0.1, 1.0 / 3.0]
    assert reset == ("reset", {})


def test_begin_and_end_of_faults_are_recorded(tmp_path: Path) -> None:
    servo = Servo()
    with Recorder(servo.runtime, tmp_path / "run.lcm"):
        servo.runtime.run(cycles=2)
        servo.runtime.write({"dps.trouble": 1.0})
        servo.runtime.run(cycles=3)
        servo.runtime.write({"dps.trouble": 0.0})
        servo.runtime.run(cycles=2)
    log = read_log(tmp_path / "run.lcm")
    (begin, (reason,)), (end, over) = log.faults
    assert (int(log.numbers[begin]), int(log.numbers[end]), over) == (3, 6, ())
    assert re.fullmatch(r"the DPS raised RuntimeError: out of ideas \(scripted\.py, line \d+\)", reason)
    assert log.ok.tolist() == [True] * 2 + [False] * 5
    assert np.isnan(log.actuation["velocity"][2:5]).all() and (log.sent["velocity"][2:] == 0.0).all()


def test_digests_are_recorded_periodically(tmp_path: Path) -> None:
    servo = Servo()
    states: dict[int, bytes] = {}
    digest = StateDigest(servo.runtime.target, servo.runtime.context)
    servo.runtime.watch(lambda cycle: states.__setitem__(cycle.number, digest()))
    with Recorder(servo.runtime, tmp_path / "run.lcm", digest_period=10 * PERIOD):
        servo.runtime.run(cycles=35)
    log = read_log(tmp_path / "run.lcm")
    assert {int(log.numbers[i]): data for i, data in log.digests} == {n: states[n] for n in (9, 19, 29)}


def test_recording_begins_and_ends_at_any_time(tmp_path: Path) -> None:
    servo = Servo()
    servo.runtime.run(cycles=10)
    for name in ("one", "two"):
        recorder = Recorder(servo.runtime, tmp_path / name)
        servo.runtime.run(cycles=10)
        recorder.close()
        recorder.close()
        servo.runtime.run(cycles=5)
    assert read_log(tmp_path / "one").numbers.tolist() == list(range(11, 21))
    assert read_log(tmp_path / "two").numbers.tolist() == list(range(26, 36))
    assert servo.bridge.tap is None


@pytest.mark.slow_cases
@pytest.mark.parametrize("before", [6, 7])
def test_initial_port_values_are_recorded_once(tmp_path: Path, before: int) -> None:
    servo = Servo()
    servo.runtime.run(cycles=before)
    with Recorder(servo.runtime, tmp_path / "run.lcm"):
        servo.runtime.run(cycles=6)
    log = read_log(tmp_path / "run.lcm")
    fed = [cycle.fed.get("position") for cycle in servo.cycles]
    assert (log.sources["position"] != 0).tolist() == [True, *(value is not None for value in fed[before + 2 :])]
    known = fed[0]
    for number, value in enumerate(fed):
        known = known if value is None else value
        if number > before:
            assert np.array_equal(log.fed["position"][number - before - 1], known)


@pytest.fixture(scope="module")
def hub() -> Iterator[Hub]:
    with Hub(port=0) as running:
        yield running


def test_messages_are_recorded_byte_for_byte(hub: Hub, tmp_path: Path) -> None:
    crossed: list[tuple[str, bytes]] = []
    with Loop(hub, lock_step=True) as loop:
        loop.bridge.tap = lambda channel, data: crossed.append((channel, data))
        with Recorder(loop.runtime, tmp_path / "run.lcm"):
            loop.sense()
            loop.runtime.switch("real")
            loop.runtime.cycle()
            loop.runtime.run(cycles=50)
    own = [(e.channel, e.data) for e in lcm.EventLog(str(tmp_path / "run.lcm")) if not e.channel.startswith("VTB_")]
    assert own == crossed
    assert {channel for channel, _ in own} == {"IIWA_STATUS", "IIWA_COMMAND"}
    log = read_log(tmp_path / "run.lcm")
    assert [message.data for message in log.messages("IIWA_COMMAND")] == [d for c, d in own if c == "IIWA_COMMAND"]


def test_lcm_reads_numbers_and_times_in_order(tmp_path: Path) -> None:
    servo = Servo()
    with Recorder(servo.runtime, tmp_path / "run.lcm"):
        servo.runtime.run(cycles=20)
    events = list(lcm.EventLog(str(tmp_path / "run.lcm")))
    assert [event.eventnum for event in events] == list(range(len(events)))
    assert [event.channel for event in events[:2]] == ["VTB_LOG", "VTB_STATE"] and events[-1].channel == "VTB_END"
    times = [event.timestamp for event in events if event.channel == "VTB_CYCLE"]
    assert np.diff(times) == pytest.approx(1e6 * PERIOD, abs=1.0)


# -- losses


def test_full_disk_is_reported_and_harmless(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    servo = Servo()
    room = 40_000
    start = subprocess.Popen

    def limited(*args: object, **options: object) -> subprocess.Popen[bytes]:
        process = start(*args, **options)  # type: ignore[call-overload]
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (room, room))
        return process  # type: ignore[no-any-return]

    monkeypatch.setattr(subprocess, "Popen", limited)
    with Recorder(servo.runtime, tmp_path / "run.lcm", digest_period=PERIOD) as recorder:
        monkeypatch.undo()
        servo.runtime.run(cycles=600)
    assert len(servo.cycles) == 601 and (tmp_path / "run.lcm").stat().st_size <= room
    assert "File too large" in caplog.text and f"{recorder.lost} of 600 cycles" in caplog.text
    log = read_log(tmp_path / "run.lcm")
    assert 0 < len(log) == 600 - recorder.lost
    assert not log.damages, "what is there is whole"
    # Whether the short last event still fits is a matter of bytes.
    assert np.array_equal(log.numbers, np.arange(1, len(log) + 1))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root mounts")
def test_log_resumes_when_disk_has_room(tmp_path: Path) -> None:
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8100k", "tmpfs", tmp_path], capture_output=True)
    if mount.returncode:
        pytest.skip(f"no mounts here: {mount.stderr.decode()}")
    try:
        servo = Servo()
        ballast = tmp_path / "ballast"
        ballast.write_bytes(bytes(8_000_000))
        with Recorder(servo.runtime, tmp_path / "run.lcm", digest_period=PERIOD) as recorder:
            servo.runtime.run(until=lambda: recorder.lost > 0, cycles=100_000)
            ballast.unlink()
            servo.runtime.run(cycles=1000)
        log = read_log(tmp_path / "run.lcm")
        assert log.closed and not log.damages
        assert log.numbers[-1] == servo.cycles[-1].number
        missing = sum(gap.last - gap.first + 1 for gap in log.gaps)
        assert missing == recorder.lost == len(servo.cycles) - 1 - len(log) > 0
        del log  # it holds the file
    finally:
        subprocess.run(["umount", tmp_path], check=True)


def test_killed_worker_process_is_harmless(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    servo = Servo()
    recorder = Recorder(servo.runtime, tmp_path / "run.lcm")
    servo.runtime.run(cycles=100)
    os.kill(recorder.pid, signal.SIGKILL)
    os.waitid(os.P_PID, recorder.pid, os.WEXITED | os.WNOWAIT)
    servo.runtime.run(cycles=100)
    assert recorder.lost >= 100
    recorder.close()
    assert len(servo.cycles) == 201
    assert "cycles of the loop are not recorded" in caplog.text
    try:
        arrived = len(read_log(tmp_path / "run.lcm"))
    except ValueError:
        arrived = 0  # it was killed before it had written anything
    assert recorder.lost == 200 - arrived


def test_stopped_worker_process_loses_cycles_only(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    servo = Servo()
    with Recorder(servo.runtime, tmp_path / "run.lcm", backlog=1) as recorder:
        os.kill(recorder.pid, signal.SIGSTOP)
        servo.runtime.run(until=lambda: recorder.lost > 100, cycles=100_000)
        os.kill(recorder.pid, signal.SIGCONT)
    assert recorder.lost == 101
    log = read_log(tmp_path / "run.lcm")
    assert len(log) == len(servo.cycles) - 1 - recorder.lost
    assert f"missing: {log.gaps[0]}" in caplog.text


# -- rejected recordings


def test_log_is_overwritten_only_on_request(tmp_path: Path) -> None:
    (tmp_path / "run.lcm").write_text("dear")
    servo = Servo()
    with pytest.raises(FileExistsError, match=r"run\.lcm exists: record to another file, or remove it"):
        Recorder(servo.runtime, tmp_path / "run.lcm")
    assert (tmp_path / "run.lcm").read_text() == "dear"
    Recorder(servo.runtime, tmp_path / "run.lcm", overwrite=True).close()
    assert len(read_log(tmp_path / "run.lcm")) == 0


def test_overwriting_keeps_the_mapped_file(tmp_path: Path) -> None:
    servo, path = Servo(), tmp_path / "run.lcm"
    with Recorder(servo.runtime, path):
        servo.runtime.run(cycles=50)
    content, file, log = path.read_bytes(), path.stat().st_ino, read_log(path)
    with Recorder(servo.runtime, path, overwrite=True):
        assert path.stat().st_ino != file, "a file that is cut off ends the process of who has mapped it"
        assert bytes(log.events.content) == content


@pytest.mark.slow
def test_recorders_end_in_any_order(tmp_path: Path, hub: Hub) -> None:
    with Loop(hub, lock_step=True) as loop:
        first = Recorder(loop.runtime, tmp_path / "first.lcm")
        second = Recorder(loop.runtime, tmp_path / "second.lcm")
        loop.sense()
        loop.runtime.switch("real")
        loop.runtime.cycle()
        first.close()
        tracemalloc.start()
        loop.runtime.bridge.tap("LARGE", bytes(1 << 20))
        loop.runtime.run(cycles=20)
        second.close()
        held, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert held < 1 << 20 < most, "nothing piles up in one that is closed"
    log = read_log(tmp_path / "second.lcm")
    assert len(list(log.messages("IIWA_STATUS"))) > len(list(read_log(tmp_path / "first.lcm").messages("IIWA_STATUS")))


def test_missing_folder_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Recorder(Servo().runtime, tmp_path / "nowhere" / "run.lcm")


def test_digest_period_below_period_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least the period, 0.001 s, not 0.0 s"):
        Recorder(Servo().runtime, tmp_path / "run.lcm", digest_period=0.0)


def test_digest_is_equal_alone_and_in_testbed() -> None:
    scenario = ServoScenario()
    testbed, alone = scenario.build(), DpsAlone(scenario)
    there, here = testbed.default_context(), alone.default_context()
    assert StateDigest(testbed, there)() == StateDigest(alone, here)()
    testbed.write(there, {"sim.sys.axes.discrete_state_0": [1.0, 2.0]})
    assert StateDigest(testbed, there)() == StateDigest(alone, here)(), "the world is not the DPS's state"


@pytest.mark.parametrize("address", ["dps.gain", "dps.seen[1]", "dps.ticks", "dps.velocity[0]"])
def test_digest_depends_on_every_bit(address: str) -> None:
    alone = DpsAlone(ServoScenario())
    context = alone.default_context()
    digest = StateDigest(alone, context)
    before = digest()
    value = alone.read(context, address)
    alone.write(context, {address: np.nextafter(value, 1e3)})
    assert digest() != before
    alone.write(context, {address: value})
    assert digest() == before


def test_digest_depends_on_abstract_state() -> None:
    first, other = (DpsAlone(SlowScenario(more={"memory": np.array([0.3, x])})) for x in (0.6, 0.7))
    digests = [StateDigest(target, target.default_context())() for target in (first, other)]
    assert digests[0] != digests[1]


@pytest.mark.slow
def test_lcm_logplayer_plays_a_log(tmp_path: Path) -> None:
    path = tmp_path / "run.lcm"
    with Hub(port=0) as hub, Loop(hub, lock_step=True) as loop, Recorder(loop.runtime, path):
        loop.sense()
        loop.runtime.switch("real")
        loop.runtime.cycle()
        loop.runtime.run(cycles=100)
    recorded = [(event.channel, event.data) for event in lcm.EventLog(str(path))]
    assert len(recorded) > 300
    heard: list[tuple[str, bytes]] = []
    player = Path(sys.executable).with_name("lcm-logplayer")
    with Hub(port=0) as hub:
        bus = lcm.LCM(hub.url)
        subscription = bus.subscribe("(?!VTB_HUB).*", lambda channel, data: heard.append((channel, data)))
        subscription.set_queue_capacity(0)
        with subprocess.Popen([player, "--lcm-url", hub.url, "--speed", "5", path], stdout=subprocess.DEVNULL) as run:
            guard = threading.Timer(PATIENCE, run.kill)
            guard.start()
            while len(heard) < len(recorded) and bus.handle_timeout(round(1e3 * PATIENCE)):
                pass
            assert run.wait(PATIENCE) == 0
            guard.cancel()
    assert heard == recorded
    assert len(read_log(path)) == 101
