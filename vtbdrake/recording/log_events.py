"""The events of an LCM log, damaged or not."""

from __future__ import annotations

import mmap
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vtbdrake.recording.log_format import OWN, LogError
from vtbdrake.recording.scan import find_events

Place = tuple[int, int, int, int]
"""Of an event: its number, its time in microseconds, begin and end of its data in the file."""

_NONE = np.empty((0, 4), np.int64)


class LogEvents:
    """Where which event lies.

    Attributes:
        damages: offset and nature of what is not an event.
        content: of the file.
    """

    def __init__(self, path: Path) -> None:
        """
        Raises:
            OSError: the file cannot be read.
            LogError: it is no file, but a pipe, say; or it has too many channels for a log.
        """
        if path.exists() and not path.is_file():
            raise LogError(f"{path} is no log: it is a folder, a device or a pipe, not a file")
        with path.open("rb") as file:
            empty = file.seek(0, 2) == 0  # which cannot be mapped
            self.content: mmap.mmap | bytes = b"" if empty else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        found, self.damages = find_events(self.content)
        self._places: dict[str, np.ndarray] = {}
        for channel, places in found.items():
            name = channel.decode(errors="replace")
            self._places[name] = np.concatenate([self.places(name), places])

    @property
    def channels(self) -> tuple[str, ...]:
        """Those that are not the recorder's own."""
        return tuple(sorted(name for name in self._places if not name.startswith(OWN)))

    def on(self, channel: str) -> Sequence[Place]:
        """The events of a channel; none, if there is no such."""
        return [(number, utime, begin, end) for number, utime, begin, end in self.places(channel).tolist()]

    def places(self, channel: str) -> np.ndarray:
        """The same as integers of shape (n, 4)."""
        return self._places.get(channel, _NONE)

    def data(self, begin: int, end: int) -> bytes:
        """Those bytes of the file."""
        return bytes(self.content[begin:end])
