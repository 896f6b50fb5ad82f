"""Tables of logs, read by others."""

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
    servo = Servo()
    path = tmp_path_factory.mktemp("log") / "run.lcm"
    with Recorder(servo.runtime, path):
        servo.runtime.run(cycles=20)
        servo.runtime.write({"dps.trouble": 1.0})
        servo.runtime.run(cycles=5)
    return read_log(path)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_pandas_reads_every_number_to_the_last_bit(log: ControlLog, tmp_path: Path, suffix: str) -> None:
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
    assert table["command.velocity[0]"].isna().sum() == 5


def test_another_suffix_is_refused(log: ControlLog, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"ends in .csv, .mcap, .parquet, unlike '.*run.xlsx'"):
        export(log, tmp_path / "run.xlsx")


@pytest.mark.parametrize(("module", "suffix"), [("pyarrow", ".parquet"), ("mcap.writer", ".mcap")])
def test_a_library_that_is_not_installed_is_named_with_its_extra(
    log: ControlLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, suffix: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'vtbdrake\[recording\]'"):
        export(log, tmp_path / f"run{suffix}")
    assert list(tmp_path.iterdir()) == []
