"""The backlog of a client."""

import random
import socket

import pytest

from vtbdrake.lcm.hub.clients import ClientConnection

pytestmark = pytest.mark.one_python

MAX_QUEUE = 100_000


def connected_pair() -> tuple[socket.socket, socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client = socket.create_connection(server.getsockname())
        return client, server.accept()[0]


def test_backlog_arrives_complete_and_in_order_except_dropped() -> None:
    choose = random.Random(1)
    client, sock = connected_pair()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    hub = ClientConnection(sock, max_message=MAX_QUEUE, max_queue=MAX_QUEUE, now=0.0, user=None)
    sent, received, dropped = [], bytearray(), 0
    with client, sock:
        client.setblocking(False)
        for _ in range(2000):
            messages: list[bytes | bytearray] = [
                b"%05d" % (len(sent) + k) + bytes(choose.choice([0, 10, 5000])) + b"\xff"
                for k in range(choose.randrange(1, 5))
            ]
            sent += messages
            dropped += hub.send(messages, 0.0)
            assert hub.queued <= MAX_QUEUE
            if choose.random() < 0.5:
                received += receive_some(client)
                hub.flush(0.0)
        while hub.queued:
            received += receive_some(client)
            hub.flush(0.0)
        received += receive_some(client)
    whole = [bytes(part) + b"\xff" for part in received.split(b"\xff")[:-1]]
    assert received.endswith(b"\xff")
    numbers = [int(part[:5]) for part in whole]
    assert numbers == sorted(set(numbers))
    assert whole == [sent[number] for number in numbers]
    assert 0 < dropped == len(sent) - len(whole)


def receive_some(client: socket.socket) -> bytes:
    try:
        return client.recv(1 << 16)
    except BlockingIOError:
        return b""
