"""Who is let in: the hub's own user, root, those that it is told; and how many of each."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator

import lcm
import pytest

from tests.lcm.hub.clients import (
    GREETING,
    Client,
    address,
    is_disconnected,
    raw_client,
    receive,
    record,
    wait_until,
)
from vtbdrake.control.bridge import BridgeError
from vtbdrake.lcm.connections import LcmLink
from vtbdrake.lcm.hub import Hub, HubConfig
from vtbdrake.lcm.hub.tcpq import connect_shortcut, peer_user

STRANGER = 65534
WELCOME = b"\x28\x76\x17\xfa\x00\x00\x01\x00"
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")

# What another user does: it connects as told, n times; says how each went; and keeps them until it is told to end.
_STRANGER = """
import encodings.idna, os, socket, sys  # before setuid: the interpreter may lie where only root may look
from struct import pack
host, port, kind, n, user = sys.argv[1], int(sys.argv[2]), sys.argv[3], int(sys.argv[4]), int(sys.argv[5])
os.setuid(user)
kept = []
for _ in range(n):
    if kind == "unix":
        sock = socket.socket(socket.AF_UNIX)
        sock.connect(f"\\0vtbdrake-hub/{host}:{port}")
    elif kind == "ipv6":
        sock = socket.socket(socket.AF_INET6)
        sock.connect((f"::ffff:{host}", port))
    else:
        sock = socket.create_connection((host, port))
    kept.append(sock)
    try:
        sock.sendall(pack(">IIIIc", 0x287617FB, 0x100, 2, 1, b"A"))
    except ConnectionError:
        pass  # It may have been refused already.
    answer = sock.recv(4096)
    print(answer[:4].hex(), answer[8:].decode(), flush=True)
sys.stdin.read()
"""


@contextlib.contextmanager
def stranger(url: str, kind: str = "tcp", *, count: int = 1, user: int = STRANGER) -> Iterator[list[tuple[str, str]]]:
    """Clients of another user: the magic number and the text that each gets first."""
    host, port = address(url)
    command = [sys.executable, "-c", _STRANGER, host, str(port), kind, str(count), str(user)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            lines = [process.stdout.readline().rstrip("\n").partition(" ") for _ in range(count)]
            yield [(magic, text) for magic, _, text in lines]
        finally:
            process.kill()


GREETED, REFUSED = "287617fa", "287617fc"


@as_root
@pytest.mark.parametrize("kind", ["tcp", "ipv6", "unix"])
def test_another_user_is_not_let_in_and_is_told(hub, kind: str) -> None:
    with stranger(hub.url, kind) as [(magic, text)]:
        assert magic == REFUSED
        assert f"user {STRANGER}" in text and "--user" in text
        assert hub.statistics().clients == 0
    assert hub.statistics().disconnected == {"user": 1}
    Client(hub.url)


@as_root
@pytest.mark.parametrize("kind", ["tcp", "ipv6", "unix"])
@pytest.mark.parametrize("fields", [{"users": [STRANGER]}, {"users": ["nobody"]}, {"all_users": True}])
def test_another_user_is_let_in_when_the_hub_is_told_so(kind: str, fields: dict[str, object]) -> None:
    with Hub(port=0, **fields) as hub, stranger(hub.url, kind) as [(magic, _)]:
        assert magic == GREETED


@as_root
def test_other_users_leave_room_for_the_hubs_own() -> None:
    with Hub(port=0, all_users=True, max_clients=8) as hub, contextlib.ExitStack() as stack:
        for k in range(4):
            told = stack.enter_context(stranger(hub.url, count=4, user=STRANGER - k))
            expected = [GREETED, GREETED, REFUSED, REFUSED] if k < 3 else [REFUSED] * 4
            assert [magic for magic, _ in told] == expected
            assert "users other than the hub's own" in told[-1][1]
        own = [Client(hub.url) for _ in range(2)]
        assert hub.statistics().clients == 3 * 2 + len(own)


@as_root
def test_what_a_stranger_sends_before_it_closes_its_socket_does_not_pass_as_roots(hub) -> None:
    """The kernel may say of a socket without a process that it is root's."""
    listener = Client(hub.url, "A")
    os.kill(hub.pid, signal.SIGSTOP)  # It sees the connection when nobody is there any more
    code = f"""
import encodings.idna, os, socket
os.setuid({STRANGER})
with socket.create_connection({address(hub.url)!r}) as sock:
    sock.sendall({GREETING + record(1, b"A", b"forged")!r})
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    os.kill(hub.pid, signal.SIGCONT)
    wait_until(lambda: hub.statistics().disconnected == {"user": 1})
    listener.sync()
    assert listener.received == []


def test_the_user_of_a_peer_is_told_for_every_kind_of_socket() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        clients = [socket.create_connection(server.getsockname()), socket.socket(socket.AF_INET6)]
        clients[1].connect(("::ffff:127.0.0.1", server.getsockname()[1]))
        for client in clients:
            with client, server.accept()[0] as accepted:
                assert peer_user(accepted) == os.geteuid()
                client.close()
                assert peer_user(accepted) is None
    one, other = socket.socketpair()
    with one, other:
        assert peer_user(one) == os.geteuid()


def test_beyond_loopback_all_places_are_for_everybody() -> None:
    with Hub(host="0.0.0.0", port=0, max_clients=4) as hub:
        url = f"tcpq://127.0.0.1:{address(hub.url)[1]}"
        clients = [Client(url, "A") for _ in range(4)]
        clients[0].publish("A")
        clients[3].wait(lambda: bool(clients[3].received))


def test_a_full_hub_says_so_to_this_packages_clients_and_refuses_lcms() -> None:
    with Hub(port=0, max_clients=1) as hub:
        first = Client(hub.url, "A")
        with pytest.raises(BridgeError, match=r"refuses the connection: max_clients=1 reached"):
            LcmLink(hub.url, {}, connect_timeout=30.0).open()
        with pytest.raises(RuntimeError):
            lcm.LCM(hub.url)
        first.publish("A")
        first.wait(lambda: bool(first.received))


def test_a_client_that_never_did_anything_makes_room() -> None:
    with Hub(port=0, max_clients=2, patience=0.1) as hub, raw_client(hub.url) as idle:
        assert receive(idle, 8) == WELCOME
        busy = Client(hub.url, "A")
        third: list[Client] = []

        def comes_in() -> bool:
            with contextlib.suppress(RuntimeError):
                third.append(Client(hub.url, "A"))
            return bool(third)

        wait_until(comes_in)
        assert is_disconnected(idle)
        third[0].publish("A")
        busy.wait(lambda: bool(busy.received))
        assert hub.statistics().disconnected["idle"] == 1


def test_many_idle_clients_lock_out_nobody() -> None:
    with Hub(port=0, patience=0.1) as hub, contextlib.ExitStack() as stack:
        for _ in range(128):
            assert receive(stack.enter_context(raw_client(hub.url)), 8) == WELCOME
        clients: list[Client] = []

        def come_in() -> bool:
            with contextlib.suppress(RuntimeError):
                clients.append(Client(hub.url, "A"))
            return len(clients) == 10

        wait_until(come_in)
        assert hub.statistics().clients == 128


def test_a_hub_that_refuses_without_a_text_is_no_hub() -> None:
    for answer in (b"", b"\x28\x76\x17\xfc", b"\x28\x76\x17\xfc\xff\xff\xff\xff", b"GET / HT"):
        with socket.create_server(("127.0.0.1", 0)) as server:

            def serve(server: socket.socket = server, answer: bytes = answer) -> None:
                with server.accept()[0] as sock:
                    sock.sendall(answer)
                    sock.shutdown(socket.SHUT_WR)
                    sock.recv(100)

            thread = threading.Thread(target=serve)
            thread.start()
            port = server.getsockname()[1]
            assert connect_shortcut("127.0.0.1", port) is None
            with pytest.raises(BridgeError, match="no LCM bus"):
                LcmLink(f"tcpq://127.0.0.1:{port}", {}, connect_timeout=30.0).open()
            thread.join()


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"users": "nobody"}, "sequence of users"),
        ({"users": ["no such user"]}, "no user 'no such user'"),
        ({"max_memory": 1}, "max_memory must be between"),
    ],
)
def test_bad_fields_are_refused(fields: dict[str, object], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        HubConfig(**fields)
