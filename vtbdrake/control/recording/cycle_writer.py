"""Makes the event of a cycle, quickly."""

from __future__ import annotations

import struct

import numpy as np

from vtbdrake.control.cycle import Cycle
from vtbdrake.control.recording.log_format import COMMANDED, CYCLE, EVENT, SENT, SYNC, VECTOR, CycleLayout
from vtbdrake.control.runtime import Runtime

_CRC_SIZE = 4


class CycleWriter:
    """The ``VTB_CYCLE`` events of one loop.

    They are all alike: each is the one before with other numbers in it.
    """

    def __init__(self, layout: CycleLayout, runtime: Runtime) -> None:
        interface, context = runtime.target.interface, runtime.context
        channel = CYCLE.encode()
        prefix = EVENT.size + len(channel)
        self._size = prefix + layout.dtype.itemsize
        self._lengths = len(channel), layout.dtype.itemsize
        self._buffer = bytearray(prefix) + layout.blank().tobytes()
        self._buffer[EVENT.size : prefix] = channel
        record = np.frombuffer(self._buffer, layout.dtype, 1, prefix)
        offsets = {name: prefix + entry[1] for name, entry in (layout.dtype.fields or {}).items()}
        self._begin = struct.Struct(">qqdd?"), offsets["utime"]
        self._frame_size = struct.Struct(">i"), offsets["size"]
        self._source, self._act = record["source"][0], record["act"][0]
        fed, commands, sent = (record[name][0] for name in ("fed", "commands", "sent"))
        self._fed = {
            signal.name: (i, fed[layout.fed[signal.name]] if signal.is_vector else None)
            for i, signal in enumerate(interface.sense)
        }
        self._commands, self._sent = (
            {
                signal.name: (i, entries[layout.commands[signal.name]] if signal.is_vector else None)
                for i, signal in enumerate(interface.act)
            }
            for entries in (commands, sent)
        )
        # What lay at the real ports before the first cycle counts as new in it.
        self._news = {}
        for signal in interface.sense:
            port = runtime.target.diagram.GetInputPort(f"real.sense.{signal.name}")
            if signal.is_vector and port.HasValue(context):
                self._news[signal.name] = np.array(port.Eval(context))
        self._abstract = {
            signal.name: _Origin(runtime.bridge.channels[signal.name])
            for signal in interface.sense
            if not signal.is_vector
        }
        self._sensed = runtime.bridge.sensed

    def hear(self, channel: str, event: int) -> None:
        """Notes that a message has come on a channel, before the bridge looks at it."""
        for name, origin in self._abstract.items():
            if origin.channel == channel:
                origin.note(self._sensed[name].count)
                origin.newest = event

    def event(self, cycle: Cycle, number: int, utime: int, before: int) -> bytes:
        """The event of ``cycle`` without its last four bytes, the checksum.

        Args:
            number: of the event.
            utime: in microseconds.
            before: bytes of the other events of this cycle.
        """
        buffer = self._buffer
        EVENT.pack_into(buffer, 0, SYNC, number, utime, *self._lengths)
        code, offset = self._begin
        code.pack_into(buffer, offset, utime, cycle.number, cycle.time, cycle.now, cycle.verdict.ok)
        self._source.fill(0)
        fed = {**self._news, **cycle.fed} if self._news else cycle.fed
        for name, value in fed.items():
            i, entries = self._fed[name]
            if entries is None:
                self._source[i] = self._abstract[name].accepted(self._sensed[name].count)
            else:
                entries[:] = value
                self._source[i] = VECTOR
        self._news = {}
        self._act.fill(0)
        for bit, values, places in (
            (COMMANDED, cycle.commands, self._commands),
            (SENT, cycle.verdict.commands, self._sent),
        ):
            for name, value in values.items():
                i, entries = places[name]
                self._act[i] |= bit
                if entries is not None:
                    entries[:] = value
        code, offset = self._frame_size
        code.pack_into(buffer, offset, before + self._size)
        return bytes(buffer[:-_CRC_SIZE])


class _Origin:
    """Which message the value of an abstract signal comes from: the newest one after which there was one value more.

    Attributes:
        channel: of the messages.
        newest: the event of the last one.
    """

    def __init__(self, channel: str) -> None:
        self.channel = channel
        self.newest = 0
        self._count = 0
        self._accepted = 0

    def note(self, count: int) -> None:
        """Takes note of how many values there have been, when all messages up to `newest` have been looked at."""
        if count > self._count:
            self._count, self._accepted = count, self.newest

    def accepted(self, count: int) -> int:
        """The event of the message with the newest value, of which there have been ``count``."""
        self.note(count)
        return self._accepted
