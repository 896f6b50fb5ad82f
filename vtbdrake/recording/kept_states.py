"""States of a replay along its log, kept in a file beside it: where a replay goes on from, instead of the beginning."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import struct
import tempfile
import zlib
from bisect import bisect_right
from collections.abc import Mapping
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import Any, NamedTuple

from vtbdrake.common.failures import one_line
from vtbdrake.state import Snapshot

_log = logging.getLogger(__name__)

SUFFIX = ".states"
"""The end of the file's name, behind the name of the log."""

_MAGIC = b"VTBSTAT1"
# Head of a record: cycles before the state, number of bytes behind the head, and their checksum.
_RECORD = struct.Struct(">qqI")


class _Place(NamedTuple):
    """Where a state lies."""

    file: FileIO
    offset: int
    size: int


class KeptStates:
    """States of a replay by the number of cycles before them, increasing.

    They are read from the file when they are asked for, so that memory does not grow with the log. One process appends
    to the file; others read what it had when they opened it, and keep their own states in a file without a name, as
    for a folder that cannot be written. What a killed process has not finished writing is cut off.

    Args:
        log: The path of the log.
        identity: Plain data that tells the log, and what replays it; a file of another identity is replaced.

    Attributes:
        path: The path of the file.
        cycles: The numbers of cycles before the states.
    """

    def __init__(self, log: Path, identity: Mapping[str, Any]) -> None:
        self._log = log
        self.path = log.with_name(log.name + SUFFIX)
        self.cycles: list[int] = []
        self._places: list[_Place] = []
        self._header = _MAGIC + _record(-1, json.dumps(identity, sort_keys=True).encode())
        self._file = self._beside() or self._unnamed()

    @property
    def last(self) -> int:
        """Return the number of cycles before the last state; 0 if there is none."""
        return self.cycles[-1] if self.cycles else 0

    def add(self, cycles: int, state: Snapshot) -> None:
        """Keep a state behind all others. Without space on the disk, nothing more is kept.

        Args:
            cycles: The number of cycles before the state; a state that is not behind the last one is not kept.
            state: The snapshot.
        """
        if self._file is None or cycles <= self.last:
            return
        end = self._file.seek(0, os.SEEK_END)
        data = state.to_bytes()
        try:
            if self._file.write(_record(cycles, data)) < _RECORD.size + len(data):
                raise OSError("the disk is full")
        except OSError as error:
            _log.warning("no more states of the replay are kept in %s: %s", self.path, one_line(error))
            self._file.truncate(end)
            self._file = None
            return
        self._note(self._file, end, cycles, len(data))

    def before(self, cycles: int) -> Snapshot | None:
        """Return the last state with at most ``cycles`` cycles before it; None if there is none."""
        while k := bisect_right(self.cycles, cycles):
            file, offset, size = self._places[k - 1]
            try:
                return Snapshot.load(_content(os.pread(file.fileno(), _RECORD.size + size, offset)))
            except (OSError, ValueError) as error:  # It was damaged since. An earlier one does it, too.
                _log.warning("a state in %s cannot be read: %s", self.path, one_line(error))
                del self.cycles[k - 1], self._places[k - 1]
        return None

    def discard(self) -> None:
        """Forget all states, and begin the file anew."""
        self.close()
        self._file = self._fresh() or self._unnamed()

    def close(self) -> None:
        """Close the file; it stays beside the log."""
        files = {place.file for place in self._places}
        for file in files if self._file is None else {*files, self._file}:
            file.close()
        self.cycles, self._places, self._file = [], [], None

    def _note(self, file: FileIO, offset: int, cycles: int, size: int) -> None:
        self.cycles.append(cycles)
        self._places.append(_Place(file, offset, size))

    def _beside(self) -> FileIO | None:
        """Return the file beside the log, if this process may append to it, and note the states in it."""
        try:
            file = FileIO(self.path, "r+")
        except FileNotFoundError:
            return self._fresh()
        except OSError:
            with suppress(OSError):
                self._read(FileIO(self.path))
            return None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # Another process appends to it.
            self._read(file)
            return None
        end = self._read(file)
        if not end:
            return self._fresh()
        file.truncate(end)
        return file

    def _read(self, file: FileIO) -> int:
        """Note the states in a file, and return where they end; 0, and the file is closed, if it has another identity.

        Only the heads are read; the states are checked when they are asked for.
        """
        end = os.fstat(file.fileno()).st_size
        if file.read(len(self._header)) != self._header:
            file.close()
            return 0
        at = len(self._header)
        while len(head := os.pread(file.fileno(), _RECORD.size, at)) == _RECORD.size:
            cycles, size, _ = _RECORD.unpack(head)
            if cycles <= self.last or not 0 <= size <= end - at - _RECORD.size:
                break
            self._note(file, at, cycles, size)
            at += _RECORD.size + size
        return at

    def _fresh(self) -> FileIO | None:
        """Return a new file beside the log. Who still reads one that lay there keeps it, by its open handle."""
        partial = self.path.with_name(f"{self.path.name}.{os.getpid()}.partial")
        try:
            file = FileIO(partial, "w+")
            # Who may not read the log may not read the states, either.
            os.fchmod(file.fileno(), self._log.stat().st_mode & 0o777)
            file.write(self._header)
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            partial.replace(self.path)
            return file
        except OSError as error:
            _log.debug("no states are kept beside the log: %s", one_line(error))
            with suppress(OSError):
                partial.unlink()
            return None

    def _unnamed(self) -> FileIO | None:
        try:
            with tempfile.TemporaryFile(buffering=0) as file:
                return FileIO(os.dup(file.fileno()), "r+")
        except OSError as error:
            _log.warning("no states of the replay can be kept: %s", one_line(error))
            return None


def _record(cycles: int, data: bytes) -> bytes:
    return _RECORD.pack(cycles, len(data), zlib.crc32(data)) + data


def _content(record: bytes) -> bytes:
    """Return the content of a record.

    Raises:
        ValueError: Its checksum is wrong.
    """
    _, size, checksum = _RECORD.unpack_from(record)
    data = record[_RECORD.size :]
    if len(data) != size or zlib.crc32(data) != checksum:
        raise ValueError("its checksum is wrong")
    return data
