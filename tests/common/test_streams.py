"""A byte stream is split into frames, whatever pieces it arrives in."""

from __future__ import annotations

import struct
import tracemalloc

from hypothesis import given
from hypothesis import strategies as st

from vtbdrake.common.streams import Frames


@given(st.lists(st.binary(max_size=300), max_size=8), st.lists(st.integers(0, 10_000), max_size=20))
def test_frames_arrive_in_pieces(frames: list[bytes], ends: list[int]) -> None:
    stream, found, begin = Frames(), [], 0
    data = b"".join(struct.pack("<Q", len(frame)) + frame for frame in frames)
    for end in [*sorted(end % (len(data) + 1) for end in ends), len(data)]:
        stream.append(data[begin:end])
        begin = end
        while (frame := stream.frame()) is not None:
            found.append(frame)
    assert found == frames and not stream.partial


def test_memory_grows_with_received_bytes_only() -> None:
    received = 1 << 20
    tracemalloc.start()
    frames = Frames()
    frames.append(struct.pack("<Q", 2**64 - 1))
    for _ in range(16):
        frames.append(bytes(received // 16))
        assert frames.frame() is None
    assert tracemalloc.get_traced_memory()[0] < 4 * received
    tracemalloc.stop()
