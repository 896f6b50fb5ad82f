"""What is not tcpq ends the connection it comes from, and disturbs no other."""

import contextlib
import random
import socket
import struct

import pytest

from tests.lcm.hub.clients import GREETING, Client, is_disconnected, raw_client, record, wait_until
from vtbdrake.lcm.hub import Hub

MEBIBYTE = 1024 * 1024
U32 = struct.Struct(">I").pack


@pytest.mark.parametrize(
    ("sent", "reason"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", "greeting"),
        (struct.pack(">II", 0x287617FA, 0x0100), "greeting"),
        (struct.pack(">II", 0x287617FB, 0x0200), "greeting"),
        (GREETING + record(0, b"A"), "malformed"),
        (GREETING + record(4, b"A"), "malformed"),
        (GREETING + record(1, b"", b"x"), "malformed"),
        (GREETING + record(2, b""), "malformed"),
        (GREETING + U32(1) + U32(0xFFFFFFFF), "malformed"),
        (GREETING + record(1, b"A" * 256, b""), "malformed"),
        (GREETING + record(1, b"\xff\xfe", b""), "malformed"),
        (GREETING + record(1, b"A\0B", b""), "malformed"),
        (GREETING + record(2, b"\xff.*"), "malformed"),
        (GREETING + record(1, b"A", b"")[:-4] + U32(16 * MEBIBYTE + 1), "too large"),
        (GREETING + record(1, b"A", b"")[:-4] + U32(0xFFFFFFFF), "too large"),
        (GREETING + b"".join(record(2, b"A%d" % i) for i in range(1025)), "malformed"),
    ],
)
def test_a_client_that_breaks_the_protocol_is_cut_off(hub, sent: bytes, reason: str) -> None:
    client = Client(hub.url, ".*")
    client.received.clear()
    with raw_client(hub.url, greeting=sent) as sock:
        assert is_disconnected(sock)
    assert hub.statistics().disconnected == {reason: 1}
    client.publish("STILL_HERE")
    client.wait(lambda: bool(client.received))
    assert client.received == [("STILL_HERE", b"")]


def test_what_came_before_the_protocol_was_broken_passes(hub) -> None:
    client = Client(hub.url, "A")
    with raw_client(hub.url) as sock:
        sock.sendall(record(1, b"A", b"1") + record(1, b"A", b"2") + record(4, b"A") + record(1, b"A", b"3"))
        assert is_disconnected(sock)
    client.sync()
    assert client.received == [("A", b"1"), ("A", b"2")]


def test_the_largest_message_passes_and_a_larger_one_does_not() -> None:
    with Hub(port=0, max_message=1000, max_queue=10_000) as hub:
        client = Client(hub.url, "A")
        with raw_client(hub.url) as sock:
            sock.sendall(record(1, b"A", bytes(1000)))
            client.wait(lambda: bool(client.received))
            sock.sendall(record(1, b"A", bytes(1001)))
            assert is_disconnected(sock)
        client.sync()
        assert client.received == [("A", bytes(1000))]


@pytest.mark.parametrize("piece", [1, 3, 7, 1000])
def test_pieces_of_any_size_make_the_same_messages(hub, piece: int) -> None:
    client = Client(hub.url, "A+")
    sent = [(b"A" * (1 + i % 5), bytes([i]) * (i * 7 % 40)) for i in range(60)]
    stream = b"".join(record(1, channel, data) for channel, data in sent)
    with raw_client(hub.url) as sock:
        sock.setsockopt(6, 1, 1)  # TCP_NODELAY
        for i in range(0, len(stream), piece):
            sock.sendall(stream[i : i + piece])
        client.wait(lambda: len(client.received) == len(sent))
    assert client.received == [(channel.decode(), data) for channel, data in sent]


def test_thousands_of_random_byte_strings_disturb_nobody(hub) -> None:
    rng = random.Random(20)
    client = Client(hub.url, "A", "SENTINEL")
    valid = [record(1, b"A", b"data"), record(2, b"A.*"), record(3, b"A.*")]
    for i in range(3000):
        noise = rng.randbytes(rng.randrange(1, 200))
        if i % 3 == 1:
            text = bytearray(b"".join(rng.choices(valid, k=4)))
            for _ in range(rng.randrange(1, 4)):
                text[rng.randrange(len(text))] ^= 1 << rng.randrange(8)
            noise = bytes(text)
        with raw_client(hub.url, greeting=b"" if i % 3 == 0 else GREETING) as sock:
            with contextlib.suppress(ConnectionError):
                sock.sendall(noise)
                sock.shutdown(socket.SHUT_WR)
            assert is_disconnected(sock)
        if i % 500 == 0:
            client.publish("SENTINEL", str(i).encode())
    wait_until(lambda: hub.statistics().clients == 1)
    client.sync()
    assert client.data("SENTINEL") == [str(i).encode() for i in range(0, 3000, 500)]
    statistics = hub.statistics()
    assert sum(statistics.disconnected.values()) == 3000
    assert statistics.disconnected["greeting"] >= 900


def test_random_bytes_as_messages_arrive_as_they_are(hub) -> None:
    rng = random.Random(21)
    client, other = Client(hub.url), Client(hub.url, "NOISE")
    sent = [("NOISE", rng.randbytes(rng.randrange(3000))) for _ in range(1000)]
    for channel, data in sent:
        client.publish(channel, data)
    other.wait(lambda: len(other.received) == len(sent))
    assert other.received == sent
