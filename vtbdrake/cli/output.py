"""Output of the commands: text or JSON, numbers, tables, CSV files, recordings.

A command prints by `show` (both forms), `say` (text alone) and `emit` (JSON alone), and has the option `json_option`.
An object of JSON is one line. Numbers that are not finite are null, since JSON lacks them.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.cli import json_requested
from vtbdrake.cli.options import option
from vtbdrake.common.json_data import plain

if TYPE_CHECKING:
    import numpy as np

RECORDINGS = (".csv", ".npz")
"""Suffixes of the files that `save_recording` writes."""

json_option = option("--json", "Print JSON instead of text; an error, too.", is_flag=True, expose_value=False)


def show(text: object, data: Any) -> None:
    """Print a result: the text, or with ``--json`` the data, for which see `plain`.

    Args:
        text: The result for a reader.
        data: The same result as plain data, for a program.
    """
    say(text)
    emit(data)


def say(text: object) -> None:
    """Print a text, unless ``--json`` asks for data."""
    if not json_requested():
        click.echo(str(text))


def emit(data: Any) -> None:
    """Print data, for which see `plain`, as a line of JSON if ``--json`` asks for it."""
    if json_requested():
        click.echo(json.dumps(plain(data), allow_nan=False))


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table with aligned columns.

    Args:
        header: The titles of the columns.
        rows: The rows of cells, each as long as the header.
    """
    from vtbdrake.state.variables import text_table

    return text_table(header, rows)


def number(value: float) -> str:
    """Format a number with six digits, and without a negative zero."""
    return f"{value + 0.0:.6g}"


def write_whole(path: Path, content: bytes, *, mode: int | None = None) -> None:
    """Write a file whole or not at all, with these permissions; by default with those that the umask leaves.

    Args:
        path: The file, which is replaced if it exists.
        content: The whole content.
        mode: The permission bits of the file, such as 0o600, as far as the umask leaves them.
    """
    from vtbdrake.state.archive import whole_file

    with whole_file(path, mode=mode) as partial:
        partial.write_bytes(content)


def write_csv(path: Path, columns: Mapping[str, Sequence[Any]], *, mode: int | None = None) -> None:
    """Write columns of equal length under their names; see `write_whole` for ``mode``.

    Args:
        path: The file, which is replaced if it exists.
        columns: The values by the title of their column.
        mode: The permission bits of the file; None for what the umask leaves.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    write_whole(path, text.getvalue().encode(), mode=mode)


def entries(address: str, values: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (address, samples) for each entry of a recording of shape (n, ...); arrays have entries ``address[i]``.

    Args:
        address: Address of the recorded variable or port.
        values: The samples, shape (n, ...); the entries of an array are counted in row-major order.
    """
    flat = values.reshape(len(values), -1)
    for i in range(flat.shape[1]):
        yield (f"{address}[{i}]" if values.ndim > 1 else address), flat[:, i]


def save_recording(path: Path, times: np.ndarray, record: Mapping[str, Any], *, mode: int | None = None) -> None:
    """Write recorded values beside the time ``t``: a column per entry in a .csv, or an array per address in an .npz.

    Args:
        path: The file, with a suffix of `RECORDINGS`.
        times: The times of the samples, shape (n,), in seconds.
        record: Address -> samples, shape (n, ...).
        mode: Permissions of the file, see `write_whole`.

    Raises:
        ValueError: A recording is not numeric.
    """
    import numpy as np

    for address, values in record.items():
        if not isinstance(values, np.ndarray):
            raise ValueError(f"the recording of {address} is not numeric, and cannot be written to {path}")
    if path.suffix == ".npz":
        content = io.BytesIO()
        arrays: dict[str, Any] = {"t": times, **record}
        np.savez_compressed(content, **arrays)
        write_whole(path, content.getvalue(), mode=mode)
        return
    columns = {"t": times}
    for address, values in record.items():
        columns |= dict(entries(address, values))
    write_csv(path, {name: column.tolist() for name, column in columns.items()}, mode=mode)
