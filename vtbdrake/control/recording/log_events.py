"""The events of an LCM log, damaged or not."""

from __future__ import annotations

import mmap
from collections.abc import Sequence
from pathlib import Path

from vtbdrake.control.lcm_maps import LONGEST_CHANNEL_NAME
from vtbdrake.control.recording.log_format import EVENT, OWN, SYNC

Place = tuple[int, int, int, int]
"""Of an event: its number, its time in microseconds, begin and end of its data in the file."""

_SYNC = SYNC.to_bytes(4, "big")


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
        """
        with path.open("rb") as file:
            empty = file.seek(0, 2) == 0  # which cannot be mapped
            self.content: mmap.mmap | bytes = b"" if empty else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self.damages: list[tuple[int, str]] = []
        self._places: dict[str, list[Place]] = {}
        self._scan()

    def _scan(self) -> None:
        content, places, size = self.content, self._places, len(self.content)
        lists: dict[bytes, list[Place]] = {}
        header_size, unpack = EVENT.size, EVENT.unpack_from
        at = 0
        while at < size:
            sync, number, utime, name, length = unpack(content, at) if at + header_size <= size else (0, 0, 0, 0, 0)
            begin = at + header_size + name
            end = begin + length
            good = sync == SYNC and 0 < name <= LONGEST_CHANNEL_NAME and end <= size
            if not good or (content[end : end + 4] != _SYNC and end < size):
                following = content.find(_SYNC, at + 1)
                # Where an event lies within another one, the length of that is wrong; else what follows is.
                if not good or 0 <= following < end:
                    torn = following < 0 and (sync == SYNC or size - at < header_size)
                    self.damages.append((at, "the file ends in the middle of an event" if torn else "no event"))
                    if following < 0:
                        break
                    at = following
                    continue
            key = content[at + header_size : begin]
            found = lists.get(key)
            if found is None:
                found = lists[key] = []
            found.append((number, utime, begin, end))
            at = end
        for key, found in lists.items():
            places.setdefault(key.decode(errors="replace"), []).extend(found)

    @property
    def channels(self) -> tuple[str, ...]:
        """Those that are not the recorder's own."""
        return tuple(sorted(name for name in self._places if not name.startswith(OWN)))

    def on(self, channel: str) -> Sequence[Place]:
        """The events of a channel; none, if there is no such."""
        return self._places.get(channel, [])

    def data(self, begin: int, end: int) -> bytes:
        """Those bytes of the file."""
        return bytes(self.content[begin:end])
