"""A byte stream is split into tcpq records, whatever pieces it arrives in."""

from __future__ import annotations

import random
import socket
import struct
import tracemalloc
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vtbdrake.lcm.hub.reader import TcpqReader, publish_record
from vtbdrake.lcm.hub.tcpq import Record, RecordType, TcpqError

GREETING = struct.pack(">II", 0x287617FB, 0x0100)
LARGEST = 1000

CHANNELS = st.binary(min_size=1, max_size=255)
PUBLICATIONS = st.builds(
    lambda channel, data: (RecordType.PUBLISH, channel, published(channel, data)), CHANNELS, st.binary(max_size=LARGEST)
)
SUBSCRIPTIONS = st.builds(
    lambda kind, pattern: (kind, pattern, struct.pack(">II", kind, len(pattern)) + pattern),
    st.sampled_from([RecordType.SUBSCRIBE, RecordType.UNSUBSCRIBE]),
    CHANNELS,
)
RECORDS = st.lists(PUBLICATIONS | SUBSCRIPTIONS, max_size=8)


def published(channel: bytes, data: bytes) -> bytes:
    return struct.pack(">II", RecordType.PUBLISH, len(channel)) + channel + struct.pack(">I", len(data)) + data


def split(reader: TcpqReader) -> Iterator[Record]:
    while (record := reader.next_record()) is not None:
        yield record


def in_pieces(stream: bytes, ends: list[int]) -> Iterator[bytes]:
    begin = 0
    for end in [*sorted(end % (len(stream) + 1) for end in ends), len(stream)]:
        yield stream[begin:end]
        begin = end


@given(RECORDS, st.lists(st.integers(0, 10_000), max_size=20))
def test_records_arrive_in_pieces(records: list[Record], ends: list[int]) -> None:
    reader, found = TcpqReader(max_message=LARGEST), []
    for piece in in_pieces(GREETING + b"".join(record for *_, record in records), ends):
        reader.append(piece)
        found += split(reader)
    assert found == [(RecordType.GREETING, b"", GREETING), *records]
    assert reader.greeted and not reader.partial


@given(RECORDS, st.lists(st.integers(0, 10_000), max_size=20))
def test_publications_skip_other_records(records: list[Record], ends: list[int]) -> None:
    reader, found = TcpqReader(max_message=LARGEST, greeted=True), []
    for piece in in_pieces(b"".join(record for *_, record in records), ends):
        reader.append(piece)
        while (publication := reader.next_publication()) is not None:
            found.append(publication)
    assert [published(*publication) for publication in found] == [
        record for kind, _, record in records if kind == RecordType.PUBLISH
    ]


@pytest.mark.parametrize("greeted", [True, False])
def test_large_records_arrive_in_pieces(greeted: bool) -> None:
    chosen = random.Random(0)
    for _ in range(20):
        sizes = [chosen.choice([0, 5, 2**18 - 12, 2**18 - 13, 2**18, 300_000, 2**20]) for _ in range(4)]
        sent = [(b"CHANNEL", chosen.randbytes(size)) for size in sizes]
        stream = GREETING * (not greeted) + b"".join(published(*message) for message in sent)
        ends = [chosen.randrange(len(stream)) for _ in range(chosen.randrange(40))]
        records, publications = (TcpqReader(max_message=2**20, greeted=greeted) for _ in range(2))
        found, taken = [], []
        for piece in in_pieces(stream, ends):
            records.append(piece)
            publications.append(piece)
            found += split(records)
            # Sometimes several pieces arrive before a publication is removed.
            while chosen.random() < 0.9 and (publication := publications.next_publication()) is not None:
                taken.append(publication)
        while (publication := publications.next_publication()) is not None:
            taken.append(publication)
        expected = [(RecordType.PUBLISH, message[0], published(*message)) for message in sent]
        assert found == [(RecordType.GREETING, b"", GREETING)] * (not greeted) + expected
        assert taken == sent and not records.partial and not publications.partial


def test_large_record_is_received_in_place() -> None:
    size, piece = 1 << 24, bytes(1 << 18)
    reader = TcpqReader(max_message=size, greeted=True)
    tracemalloc.start()
    reader.append(published(b"A", b"")[:-4] + struct.pack(">I", size))
    for _ in range(size // len(piece)):
        assert reader.next_record() is None and reader.partial
        reader.append(piece)
    record = reader.next_record()
    now, most = tracemalloc.get_traced_memory()
    assert most < 1.2 * size
    del record
    assert tracemalloc.get_traced_memory()[0] < now - size
    assert tracemalloc.get_traced_memory()[0] < 5 * len(piece)
    tracemalloc.stop()


def test_publication_of_4_gib_is_an_error() -> None:
    with pytest.raises(ValueError, match="less than 4 GiB each, not 1 and 4294967296 bytes"):
        publish_record(b"A", bytes(2**32))


@given(CHANNELS, st.binary())
def test_publication_is_written_as_in_liblcm(channel: bytes, data: bytes) -> None:
    assert publish_record(channel, data) == published(channel, data)


@pytest.mark.parametrize(
    ("bytes_", "reason"),
    [
        (struct.pack(">II", 4, 1), "malformed"),
        (struct.pack(">II", 0, 1), "malformed"),
        (struct.pack(">II", RecordType.PUBLISH, 0), "malformed"),
        (struct.pack(">II", RecordType.SUBSCRIBE, 256), "malformed"),
        (struct.pack(">II", RecordType.SUBSCRIBE, 2**32 - 1), "malformed"),
        (struct.pack(">II", RecordType.PUBLISH, 1) + b"A" + struct.pack(">I", LARGEST + 1), "too large"),
        (struct.pack(">II", RecordType.PUBLISH, 1) + b"A" + struct.pack(">I", 2**32 - 1), "too large"),
    ],
)
def test_invalid_record_is_an_error_after_valid_ones(bytes_: bytes, reason: str) -> None:
    reader = TcpqReader(max_message=LARGEST, greeted=True)
    reader.append(published(b"A", b"1") + bytes_)
    assert reader.next_record() == (RecordType.PUBLISH, b"A", published(b"A", b"1"))
    for _ in range(2):
        with pytest.raises(TcpqError) as caught:
            reader.next_record()
        assert caught.value.reason == reason


@pytest.mark.parametrize("greeting", [struct.pack(">II", 0x287617FA, 0x0100), struct.pack(">II", 0x287617FB, 0x0200)])
def test_other_greeting_is_an_error(greeting: bytes) -> None:
    reader = TcpqReader(max_message=LARGEST)
    reader.append(greeting)
    with pytest.raises(TcpqError, match="greeting must be|version of tcpq must be"):
        reader.next_record()


def test_memory_grows_with_received_bytes_only() -> None:
    announced, received = 1 << 30, 1 << 20
    tracemalloc.start()
    reader = TcpqReader(max_message=1 << 31, greeted=True)
    reader.append(published(b"A", b"")[:-4] + struct.pack(">I", announced))
    for _ in range(16):
        reader.append(bytes(received // 16))
        assert reader.next_record() is None
    assert tracemalloc.get_traced_memory()[0] < 8 * received
    reader = TcpqReader(max_message=1 << 31, greeted=True)
    reader.append(published(b"A", bytes(received)))
    assert reader.next_record() is not None
    reader.append(published(b"A", b"1"))
    assert tracemalloc.get_traced_memory()[0] < received // 4
    tracemalloc.stop()


def test_socket_is_read_without_waiting() -> None:
    near, far = socket.socketpair()
    reader = TcpqReader(max_message=LARGEST, greeted=True)
    with near, far:
        assert reader.receive(near.fileno(), 100) == -1
        for limit in (0, -1, -(2**31)):
            with pytest.raises(ValueError, match=f"a positive number of bytes, not {limit}"):
                reader.receive(near.fileno(), limit)
        far.sendall(published(b"A", bytes(200)))
        assert [reader.receive(near.fileno(), 100) for _ in range(4)] == [100, 100, 13, -1]
        assert reader.next_publication() == (b"A", bytes(200))
        far.close()
        assert reader.receive(near.fileno(), 100) == 0
    with pytest.raises(OSError, match="Bad file descriptor"):
        reader.receive(near.fileno(), 100)
