"""What a recorder's own process does: it writes the file."""

from __future__ import annotations

import os
import time
from typing import NamedTuple

from vtbdrake.control.worker_process import FrameConnection

PAUSE = 0.02
"""Seconds between two looks whether there is something to write; the line holds more than comes meanwhile."""


class Loss(NamedTuple):
    """How many frames could not be written by now, and why the last one could not."""

    frames: int
    reason: str

    def to_bytes(self) -> bytes:
        return f"{self.frames} {self.reason}".encode()

    @classmethod
    def from_bytes(cls, data: bytes) -> Loss:
        frames, _, reason = data.decode().partition(" ")
        return cls(int(frames), reason)


def write_log(channel: FrameConnection, path: str) -> None:
    """Writes every frame at the end of a file that exists, whole or not at all; tells of those that it could not."""
    file = os.open(path, os.O_WRONLY | os.O_APPEND)
    end, lost = os.fstat(file).st_size, 0
    try:
        while True:
            frame = _next(channel)
            try:
                _write(file, frame)
                end += len(frame)
            except OSError as error:
                # A part of a frame would be damage, its absence is a gap; when there is room again, the log goes on.
                os.ftruncate(file, end)
                lost += 1
                channel.send(Loss(lost, error.strerror or str(error)).to_bytes())
    except EOFError:
        pass
    finally:
        os.close(file)


def _next(channel: FrameConnection) -> bytes:
    """The next frame. Nobody waits at the line for it: to wake him up would cost the loop more than all the rest."""
    while True:
        try:
            return channel.receive(0.0)
        except TimeoutError:
            time.sleep(PAUSE)


def _write(file: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(file, view) :]
