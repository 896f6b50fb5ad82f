"""The server: admission, limits, and hostile clients.

Some tests stop the hub's process while messages of several clients arrive, and assert in which order the hub handles
them afterwards: they count work, not time.
"""

from __future__ import annotations

import contextlib
import logging
import os
import random
import resource
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace

import lcm
import pytest

from tests.lcm.hub.clients import (
    GREETING,
    MEBIBYTE,
    WELCOME,
    Client,
    address,
    is_disconnected,
    raw_client,
    receive,
    record,
    resident,
    stopped,
    wait_until,
)
from vtbdrake.control.bridge import BridgeError
from vtbdrake.lcm.connections import LcmLink, TcpqConnection
from vtbdrake.lcm.hub import Hub, HubConfig, HubServer, clients
from vtbdrake.lcm.hub import hub_server as server
from vtbdrake.lcm.hub.clients import SLICE
from vtbdrake.lcm.hub.reader import TcpqReader

pytestmark = pytest.mark.one_python

DATA = bytes(MEBIBYTE)


@pytest.mark.parametrize(
    ("piece", "returned", "message", "turns"),
    [
        (100, None, record(1, b"A", bytes(237)), [[100, 100, 50]]),  # The rest of a message is read at once.
        (100, SLICE, record(1, b"A", bytes(237)), [[SLICE], [SLICE], [SLICE]]),  # A large one is read in turns.
        (1400, None, record(1, b"A", b"") * 130, [[1400], [290]]),  # So are many small ones.
        (100, None, record(1, b"A", bytes(887)), [[100] * 8, [100]]),  # No more than eight reads per turn.
    ],
)
def test_reading_goes_on_within_a_message_only(
    monkeypatch: pytest.MonkeyPatch, piece: int, returned: int | None, message: bytes, turns: list[list[int]]
) -> None:
    reads: list[list[int]] = [[]]

    class InPieces(TcpqReader):
        def receive(self, fileno: int, size: int) -> int:
            if not self.greeted:
                return super().receive(fileno, len(GREETING))
            received = super().receive(fileno, min(size, piece))
            if received > 0:
                received = returned or received
                reads[-1].append(received)
            return received

    def next_turn() -> float:
        reads.append([])
        return time.monotonic()

    monkeypatch.setattr(clients, "TcpqReader", InPieces)
    monkeypatch.setattr(server, "time", SimpleNamespace(monotonic=next_turn))
    hub = HubServer(HubConfig(port=0))
    with socket.create_connection(address(hub.url)) as client:
        client.sendall(GREETING)
        thread = threading.Thread(target=hub.serve_forever)
        thread.start()
        try:
            assert receive(client, len(WELCOME)) == WELCOME
            client.sendall(message)
            wait_until(lambda: sum(map(len, reads)) == sum(map(len, turns)))
        finally:
            hub.stop()
            thread.join()
    assert [turn for turn in reads if turn] == turns


def test_client_that_never_reads_is_disconnected() -> None:
    with Hub(port=0, max_message=MEBIBYTE, max_queue=4 * MEBIBYTE, patience=0.5) as hub, raw_client(hub.url) as slow:
        slow.sendall(record(2, b"IMAGE"))
        client = Client(hub.url, "IMAGE")
        for _ in range(40):
            client.publish("IMAGE", DATA)
            client.wait(lambda: bool(client.received))
            assert client.received.pop() == ("IMAGE", DATA)
        wait_until(lambda: hub.statistics().disconnected.get("stalled") == 1)
        assert hub.statistics().dropped > 0
        assert is_disconnected(slow)
        assert hub.statistics().clients == 1


def test_slow_client_loses_only_its_oldest_messages() -> None:
    with Hub(port=0, max_message=MEBIBYTE, max_queue=4 * MEBIBYTE, patience=60.0) as hub, raw_client(hub.url) as slow:
        slow.sendall(record(2, b"N"))
        client = Client(hub.url)
        numbers = [bytes([i]) * (MEBIBYTE // 4) for i in range(200)]
        for number in numbers:
            client.publish("N", number)
        client.sync()
        statistics = hub.statistics()
        assert 3 * MEBIBYTE < statistics.queued <= 4 * MEBIBYTE
        assert 0 < statistics.dropped < 200

        assert receive(slow, 8) == WELCOME
        size = len(record(1, b"N", numbers[0]))
        arrived = [receive(slow, size) for _ in range(200 - statistics.dropped)]
        order = [message[-1] for message in arrived]
        assert arrived == [record(1, b"N", numbers[i]) for i in order]
        assert order == sorted(order)
        assert order[-15:] == list(range(185, 200))
        wait_until(lambda: hub.statistics().queued == 0)


def test_memory_of_backlogs_and_incomplete_messages_is_bounded() -> None:
    limits = {"max_message": MEBIBYTE, "max_queue": 4 * MEBIBYTE, "patience": 60.0}
    with Hub(port=0, **limits) as hub, contextlib.ExitStack() as stack:
        client = Client(hub.url)
        for _ in range(4):
            stack.enter_context(raw_client(hub.url)).sendall(record(2, b"IMAGE"))
        for _ in range(4):
            stack.enter_context(raw_client(hub.url)).sendall(record(1, b"IMAGE", DATA)[:-1])
        before = resident(hub.pid)
        for _ in range(300):
            client.publish("IMAGE", DATA)
        client.sync()
        assert hub.statistics().dropped > 4 * 200
        assert resident(hub.pid) - before < (4 * 4 + 4 + 8) * MEBIBYTE


@pytest.mark.slow
def test_channel_names_do_not_accumulate(hub) -> None:
    with raw_client(hub.url) as sock:
        before = resident(hub.pid)
        for i in range(100):
            names = [b"CHANNEL_%0240d" % (500 * i + j) for j in range(500)]
            sock.sendall(b"".join(record(1, name, b"") + record(2, name) + record(3, name) for name in names))
        wait_until(lambda: hub.statistics().messages == 50_000)
        assert resident(hub.pid) - before < 8 * MEBIBYTE


def test_client_without_greeting_is_disconnected() -> None:
    with Hub(port=0, patience=0.2) as hub, raw_client(hub.url, greeting=GREETING[:2]) as sock:
        assert is_disconnected(sock)
        assert hub.statistics().disconnected == {"greeting": 1}


def test_max_clients_rejects_one_more_client() -> None:
    with Hub(port=0, max_clients=2) as hub:
        clients = [Client(hub.url, "A") for _ in range(2)]
        with raw_client(hub.url, greeting=b"") as sock:
            assert is_disconnected(sock)
        clients[0].publish("A")
        clients[1].wait(lambda: bool(clients[1].received))
        assert hub.statistics().disconnected == {"too many": 1}


def test_next_client_waits_for_file_descriptors(hub) -> None:
    client = Client(hub.url, "A")
    allowed = resource.prlimit(hub.pid, resource.RLIMIT_NOFILE)
    used = {int(fileno.name) for fileno in Path(f"/proc/{hub.pid}/fd").iterdir()}
    lowest_free = min(set(range(len(used) + 1)) - used)
    resource.prlimit(hub.pid, resource.RLIMIT_NOFILE, (lowest_free, allowed[1]))
    with raw_client(hub.url) as waiting:
        client.publish("A", b"as before")
        client.wait(lambda: bool(client.received))
        assert hub.statistics().clients == 1
        resource.prlimit(hub.pid, resource.RLIMIT_NOFILE, allowed)
        assert receive(waiting, 8) == WELCOME
    assert client.received == [("A", b"as before")]


def test_incomplete_message_ends_the_connection() -> None:
    with Hub(port=0, patience=0.2) as hub, raw_client(hub.url) as sock:
        sock.sendall(record(1, b"A", b"whole") + record(1, b"A", DATA)[:-1])
        assert is_disconnected(sock)
        assert hub.statistics().disconnected == {"incomplete": 1}


def test_message_sent_byte_by_byte_ends_the_connection() -> None:
    with Hub(port=0, patience=0.2) as hub, raw_client(hub.url) as sock:
        text = iter(record(1, b"A", bytes(10_000_000)))

        def is_over() -> bool:
            with contextlib.suppress(ConnectionError):
                sock.sendall(bytes([next(text)]))
            return hub.statistics().disconnected == {"incomplete": 1}

        wait_until(is_over)


def test_sum_of_incomplete_messages_is_bounded() -> None:
    limits = {"max_message": MEBIBYTE, "max_queue": 2 * MEBIBYTE, "max_memory": 4 * MEBIBYTE, "patience": 60.0}
    with Hub(port=0, **limits) as hub, contextlib.ExitStack() as stack:
        client = Client(hub.url, "A")
        before = resident(hub.pid)
        for _ in range(50):
            with contextlib.suppress(ConnectionError):
                stack.enter_context(raw_client(hub.url)).sendall(record(1, b"A", DATA)[:-1])
        wait_until(lambda: hub.statistics().disconnected.get("memory", 0) >= 45)
        client.publish("A")
        client.wait(lambda: bool(client.received))
        assert hub.statistics().clients <= 6
        assert resident(hub.pid) - before < (4 + 8) * MEBIBYTE


def test_sum_of_backlogs_is_bounded_and_readers_stay() -> None:
    limits = {"max_message": MEBIBYTE, "max_queue": 4 * MEBIBYTE, "max_memory": 16 * MEBIBYTE, "patience": 60.0}
    with Hub(port=0, **limits) as hub, contextlib.ExitStack() as stack:
        client = Client(hub.url, "A")
        for _ in range(20):
            stack.enter_context(raw_client(hub.url)).sendall(record(2, b"A"))
        wait_until(lambda: hub.statistics().clients == 21)
        for _ in range(20):
            client.publish("A", DATA)
            client.wait(lambda: bool(client.received))
            assert client.received.pop() == ("A", DATA)
        statistics = hub.statistics()
        assert statistics.disconnected["memory"] >= 20 - 16 // 3
        assert statistics.queued <= 16 * MEBIBYTE


def test_log_filter_suppresses_and_counts_repetitions(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr(server.time, "monotonic", lambda: now)
    logger = logging.getLogger(f"{__name__}.limited")
    logger.addFilter(server.RateLimitFilter())
    for second in range(9):
        now = float(second)
        logger.warning("rejected: %s", second)
    logger.warning("another kind")
    now = 10.0
    logger.warning("rejected: %s", 10)
    assert [record.getMessage() for record in caplog.records] == [
        *(f"rejected: {second}" for second in range(5)),
        "another kind",
        "rejected: 10 (4 more messages like this one were suppressed)",
    ]


def test_rejections_do_not_flood_the_log(capfd: pytest.CaptureFixture[str]) -> None:
    with Hub(port=0, protect=["COMMAND"], max_clients=2) as hub, raw_client(hub.url) as sock:
        client = Client(hub.url)
        client.publish("COMMAND")
        client.sync()
        for channel in (b"VTB_HUB", b"VTB_HUB_TAKE/COMMAND", b"VTB_HUB_TAKE/OTHER", b"COMMAND"):
            sock.sendall(record(1, channel, b"") * 1000)
        sock.sendall(b"".join(record(2, b"(%d" % i) for i in range(1000)))
        wait_until(lambda: hub.statistics().refused == 4000)
        for _ in range(50):
            with raw_client(hub.url, greeting=b"") as other:
                assert is_disconnected(other)
    lines = capfd.readouterr().err.splitlines()
    assert 4 < len(lines) < 40
    assert any("VTB_HUB" in line for line in lines) and any("max_clients" in line for line in lines)


def handled_before(hub: Hub, observer: Client, floods: Sequence[tuple[socket.socket, bytes]], messages: int) -> int:
    """Return how many messages of the floods the hub handles before one message of another client.

    All of them have arrived at the hub before it handles the first one.
    """
    with raw_client(hub.url) as quiet:
        for sock in (*(sock for sock, _ in floods), quiet):
            receive(sock, 8)
        with stopped(hub):
            for sock, flood in floods:
                sock.sendall(flood)
            quiet.sendall(record(1, b"QUIET", b""))
        observer.wait(lambda: len(observer.received) == messages + 1)
    return [channel for channel, _ in observer.received].index("QUIET")


def test_clients_are_served_in_turns(hub) -> None:
    observer = Client(hub.url, "FLOOD.*", "QUIET")
    flood = b"".join(record(1, b"FLOOD_%d" % (i % 7), b"%d" % i) for i in range(2000))
    with raw_client(hub.url) as sock:
        assert handled_before(hub, observer, [(sock, flood)], 2000) <= 2 * 64
    assert [data for channel, data in observer.received if channel != "QUIET"] == [b"%d" % i for i in range(2000)]


def test_new_channels_take_shorter_turns(hub) -> None:
    observer = Client(hub.url, "NEW.*", "QUIET")
    flood = b"".join(record(1, b"NEW_%d" % i, b"") for i in range(2000))
    with raw_client(hub.url) as sock:
        assert handled_before(hub, observer, [(sock, flood)], 2000) <= 2 * 64 / 16


def test_ten_floods_take_turns_with_a_quiet_client(hub) -> None:
    observer = Client(hub.url, "QUIET", "FLOOD")
    with contextlib.ExitStack() as stack:
        floods = [(stack.enter_context(raw_client(hub.url)), record(1, b"FLOOD", b"") * 1000) for _ in range(10)]
        assert handled_before(hub, observer, floods, 10_000) <= 2 * 10 * 64


LONG = b"N" * 240
FLOODS = {
    "subscriptions": b"".join(record(2, b"A_%d.*" % i) for i in range(1000)),
    "expensive subscriptions": b"".join(record(2, b".*" + b"a" * (i % 200) + b".*b") for i in range(1000)),
    "unsubscriptions": (record(2, b"A.*") + record(3, b"A.*")) * 1000,
    "unsubscriptions without subscription": b"".join(record(3, b"A_%d.*" % i) for i in range(2000)),
    "protected channel": record(1, b"COMMAND", b"x") * 2000,
    "requests": record(1, b"VTB_HUB_TAKE/COMMAND", b"") * 2000,
    "requests for unprotected channels": b"".join(record(1, b"VTB_HUB_TAKE/%d" % i, b"") for i in range(2000)),
    "status channel": record(1, b"VTB_HUB", b"{}") * 2000,
    "new channels": b"".join(record(1, b"%d" % i + LONG, b"") for i in range(400)),
}


@pytest.mark.slow_cases
@pytest.mark.parametrize("flood", FLOODS.values(), ids=FLOODS)
def test_quiet_client_is_served_before_a_flood_ends(flood: bytes) -> None:
    with Hub(port=0, protect=["COMMAND"], lease=300.0) as hub, raw_client(hub.url) as hostile:
        owner, observer = Client(hub.url), Client(hub.url, "QUIET", "DONE")
        owner.publish("COMMAND")
        owner.sync()
        assert handled_before(hub, observer, [(hostile, flood + record(1, b"DONE", b""))], 1) == 0


def hostile_bytes(choose: random.Random) -> bytes:
    """Return records of a hostile client: valid and nearly valid ones, cut off anywhere."""
    name = bytes(choose.choices(b"AB.*+?()[]|\\x", k=choose.choice([1, 5, 60, 255])))
    kinds = [
        record(1, b"A", choose.randbytes(choose.choice([0, 10, 5000]))),
        record(1, b"IMAGE", bytes(200_000)),
        record(1, b"COMMAND", b"hostile"),
        record(1, b"VTB_HUB_TAKE/COMMAND", b""),
        record(2, name),
        record(3, name),
        record(2, b".*"),
        b"".join(record(2, b"%d.*" % choose.randrange(10**6)) for _ in range(50)),
        record(1, b"A", bytes(900_000))[:-1],
        choose.randbytes(30),
    ]
    text = b"".join(choose.choices(kinds, k=choose.randrange(1, 12)))
    greeting = GREETING if choose.random() < 0.9 else choose.randbytes(8)
    return greeting + (text[: choose.randrange(len(text))] if choose.random() < 0.3 else text)


def test_controller_and_robot_work_among_hostile_clients() -> None:
    limits = {"max_message": MEBIBYTE, "max_queue": 2 * MEBIBYTE, "max_memory": 16 * MEBIBYTE, "patience": 5.0}
    choose = random.Random(5)
    with Hub(port=0, protect=["COMMAND"], max_clients=24, **limits) as hub, contextlib.ExitStack() as stack:
        robot, controller = Client(hub.url, "COMMAND", "SENTINEL"), Client(hub.url)
        controller.publish("COMMAND", b"0")
        controller.sync()
        before = resident(hub.pid)
        kept: list[socket.socket] = []
        for k in range(1, 201):
            with contextlib.suppress(OSError):
                sock = stack.enter_context(raw_client(hub.url, greeting=b""))
                kept.append(sock)
                sock.setblocking(False)
                data = hostile_bytes(choose)
                while data:
                    data = data[sock.send(data) :]
            while len(kept) > 40 or (kept and choose.random() < 0.2):
                kept.pop(choose.randrange(len(kept))).close()
            controller.publish("COMMAND", str(k).encode())
            robot.wait(lambda k=k: robot.data("COMMAND")[-1:] == [str(k).encode()])
        assert robot.data("COMMAND") == [str(k).encode() for k in range(201)]
        assert resident(hub.pid) - before < (16 + 16) * MEBIBYTE
        for sock in kept:
            sock.close()
        wait_until(lambda: hub.statistics().clients == 2)
        statistics = hub.statistics()
        assert statistics.queued == 0 and statistics.protected["COMMAND"].taken == 0
        assert statistics.refused > 0


OTHER_USER = 65534
ACCEPTED, REJECTED = "287617fa", "287617fc"
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")

# Connects as another user, n times, prints the first answer on each connection, and keeps them until its input closes.
_OTHER_USER = """
import encodings.idna, os, socket, sys  # before setuid: only root may be able to read the interpreter's files
from struct import pack
host, port, kind, n, user = sys.argv[1], int(sys.argv[2]), sys.argv[3], int(sys.argv[4]), int(sys.argv[5])
os.setuid(user)
kept = []
for _ in range(n):
    if kind == "ipv6":
        sock = socket.socket(socket.AF_INET6)
        sock.connect((f"::ffff:{host}", port))
    else:
        sock = socket.create_connection((host, port))
    kept.append(sock)
    try:
        sock.sendall(pack(">IIIIc", 0x287617FB, 0x100, 2, 1, b"A"))
    except ConnectionError:
        pass  # It may have been rejected already.
    answer = sock.recv(4096)
    print(answer[:4].hex(), answer[8:].decode(), flush=True)
sys.stdin.read()
"""


@contextlib.contextmanager
def other_user(
    url: str, kind: str = "tcp", *, count: int = 1, user: int = OTHER_USER
) -> Iterator[list[tuple[str, str]]]:
    """Connect clients of another user; yield the magic number and the text that each receives first."""
    host, port = address(url)
    command = [sys.executable, "-c", _OTHER_USER, host, str(port), kind, str(count), str(user)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            lines = [process.stdout.readline().rstrip("\n").partition(" ") for _ in range(count)]
            yield [(magic, text) for magic, _, text in lines]
        finally:
            process.kill()


@as_root
@pytest.mark.parametrize("kind", ["tcp", "ipv6"])
def test_other_user_is_rejected_with_a_reason(hub, kind: str) -> None:
    with other_user(hub.url, kind) as [(magic, text)]:
        assert magic == REJECTED
        assert f"user {OTHER_USER}" in text and "--user" in text
        assert hub.statistics().clients == 0
    assert hub.statistics().disconnected == {"user": 1}
    Client(hub.url)


@pytest.mark.slow_cases
@as_root
@pytest.mark.parametrize("kind", ["tcp", "ipv6"])
@pytest.mark.parametrize("fields", [{"users": [OTHER_USER]}, {"users": ["nobody"]}, {"all_users": True}])
def test_configured_user_is_admitted(kind: str, fields: dict[str, object]) -> None:
    with Hub(port=0, **fields) as hub, other_user(hub.url, kind) as [(magic, _)]:
        assert magic == ACCEPTED


@as_root
def test_connections_are_reserved_for_the_hubs_own_user() -> None:
    with Hub(port=0, all_users=True, max_clients=8) as hub, contextlib.ExitStack() as stack:
        for k in range(4):
            answers = stack.enter_context(other_user(hub.url, count=4, user=OTHER_USER - k))
            expected = [ACCEPTED, ACCEPTED, REJECTED, REJECTED] if k < 3 else [REJECTED] * 4
            assert [magic for magic, _ in answers] == expected
            assert "users other than the hub's own" in answers[-1][1]
        own = [Client(hub.url) for _ in range(2)]
        assert hub.statistics().clients == 3 * 2 + len(own)


@as_root
def test_closed_socket_of_other_user_is_rejected(hub) -> None:
    """The kernel may report root as the user of a socket that its process has closed."""
    listener = Client(hub.url, "A")
    code = f"""
import encodings.idna, os, socket
os.setuid({OTHER_USER})
with socket.create_connection({address(hub.url)!r}) as sock:
    sock.sendall({GREETING + record(1, b"A", b"forged")!r})
"""
    with stopped(hub):
        subprocess.run([sys.executable, "-c", code], check=True)
    wait_until(lambda: hub.statistics().disconnected == {"user": 1})
    listener.sync()
    assert listener.received == []


def test_beyond_loopback_all_clients_are_admitted() -> None:
    with Hub(host="0.0.0.0", port=0, max_clients=4) as hub:
        url = f"tcpq://127.0.0.1:{address(hub.url)[1]}"
        clients = [Client(url, "A") for _ in range(4)]
        clients[0].publish("A")
        clients[3].wait(lambda: bool(clients[3].received))


def test_full_hub_tells_clients_the_reason() -> None:
    with Hub(port=0, max_clients=1) as hub:
        first = Client(hub.url, "A")
        with pytest.raises(BridgeError, match=r"max_clients=1 reached"):
            LcmLink(hub.url, {}, connect_timeout=30.0).open()
        with pytest.raises(RuntimeError):
            lcm.LCM(hub.url)
        first.publish("A")
        first.wait(lambda: bool(first.received))


def test_idle_client_makes_room_for_another() -> None:
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


def test_many_idle_clients_make_room() -> None:
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


@pytest.mark.parametrize(
    "answer", [b"", b"\x28\x76\x17\xfc", b"\x28\x76\x17\xfc\xff\xff\xff\xff", b"GET / HT"], ids=bytes.hex
)
def test_incomplete_rejection_is_no_hub(answer: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            with listener.accept()[0] as sock:
                sock.sendall(answer)
                sock.shutdown(socket.SHUT_WR)
                sock.recv(100)

        thread = threading.Thread(target=serve)
        thread.start()
        port = listener.getsockname()[1]
        with pytest.raises(BridgeError, match="no LCM bus"):
            LcmLink(f"tcpq://127.0.0.1:{port}", {}, connect_timeout=30.0).open()
        thread.join()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"protect": "COMMAND"}, "HubConfig.protect must be a list, such as ['COMMAND'], not 'COMMAND'"),
        ({"protect": ["VTB_HUB"]}, "cannot protect 'VTB_HUB', one of the hub's own channels"),
        ({"protect": ["VTB_HUB_TAKE/A"]}, "one of the hub's own channels"),
        ({"protect": ["VTB_HUB_KEEP/A"]}, "one of the hub's own channels"),
        ({"protect": [""]}, "must have 1 to 242 bytes"),
        ({"protect": ["Ä" * 122]}, "must have 1 to 242 bytes"),
        ({"users": "nobody"}, "users must be a list"),
        ({"users": ["no such user"]}, "no user 'no such user'"),
        ({"lease": 0.0}, "HubConfig.lease must be a finite number above 0 s, not 0.0"),
        ({"patience": float("nan")}, "patience must be a finite number above 0 s, not nan"),
        ({"port": 65536}, "port must be a whole number from 0 to 65535"),
        ({"max_queue": 1000}, "max_queue must be at least"),
        ({"max_memory": 1}, "max_memory must be at least max_queue, 33554432 bytes, not 1"),
        ({"max_message": 0}, "max_message must be a whole number from 1 to 268435456 bytes"),
        ({"max_clients": 0}, "max_clients must be a whole number of at least 1"),
        ({"priority": 100}, "priority must be a whole number from 0 to 99"),
        ({"cpus": [-1]}, "cpus[0] must be a whole number of at least 0, not -1"),
    ],
)
def test_config_out_of_range_is_an_error(fields, message: str) -> None:
    with pytest.raises(ValueError) as error:
        HubConfig(**fields)
    assert message in str(error.value)


@pytest.mark.parametrize("stamped", [False, True], ids=["plain", "stamped"])
def test_last_message_before_closing_arrives(hub: Hub, stamped: bool) -> None:
    listener, flooder = Client(hub.url, "LAST"), Client(hub.url)
    expected = [b"%d" % number for number in range(200)]
    for data in expected:
        # It closes with unread messages, as a controller does that ends; the hub may send before it reads.
        connection = TcpqConnection(hub.url, {"FLOOD": lambda *_: None}, 30.0, stamped=stamped)
        for _ in range(20):
            flooder.publish("FLOOD")
        connection.publish([("LAST", data)])
        connection.close()
        flooder.publish("FLOOD")
    listener.wait(lambda: len(listener.received) == len(expected))
    assert listener.data("LAST") == expected
