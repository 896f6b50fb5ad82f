"""Hostile clients against a hub in a process of its own: who behaves is served in its turn, and memory is bounded.

What is counted is work, not time: while the hub is stopped, a flood waits at its door that ends with a message on DONE,
and one message on QUIET of a client that behaves. When the hub goes on, QUIET arrives before DONE.
"""

import contextlib
import os
import random
import signal
import socket

import pytest

from tests.lcm.hub.clients import GREETING, Client, raw_client, receive, record, wait_until
from tests.lcm.hub.test_limits import MEBIBYTE, resident
from vtbdrake.lcm.hub import Hub

LONG = b"N" * 240
DONE = record(1, b"DONE", b"")

FLOODS = {
    "subscriptions": b"".join(record(2, b"A_%d.*" % i) for i in range(1000)),
    "dear subscriptions": b"".join(record(2, b".*" + b"a" * (i % 200) + b".*b") for i in range(1000)),
    "unsubscriptions": (record(2, b"A.*") + record(3, b"A.*")) * 1000,
    "unsubscriptions of what never was": b"".join(record(3, b"A_%d.*" % i) for i in range(2000)),
    "protected": record(1, b"COMMAND", b"x") * 2000,
    "requests": record(1, b"VTB_HUB_TAKE/COMMAND", b"") * 2000,
    "requests for what is not protected": b"".join(record(1, b"VTB_HUB_TAKE/%d" % i, b"") for i in range(2000)),
    "status": record(1, b"VTB_HUB", b"{}") * 2000,
    "new names": b"".join(record(1, b"%d" % i + LONG, b"") for i in range(400)),
}


@pytest.mark.parametrize("flood", FLOODS)
def test_a_flood_does_not_hold_up_who_behaves(flood: str) -> None:
    with Hub(port=0, protect=["COMMAND"], lease=300.0) as hub, raw_client(hub.url) as hostile:
        owner, observer = Client(hub.url), Client(hub.url, "QUIET", "DONE")
        owner.publish("COMMAND")
        owner.sync()
        with raw_client(hub.url) as quiet:
            for sock in (hostile, quiet):
                receive(sock, 8)
            os.kill(hub.pid, signal.SIGSTOP)
            hostile.sendall(FLOODS[flood] + DONE)
            quiet.sendall(record(1, b"QUIET", b""))
            os.kill(hub.pid, signal.SIGCONT)
            observer.wait(lambda: len(observer.received) == 2)
        assert [channel for channel, _ in observer.received] == ["QUIET", "DONE"]


def test_many_who_flood_take_turns_with_one_who_behaves() -> None:
    """Of ten floods, each with a thousand messages, at most two turns each pass before it is served."""
    with Hub(port=0) as hub, contextlib.ExitStack() as stack:
        observer = Client(hub.url, "QUIET", "FLOOD")
        floods = [stack.enter_context(raw_client(hub.url)) for _ in range(10)]
        quiet = stack.enter_context(raw_client(hub.url))
        for sock in (*floods, quiet):
            receive(sock, 8)
        os.kill(hub.pid, signal.SIGSTOP)
        for sock in floods:
            sock.sendall(record(1, b"FLOOD", b"") * 1000)
        quiet.sendall(record(1, b"QUIET", b""))
        os.kill(hub.pid, signal.SIGCONT)
        observer.wait(lambda: len(observer.received) == 10_001)
    assert [channel for channel, _ in observer.received].index("QUIET") <= 2 * 10 * 64


def hostile_bytes(choose: random.Random) -> bytes:
    """What a hostile client sends: some of what is valid, some of what is nearly so, cut off anywhere."""
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


def send_what_fits(sock: socket.socket, data: bytes) -> None:
    """Sends without waiting; who does not read must not hold up the test either."""
    sock.setblocking(False)
    with contextlib.suppress(OSError):
        while data:
            data = data[sock.send(data) :]


def test_a_pair_goes_on_among_hundreds_of_hostile_clients() -> None:
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
                sock = stack.enter_context(contextlib.closing(raw_socket(hub.url)))
                send_what_fits(sock, hostile_bytes(choose))
                kept.append(sock)
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


def raw_socket(url: str) -> socket.socket:
    host, _, port = url.removeprefix("tcpq://").partition(":")
    return socket.create_connection((host, int(port)), timeout=30.0)
