"""Arrays that grow with a log, on disk: memory holds what is in use."""

from __future__ import annotations

import logging
import mmap
import os
import tempfile
from contextlib import suppress
from io import FileIO
from math import prod
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from vtbdrake.common.failures import one_line

_log = logging.getLogger(__name__)

ROWS_TOGETHER = 4096
"""Rows that are kept in memory before they are written; an array of fewer rows has no file."""


class DiskArray:
    """Rows that are appended, and then read as one array, whose pages the system reads from a file and gives back.

    The file has no name, and goes with the array. It lies in a folder of the user's choice, or else where temporary
    files are; without space on either, the rows stay in memory.

    Args:
        dtype: The type of the entries.
        shape: The shape of a row.
        folder: The folder.
    """

    def __init__(self, dtype: DTypeLike, shape: tuple[int, ...], folder: Path) -> None:
        self._dtype = np.dtype(dtype)
        self._shape, self._folder = shape, folder
        self._rows: list[np.ndarray] = []  # not written
        self._waiting = 0  # how many these are
        self._file: FileIO | None = None
        self._written = 0
        self._on_disk = True

    def append(self, rows: np.ndarray) -> None:
        """Append rows.

        Args:
            rows: Their entries, shape (n, *shape).
        """
        self._rows.append(np.array(rows, self._dtype).reshape(-1, *self._shape))
        self._waiting += len(self._rows[-1])
        if self._waiting >= ROWS_TOGETHER and self._on_disk:
            self._write()

    def array(self) -> np.ndarray:
        """Return all rows, shape (n, *shape); they cannot be changed."""
        if self._written and self._rows and self._on_disk:
            self._write()
        rows = np.concatenate([np.empty((0, *self._shape), self._dtype), *self._rows])
        if self._file is not None and self._written:
            content = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)
            written = np.frombuffer(content, self._dtype, self._written * prod(self._shape))
            written = written.reshape(-1, *self._shape)
            rows = np.concatenate([written, rows]) if self._rows else written
        rows.flags.writeable = False
        return rows

    def _write(self) -> None:
        """Write the waiting rows; where that fails, they and all further ones stay in memory."""
        rows = np.concatenate(self._rows)
        try:
            self._file = self._file or self._opened()
            if self._file.write(rows.tobytes()) < rows.nbytes:
                raise OSError("the disk is full")
        except OSError as error:
            _log.warning("the index of a log stays in memory: %s", one_line(error))
            self._rows, self._on_disk = [rows], False
            return
        self._written += len(rows)
        self._rows, self._waiting = [], 0

    def _opened(self) -> FileIO:
        with suppress(OSError), tempfile.TemporaryFile(dir=self._folder, buffering=0) as file:
            return FileIO(os.dup(file.fileno()), "r+")
        with tempfile.TemporaryFile(buffering=0) as file:
            return FileIO(os.dup(file.fileno()), "r+")
