"""Tables of other programs as logs: values against numpy's and pandas' own reading, and bad tables against messages."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np
import pandas
import pytest
from mcap.writer import Writer

from tests.real import recordings
from vtbdrake.recording.log_format import LogError
from vtbdrake.recording.log_reader import read_log
from vtbdrake.recording.table_reader import read_table
from vtbdrake_diagrams.cart_pole import CartPoleScenario

pytestmark = pytest.mark.one_python

TIMES = np.array([0.0, 0.01, 0.02, 0.03])
DATES = np.array("2026-01-01", dtype="M8[ns]") + 10 * np.arange(4).astype("m8[ms]")
Q = np.array([[0.0, 1.0], [10.0, 2.0], [20.0, 3.0], [30.0, 4.5]])


def write(path: Path) -> Path:
    """Write the same numbers in the format of the suffix."""
    columns = {"t": TIMES, "q1": Q[:, 0], "q2": Q[:, 1], "tau": -Q[:, 0]}
    if path.suffix == ".npz":
        np.savez(path, **columns)
    elif path.suffix == ".parquet":
        pandas.DataFrame(columns).to_parquet(path)
    elif path.suffix == ".mcap":
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start()
            schema = writer.register_schema("s", "jsonschema", b"{}")
            channel = writer.register_channel("/joints", "json", schema)
            for row in zip(*columns.values(), strict=True):
                message = json.dumps(dict(zip(columns, row, strict=True)) | {"frame": "base"}).encode()
                writer.add_message(channel, round(1e9 * (5.0 + row[0])), message, 0)
            writer.finish()
    else:
        separator = {".csv": ",", ".txt": ";", ".dat": " "}[path.suffix]
        pandas.DataFrame(columns).to_csv(path, sep=separator, index=False)
    return path


def test_one_column_may_have_a_unit_of_another() -> None:
    table = {"time": [0.0, 0.1], "q1": [1.0, 2.0], "q2": [90.0, 180.0]}
    log = read_table(table, sense={"position": ["q1", "q2"]}, units={"q2": "deg"})
    np.testing.assert_allclose(log.sense["position"].values, [[1.0, np.pi / 2.0], [2.0, np.pi]], rtol=1e-15)


@pytest.mark.parametrize("suffix", [".csv", ".txt", ".dat", ".npz", ".parquet"])
def test_columns_become_signals_in_si_units(tmp_path: Path, suffix: str) -> None:
    log = read_table(
        write(tmp_path / f"run{suffix}"),
        sense={"position": ["q1", "q2"]},
        act={"torque": "tau"},
        time="t",
        units={"position": "deg", "t": "ms"},
    )
    assert np.array_equal(log.sense["position"].times, 1e-3 * TIMES)
    np.testing.assert_allclose(log.sense["position"].values, np.radians(Q), rtol=1e-15)
    assert np.array_equal(log.act["torque"].values, -Q[:, :1])
    assert (log.start, log.end) == (0.0, 0.03e-3) and log.remarks == ()
    assert "sense.position: 4 samples of 2 entries from 0 to 3e-05 s, every 0.01 ms" in str(log)


def test_topics_have_times_of_their_own(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap")
    for time, first in (("log_time", 5.0), ("t", 0.0)):
        log = read_table(path, sense={"position": ["/joints.q1", "/joints.q2"]}, time=time)
        np.testing.assert_allclose(log.sense["position"].times, first + TIMES, atol=1e-9)
        assert np.array_equal(log.sense["position"].values, Q)


def test_columns_of_another_library_are_taken_with_times_of_their_own_or_a_period() -> None:
    table = {"time": TIMES, "q": Q, "gps": [[1.0, 2.0], [3.0, 4.0]], "t_gps": [0.0, 0.5]}
    log = read_table(table, sense={"second": "q[1]", "gps": "gps"}, times={"gps": "t_gps"})
    assert np.array_equal(log.sense["second"].values[:, 0], Q[:, 1])
    assert log.sense["gps"].times.tolist() == [0.0, 0.5]
    assert read_table(table, sense={"q": "q"}, time=0.25).sense["q"].times.tolist() == [0.0, 0.25, 0.5, 0.75]


def test_what_is_left_out_is_said() -> None:
    times = [0.0, 0.01, 0.01, 0.02, 0.03, 0.5]
    q = [[1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [np.nan, 0.0], [5.0, 0.0], [6.0, 0.0]]
    log = read_table({"time": times, "q": q}, sense={"q": "q"})
    assert log.sense["q"].times.tolist() == [0.0, 0.01, 0.03, 0.5]
    assert log.sense["q"].values[:, 0].tolist() == [1.0, 3.0, 5.0, 6.0]
    assert log.remarks == (
        "the table: q: 1 of 6 rows are not whole",
        "the table: q: 1 of 5 times are repeated; the last row counts",
        "the table: q: 1 gap of more than 5 periods of 20 ms, the first from 0.03 to 0.5 s",
        "the table: q: entries that never change: 1",
    )


def test_recording_that_was_cut_off_in_a_row_is_read_up_to_it(tmp_path: Path) -> None:
    path = tmp_path / "cut.csv"
    path.write_text("time,q\n0.0,1.0\n0.1,2.0\n0.2")
    assert read_table(path, sense={"q": "q"}).sense["q"].values.tolist() == [[1.0], [2.0]]


def test_newest_sample_is_held() -> None:
    series = read_table({"time": TIMES, "q": Q}, sense={"q": "q"}).sense["q"]
    held = series.at([-0.1, 0.0, 0.015, 1.0])
    assert np.isnan(held[0]).all() and np.array_equal(held[1:], Q[[0, 1, 3]])
    assert np.array_equal(series.between(0.01, 0.03).values, Q[1:3])
    with pytest.raises(LogError, match="no sample from 1 to 2 s: they lie from 0 to 0.03 s"):
        series.between(1.0, 2.0)


@pytest.mark.parametrize(
    ("table", "options", "message"),
    [
        ({"time": TIMES, "qa": Q}, {}, "has no column 'q'; did you mean qa"),
        ({"time": TIMES, "q": Q[:3]}, {}, "q has 3 rows, its times 4"),
        (
            {"time": [0.0, 0.2, 0.1, 0.3], "q": Q},
            {},
            r"backwards, first from row 1 \(0.2 s\) to row 2 \(0.1 s\), 1 times",
        ),
        ({"time": [0.0, np.nan, 0.1, 0.3], "q": Q}, {}, "the time of row 1 is nan"),
        ({"time": TIMES, "q": ["a", "b", "c", "d"]}, {}, "the column q is not of numbers"),
        ({"time": TIMES, "q": Q * np.nan}, {}, "no row that is whole"),
        ({"time": TIMES, "q": Q}, {"units": {"q": "furlong"}}, "unknown unit 'furlong': one of deg"),
        ({"time": TIMES, "q": Q}, {"units": {"p": "deg"}}, "a unit for 'p', which is no signal"),
        ({"time": TIMES, "q": Q}, {"act": {"q": "q"}}, "q cannot be both"),
        ({"time": TIMES, "q": Q}, {"sense": {"q": "q[2]"}}, r"no q\[2\]: q has the shape \(4, 2\)"),
        ({"time": TIMES, "q": Q}, {"sense": {}}, "at least one signal"),
        ({"time": TIMES, "q": Q}, {"sense": {"q": []}}, "the signal q has no column"),
        ({"time": TIMES, "q": Q + 1j}, {}, "the column q is not of numbers: its numbers are complex"),
        ({"time": [datetime(2026, 1, 1)] * 4, "q": Q}, {}, "time is not of numbers: it is of Python's dates"),
        ({"time": [timedelta(0)] * 4, "q": Q}, {}, "time is not of numbers: it is of Python's dates or durations"),
        ({"time": DATES, "q": Q}, {"units": {"time": "ns"}}, "has its own unit: leave the unit ns out"),
        ({"time": DATES.astype("M8[Y]"), "q": Q}, {}, r"it is of datetime64\[Y\], whose unit is not known"),
        ({"time": [], "q": []}, {}, "q has no row that is whole"),
        ({"q": Q}, {"time": 0.0}, "the period: a finite number above 0 s, not 0.0"),
        ({"q": Q}, {"time": -0.1}, "the period: a finite number above 0 s, not -0.1"),
        ({"q": Q}, {"time": np.inf}, "the period: a finite number above 0 s, not inf"),
        ({"q": Q}, {"time": True}, "the period: a finite number above 0 s, not True"),
    ],
)
def test_bad_table_is_refused(table: dict[str, object], options: dict[str, object], message: str) -> None:
    with pytest.raises(LogError, match=message):
        read_table(table, **{"sense": {"q": "q"}, **options})


def test_columns_of_something_else_are_refused() -> None:
    with pytest.raises(LogError, match=r"its columns by name \(dict\(frame\)\), not a list"):
        read_table([[0.0, 1.0]], sense={"q": "q"})  # type: ignore[arg-type]


@pytest.mark.parametrize("dtype", ["M8[s]", "M8[ms]", "M8[us]", "M8[ns]", "m8[ms]", "m8[ns]", "M8[10us]", "m8[h]"])
def test_dates_and_durations_are_seconds_whatever_their_unit(dtype: str) -> None:
    # 3 h later each: a whole number of every unit.
    times = np.array("2026-01-01T00", dtype="M8[h]") + 3 * np.arange(4)
    kept = (times if dtype[0] == "M" else times - times[0]).astype(dtype)
    begin = datetime(2026, 1, 1, tzinfo=UTC).timestamp() if dtype[0] == "M" else 0.0
    log = read_table({"time": kept, "q": Q}, sense={"q": "q"})
    assert log.sense["q"].times.tolist() == [begin + 10800.0 * k for k in range(4)]


def test_dates_keep_a_fraction_of_a_second_and_dates_that_are_missing_have_no_value(tmp_path: Path) -> None:
    log = read_table({"time": DATES, "q": Q}, sense={"q": "q"})
    assert log.sense["q"].times.tolist() == [1767225600.0, 1767225600.01, 1767225600.02, 1767225600.03]
    ages = np.array([0, 1500, "NaT", 2500], dtype="m8[us]")
    assert read_table({"time": TIMES, "age": ages}, sense={"age": "age"}).sense["age"].values.T.tolist() == [
        [0.0, 0.0015, 0.0025]
    ]


def test_parquet_with_time_stamps_is_in_seconds(tmp_path: Path) -> None:
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    stamps = arrow.array(DATES.astype("M8[us]"), type=arrow.timestamp("us", tz="Europe/Berlin"))
    parquet.write_table(arrow.table({"time": stamps, "q": Q[:, 0]}), tmp_path / "a.parquet")
    times = read_table(tmp_path / "a.parquet", sense={"q": "q"}).sense["q"].times
    assert times.tolist() == [1767225600.0, 1767225600.01, 1767225600.02, 1767225600.03]


def test_column_of_parquet_that_numpy_lacks_is_told(tmp_path: Path) -> None:
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    parquet.write_table(arrow.table({"time": arrow.array([0, 1], arrow.time64("ns"))}), tmp_path / "a.parquet")
    with pytest.raises(LogError, match="a.parquet: the column time cannot be read: "):
        read_table(tmp_path / "a.parquet", sense={"q": "time"})


def test_masked_entry_is_no_sample() -> None:
    column = np.ma.masked_array([1, 2, 3, 4], mask=[False, True, False, False])
    series = read_table({"time": TIMES, "q": column}, sense={"q": "q"}).sense["q"]
    assert series.values.T.tolist() == [[1.0, 3.0, 4.0]]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.xlsx", "x", "a table ends in .csv, .dat, .txt, .npz, .parquet, .mcap"),
        ("a.lcm", "x", "Logs of the loop or of lcm-logger are read by read_log"),
        ("a.mcap", "x", "is no MCAP file: it does not begin as one"),
        ("a.csv", "", "fewer than two lines"),
        ("a.csv", "time,q,q\n0,1,2\n", "two columns 'q'"),
        ("a.csv", "time,q\n0,1\n1\n2,3\n", "row 1 has 1 columns, not 2"),
        ("a.npz", "no archive", "not an .npz of arrays"),
        ("a.parquet", "", "a.parquet is no Parquet file that can be read: "),
        ("a.parquet", "PAR1junkPAR1", "a.parquet is no Parquet file that can be read: "),
    ],
)
def test_bad_file_is_refused(tmp_path: Path, name: str, content: str, message: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(LogError, match=message):
        read_table(tmp_path / name, sense={"q": "q"})


def test_mcap_of_its_first_bytes_alone_has_no_column(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(LogError, match="has no column 'q'; it has: none"):
        read_table(path, sense={"q": "q"})


def test_table_is_no_log_and_the_error_says_what_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time,q\n0,1\n")
    with pytest.raises(LogError, match="is not a log of a control loop.*; read_table reads text, .npz, Parquet, MCAP"):
        read_log(path)
    with pytest.raises(LogError, match="is not an LCM log: it has no whole event; read_table reads text"):
        read_log(path, CartPoleScenario())


def test_recordings_of_real_robots_are_read_as_they_are() -> None:
    path = recordings("dfki_double_pendulum/**/sys_id/**/trajectory.csv")[0]
    log = read_table(path, sense={"position": ["pos_meas1", "pos_meas2"]}, act={"torque": ["tau_meas1", "tau_meas2"]})
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    assert np.array_equal(log.sense["position"].times, table[:, 0])
    assert np.array_equal(log.act["torque"].values, table[:, 13:15])
    path = recordings("victoria_park/inputs.dat")[0]
    inputs = read_table(path, sense={"speed": "1", "steering": "2"}, time="0")
    assert np.array_equal(inputs.sense["speed"].values[:, 0], np.loadtxt(path)[:, 1])


def test_episode_of_a_table_with_lists_is_read(tmp_path: Path) -> None:
    columns = {"episode_index": [0, 0, 1, 1], "timestamp": [0.0, 0.1, 0.0, 0.1], "state": Q.tolist()}
    pandas.DataFrame(columns).to_parquet(tmp_path / "episodes.parquet")
    read = partial(read_table, tmp_path / "episodes.parquet", sense={"state": "state"}, time="timestamp")
    log = read(episode=1)
    assert log.sense["state"].times.tolist() == [0.0, 0.1] and np.array_equal(log.sense["state"].values, Q[2:])
    with pytest.raises(LogError, match="episode_index has no episode 2, but 0 to 1"):
        read(episode=2)
    with pytest.raises(LogError, match="time runs backwards"):
        read()
    pandas.DataFrame({"a": [[1.0], [1.0, 2.0]]}).to_parquet(tmp_path / "ragged.parquet")
    with pytest.raises(LogError, match="the lists of the column a have several lengths"):
        read_table(tmp_path / "ragged.parquet", sense={"a": "a"}, time=0.1)
