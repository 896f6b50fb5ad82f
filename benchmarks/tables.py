"""Processor time of reading tables as signals."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow
from pyarrow import csv, parquet

import vtbdrake as vtb
from benchmarks.measure import LOWER, Benchmark, interleaved_values, processor_time, ratio, spread

# Times, and three signals of three entries.
_SENSE = {"position": ["q0", "q1", "q2"], "velocity": ["v0", "v1", "v2"]}
_ACT = {"torque": ["u0", "u1", "u2"]}


def read_table_csv(rows: int = 1_000_000, repeats: int = 5) -> Benchmark:
    """Measure the processor time of `read_table` for a CSV file of ten columns, relative to pyarrow's own reader.

    They run in turns. Both end with numpy's arrays; `read_table` also looks for rows that are not whole, for gaps and
    repeated times.
    """
    return _against_arrow("read_table_csv", "t.csv", csv.write_csv, csv.read_csv, rows, repeats)


def read_table_parquet(rows: int = 1_000_000, repeats: int = 9) -> Benchmark:
    """Measure the processor time of `read_table` for a Parquet file, relative to pyarrow's own reader."""
    return _against_arrow("read_table_parquet", "t.parquet", parquet.write_table, parquet.read_table, rows, repeats)


def _against_arrow(
    name: str,
    file: str,
    write: Callable[[Any, Path], Any],
    read: Callable[[Path], Any],
    rows: int,
    repeats: int,
) -> Benchmark:
    random = np.random.default_rng(0)
    names = [column for columns in (*_SENSE.values(), *_ACT.values()) for column in columns]
    columns = {"time": 1e-3 * np.arange(rows)} | {column: random.normal(size=rows) for column in names}
    with TemporaryDirectory() as folder:
        path = Path(folder) / file
        write(pyarrow.table(columns), path)
        ours, theirs = interleaved_values(
            lambda: processor_time(lambda: vtb.read_table(path, sense=_SENSE, act=_ACT)),
            lambda: processor_time(lambda: [column.to_numpy() for column in read(path).columns]),
            repeats=repeats,
        )
    return Benchmark(
        name=name,
        value=ratio(ours, theirs),
        unit="1",
        goal=3.0,
        better=LOWER,
        against="pyarrow's own reader and arrays of numpy, processor time",
        note=f"{rows} rows of {len(columns)} columns: {spread(ours)}, pyarrow {spread(theirs)}",
    )
