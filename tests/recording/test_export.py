"""Exported logs, read by pandas and by the library of MCAP."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pandas
import pytest
from mcap.reader import make_reader

from tests.recording.servo import Servo
from vtbdrake.recording.export import export
from vtbdrake.recording.log_reader import ControlLog, read_log
from vtbdrake.recording.recorder import Recorder

SIGNALS = ("sense.position", "sense.speed", "command.velocity", "sent.velocity")
NAMES = ["cycle", "time", "now", "utime", "ok", *(f"{signal}[{i}]" for signal in SIGNALS for i in (0, 1))]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> ControlLog:
    servo = Servo(alone=False, begun=False)
    path = tmp_path_factory.mktemp("log") / "run.lcm"
    with Recorder(servo.runtime, path):
        servo.runtime.run(cycles=10)
        servo.runtime.switch("real")
        servo.runtime.write({"u.target": [0.5, 1.0 / 3.0]})
        servo.runtime.run(cycles=10)
        servo.runtime.write({"dps.trouble": 2.0})
        servo.runtime.run(cycles=5)
    return read_log(path)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_pandas_reads_numbers_exactly(log: ControlLog, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"run{suffix}"
    export(log, path)
    table = {".csv": pandas.read_csv, ".parquet": pandas.read_parquet}[suffix](path)
    assert list(table.columns) == NAMES
    assert table["cycle"].tolist() == log.numbers.tolist() and table["utime"].tolist() == log.utimes.tolist()
    assert table["ok"].tolist() == [True] * 20 + [False] * 5
    for column, values in [
        ("time", log.times),
        ("sense.position[1]", log.fed["position"][:, 1]),
        ("command.velocity[0]", log.actuation["velocity"][:, 0]),
        ("sent.velocity[1]", log.sent["velocity"][:, 1]),
    ]:
        assert np.array_equal(table[column].to_numpy(dtype=float), values, equal_nan=True)
    assert table["command.velocity[0]"].isna().sum() == 15


def permissions(path: Path) -> int:
    return path.stat().st_mode & 0o777


def test_what_records_a_machine_is_read_by_its_owner_alone(log: ControlLog, tmp_path: Path) -> None:
    assert permissions(Path(log.path)) == 0o600
    for suffix in (".csv", ".parquet", ".mcap"):
        path = tmp_path / f"run{suffix}"
        export(log, path)
        assert permissions(path) == 0o600
        export(log, path, mode=0o640)
        assert permissions(path) == 0o640
    servo = Servo(alone=False, begun=False)
    with Recorder(servo.runtime, tmp_path / "shared.lcm", mode=0o644):
        pass
    assert permissions(tmp_path / "shared.lcm") == 0o644
    (tmp_path / "shared.lcm").chmod(0o666)
    with Recorder(Servo(alone=False, begun=False).runtime, tmp_path / "shared.lcm", overwrite=True):
        pass
    assert permissions(tmp_path / "shared.lcm") == 0o600


def test_unknown_suffix_is_rejected(log: ControlLog, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"ends in .csv, .mcap, .parquet, unlike '.*run.xlsx'"):
        export(log, tmp_path / "run.xlsx")


@pytest.mark.parametrize(("module", "suffix"), [("pyarrow", ".parquet"), ("mcap.writer", ".mcap")])
def test_missing_library_names_its_extra(
    log: ControlLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, suffix: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'vtbdrake\[recording\]'"):
        export(log, tmp_path / f"run{suffix}")
    assert list(tmp_path.iterdir()) == []


Entry = tuple[str, str, int, dict[str, Any]]


@pytest.fixture(scope="module")
def entries(log: ControlLog, tmp_path_factory: pytest.TempPathFactory) -> list[Entry]:
    return exported(log, tmp_path_factory.mktemp("mcap") / "run.mcap")


def exported(log: ControlLog, path: Path) -> list[Entry]:
    """Return topic, schema, time and content of all messages."""
    export(log, path)

    def strict(name: str) -> None:
        raise AssertionError(f"JSON has no {name}")

    def read() -> Iterator[Entry]:
        with path.open("rb") as file:
            for schema, channel, message in make_reader(file).iter_messages():
                assert schema is not None and schema.encoding == "jsonschema" and channel.message_encoding == "json"
                content = json.loads(message.data, parse_constant=strict)
                jsonschema.validate(content, {**json.loads(schema.data), "additionalProperties": False})
                yield channel.topic, schema.name, message.log_time, content

    return list(read())


def on(entries: list[Entry], topic: str) -> list[tuple[int, dict[str, Any]]]:
    return [(time, content) for found, _, time, content in entries if found == topic]


def test_mcap_has_topics_of_signals_and_cycles(log: ControlLog, entries: list[Entry]) -> None:
    new = np.flatnonzero(log.sources["speed"])
    assert [(time, content["time"], content["value"]) for time, content in on(entries, "/sense/speed")] == [
        (1000 * log.utimes[i], log.times[i], log.fed["speed"][i].tolist()) for i in new
    ]
    commands = on(entries, "/command/velocity")
    assert [content["value"] for _, content in commands[:10]] == log.actuation["velocity"][10:20].tolist()
    assert [content["value"] for _, content in on(entries, "/sent/velocity")] == log.sent["velocity"][10:].tolist()
    cycles = [content for _, content in on(entries, "/cycle")]
    assert [content["cycle"] for content in cycles] == list(range(25))
    assert cycles[7]["since_last"] == log.now[7] - log.now[6] and cycles[-1]["ok"] is False


def test_mcap_writes_nan_as_null(entries: list[Entry]) -> None:
    assert on(entries, "/command/velocity")[-1][1]["value"] == [None, 0.0]


def test_mcap_has_initial_and_changed_values(log: ControlLog, entries: list[Entry]) -> None:
    (before, sim), (after, real) = on(entries, "/switches")
    assert before == 1000 * log.utimes[0] and sim["positions"]["act.velocity"] == "sim"
    assert after == 1000 * log.utimes[10] and real["positions"]["act.velocity"] == "real"
    assert [content["value"] for _, content in on(entries, "/variable/u.target")] == [[0.0, 0.0], [0.5, 1.0 / 3.0]]
    assert [content["value"] for _, content in on(entries, "/variable/dps.trouble")] == [[0.0], [2.0]]


def test_mcap_faults_are_foxglove_log_entries(log: ControlLog, entries: list[Entry]) -> None:
    [(schema, time, content)] = [(schema, time, c) for topic, schema, time, c in entries if topic == "/faults"]
    assert schema == "foxglove.Log" and "not finite" in content["message"] and content["level"] == 4
    assert 10**9 * content["timestamp"]["sec"] + content["timestamp"]["nsec"] == time == 1000 * log.utimes[20]


def test_mcap_has_resets_of_the_guards(tmp_path: Path) -> None:
    servo = Servo()
    with Recorder(servo.runtime, tmp_path / "run.lcm"):
        for trouble, cycles in ((0.0, 5), (2.0, 5), (0.0, 5)):
            servo.runtime.write({"dps.trouble": trouble})
            servo.runtime.run(cycles=cycles)
        servo.runtime.reset()
        servo.runtime.run(cycles=5)
    log = read_log(tmp_path / "run.lcm")
    entries = exported(log, tmp_path / "run.mcap")
    [(schema, time, content)] = [(schema, time, c) for topic, schema, time, c in entries if topic == "/reset"]
    assert (schema, time, content) == ("vtbdrake.Reset", 1000 * log.utimes[15], {"time": log.times[15]})


def test_mcap_messages_are_in_order_of_time(entries: list[Entry]) -> None:
    times = [time for _, _, time, _ in entries]
    assert times == sorted(times)
