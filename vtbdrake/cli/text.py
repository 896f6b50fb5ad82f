"""Tables of text and files of rows."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from vtbdrake.state.archive import whole_file


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns under their names, as wide as their longest cell."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    lines = (header, ["-" * width for width in widths], *rows)
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    )


def number(value: float) -> str:
    """Six digits, without a negative zero."""
    return f"{value + 0.0:.6g}"


def finite(value: Any) -> Any:
    """A number, or nested lists of them, for JSON, which knows no NaN and no infinity: null stands for these."""
    if isinstance(value, list):
        return [finite(item) for item in value]
    return value if isfinite(value) else None


def write_csv(path: Path, columns: Mapping[str, Sequence[Any]]) -> None:
    """Writes columns of equal length under their names; the file is written whole or not at all."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    write_whole(path, text.getvalue().encode())


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file whole or not at all."""
    with whole_file(path) as partial:
        partial.write_bytes(content)
