"""The write-ahead log beside an SQLite file: whether damage hides what was written to it.

SQLite reads the log (https://www.sqlite.org/fileformat2.html#walformat) up to the first frame whose checksum is wrong,
and takes the rest for remains of an earlier log, which it is in most files. A flipped bit thus drops all later
transactions without a word.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

# Magic, version, page size, number of the checkpoint, two salts, two checksums.
_HEADER = struct.Struct(">8I")
# Page, size of the file after a commit, two salts, two checksums.
_FRAME = struct.Struct(">6I")
# The last bit of the magic number says whether the checksums add words of big or of little endian.
_MAGIC = {0x377F0682: "<", 0x377F0683: ">"}


@dataclass(frozen=True)
class LostWrites:
    """The part of a log that SQLite would ignore although it was written since the last checkpoint.

    Attributes:
        readable: Bytes at the beginning of the log that SQLite reads.
        frames: Complete pages behind them.
    """

    readable: int
    frames: int


def lost_writes(path: Path) -> LostWrites | None:
    """Return the damage that hides in the write-ahead log of an SQLite file; None if there is none, or no log.

    A log that ends within a frame is no damage: its process was killed while it wrote.
    """
    try:
        log = path.with_name(path.name + "-wal").read_bytes()
    except FileNotFoundError:
        return None
    if len(log) <= _HEADER.size:
        return None
    magic, _, page_size, _, *salts, first, second = _HEADER.unpack_from(log)
    order = _MAGIC.get(magic)
    if order is None or (first, second) != (sums := _add((0, 0), log[: _HEADER.size - 8], order)):
        return LostWrites(0, (len(log) - _HEADER.size) // (_FRAME.size + 4096))
    step = _FRAME.size + page_size
    starts = range(_HEADER.size, len(log) - step + 1, step)
    for start in starts:
        *_, first, second = _FRAME.unpack_from(log, start)
        sums = _add(sums, log[start : start + 8], order)
        sums = _add(sums, log[start + _FRAME.size : start + step], order)
        if (first, second) != sums or not _is_new(log, start, salts, all):
            # Frames of an earlier log have other salts. Damage may have changed one of them.
            new = sum(_is_new(log, later, salts, any) for later in starts if later >= start)
            return LostWrites(start, new) if new else None
    return None


def _is_new(log: bytes, start: int, salts: list[int], which: Callable[[Iterable[bool]], bool]) -> bool:
    _, _, *frame_salts, _, _ = _FRAME.unpack_from(log, start)
    return which(a == b for a, b in zip(frame_salts, salts, strict=True))


def _add(sums: tuple[int, int], data: bytes, order: str) -> tuple[int, int]:
    """Return the running checksums of SQLite after further data, whose length is a multiple of 8."""
    first, second = sums
    for a, b in struct.iter_unpack(f"{order}2I", data):
        first = (first + a + second) & 0xFFFFFFFF
        second = (second + b + first) & 0xFFFFFFFF
    return first, second
