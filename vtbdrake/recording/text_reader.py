"""Tables in text: numbers in columns, separated by commas, semicolons, tabs or blanks.

Arrow reads a table in which every row has the same number of fields. Rows of several lengths, and a machine without
pyarrow, are left to Python's own reader of CSV, which is about ten times slower and can name the row that is wrong.
Columns with others than numbers are converted by the same function in both cases.
"""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.recording.log_format import LogError

_BYTE_ORDER_MARK = b"\xef\xbb\xbf"

_LONGEST_ROW = 1 << 20
"""Bytes at the end of a text in which its last row begins: Arrow's own limit for a row."""


def read_text(path: Path) -> Mapping[str, NDArray[Any]]:
    """Return the columns of a text by name: floats, NaN where a field is empty; texts, if some are no numbers.

    Without a line of names, the columns are "0", "1", ... A last row that was cut off is left out.

    Args:
        path: The file, in UTF-8.

    Raises:
        LogError: It has fewer than two lines, two columns with one name, or a row with too few fields.
    """
    layout = _Layout.of(path)
    columns = _read_by_arrow(path, layout) if find_spec("pyarrow") else None
    return _read_by_rows(path, layout) if columns is None else columns


@dataclass(frozen=True)
class _Layout:
    """What the first line of a text tells.

    Attributes:
        names: The names of the columns.
        separator: The character between fields; None for blanks.
        has_header: Whether the first line has the names, and is no row.
    """

    names: list[str]
    separator: str | None
    has_header: bool

    @classmethod
    def of(cls, path: Path) -> _Layout:
        """Return the layout of a text."""
        with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
            head = file.readline()
        separator = next((mark for mark in ",;\t" if mark in head), None)
        names = [name.strip().strip('"') for name in _fields(head, separator)]
        if not names:
            raise LogError(f"{path} is no table: it has fewer than two lines")
        if all(_is_number(name) for name in names):
            return cls([str(k) for k in range(len(names))], separator, False)
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise LogError(f"{path} has two columns {twice!r}")
        return cls(names, separator, True)


def _fields(line: str, separator: str | None) -> list[str]:
    return line.split() if separator is None else next(csv.reader([line], delimiter=separator), [])


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _numbers(column: Sequence[str]) -> NDArray[Any]:
    """Return a column as floats, NaN where it is empty; as texts, if it has others than numbers."""
    texts = np.array(column)
    texts[np.char.strip(texts) == ""] = "nan"
    try:
        return texts.astype(float)
    except ValueError:
        return texts


# -- by Arrow


class _ArrowColumns(Mapping[str, NDArray[Any]]):
    """The columns of a table of Arrow: floats, or the bytes of texts."""

    def __init__(self, table: Any) -> None:
        self._table = table

    def __getitem__(self, name: str) -> NDArray[Any]:
        column = self._table[name]
        if str(column.type) == "double":
            return np.asarray(column.to_numpy())
        return _numbers([(text or b"").decode(errors="replace") for text in column.to_pylist()])

    def __iter__(self) -> Iterator[str]:
        return iter(self._table.column_names)

    def __len__(self) -> int:
        return len(self._table.column_names)


def _read_by_arrow(path: Path, layout: _Layout) -> _ArrowColumns | None:
    """Return the columns; None if Arrow cannot read the rows, because they have several lengths or there are none."""
    import pyarrow
    from pyarrow import csv as arrow_csv

    rows = _rows(pyarrow.memory_map(os.fspath(path)).read_buffer(), layout)
    first = _first_row(rows, layout)
    if len(first) < len(layout.names):
        return None
    # A separator may end each row: a field without a name.
    names = layout.names + [f"\0{k}" for k in range(len(first) - len(layout.names))]
    types = {name: pyarrow.float64() for name in names}
    types |= {name: pyarrow.binary() for name, field in zip(names, first, strict=True) if not _is_number(field or "0")}
    while True:
        try:
            table = arrow_csv.read_csv(
                pyarrow.BufferReader(rows),
                read_options=arrow_csv.ReadOptions(column_names=names),
                parse_options=arrow_csv.ParseOptions(
                    delimiter=layout.separator or " ", quote_char=False if layout.separator is None else '"'
                ),
                convert_options=arrow_csv.ConvertOptions(
                    column_types=types, include_columns=layout.names, null_values=[""]
                ),
            )
            return _ArrowColumns(table)
        except pyarrow.ArrowInvalid as error:
            # A column whose first field is a number, or empty, has a text further down.
            column = re.search(r"In CSV column #(\d+)", str(error))
            if column is None or types[name := names[int(column[1])]] == pyarrow.binary():
                return None
            types[name] = pyarrow.binary()


def _rows(content: Any, layout: _Layout) -> Any:
    """Return the rows of a text as bytes or a buffer, with one blank between fields, without a last row cut off."""
    view = memoryview(content)
    start = len(_BYTE_ORDER_MARK) if bytes(view[:3]) == _BYTE_ORDER_MARK else 0
    if layout.has_header and (head := re.search(rb"\r?\n|\r|$", view)):
        start = head.end()
    rows = content[start:]
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
        if layout.has_header:
            file.readline()
        if layout.separator is None:
            rows = [line.split() for line in file if line.strip()]
        else:
            rows = [row for row in csv.reader(file, delimiter=layout.separator) if row]
    if not rows:
        raise LogError(f"{path} is no table: it has fewer than two lines")
    short = [number for number, row in enumerate(rows) if len(row) < len(names)]
    if short == [len(rows) - 1]:
        rows.pop()  # The recording was cut off in the middle of a row.
    elif short:
        raise LogError(f"{path}: row {short[0]} has {len(rows[short[0]])} columns, not {len(names)}")
    columns = list(zip(*rows, strict=False))  # A separator may end each row.
    return {name: _numbers(column) for name, column in zip(names, columns, strict=False)}
