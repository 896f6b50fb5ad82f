"""The bytes of a log: LCM's events, and the layout of the cycles in it."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from vtbdrake.recording.lcm_types.lcmt_vtb_cycle import lcmt_vtb_cycle

VERSION = 3
LOG, STATE, CYCLE, CHANGE, FAULT, DIGEST, END = (
    f"VTB_{name}" for name in ("LOG", "STATE", "CYCLE", "CHANGE", "FAULT", "DIGEST", "END")
)
OWN = "VTB_"
"""With what the names of a log's own channels begin."""

SYNC = 0xEDA1DA01
EVENT = struct.Struct(">IqqII")
"""Sync word, number of the event, time in microseconds, length of the channel's name, length of the data."""

MAX_CHANNELS = 10_000
"""Of a log; in memory each costs much more than its smallest event in the file."""
MAX_DAMAGES = 1000
"""So many places where a file is damaged are told one by one."""
MAX_SIZE = 1 << 20
"""Of all signals of one side together, in numbers."""

DIGEST_SIZE = 16
VECTOR = -1
"""`lcmt_vtb_cycle.source` of a vector signal."""
COMMANDED, SENT = 1, 2
"""Bits of `lcmt_vtb_cycle.act`."""


class LogError(ValueError):
    """A file that is no log of a control loop, or a log that does not fit what it is used for."""


def event(number: int, utime: int, channel: bytes, data: bytes) -> bytes:
    """One event of an LCM log; ``utime`` in microseconds."""
    return EVENT.pack(SYNC, number, utime, len(channel), len(data)) + channel + data


class LoggedSignal(NamedTuple):
    """What a log tells of a signal: its name, its size (None if it is abstract) and its unit."""

    name: str
    size: int | None
    unit: str


def parts(signals: Sequence[LoggedSignal]) -> dict[str, slice]:
    """Which entries belong to which signal, where those of all vector signals lie one after the other."""
    vectors = [(signal.name, signal.size) for signal in signals if signal.size is not None]
    ends = accumulate(size for _, size in vectors)
    return {name: slice(end - size, end) for (name, size), end in zip(vectors, ends, strict=True)}


class CycleLayout:
    """Where everything lies in the data of a ``VTB_CYCLE`` event; the same for all cycles of one interface.

    Attributes:
        dtype: of the data as one NumPy record, with the fields of `lcmt_vtb_cycle` and ``fingerprint``.
        fed, commands: which entries of ``fed``, and of ``commands`` and ``sent``, belong to which vector signal.
    """

    def __init__(self, sense: Sequence[LoggedSignal], act: Sequence[LoggedSignal]) -> None:
        self.fed, self.commands = parts(sense), parts(act)
        self._fixed = {
            "fingerprint": lcmt_vtb_cycle().get_hash(),
            "num_sense": len(sense),
            "num_fed": sum(signal.size or 0 for signal in sense),
            "num_act": len(act),
            "num_commands": sum(signal.size or 0 for signal in act),
        }
        self.dtype = np.dtype(
            [
                ("fingerprint", ">u8"),
                ("utime", ">i8"),
                ("number", ">i8"),
                ("time", ">f8"),
                ("now", ">f8"),
                ("ok", "?"),
                ("num_sense", ">i4"),
                ("source", ">i8", (self._fixed["num_sense"],)),
                ("num_fed", ">i4"),
                ("fed", ">f8", (self._fixed["num_fed"],)),
                ("num_act", ">i4"),
                ("act", "i1", (self._fixed["num_act"],)),
                ("num_commands", ">i4"),
                ("commands", ">f8", (self._fixed["num_commands"],)),
                ("sent", ">f8", (self._fixed["num_commands"],)),
                ("size", ">i4"),
                ("crc", ">u4"),
            ]
        )

    def blank(self) -> np.ndarray:
        """A record, of shape (1,), of a cycle in which nothing happened."""
        record = np.zeros(1, self.dtype)
        for name in ("fed", "commands", "sent"):
            record[name] = np.nan
        for name, value in self._fixed.items():
            record[name] = value
        return record

    def fits(self, records: np.ndarray) -> np.ndarray:
        """Which of some records, of shape (n,), have this layout: booleans of shape (n,)."""
        good = np.ones(len(records), bool)
        for name, value in self._fixed.items():
            good &= records[name] == value
        return good
