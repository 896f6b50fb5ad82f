"""The channel between two processes: frames over a socket, which hold objects or bytes.

A frame is its length and its bytes. It holds a message (any object, pickled, with its arrays beside it), or bytes that
are not unpacked here: events of a log, an answer of a rollout worker, or a message to be forwarded.
"""

from __future__ import annotations

import pickle
import select
import socket
import struct
import time
from typing import Any

from vtbdrake.common.streams import Frames

_COUNT = struct.Struct("<I")
LENGTH = struct.Struct("<Q")
CHUNK = 1 << 18  # bytes that are received at a time


def pack(message: Any) -> list[Any]:
    """Return a message as parts of a frame; its arrays are parts of their own, which are not copied."""
    buffers: list[pickle.PickleBuffer] = []
    body = pickle.dumps(message, protocol=5, buffer_callback=buffers.append)
    raw = [buffer.raw() for buffer in buffers]
    lengths = [len(body), *(view.nbytes for view in raw)]
    return [_COUNT.pack(len(lengths)), *map(LENGTH.pack, lengths), body, *raw]


def unpack(frame: bytes) -> Any:
    """Return the message in a frame; its arrays are read-only views of the frame."""
    (count,) = _COUNT.unpack_from(frame)
    position = _COUNT.size + count * LENGTH.size
    parts = []
    for (length,) in LENGTH.iter_unpack(memoryview(frame)[_COUNT.size : position]):
        parts.append(memoryview(frame)[position : position + length])
        position += length
    return pickle.loads(parts[0], buffers=parts[1:])


class FrameConnection:
    """An end of the connection between two processes, which carries messages and other frames; its calls block."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._frames = Frames()

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when frames arrive."""
        return self._socket.fileno()

    def receive(self, timeout: float | None = None) -> Any:
        """Return the next message; see `receive_frame`."""
        return unpack(self.receive_frame(timeout))

    def send(self, message: Any) -> None:
        """Send a message; see `send_frame`."""
        self.send_frame(*pack(message))

    def receive_frame(self, timeout: float | None = None) -> bytes:
        """Return the next frame.

        Args:
            timeout: Time in seconds; None to wait forever.

        Raises:
            EOFError: The other end is closed, and all frames were returned.
            TimeoutError: No frame arrived in time.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        while (frame := self._frames.frame()) is None:
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            if not select.select((self._socket,), (), (), left)[0]:
                raise TimeoutError(f"no frame arrived within {timeout} s")
            if not self._frames.receive(self._socket.fileno(), CHUNK):
                raise EOFError("the other end of the connection is closed")
        return frame

    def pop_frames(self) -> list[bytes]:
        """Return the frames that have arrived, in order, without waiting.

        Raises:
            EOFError: The other end is closed, and all frames were returned.
            OSError: The connection is lost.
        """
        size = CHUNK
        while size == CHUNK:  # A smaller one was all that there was.
            size = self._frames.receive(self._socket.fileno(), CHUNK)
        frames = list(iter(self._frames.frame, None))
        if not size and not frames:
            raise EOFError("it has closed the connection")
        return frames

    def send_frame(self, *parts: bytes) -> None:
        """Send one frame that consists of the parts.

        Raises:
            OSError: The other end is closed.
        """
        self._socket.sendall(b"".join((LENGTH.pack(sum(map(len, parts))), *parts)))
