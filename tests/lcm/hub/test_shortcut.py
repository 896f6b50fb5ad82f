"""Clients that come by the Unix socket beside the hub's address, and what becomes of those that cannot."""

from __future__ import annotations

import contextlib
import logging
import os
import random
import resource
import select
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.lcm.hub.clients import (
    GREETING,
    TIMEOUT,
    Client,
    ClientProcess,
    address,
    is_disconnected,
    receive,
    record,
    wait_until,
)
from vtbdrake.lcm.connections import LcmLink, TcpqConnection
from vtbdrake.lcm.hub import Hub, client_name
from vtbdrake.lcm.hub.tcpq import address_name, connect_shortcut, shortcut_name

MEBIBYTE = 1024 * 1024
WELCOME = b"\x28\x76\x17\xfa\x00\x00\x01\x00"


class Own:
    """A client of this package, and what it has received."""

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
        """Takes in messages (and sends the rest of what it has published) until the condition holds."""
        while not condition():
            sending = [self.connection] if self.connection.pending else []
            assert any(select.select([self.connection], sending, [], TIMEOUT)), "waited in vain"
            self.connection.take(100)

    def sync(self) -> None:
        """Returns when the hub has handled all that this client has sent, and this client all that the hub had sent."""
        self.publish(self._sync)
        self.wait(lambda: (self._sync, b"") in self.received)
        self.received.remove((self._sync, b""))

    def __enter__(self) -> Own:
        return self

    def __exit__(self, *_: object) -> None:
        self.connection.close()


@contextlib.contextmanager
def raw_shortcut(url: str, greeting: bytes = GREETING) -> Iterator[socket.socket]:
    """The shortcut's end of a client, on which the test speaks itself."""
    sock = connect_shortcut(*address(url))
    assert sock is not None
    with sock:
        sock.settimeout(TIMEOUT)
        if greeting:  # To send nothing, too, fails once the hub has hung up.
            sock.sendall(greeting)
        yield sock


@contextlib.contextmanager
def holder(port: int, *, user: int | None = None) -> Iterator[None]:
    """Another process that listens on the shortcut's name, as this or another user."""
    code = f"""
import os, socket, sys
if {user!r} is not None:
    os.setuid({user!r})
sock = socket.socket(socket.AF_UNIX)
sock.bind({shortcut_name("127.0.0.1", port)!r})
sock.listen()
print("ready", flush=True)
sys.stdin.read()
"""
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == b"ready\n"
            yield
        finally:
            process.kill()


def relayed(own: Own, client: Client) -> bool:
    """Lets both go on; whether something has arrived."""
    own.connection.take(1)
    client.bus.handle_timeout(1)
    return bool(client.received)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def is_local(name: str | None) -> bool:
    assert name is not None
    return name.startswith("local:")


@pytest.mark.parametrize(
    ("host", "name"),
    [
        ("127.0.0.1", b"\0vtbdrake-hub/127.0.0.1:7700"),
        ("localhost", b"\0vtbdrake-hub/127.0.0.1:7700"),
        ("127.0.0.2", b"\0vtbdrake-hub/127.0.0.2:7700"),
        ("0.0.0.0", None),
        ("192.168.0.1", None),
        ("robot", None),
    ],
)
def test_there_is_a_shortcut_beside_loopback_addresses_only(host: str, name: bytes | None) -> None:
    assert shortcut_name(host, 7700) == name


def test_a_hub_that_listens_beyond_loopback_has_no_shortcut() -> None:
    with Hub(host="0.0.0.0", port=0) as hub:
        port = address(hub.url)[1]
        assert f":{port}" not in Path("/proc/net/unix").read_text()
        with Own(f"tcpq://127.0.0.1:{port}", "A") as own:
            assert not is_local(own.name)


def test_messages_pass_between_both_kinds_of_clients(hub) -> None:
    client = Client(hub.url, "A")
    with Own(hub.url, "A", "B") as own:
        assert is_local(own.name)
        client.publish("A", b"by TCP")
        client.sync()
        own.publish("A", b"by the shortcut")
        own.publish("B", b"to itself")
        own.sync()
        client.sync()
        assert client.received == [("A", b"by TCP"), ("A", b"by the shortcut")]
        assert own.received == [*client.received, ("B", b"to itself")]


def test_localhost_is_the_same_hub(hub) -> None:
    with Own(f"tcpq://localhost:{address(hub.url)[1]}") as own:
        assert is_local(own.name)


def test_stamped_messages_come_by_tcp(hub) -> None:
    with Own(hub.url, "A", stamped=True) as own:
        assert own.name is not None and own.name.startswith("127.0.0.1:")
        own.publish("A")
        own.sync()
        assert own.connection.arrived is not None


def test_hub_and_clients_agree_on_their_names_and_a_channel_has_one_owner_whichever_way_it_came() -> None:
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


def test_names_that_clients_choose_themselves_are_written_in_one_line() -> None:
    assert address_name(b"\x0000a3f") == "local:00a3f"
    assert address_name(b"\0a\n\xff") == "local:a\\n\\xff"
    assert address_name("/tmp/it's") == "local:/tmp/it's"
    assert address_name("") == "local:"


@pytest.mark.parametrize("size", [1, 256 * 1024 - 13, 3 * MEBIBYTE, 16 * MEBIBYTE])
def test_large_messages_arrive_whole_in_both_directions(hub, size: int) -> None:
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


def test_what_the_socket_does_not_take_at_once_leaves_while_messages_are_taken(hub) -> None:
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


def test_a_link_that_waits_for_messages_sends_the_rest_of_its_own(hub) -> None:
    received: list[tuple[str, bytes]] = []
    data = random.Random(1).randbytes(MEBIBYTE)
    link = LcmLink(hub.url, {"A": lambda *message: received.append(message)}, connect_timeout=TIMEOUT)
    with closing(link):
        link.open()
        with socket.socket(fileno=os.dup(link.sources[0].fileno())) as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 65536)
        assert link.publish(("A", data))
        assert (link.take(TIMEOUT, 1), received) == (1, [("A", data)])


def test_one_that_never_reads_holds_up_nobody_and_is_cut_off() -> None:
    limits = {"max_message": MEBIBYTE, "max_queue": 4 * MEBIBYTE, "patience": 0.5}
    with Hub(port=0, **limits) as hub, raw_shortcut(hub.url) as slow, Own(hub.url, "IMAGE") as own:
        slow.sendall(record(2, b"IMAGE"))
        for _ in range(20):
            own.publish("IMAGE", bytes(MEBIBYTE))
            own.wait(lambda: bool(own.received))
            assert own.received.pop() == ("IMAGE", bytes(MEBIBYTE))
        wait_until(lambda: hub.statistics().disconnected.get("stalled") == 1)
        assert hub.statistics().dropped > 0
        assert is_disconnected(slow)


def test_a_slow_one_gets_its_latest_messages_whole() -> None:
    with Hub(port=0, max_message=MEBIBYTE, max_queue=4 * MEBIBYTE, patience=60.0) as hub, raw_shortcut(hub.url) as slow:
        slow.sendall(record(2, b"N"))
        client = Client(hub.url)
        numbers = [bytes([i]) * (MEBIBYTE // 4) for i in range(40)]
        for number in numbers:
            client.publish("N", number)
        client.sync()
        dropped = hub.statistics().dropped
        assert 0 < dropped < 40
        assert receive(slow, 8) == WELCOME
        arrived = [receive(slow, len(record(1, b"N", numbers[0]))) for _ in range(40 - dropped)]
        order = [message[-1] for message in arrived]
        assert arrived == [record(1, b"N", numbers[i]) for i in order]
        assert order[-15:] == list(range(25, 40))
        wait_until(lambda: hub.statistics().queued == 0)


def test_one_that_is_killed_in_the_middle_of_a_message_is_forgotten(hub) -> None:
    port = address(hub.url)[1]
    code = f"""
import sys
from vtbdrake.lcm.hub.tcpq import connect_shortcut
sock = connect_shortcut("127.0.0.1", {port})
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


@pytest.mark.parametrize(
    ("sent", "reason"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", "greeting"),
        (GREETING + record(0, b"A"), "malformed"),
        (GREETING + record(1, b"A", b"")[:-4] + (16 * MEBIBYTE + 1).to_bytes(4, "big"), "too large"),
    ],
)
def test_what_is_not_tcpq_ends_the_connection(hub, sent: bytes, reason: str) -> None:
    with raw_shortcut(hub.url, sent) as sock:
        assert is_disconnected(sock)
    assert hub.statistics().disconnected == {reason: 1}


def test_who_does_not_greet_is_cut_off() -> None:
    with Hub(port=0, patience=0.2) as hub, raw_shortcut(hub.url, GREETING[:2]) as sock:
        assert is_disconnected(sock)
        assert hub.statistics().disconnected == {"greeting": 1}


def test_both_kinds_of_clients_count_as_clients() -> None:
    with Hub(port=0, max_clients=2) as hub, Own(hub.url):
        client = Client(hub.url)
        with raw_shortcut(hub.url, b"") as sock:
            assert is_disconnected(sock)
        client.sync()
        assert (hub.statistics().clients, hub.statistics().disconnected) == (2, {"too many": 1})


def test_without_file_descriptors_the_next_client_waits_until_there_are(hub) -> None:
    allowed = resource.prlimit(hub.pid, resource.RLIMIT_NOFILE)
    used = {int(fileno.name) for fileno in Path(f"/proc/{hub.pid}/fd").iterdir()}
    lowest_free = min(set(range(len(used) + 1)) - used)
    resource.prlimit(hub.pid, resource.RLIMIT_NOFILE, (lowest_free, allowed[1]))
    with raw_shortcut(hub.url) as waiting:
        assert hub.statistics().clients == 0
        resource.prlimit(hub.pid, resource.RLIMIT_NOFILE, allowed)
        assert receive(waiting, 8) == WELCOME


def test_a_hub_whose_name_is_taken_warns_once_and_is_there_for_tcp(caplog: pytest.LogCaptureFixture) -> None:
    port = free_port()
    with holder(port), Hub(port=port) as hub:
        client = Client(hub.url, "A")
        client.publish("A")
        client.sync()
        assert client.received == [("A", b"")]
    (warning,) = caplog.records
    assert "by TCP only" in warning.getMessage() and "in use" in warning.getMessage()


def test_who_holds_the_name_as_our_own_user_is_taken_for_the_hub() -> None:
    """It may: it could as well have taken the port."""
    port = free_port()
    with holder(port), Hub(port=port) as hub, pytest.raises(TimeoutError):
        TcpqConnection(hub.url, {}, 0.05)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_who_holds_the_name_as_another_user_is_not_spoken_to(caplog: pytest.LogCaptureFixture) -> None:
    port, stranger = free_port(), 65534
    with holder(port, user=stranger), Hub(port=port) as hub:
        caplog.clear()
        with Own(hub.url) as own:
            assert not is_local(own.name)
            own.sync()
    (warning,) = caplog.records
    assert warning.levelno == logging.WARNING
    assert f"belongs to user {stranger}" in warning.getMessage()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_a_hub_of_root_is_trusted_by_everybody() -> None:
    with Hub(port=0, users=[65534]) as hub:
        code = f"""
import os, sys
sys.path[:] = {sys.path!r}
from vtbdrake.lcm.connections import TcpqConnection
os.setuid(65534)
print(TcpqConnection({hub.url!r}, {{}}, {TIMEOUT}).name)
"""
        output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert is_local(output)


def test_a_hub_that_is_restarted_is_found_by_the_shortcut_again() -> None:
    port = free_port()
    with closing(LcmLink(f"tcpq://127.0.0.1:{port}", {}, connect_timeout=TIMEOUT)) as link:
        for losses in range(3):
            with Hub(port=port) as hub:
                if losses:
                    wait_until(lambda: link.connected)
                else:
                    link.open()
                assert is_local(link.name)
                os.kill(hub.pid, 9)
            wait_until(lambda: not link.connected or bool(link.take(0.0, 100)))
            assert link.losses == losses + 1
        assert link.reconnections == 2
