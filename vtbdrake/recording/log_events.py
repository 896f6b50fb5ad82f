"""The events of an LCM log, whoever has written it, damaged ones included."""

from __future__ import annotations

import mmap
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vtbdrake.recording.disk_array import ROWS_TOGETHER, DiskArray
from vtbdrake.recording.log_codec import find_events
from vtbdrake.recording.log_format import LOG, OWN_PREFIX, LogError

NO_LCM_LOG = "read_table reads text, .npz, Parquet, MCAP, bags of ROS and data sets of LeRobot"
"""The remedy for a file that has no event of LCM."""

_NO_EVENTS = np.empty((0, 4), np.int64)


class Damage(NamedTuple):
    """Unreadable bytes of a file: their offset and the kind of damage.

    Attributes:
        offset: The offset of the first byte in the file.
        description: The kind of the damage.
    """

    offset: int
    description: str

    def __str__(self) -> str:
        return f"at byte {self.offset}: {self.description}"


class Message(NamedTuple):
    """A message that came or went: number of its event, time in microseconds since 1970, channel and bytes.

    Attributes:
        event: The number of its event.
        utime: The time in microseconds since 1970.
        channel: The LCM channel.
        data: The bytes.
    """

    event: int
    utime: int
    channel: str
    data: bytes


class LogEvents:
    """The events of an LCM log, damaged or not. Where they lie is kept on disk, see `DiskArray`.

    Attributes:
        damages: Offset and kind of all bytes that are not events.
        content: Bytes of the file.
        folder: The folder of the file.

    Raises:
        OSError: The file cannot be read.
        LogError: The path is not a regular file, or the file has too many channels for a log.
    """

    def __init__(self, path: Path) -> None:
        if path.exists() and not path.is_file():
            raise LogError(f"{path} is not a log: it is a folder, a device or a pipe, not a file")
        self.folder = path.parent
        with path.open("rb") as file:
            empty = file.seek(0, 2) == 0  # An empty file cannot be mapped.
            self.content: mmap.mmap | bytes = b"" if empty else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        kept: dict[str, DiskArray] = {}

        def keep(channel: bytes, places: np.ndarray) -> None:
            name = channel.decode(errors="replace")
            if name not in kept:
                kept[name] = DiskArray(np.int64, (4,), self.folder)
            kept[name].append(places)
            self.release()

        self.damages = find_events(self.content, keep, ROWS_TOGETHER)
        self._places = {name: places.array() for name, places in kept.items()}

    @property
    def channels(self) -> tuple[str, ...]:
        """Return the channels of the messages, without the recorder's own."""
        return tuple(sorted(name for name in self._places if not name.startswith(OWN_PREFIX)))

    @property
    def of_loop(self) -> bool:
        """Return whether a `Recorder` has written the log, not another program."""
        return LOG in self._places

    def places(self, channel: str) -> np.ndarray:
        """Return the events of a channel as integers of shape (n, 4).

        The columns are event number, time in microseconds, and begin and end of the data in the file.
        """
        return self._places.get(channel, _NO_EVENTS)

    def on(self, channel: str) -> Sequence[tuple[int, int, int, int]]:
        """Return the rows of `places` as tuples."""
        return [(number, utime, begin, end) for number, utime, begin, end in self.places(channel).tolist()]

    def data(self, begin: int, end: int) -> bytes:
        """Return a range of bytes of the file.

        Args:
            begin: Offset of the first byte.
            end: Offset behind the last byte.
        """
        return bytes(self.content[begin:end])

    def release(self) -> None:
        """Give back the memory into which parts of the file were read; what is needed again is read again."""
        if isinstance(self.content, mmap.mmap):
            self.content.madvise(mmap.MADV_DONTNEED)
