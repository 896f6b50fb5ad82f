"""Logs as tables: CSV and Parquet, one row per cycle."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vtbdrake.recording.control_log import ControlLog
from vtbdrake.recording.mcap_export import export_mcap
from vtbdrake.state.files import whole_file


def columns(log: ControlLog) -> dict[str, np.ndarray]:
    """The table of a log, n rows: ``cycle``, ``time`` (of the DPS, s), ``now`` (on the loop's clock, s), ``utime`` (us
    since 1970), ``ok``, and the entries of all vector signals.

    ``sense.<signal>`` is the newest value, ``command.<signal>`` what the DPS commanded and ``sent.<signal>`` what was
    sent after the guards; a signal of several entries has a column ``sense.<signal>[i]`` for each. NaN where there is
    none.
    """
    table = {"cycle": log.numbers, "time": log.times, "now": log.now, "utime": log.utimes, "ok": log.ok}
    for kind, signals in (("sense", log.fed), ("command", log.commands), ("sent", log.sent)):
        table |= {name: column for signal, values in signals.items() for name, column in _entries(kind, signal, values)}
    return table


def _entries(kind: str, signal: str, values: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    size = values.shape[1]
    for i in range(size):
        yield f"{kind}.{signal}[{i}]" if size > 1 else f"{kind}.{signal}", values[:, i]


def export_csv(log: ControlLog, path: str | os.PathLike[str]) -> None:
    """Writes `columns` with their names in the first row; every number reads back to the last bit."""
    table = columns(log)
    with whole_file(path) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table)
        writer.writerows(zip(*(column.tolist() for column in table.values()), strict=True))


def export_parquet(log: ControlLog, path: str | os.PathLike[str]) -> None:
    """Writes `columns` as a Parquet file.

    Raises:
        ModuleNotFoundError: pyarrow is not installed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("Parquet needs pyarrow: pip install 'vtbdrake[recording]'") from error
    with whole_file(path) as partial:
        parquet.write_table(pyarrow.table(columns(log)), partial)


EXPORTS: Mapping[str, Callable[[ControlLog, Any], None]] = {
    ".csv": export_csv,
    ".mcap": export_mcap,
    ".parquet": export_parquet,
}
"""By the suffix of the file."""


def export(log: ControlLog, path: str | os.PathLike[str]) -> None:
    """Writes a log in the format that the file's suffix names: .csv, .mcap or .parquet.

    Raises:
        ValueError: the suffix is none of them.
        ModuleNotFoundError: the library for it is not installed.
    """
    suffix = Path(path).suffix
    if suffix not in EXPORTS:
        raise ValueError(f"a log is exported to a file that ends in {', '.join(EXPORTS)}, unlike {os.fspath(path)!r}")
    EXPORTS[suffix](log, path)
