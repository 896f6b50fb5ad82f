"""Reading what another program has recorded: tables of numbers, whose columns become signals."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from datetime import date, timedelta
from functools import cache
from math import inf, pi
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array
from vtbdrake.common.suggestions import did_you_mean
from vtbdrake.recording.lerobot_format import INFO
from vtbdrake.recording.lerobot_reader import LeRobotTable
from vtbdrake.recording.log import Log, Series, checked_series
from vtbdrake.recording.log_format import LogError
from vtbdrake.recording.message_reader import BagTable, McapTable, MessageTable
from vtbdrake.recording.parquet_reader import ParquetTable
from vtbdrake.recording.text_reader import read_text

Table = Mapping[str, Any]
"""Columns by name: arrays (n,), or (n, k) for k entries."""

UNITS: Mapping[str, float] = {
    "deg": pi / 180.0, "deg/s": pi / 180.0, "rpm": pi / 30.0,
    "mm": 1e-3, "cm": 1e-2, "km/h": 1.0 / 3.6, "mm/s": 1e-3, "g": 9.80665,
    "ms": 1e-3, "us": 1e-6, "ns": 1e-9,
    "mN m": 1e-3, "kN": 1e3, "gauss": 1e-4,
}  # fmt: skip
"""Factor to SI units, of units that are no SI units; "g" is standard gravity."""


_TICKS: Mapping[str, float] = {"ns": 1e9, "us": 1e6, "ms": 1e3, "s": 1.0, "m": 1 / 60, "h": 1 / 3600, "D": 1 / 86400}
"""Ticks per second of NumPy's dates and durations, by their unit."""


def read_table(
    source: str | os.PathLike[str] | Table,
    *,
    sense: Mapping[str, str | Sequence[str]],
    act: Mapping[str, str | Sequence[str]] | None = None,
    time: str | float = "time",
    times: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    episode: int | None = None,
    episodes: str = "episode_index",
) -> Log:
    """Return the signals in a table that somebody else has recorded.

    For example::

        log = read_table("trajectory.csv", sense={"joint_position": ["pos_meas1", "pos_meas2"]},
                         act={"torque": ["tau_meas1", "tau_meas2"]}, units={"joint_position": "deg"})

    A row in which an entry of a signal is NaN or empty is no sample of that signal. The last one of several rows with
    the same time counts. What was left out is said in `Log.remarks`, gaps too.

    Args:
        source: A file: text (.csv, .dat, .txt; separated by commas, semicolons, tabs or blanks), .npz, .parquet; or a
            recording of messages: .mcap (JSON, protobuf or ROS 2), or a bag of ROS (the folder of a rosbag2, .db3,
            .bag), whose columns are ``topic.field``, ``topic.field.field[2]`` and ``topic.log_time``: only the topics
            that are asked for are decoded; or the folder of a data set of LeRobot (v3.0), whose columns are ``time``,
            its features, and their entries by name (``observation.state.elbow``). For any other format, the columns
            themselves. Without a line of names, the columns of a text are "0", "1", ..., or have the names in a comment
            (#) above the rows. With pyarrow (the extra ``recording``), a text is read ten times as fast.
        sense: For each sensor signal, its column, or the columns of its entries. ``name[2]`` is the third entry of a
            column that has several.
        act: The same for the actuator signals.
        time: The column of the times, in a recording of messages a field of each topic, such as ``log_time`` or
            ``header.stamp``; or the period in s, if the table has no times.
        times: The column of the times of the signals that have others, by signal.
        units: Units that are none of SI (`UNITS`): of a signal by its name, of one column or of times by the column.
        episode: Read the rows of this episode alone, in a table that has several.
        episodes: The column with the number of each row's episode.

    Raises:
        OSError: The file cannot be read.
        LogError: A column is missing, has another length than its times or is no number; a time is not finite or runs
            backwards; the format or a unit is unknown; the period is not positive.
        ModuleNotFoundError: The library for the format is not installed.
    """
    act, times, units = act or {}, times or {}, units or {}
    if not isinstance(source, str | os.PathLike | Mapping):
        raise LogError(f"a table is a file, or its columns by name (dict(frame)), not a {type(source).__name__}")
    if not isinstance(time, str) and not _is_period(time):
        raise LogError(f"time is the name of a column, or the period: a finite number above 0 s, not {time!r}")
    name = "the table" if isinstance(source, Mapping) else os.fspath(source)
    table = source if isinstance(source, Mapping) else _read_file(Path(source))
    if both := sense.keys() & act.keys():
        raise LogError(f"{', '.join(sorted(both))} cannot be both, a sensor signal and an actuator signal")
    _check_keys(times, {*sense, *act}, "times")
    columns = {signal: [each] if isinstance(each, str) else list(each) for signal, each in {**sense, **act}.items()}
    if empty := next((signal for signal, each in columns.items() if not each), None):
        raise LogError(f"the signal {empty} has no column")
    entries_of_all = {column for each in columns.values() for column in each}
    _check_keys(units, {*columns, *entries_of_all, *times.values(), str(time)}, "a unit")
    remarks: list[str] = []
    rows = None if episode is None else _rows_of(_column(table, episodes, name)[:, 0], episode, f"{name}: {episodes}")

    @cache  # Most signals have the same times.
    def times_in(column: str, unit: str | None) -> Array:
        shared: Array = _column(table, column, name, unit)[:, 0] * _factor(unit)
        shared.flags.writeable = False
        return shared

    def read(signals: Mapping[str, str | Sequence[str]]) -> dict[str, Series]:
        series = {}
        for signal in signals:
            each, label = columns[signal], f"{name}: {signal}"
            own_units = [units.get(entry, units.get(signal)) for entry in each]
            parts = [_column(table, entry, name, unit) for entry, unit in zip(each, own_units, strict=True)]
            entries = _side_by_side(parts, [_factor(unit) for unit in own_units], label)
            stamps = times.get(signal, time)
            if isinstance(stamps, str):
                at = times_in(_time_column(table, stamps, each[0]), units.get(stamps))
            else:
                at = stamps * np.arange(len(entries), dtype=float)
            if rows is not None:
                at, entries = at[rows], entries[rows]
            series[signal] = checked_series(label, at, entries, remarks)
        return series

    read_sense, read_act = read(sense), read(act)
    if isinstance(table, MessageTable | LeRobotTable):
        remarks += table.remarks
    return Log(name, read_sense, read_act, remarks)


def _is_period(time: object) -> bool:
    return isinstance(time, int | float | np.number) and not isinstance(time, bool) and bool(0.0 < time < inf)


def _side_by_side(columns: Sequence[Array], factors: Sequence[float], label: str) -> Array:
    """Return columns, (n, k) each, times their factors as one array, which is copied no more: read-only."""
    lengths = sorted({len(column) for column in columns})
    if len(lengths) > 1:
        raise LogError(f"{label}: its columns have {' and '.join(map(str, lengths))} rows, not one number of them")
    entries = np.empty((*lengths, sum(column.shape[1] for column in columns)))
    begin = 0
    for column, factor in zip(columns, factors, strict=True):
        end = begin + column.shape[1]
        np.multiply(column, factor, out=entries[:, begin:end])
        begin = end
    entries.flags.writeable = False
    return entries


def _rows_of(numbers: Array, episode: int, label: str) -> NDArray[Any]:
    """Return the rows of an episode, by the numbers of the episodes of all rows, (n,)."""
    rows = np.flatnonzero(numbers == episode)
    if not rows.size:
        raise LogError(f"{label} has no episode {episode}, but {np.min(numbers):g} to {np.max(numbers):g}")
    return rows


def _check_keys(mapping: Mapping[str, Any], names: set[str], noun: str) -> None:
    for key in mapping:
        if key not in names:
            raise LogError(f"{noun} for {key!r}, which is no signal or column{did_you_mean(key, names)}")


def _factor(unit: str | None) -> float:
    if unit is None:
        return 1.0
    if unit not in UNITS:
        raise LogError(f"unknown unit {unit!r}: one of {', '.join(UNITS)}, or none for SI")
    return UNITS[unit]


def _column(table: Table, name: str, source: str, unit: str | None = None) -> Array:
    """Return a column, (n, k); ``unit`` is what it has by the caller."""
    base, bracket, index = name.partition("[")
    if name in table:
        column = table[name]
    elif bracket and base in table and index.endswith("]") and index[:-1].isdigit():
        column = np.asarray(table[base])
        if column.ndim != 2 or int(index[:-1]) >= column.shape[1]:
            raise LogError(f"{source}: no {name}: {base} has the shape {column.shape}")
        column = column[:, int(index[:-1])]
    else:
        shown = ", ".join(list(table)[:20]) + (", ..." if len(table) > 20 else "")
        remarks = "; ".join(["", *getattr(table, "remarks", ())])
        near = did_you_mean(name, table, cutoff=0.5)
        raise LogError(f"{source} has no column {name!r}{near}; it has: {shown or 'none'}{remarks}")
    try:
        values = _floats(column, unit)
    except (TypeError, ValueError) as error:
        reason = _first_text(column) or str(error)
        raise LogError(f"{source}: the column {name} is not of numbers: {reason}") from None
    if values.ndim not in (1, 2):
        raise LogError(f"{source}: the column {name} has the shape {values.shape}, not (n,) or (n, k)")
    return values.reshape(len(values), -1 if values.size else (values.shape[1:] or (1,))[0])


def _floats(column: Any, unit: str | None) -> Array:
    """Return a column as floats: NaN where it is masked, dates and durations in s.

    Raises:
        TypeError: It is of complex numbers or of objects, or has a unit although its type has one.
        ValueError: It is of texts.
    """
    if isinstance(column, np.ma.MaskedArray):
        return np.where(np.ma.getmaskarray(column), np.nan, _floats(column.data, unit))
    entries = np.asarray(column)
    if entries.dtype.kind == "c":
        raise TypeError("its numbers are complex; give real and imaginary part as two columns")
    if any(isinstance(value, date | timedelta) for value in entries.ravel()[:1]):
        raise TypeError("it is of Python's dates or durations; give numbers, or numpy.datetime64 in UTC")
    if entries.dtype.kind not in "mM":
        return np.asarray(column, dtype=float)
    if unit is not None:
        raise TypeError(f"it is of {entries.dtype}, which has its own unit: leave the unit {unit} out")
    tick, count = np.datetime_data(entries.dtype)
    if tick not in _TICKS:
        raise TypeError(f"it is of {entries.dtype}, whose unit is not known in s")
    ticks = entries.astype(np.int64) * count
    whole, rest = np.divmod(ticks, round(_TICKS[tick])) if _TICKS[tick] > 1.0 else (0, ticks)
    seconds = whole + rest / _TICKS[tick]  # As its fraction is computed for itself, it is the nearest float.
    return np.where(np.isnat(entries), np.nan, seconds)


def _first_text(column: Any) -> str:
    """Return row and text of the first entry of a column that is no number; empty if the column has no texts."""
    for row, text in enumerate(np.ravel(column)):
        if not isinstance(text, str):
            return ""
        try:
            float(text)
        except ValueError:
            units = "; begin a line of units or comments with #" if row == 0 else ""
            return f"row {row} is {str(text)!r}{units}"
    return ""


def _time_column(table: Table, name: str, column: str) -> str:
    """Return the name of a column of times; in a recording of messages, of the topic that ``column`` is of."""
    return f"{table.topic_of(column)}.{name}" if isinstance(table, MessageTable) and name not in table else name


# -- formats


def _read_file(path: Path) -> Table:
    if (path / "metadata.yaml").is_file():
        return BagTable(path)
    if (path / INFO).is_file():
        return LeRobotTable(path)
    if path.is_dir():
        raise LogError(
            f"{path} is a folder, not a file, and no rosbag2, which has a metadata.yaml, nor a data set of LeRobot, "
            f"which has a {INFO}"
        )
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise LogError(
            f"{path}: a table ends in {', '.join(READERS)}. Logs of the loop or of lcm-logger are read by read_log. "
            'Read another format with its library, and give the columns: read_table({"time": t, "q": q}, ...)'
        )
    return READERS[suffix](path)


def _read_npz(path: Path) -> Table:
    try:
        with np.load(path) as arrays:
            return dict(arrays)
    except (ValueError, EOFError, KeyError) as error:
        raise LogError(f"{path} is not an .npz of arrays without pickles: {error}") from error


READERS: Mapping[str, Callable[[Path], Table]] = {
    **dict.fromkeys((".csv", ".dat", ".txt"), read_text),
    ".npz": _read_npz,
    ".parquet": ParquetTable,
    ".mcap": McapTable,
    ".db3": BagTable,
    ".bag": BagTable,
}
"""Readers by the suffix of the file."""
