"""Tables in text: numbers in columns, separated by commas, semicolons, tabs or blanks.

Arrow reads a table in which every row has the same number of fields. Rows of several lengths, and a machine without
pyarrow, are left to Python's own reader of CSV, which is about ten times slower and can name the row that is wrong.
Columns with others than numbers are converted by the same function in both cases.
"""

from __future__ import annotations

import csv
import mmap
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from vtbdrake.recording.log_format import LogError

_COMMENTS = ("#", "%", "//")
"""The beginnings of a line that is no row."""

_ABOVE = re.compile(r"\s*$|sep=.\s*$", re.IGNORECASE)
"""Further lines above the names: blank ones, and the separator as Excel writes it."""

_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d+(?:[eE][+-]?\d+)?\s*")
"""A number with a decimal comma, between separators that are no commas."""

_LONGEST_ROW = 1 << 20
"""Bytes at the end of a text in which its last row begins: Arrow's own limit for a row."""


def read_text(path: Path) -> Mapping[str, NDArray[Any]]:
    """Return the columns of a text by name: floats, NaN where a field is empty; texts, if some are no numbers.

    Without a line of names, the columns are "0", "1", ..., or have the names in a comment above the rows. Lines that
    begin with #, % or // are comments. Where semicolons, tabs or blanks separate fields, numbers may have decimal
    commas. A last row that was cut off is left out.

    Args:
        path: The file, in UTF-8.

    Raises:
        LogError: It has fewer than two lines, two columns with one name, or a row with too few or too many fields.
    """
    layout = _Layout.of(path)
    columns = _read_by_arrow(path, layout) if find_spec("pyarrow") else None
    return _read_by_rows(path, layout) if columns is None else columns


@dataclass(frozen=True)
class _Layout:
    """What the first lines of a text tell.

    Attributes:
        names: The names of the columns.
        separator: The character between fields; None for blanks.
        decimal: The decimal mark, a point or a comma.
        skipped: Number of lines before the first row: comments, and the line of names.
    """

    names: list[str]
    separator: str | None
    decimal: str
    skipped: int

    @classmethod
    def of(cls, path: Path) -> _Layout:
        """Return the layout of a text."""
        with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
            above, head = _after_comments(file)
            below, first = _after_comments(file)
        if "\0" in head:
            raise LogError(
                f"{path} is no text in UTF-8: if it is a table in UTF-16, as spreadsheets write it, convert it by "
                "iconv -f UTF-16 -t UTF-8"
            )
        separator = next((mark for mark in ",;\t" if mark in head), None)
        if ";" in head and ";" in first:  # Its commas are decimal.
            separator = ";"
        fields = [name.strip().strip('"') for name in _fields(head, separator)]
        if not fields:
            raise LogError(f"{path} is no table: it has fewer than two lines")
        decimal = "," if any(map(_DECIMAL_COMMA.fullmatch, _fields(first or head, separator))) else "."
        if not all(_is_number(field, decimal) for field in fields):
            return cls(_checked_names(fields, path), separator, decimal, len(above) + 1 + len(below))
        comment = next((line for line in reversed(above) if line.startswith(_COMMENTS)), "")
        names = _fields(comment.lstrip("#%/ ").strip(), separator)  # As numpy.savetxt writes its header.
        if len(names) != len(fields):
            names = [str(k) for k in range(len(fields))]
        return cls(_checked_names([name.strip() for name in names], path), separator, decimal, len(above))


def _after_comments(file: TextIO) -> tuple[list[str], str]:
    """Return the comments and blank lines that follow in a file, and the line after them."""
    comments = []
    while (line := file.readline()) and (line.startswith(_COMMENTS) or _ABOVE.match(line)):
        comments.append(line)
    return comments, line


def _checked_names(names: list[str], path: Path) -> list[str]:
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise LogError(f"{path} has two columns {twice!r}")
    return names


def _fields(line: str, separator: str | None) -> list[str]:
    return line.split() if separator is None else next(csv.reader([line], delimiter=separator), [])


def _is_number(text: str, decimal: str) -> bool:
    try:
        float(text.replace(decimal, "."))
    except ValueError:
        return False
    return True


def _numbers(column: Sequence[str], layout: _Layout) -> NDArray[Any]:
    """Return a column as floats, NaN where it is empty; as texts, if it has others than numbers."""
    texts = np.array(column)
    texts[np.char.strip(texts) == ""] = "nan"
    # The first row does not show the decimal mark if its numbers are whole.
    for decimal in dict.fromkeys((layout.decimal, "." if layout.separator == "," else ",")):
        with suppress(ValueError):
            return (texts if decimal == "." else np.char.replace(texts, decimal, ".")).astype(float)
    return texts


def _check_width(fields: Sequence[str], row: int, path: Path, layout: _Layout) -> None:
    """Check that a row has no more fields than there are names, but for empty ones after a last separator.

    Raises:
        LogError: It has more.
    """
    if not any(field.strip() for field in fields[len(layout.names) :]):
        return
    cause = ": is there a line above the names that is no comment (#), or a column without a name?"
    if layout.separator == "," and all(re.fullmatch(r"\s*[+-]?\d*(?:[eE][+-]?\d+)?\s*", field) for field in fields):
        cause = (
            ": decimal commas cannot be told from commas between columns; write decimal points, or separate the "
            "columns by semicolons"
        )
    raise LogError(f"{path}: row {row} has {len(fields)} columns, but there are {len(layout.names)} names{cause}")


# -- by Arrow


class _ArrowColumns(Mapping[str, NDArray[Any]]):
    """The columns of a table of Arrow: floats, or the bytes of texts."""

    def __init__(self, table: Any, layout: _Layout) -> None:
        self._table = table
        self._layout = layout

    def __getitem__(self, name: str) -> NDArray[Any]:
        column = self._table[name]
        if str(column.type) == "double":
            return np.asarray(column.to_numpy())
        return _numbers([(text or b"").decode(errors="replace") for text in column.to_pylist()], self._layout)

    def __iter__(self) -> Iterator[str]:
        return iter(self._table.column_names)

    def __len__(self) -> int:
        return len(self._table.column_names)


def _read_by_arrow(path: Path, layout: _Layout) -> _ArrowColumns | None:
    """Return the columns; None if Arrow cannot read the rows: several lengths, comments between them, or no row."""
    import pyarrow
    from pyarrow import csv as arrow_csv

    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        end_of_line = max(_start(content, layout) - 1, 0)
        if any(content.rfind(b"\n" + mark.encode()) >= end_of_line for mark in _COMMENTS):
            return None
    rows = _rows(pyarrow.memory_map(os.fspath(path)).read_buffer(), layout)
    first = _first_row(rows, layout)
    if len(first) < len(layout.names):
        return None
    _check_width(first, 0, path, layout)
    # A separator may end each row: a field without a name.
    names = layout.names + [f"\0{k}" for k in range(len(first) - len(layout.names))]
    types = {name: pyarrow.float64() for name in names}
    types |= {
        name: pyarrow.binary()
        for name, field in zip(names, first, strict=True)
        if not _is_number(field or "0", layout.decimal)
    }
    while True:
        try:
            table = arrow_csv.read_csv(
                pyarrow.BufferReader(rows),
                read_options=arrow_csv.ReadOptions(column_names=names),
                parse_options=arrow_csv.ParseOptions(
                    delimiter=layout.separator or " ", quote_char=False if layout.separator is None else '"'
                ),
                convert_options=arrow_csv.ConvertOptions(
                    column_types=types, include_columns=layout.names, null_values=[""], decimal_point=layout.decimal
                ),
            )
            return _ArrowColumns(table, layout)
        except pyarrow.ArrowInvalid as error:
            # A column whose first field is a number, or empty, has a text further down.
            column = re.search(r"In CSV column #(\d+)", str(error))
            if column is None or types[name := names[int(column[1])]] == pyarrow.binary():
                return None
            types[name] = pyarrow.binary()


def _start(content: Any, layout: _Layout) -> int:
    """Return the offset of the first row in the bytes of a text."""
    lines = re.match(rb"(?:\xef\xbb\xbf)?(?:[^\r\n]*(?:\r\n|\r|\n|$)){%d}" % layout.skipped, content)
    return lines.end() if lines else 0


def _rows(content: Any, layout: _Layout) -> Any:
    """Return the rows of a text as bytes or a buffer, with one blank between fields, without a last row cut off."""
    rows = content[_start(content, layout) :]
    if layout.separator is None and re.search(rb"  |\t|^ | \r?$", rows, re.MULTILINE):
        rows = re.sub(rb"[ \t]*[\r\n]+[ \t]*", b"\n", re.sub(rb"[ \t]+", b" ", rows)).strip(b" ")
    tail = bytes(memoryview(rows)[-_LONGEST_ROW:])
    last = re.split(rb"[\r\n]", tail.rstrip(b"\r\n"))[-1]
    if len(_fields(last.decode(errors="replace"), layout.separator)) < len(layout.names):
        return rows[: len(rows) - len(tail) + tail.rindex(last)]
    return rows


def _first_row(rows: Any, layout: _Layout) -> list[str]:
    """Return the fields of the first row."""
    line = re.search(rb"[^\r\n]+", rows)
    return _fields(line[0].decode(errors="replace"), layout.separator) if line else []


# -- by rows


def _read_by_rows(path: Path, layout: _Layout) -> dict[str, NDArray[Any]]:
    names = layout.names
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
        for _ in range(layout.skipped):
            file.readline()
        if layout.separator is None:
            rows = [line.split() for line in file if line.strip() and not line.startswith(_COMMENTS)]
        else:
            reader = csv.reader(file, delimiter=layout.separator)
            rows = [row for row in reader if row and not row[0].startswith(_COMMENTS)]
    if not rows:
        raise LogError(f"{path} is no table: it has fewer than two lines")
    short = [number for number, row in enumerate(rows) if len(row) < len(names)]
    if short == [len(rows) - 1]:
        rows.pop()  # The recording was cut off in the middle of a row.
    elif short:
        cause = "" if short[0] else f" ({', '.join(names)}): is the line above a comment? Begin it with #"
        raise LogError(f"{path}: row {short[0]} has {len(rows[short[0]])} columns, not {len(names)}{cause}")
    for number, row in enumerate(rows):
        _check_width(row, number, path, layout)
    columns = list(zip(*rows, strict=False))  # A separator may end each row.
    return {name: _numbers(column, layout) for name, column in zip(names, columns, strict=False)}
