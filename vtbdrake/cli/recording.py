"""What a rollout recorded: as a table of extremes, and as files."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vtbdrake.cli.text import number, table, write_csv, write_whole
from vtbdrake.rollout import RolloutResult
from vtbdrake.state import Variables

# The column of time from t0; no address is that short.
TIME = "t"
# Larger arrays (images, clouds) get one line for all their entries.
_MANY = 64


def summary(result: RolloutResult, variables: Variables) -> str:
    """Final, least and largest value of every entry that was recorded."""
    rows: list[tuple[str, ...]] = []
    for address, values in result.record.items():
        unit = variables[address].unit if address in variables else ""
        if not isinstance(values, np.ndarray):
            rows.append((address, unit, f"{len(values)} values", "", ""))
        elif values[0].size > _MANY:
            rows.append((address, unit, f"{values[0].size} entries", *map(number, _extremes(values))))
        else:
            rows += [
                (name, unit, *map(number, (column[-1], *_extremes(column))))
                for name, column in entries(address, values)
            ]
    return table(("recorded", "unit", "final", "min", "max"), rows)


def _extremes(values: np.ndarray) -> tuple[float, float]:
    known = values[~np.isnan(values)]
    return (float(known.min()), float(known.max())) if known.size else (np.nan, np.nan)


def entries(address: str, values: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """(address, samples) of every entry of a recording of shape (n, ...); those of an array are ``address[i]``."""
    flat = values.reshape(len(values), -1)
    for i in range(flat.shape[1]):
        yield (f"{address}[{i}]" if values.ndim > 1 else address), flat[:, i]


def save_recording(result: RolloutResult, path: Path) -> None:
    """Writes the recording: a CSV table of one column per entry, or a NumPy archive of one array per address.

    Raises:
        ValueError: something recorded is not numeric.
    """
    for address, values in result.record.items():
        if not isinstance(values, np.ndarray):
            raise ValueError(f"the recording of {address} is not numeric, and cannot be saved")
    WRITERS[path.suffix](path, result.times, result.record)


def _write_csv(path: Path, times: np.ndarray, record: Mapping[str, np.ndarray]) -> None:
    columns: dict[str, Any] = {TIME: times}
    for address, values in record.items():
        columns |= dict(entries(address, values))
    write_csv(path, {name: column.tolist() for name, column in columns.items()})


def _write_npz(path: Path, times: np.ndarray, record: Mapping[str, np.ndarray]) -> None:
    content = io.BytesIO()
    arrays: dict[str, Any] = {TIME: times, **record}
    np.savez_compressed(content, **arrays)
    write_whole(path, content.getvalue())


WRITERS: dict[str, Callable[[Path, np.ndarray, Mapping[str, np.ndarray]], None]] = {
    ".csv": _write_csv,
    ".npz": _write_npz,
}
