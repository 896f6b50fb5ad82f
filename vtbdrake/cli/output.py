"""Output of the commands: numbers, tables, CSV files, recordings."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from vtbdrake.state.archive import whole_file
from vtbdrake.state.variables import text_table

RECORDINGS = (".csv", ".npz")
"""Suffixes of the files that `save_recording` writes."""

table = text_table


def number(value: float) -> str:
    """Format a number with six digits, and without a negative zero."""
    return f"{value + 0.0:.6g}"


def finite(value: Any) -> Any:
    """Replace NaN and infinity by None in a number or in nested lists, because JSON lacks them."""
    if isinstance(value, list):
        return [finite(item) for item in value]
    return value if isfinite(value) else None


def write_whole(path: Path, content: bytes) -> None:
    """Write a file whole or not at all."""
    with whole_file(path) as partial:
        partial.write_bytes(content)


def write_csv(path: Path, columns: Mapping[str, Sequence[Any]]) -> None:
    """Write columns of equal length under their names."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    write_whole(path, text.getvalue().encode())


def entries(address: str, values: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (address, samples) for each entry of a recording of shape (n, ...); arrays have entries ``address[i]``."""
    flat = values.reshape(len(values), -1)
    for i in range(flat.shape[1]):
        yield (f"{address}[{i}]" if values.ndim > 1 else address), flat[:, i]


def save_recording(path: Path, times: np.ndarray, record: Mapping[str, Any]) -> None:
    """Write recorded values beside the time ``t``: a column per entry in a .csv, or an array per address in an .npz.

    Args:
        path: The file, with a suffix of `RECORDINGS`.
        times: The times of the samples, shape (n,), in seconds.
        record: Address -> samples, shape (n, ...).

    Raises:
        ValueError: A recording is not numeric.
    """
    for address, values in record.items():
        if not isinstance(values, np.ndarray):
            raise ValueError(f"the recording of {address} is not numeric, and cannot be written to {path}")
    if path.suffix == ".npz":
        content = io.BytesIO()
        arrays: dict[str, Any] = {"t": times, **record}
        np.savez_compressed(content, **arrays)
        write_whole(path, content.getvalue())
        return
    columns = {"t": times}
    for address, values in record.items():
        columns |= dict(entries(address, values))
    write_csv(path, {name: column.tolist() for name, column in columns.items()})
