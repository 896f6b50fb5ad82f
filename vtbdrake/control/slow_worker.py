"""The other process of a slow part, and how arrays travel to it and back."""

from __future__ import annotations

import pickle
import struct
import traceback
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vtbdrake.control.companion import Channel
    from vtbdrake.testbed.slow_function import SlowFunction

READY = b""
_COUNT = struct.Struct("<I")
_LENGTH = struct.Struct("<Q")


def serve(channel: Channel, function: SlowFunction) -> None:
    """Says that it is ready; then answers every request, arrays, by the function's arrays, or its error as text."""
    channel.send(READY)
    while True:
        request = unpack(channel.receive())
        try:
            answer: Any = function(request)
        except Exception:
            answer = traceback.format_exc()
        channel.send(b"".join(pack(answer)))


def pack(message: Any) -> list[Any]:
    """A message as parts of a frame; its arrays are parts of their own, which are not copied."""
    buffers: list[pickle.PickleBuffer] = []
    body = pickle.dumps(message, protocol=5, buffer_callback=buffers.append)
    raw = [buffer.raw() for buffer in buffers]
    lengths = [len(body), *(view.nbytes for view in raw)]
    return [_COUNT.pack(len(lengths)), *map(_LENGTH.pack, lengths), body, *raw]


def unpack(frame: bytes) -> Any:
    """The message in a frame; its arrays lie in the frame, and are read only."""
    (count,) = _COUNT.unpack_from(frame)
    position = _COUNT.size + count * _LENGTH.size
    parts = []
    for (length,) in _LENGTH.iter_unpack(memoryview(frame)[_COUNT.size : position]):
        parts.append(memoryview(frame)[position : position + length])
        position += length
    return pickle.loads(parts[0], buffers=parts[1:])
