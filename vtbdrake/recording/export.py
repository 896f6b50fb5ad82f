"""Export of logs to CSV and Parquet."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

from vtbdrake.common.extras import extra_module
from vtbdrake.recording.log import Log, Series
from vtbdrake.recording.log_entries import log_sides
from vtbdrake.recording.log_reader import ControlLog
from vtbdrake.state.archive import PRIVATE, whole_file


def export(log: ControlLog | Log, path: str | os.PathLike[str], *, mode: int = PRIVATE) -> None:
    """Write the table of `columns` of a log in the format that the file's suffix names: .csv or .parquet.

    For Foxglove and Rerun, `vtbdrake.visualization.write_scene` writes a log with its world.

    Args:
        log: The log.
        path: Path of the file. It is written as a whole or not at all.
        mode: Permissions of the file, as far as the umask leaves them; by default only its owner reads it.

    Raises:
        ValueError: The suffix is none of them.
        ModuleNotFoundError: The library for the format is not installed.
    """
    suffix = Path(path).suffix
    if suffix not in EXPORTS:
        raise ValueError(f"a log is exported to a file that ends in {', '.join(EXPORTS)}, unlike {os.fspath(path)!r}")
    with whole_file(path, mode=mode) as partial:
        EXPORTS[suffix](log, partial)


def columns(log: ControlLog | Log) -> dict[str, np.ndarray]:
    """Return a log as a table of n rows, one per cycle.

    The columns are ``cycle``, ``time`` (of the DPS, s), ``now`` (on the loop's clock, s), ``utime`` (us since 1970),
    ``ok``, and the entries of all vector signals: ``sense.<signal>`` is the newest value, ``command.<signal>`` the
    actuator command of the DPS and ``sent.<signal>`` the one sent after the guards. A signal of several entries has a
    column ``sense.<signal>[i]`` for each. Missing values are NaN.

    A `Log` has a row for each time of any signal, and the columns ``time``, ``sense.<signal>`` and ``sent.<signal>``; a
    signal without a sample at that time is NaN, so that `read_table` gives the same samples.
    """
    if isinstance(log, Log):
        times = np.unique(np.concatenate([series.times for series in (*log.sense.values(), *log.act.values())]))
        return {"time": times, **_entry_columns((name, _placed(series, times)) for name, series in log_sides(log))}
    sides = (("sense", log.fed), ("command", log.actuation), ("sent", log.sent))
    table = {"cycle": log.numbers, "time": log.times, "now": log.now, "utime": log.utimes, "ok": log.ok}
    return table | _entry_columns((f"{kind}.{name}", values) for kind, each in sides for name, values in each.items())


def _entry_columns(signals: Iterable[tuple[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return a column for each entry of signals with values of shape (n, size)."""
    table = {}
    for name, values in signals:
        size = values.shape[1]
        for i in range(size):
            table[f"{name}[{i}]" if size > 1 else name] = values[:, i]
    return table


def _placed(series: Series, times: np.ndarray) -> np.ndarray:
    """Return the samples at their times among others, NaN at the latter."""
    values = np.full((len(times), series.values.shape[1]), np.nan)
    values[np.searchsorted(times, series.times)] = series.values
    return values


def _write_csv(log: ControlLog | Log, path: Path) -> None:
    """Write a CSV file whose numbers read back to the last bit."""
    table = columns(log)
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table)
        writer.writerows(zip(*(column.tolist() for column in table.values()), strict=True))


def _write_parquet(log: ControlLog | Log, path: Path) -> None:
    pyarrow, parquet = (
        extra_module(name, purpose="Parquet", extra="recording") for name in ("pyarrow", "pyarrow.parquet")
    )
    parquet.write_table(pyarrow.table(columns(log)), path)


EXPORTS: Mapping[str, Callable[[ControlLog | Log, Path], None]] = {
    ".csv": _write_csv,
    ".parquet": _write_parquet,
}
"""Writers by the suffix of the file."""
