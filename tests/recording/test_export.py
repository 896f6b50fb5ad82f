"""Exported logs, read by pandas."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas
import pytest

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
    for suffix in (".csv", ".parquet"):
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
    with pytest.raises(ValueError, match=r"ends in .csv, .parquet, unlike '.*run.xlsx'"):
        export(log, tmp_path / "run.xlsx")


def test_missing_library_names_its_extra(log: ControlLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'vtbdrake\[recording\]'"):
        export(log, tmp_path / "run.parquet")
    assert list(tmp_path.iterdir()) == []
