"""Logs from the command line: replayed and exported."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import pandas
import pytest

from tests.cli.program import PENDULUM, error_of, run
from tests.recording.lcm_logger import PERIOD, write_log
from tests.recording.servo import Servo
from tests.visualization.scenes.reading import read_mcap
from vtbdrake.lcm.maps import decode
from vtbdrake.recording.lcm_types.lcmt_vtb_log import lcmt_vtb_log
from vtbdrake.recording.log_events import LogEvents
from vtbdrake.recording.log_format import CYCLE, LOG, LogError, event
from vtbdrake.recording.log_reader import read_log
from vtbdrake.recording.recorder import Recorder
from vtbdrake.recording.replay import replay
from vtbdrake.recording.table_reader import read_table

SCENARIO = ("--scenario", "tests.control.scripted:ServoScenario")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    servo = Servo()
    path = tmp_path_factory.mktemp("log") / "run.lcm"
    with Recorder(servo.runtime, path):
        servo.runtime.run(cycles=20)
    return path


def test_replay_compares_and_writes_what_was_recorded(path: Path, tmp_path: Path) -> None:
    out = tmp_path / "velocity.csv"
    program = run("replay", path, *SCENARIO, "--record", "dps.velocity", "--out", out)
    assert program.exit_code == 0, program.stderr
    assert "20 cycles replayed, 0 digests of the state: identical" in program.stdout
    assert out.stat().st_mode & 0o777 == 0o600  # What a machine has done is its owner's.
    table = pandas.read_csv(out)
    assert len(table) == 20 and table["t"].is_monotonic_increasing
    assert np.ptp(table["dps.velocity[0]"]) > 0.0


def test_replay_on_the_testbed_and_with_other_values(path: Path) -> None:
    by_another_module = ("--scenario", "tests.recording.servo:ServoScenario")
    assert "identical" in run("replay", path, *by_another_module, "--on", "testbed").stdout
    program = run("replay", path, *SCENARIO, "--set", "dps.gain=1.5")
    assert program.exit_code == 0 and "not compared" in program.stdout


@pytest.mark.parametrize("cut", ["in an event", "between two events"])
def test_cut_log_is_replayed_up_to_its_end_and_counts_as_incomplete(
    path: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, cut: str
) -> None:
    damaged = tmp_path / "damaged.lcm"
    size = LogEvents(path).on(CYCLE)[-3][3] if cut == "between two events" else -300
    damaged.write_bytes(path.read_bytes()[:size])
    program = run("replay", damaged, *SCENARIO)
    assert program.exit_code == 1 and "identical" in program.stdout
    assert "the recorder was not closed: later cycles may be missing" in program.stdout
    assert "Error: not everything was compared: the recorder was not closed" in program.stderr
    assert ("the file ends in the middle of an event" in caplog.text) == (cut == "in an event")


def test_cycles_behind_a_gap_count_as_not_compared(path: Path, tmp_path: Path) -> None:
    content = bytearray(path.read_bytes())
    middle = content.index(b"VTB_CYCLE", len(content) // 2)
    content[middle : middle + 40] = bytes(40)
    (tmp_path / "gap.lcm").write_bytes(content)
    program = run("replay", tmp_path / "gap.lcm", *SCENARIO)
    assert program.exit_code == 1 and "identical" in program.stdout
    assert "not everything was compared: the replay ends where the log lacks" in program.stderr


def of_scenario(name: str, path: Path, folder: Path) -> Path:
    """Return a copy of the log ``path`` whose header names another scenario."""
    events = LogEvents(path)
    message = decode(lcmt_vtb_log, events.data(*events.on(LOG)[0][2:]))
    message.header = read_log(path).header.to_json().replace("tests.control.scripted:ServoScenario", name)
    crc = zlib.crc32(message.header.encode())
    message.crc = crc - (1 << 32) if crc >> 31 else crc
    log = folder / "foreign.lcm"
    log.write_bytes(event(0, 0, LOG.encode(), message.encode()) + path.read_bytes()[events.on(LOG)[0][3] :])
    return log


@pytest.mark.parametrize("named", [(), SCENARIO])
def test_log_of_a_script_is_replayed_there_only(path: Path, tmp_path: Path, named: tuple[str, ...]) -> None:
    log = of_scenario("__main__:ServoScenario", path, tmp_path)
    assert "a class of a script or a notebook: only there can it be replayed" in error_of("replay", log, *named)


def test_a_log_has_nobodys_code_run(path: Path, tmp_path: Path) -> None:
    (tmp_path / "foreign.py").write_text(f"open({str(tmp_path / 'has_run')!r}, 'w')\n")
    log = of_scenario("foreign:Scenario", path, tmp_path)
    assert read_log(log).header.scenario_name == "foreign:Scenario"
    with pytest.raises(LogError, match="runs its code: if you trust it, import it first"):
        replay(log)
    for command in (("replay", log), ("export", log, tmp_path / "a.csv"), ("replay", log, *SCENARIO)):
        program = run(*command, cwd=tmp_path)
        assert program.exit_code in (0, 2) and not (tmp_path / "has_run").exists()
    assert run("replay", log, "--scenario", "foreign:Scenario", cwd=tmp_path).exit_code == 2
    assert (tmp_path / "has_run").exists()


def test_export_writes_every_format(path: Path, tmp_path: Path) -> None:
    for suffix in (".csv", ".parquet", ".mcap", ".rrd"):
        out = tmp_path / f"run{suffix}"
        program = run("export", path, out)
        assert program.exit_code == 0 and "20 cycles of 0.001 s" in program.stdout, program.stderr
        assert out.stat().st_size > 1000
        assert ("add --scenario tests.control.scripted:Servo" in program.stdout) == (suffix in (".mcap", ".rrd"))


def test_scene_of_a_log_has_its_world_if_the_scenario_is_named(path: Path, tmp_path: Path) -> None:
    out = tmp_path / "run.mcap"
    program = run("export", path, out, *SCENARIO, "--rate", "100", "--no-images")
    assert program.exit_code == 0 and "has no world" not in program.stdout, program.stderr
    messages = read_mcap(out)
    # The servo has no plant: its frames are the world alone, and the replay gives the commands u.
    assert [entity.id for entity in messages["/scene"][0][1].entities] == []
    assert len(messages["/u/target"]) == 3


def test_log_of_lcm_logger_is_exported_by_the_protocol_of_its_machine(tmp_path: Path) -> None:
    times = PERIOD * np.arange(5)
    columns = {"time": times, "q": np.sin(times), "u": np.cos(times)}
    log = read_table(columns, sense={"position": "q"}, act={"torque": "u"})
    foreign = write_log(tmp_path / "lcmlog-2026-11-29.00", log)
    pendulum = ("--scenario", "tests.recording.lcm_logger:LcmPendulum")
    program = run("export", foreign, tmp_path / "run.csv", *pendulum)
    assert program.exit_code == 0 and "no state of the DPS" in program.stdout, program.stderr
    assert pandas.read_csv(tmp_path / "run.csv")["sent.torque"].tolist() == columns["u"].tolist()
    assert "read through the protocol of its machine" in error_of("export", foreign, tmp_path / "run.csv")
    assert "read through the protocol of its machine" in error_of("replay", foreign, *pendulum)
    assert "no message on CART_POLE_STATE" in error_of("view", "cart_pole", "--log", foreign)
    vary = ("--position", "position", "--torque", "torque", "--vary", "sim.sys.pendulum.link.mass=0.3:3")
    assert "no message on CART_POLE_STATE" in error_of("calibrate", "cart_pole", foreign, *vary)


def test_bad_input_is_one_line(path: Path, tmp_path: Path) -> None:
    (tmp_path / "no.lcm").write_text("no")
    for arguments, expected in [
        (("replay", tmp_path / "no.lcm"), "is not a log of a control loop"),
        (("replay", tmp_path / "nowhere.lcm"), "No such file"),
        (("replay", path, "--record", "dps.gain"), "give both or neither"),
        (("replay", path), f"if you trust it, add {' '.join(SCENARIO)}"),
        (
            ("replay", path, "--scenario", "tests.testbeds:PendulumScenario"),
            "is of the scenario tests.control.scripted",
        ),
        (("export", path, tmp_path / "run.csv", "--no-images"), "go with a scene (.mcap or .rrd), not with .csv"),
        (("export", path, tmp_path / "run.xls"), "ends in .csv or .parquet or .mcap or .rrd"),
    ]:
        assert expected in error_of(*arguments)


def test_log_that_cannot_be_viewed_is_told(path: Path, tmp_path: Path) -> None:
    servo = SCENARIO[1]
    assert f"{path} is of the scenario {servo}, not of tests.testbeds:PendulumScenario" in error_of(
        "view", "tests.testbeds:PendulumScenario", "--log", path
    )
    other = error_of("view", servo, "--field", "rate=3.5", "--log", path)
    assert "the log is of another scenario" in other and "rate" in other
    (tmp_path / "cut.lcm").write_bytes(path.read_bytes()[:600])
    assert "cut.lcm" in error_of("view", servo, "--log", tmp_path / "cut.lcm")
    (tmp_path / "text.lcm").write_text("a text")
    assert "is not an LCM log" in error_of("view", servo, "--log", tmp_path / "text.lcm")
    assert "leave out --set, --start and --vr" in error_of("view", servo, "--log", path, "--set", "dps.gain=2")


def test_problem_that_cannot_be_viewed_is_told() -> None:
    assert "expected MODULE:NAME" in error_of("view", PENDULUM, "--problem", "nothing")
    assert "cannot import nothing" in error_of("view", PENDULUM, "--problem", "nothing:problem")
    assert "is no Problem" in error_of("view", PENDULUM, "--problem", "tests.testbeds:PENDULUM")
    assert "SCENARIO --problem swing:NAME" in error_of("view", "studies/swing.py")
    other = error_of("view", PENDULUM, "--problem", "tests.web.live.test_drive:problem")
    assert "the problem is one of LimitedPendulumScenario" in other
