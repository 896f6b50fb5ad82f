"""The protocol, and this package's own client."""

from __future__ import annotations

import contextlib
import os
import random
import select
import socket
import struct
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from tests.lcm.hub.clients import (
    GREETING,
    MEBIBYTE,
    TIMEOUT,
    Client,
    ClientProcess,
    address,
    is_disconnected,
    raw_client,
    record,
    wait_until,
)
from vtbdrake.lcm.connections import LcmLink, TcpqConnection
from vtbdrake.lcm.hub import Hub, client_name
from vtbdrake.lcm.hub.tcpq import peer_user

pytestmark = pytest.mark.one_python

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
def test_protocol_violation_ends_the_connection(quiet_hub, sent: bytes, reason: str) -> None:
    client = Client(quiet_hub.url, ".*")
    client.received.clear()
    before = quiet_hub.statistics().disconnected.get(reason, 0)
    with raw_client(quiet_hub.url, greeting=sent) as sock:
        assert is_disconnected(sock)
    assert quiet_hub.statistics().disconnected[reason] == before + 1
    client.publish("STILL_HERE")
    client.wait(lambda: bool(client.received))
    assert client.received == [("STILL_HERE", b"")]


def test_records_before_a_violation_are_handled(hub) -> None:
    client = Client(hub.url, "A")
    with raw_client(hub.url) as sock:
        sock.sendall(record(1, b"A", b"1") + record(1, b"A", b"2") + record(4, b"A") + record(1, b"A", b"3"))
        assert is_disconnected(sock)
    client.sync()
    assert client.received == [("A", b"1"), ("A", b"2")]


def test_max_message_limits_messages() -> None:
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
def test_messages_arrive_in_pieces_of_any_size(quiet_hub, piece: int) -> None:
    client = Client(quiet_hub.url, "A+")
    sent = [(b"A" * (1 + i % 5), bytes([i]) * (i * 7 % 40)) for i in range(60)]
    stream = b"".join(record(1, channel, data) for channel, data in sent)
    with raw_client(quiet_hub.url) as sock:
        sock.setsockopt(6, 1, 1)  # TCP_NODELAY
        for i in range(0, len(stream), piece):
            sock.sendall(stream[i : i + piece])
        client.wait(lambda: len(client.received) == len(sent))
    assert client.received == [(channel.decode(), data) for channel, data in sent]


@pytest.mark.slow
def test_random_bytes_disturb_no_other_client(hub) -> None:
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


def test_random_data_arrives_unchanged(hub) -> None:
    rng = random.Random(21)
    client, other = Client(hub.url), Client(hub.url, "NOISE")
    sent = [("NOISE", rng.randbytes(rng.randrange(3000))) for _ in range(1000)]
    for channel, data in sent:
        client.publish(channel, data)
    other.wait(lambda: len(other.received) == len(sent))
    assert other.received == sent


class Own:
    """A client of this package that keeps the messages it receives."""

    def __init__(self, url: str, *channels: str, stamped: bool = False) -> None:
        self.received: list[tuple[str, bytes]] = []
        self._sync = f"SYNC_{id(self)}"
        handlers = dict.fromkeys([*channels, self._sync], lambda *message: self.received.append(message))
        self.connection = TcpqConnection(url, handlers, TIMEOUT, stamped=stamped)

    @property
    def name(self) -> str | None:
        return self.connection.name

    def publish(self, channel: str, data: bytes = b"") -> None:
        self.connection.publish([(channel, data)])

    def wait(self, condition: Callable[[], bool]) -> None:
        """Receive messages, and send the rest of published ones, until the condition holds."""
        while not condition():
            sending = [self.connection] if self.connection.pending else []
            assert any(select.select([self.connection], sending, [], TIMEOUT)), "timeout"
            self.connection.receive(100)

    def sync(self) -> None:
        """Wait until hub and client have handled all messages that they had sent to each other."""
        self.publish(self._sync)
        self.wait(lambda: (self._sync, b"") in self.received)
        self.received.remove((self._sync, b""))

    def __enter__(self) -> Own:
        return self

    def __exit__(self, *_: object) -> None:
        self.connection.close()


def relayed(own: Own, client: Client) -> bool:
    """Let both clients receive; return whether the second one has received anything."""
    own.connection.receive(1)
    client.bus.handle_timeout(1)
    return bool(client.received)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def test_own_client_and_liblcm_exchange_messages(hub) -> None:
    client = Client(hub.url, "A")
    with Own(hub.url, "A", "B") as own:
        client.publish("A", b"by liblcm")
        client.sync()
        own.publish("A", b"by the own client")
        own.publish("B", b"to itself")
        own.sync()
        client.sync()
        assert client.received == [("A", b"by liblcm"), ("A", b"by the own client")]
        assert own.received == [*client.received, ("B", b"to itself")]


def test_arrivals_are_stamped(hub) -> None:
    with Own(hub.url, "A", stamped=True) as own:

        def is_stamped() -> bool:  # The kernel enables time stamps a little later.
            own.publish("A")
            own.sync()
            return own.connection.arrived is not None

        wait_until(is_stamped)


def test_ownership_covers_own_clients_and_liblcm() -> None:
    with Hub(port=0, protect=["COMMAND"], lease=0.05) as hub:
        robot, other = Client(hub.url, "COMMAND"), Client(hub.url)
        other_name = client_name(other.bus.fileno())
        with Own(hub.url) as own, Own(hub.url) as third:
            assert own.name == client_name(own.connection.fileno()) != third.name

            def state():
                return hub.statistics().protected["COMMAND"]

            own.publish("COMMAND", b"own")
            own.sync()
            other.publish("COMMAND", b"refused")
            other.sync()
            assert (state().owner, state().last_refused) == (own.name, other_name)
            wait_until(lambda: state().lease_over)
            other.publish("VTB_HUB_TAKE/COMMAND")
            other.publish("COMMAND", b"other")
            other.sync()
            own.publish("COMMAND", b"stale")
            own.sync()
            assert (state().owner, state().last_refused) == (other_name, own.name)
            wait_until(lambda: state().lease_over)
            third.publish("VTB_HUB_TAKE/COMMAND")
            third.publish("COMMAND", b"third")
            third.sync()
            assert (state().owner, state().refused, state().taken) == (third.name, 2, 2)
        robot.sync()
        assert robot.data("COMMAND") == [b"own", b"other", b"third"]


@pytest.mark.parametrize("size", [1, 256 * 1024 - 13, 3 * MEBIBYTE, 16 * MEBIBYTE])
def test_large_messages_arrive_unchanged(hub, size: int) -> None:
    data = random.Random(size).randbytes(size)
    client = Client(hub.url, "UP")
    with Own(hub.url, "DOWN") as own, ClientProcess(hub.url) as process:
        own.publish("UP", data)
        wait_until(lambda: relayed(own, client))
        assert client.received == [("UP", data)]
        process.begin(("DOWN", "x" * size))
        own.wait(lambda: bool(own.received))
        assert own.received == [("DOWN", b"x" * size)]
        process.end()


def test_unsent_rest_is_sent_while_receiving(hub) -> None:
    data = random.Random(1).randbytes(MEBIBYTE)
    client = Client(hub.url, "A")
    with Own(hub.url) as own:
        with socket.socket(fileno=os.dup(own.connection.fileno())) as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 65536)
        own.publish("A", data)
        wait_until(lambda: relayed(own, client))
        own.publish("A", b"next")
        client.wait(lambda: len(client.received) == 2)
    assert client.received == [("A", data), ("A", b"next")]


def test_waiting_link_sends_its_rest(hub) -> None:
    received: list[tuple[str, bytes]] = []
    data = random.Random(1).randbytes(MEBIBYTE)
    link = LcmLink(hub.url, {"A": lambda *message: received.append(message)}, connect_timeout=TIMEOUT)
    with closing(link):
        link.open()
        with socket.socket(fileno=os.dup(link.sources[0].fileno())) as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 65536)
        assert link.publish(("A", data))
        assert (link.receive(TIMEOUT, 1), received) == (1, [("A", data)])


def test_client_killed_within_a_message_is_removed(hub) -> None:
    port = address(hub.url)[1]
    code = f"""
import socket, sys
sock = socket.create_connection(("127.0.0.1", {port}))
sock.sendall({GREETING + record(1, b"A", b"whole") + record(1, b"A", bytes(1000))[:-1]!r})
print("ready", flush=True)
sys.stdin.read()
"""
    root = Path(__file__).resolve().parents[3]
    client = Client(hub.url, "A")
    with subprocess.Popen(
        [sys.executable, "-c", code], cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == b"ready\n"
        client.wait(lambda: bool(client.received))
        assert hub.statistics().clients == 2
        process.kill()
    wait_until(lambda: hub.statistics().clients == 1)
    client.sync()
    assert client.received == [("A", b"whole")]


def test_restarted_hub_is_found() -> None:
    port = free_port()
    with closing(LcmLink(f"tcpq://127.0.0.1:{port}", {}, connect_timeout=TIMEOUT)) as link:
        for losses in range(3):
            with Hub(port=port) as hub:
                if losses:
                    wait_until(lambda: bool(link.receive(0.1, 1)) or link.connected)
                else:
                    link.open()
                os.kill(hub.pid, 9)
            wait_until(lambda: not link.connected or bool(link.receive(0.1, 100)))
            assert link.losses == losses + 1
        assert link.reconnections == 2


def test_kernel_reports_users_of_open_sockets() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        clients = [socket.create_connection(server.getsockname()), socket.socket(socket.AF_INET6)]
        clients[1].connect(("::ffff:127.0.0.1", server.getsockname()[1]))
        for client in clients:
            with client, server.accept()[0] as accepted:
                assert peer_user(accepted) == os.geteuid()
                client.close()
                assert peer_user(accepted) is None
