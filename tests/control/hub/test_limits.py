"""Slow, silent and too many clients: none costs the others anything."""

import contextlib
import resource
from pathlib import Path

from tests.control.hub.clients import Client, is_disconnected, raw_client, receive, record, wait_until
from vtbdrake.control.hub import Hub

MEBIBYTE = 1024 * 1024
DATA = bytes(MEBIBYTE)


def resident(pid: int) -> int:
    """Bytes of memory that a process has."""
    line = next(line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmRSS"))
    return 1024 * int(line.split()[1])


def test_a_client_that_never_reads_holds_up_nobody_and_is_cut_off() -> None:
    with Hub(port=0, max_message=MEBIBYTE, max_queue=4 * MEBIBYTE, patience=0.5) as hub, raw_client(hub.url) as slow:
        slow.sendall(record(2, b"IMAGE"))
        client = Client(hub.url, "IMAGE")
        for _ in range(40):
            client.publish("IMAGE", DATA)
            client.wait(lambda: bool(client.received))
            assert client.received.pop() == ("IMAGE", DATA)
        wait_until(lambda: hub.statistics().disconnected.get("stalled") == 1)
        assert is_disconnected(slow)
        assert hub.statistics().clients == 1


def test_a_slow_client_loses_its_oldest_messages_and_no_more_than_it_must() -> None:
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

        assert receive(slow, 8) == b"\x28\x76\x17\xfa\x00\x00\x01\x00"
        size = len(record(1, b"N", numbers[0]))
        arrived = [receive(slow, size) for _ in range(200 - statistics.dropped)]
        order = [message[-1] for message in arrived]
        assert arrived == [record(1, b"N", numbers[i]) for i in order]
        assert order == sorted(order)
        assert order[-15:] == list(range(185, 200))
        wait_until(lambda: hub.statistics().queued == 0)


def test_memory_is_bounded() -> None:
    limits = {"max_message": MEBIBYTE, "max_queue": 4 * MEBIBYTE, "patience": 60.0}
    with Hub(port=0, **limits) as hub, contextlib.ExitStack() as stack:
        client = Client(hub.url)
        for _ in range(4):
            stack.enter_context(raw_client(hub.url)).sendall(record(2, b"IMAGE"))
        for _ in range(4):  # They announce a message, send most of it, and fall silent.
            stack.enter_context(raw_client(hub.url)).sendall(record(1, b"IMAGE", DATA)[:-1])
        before = resident(hub.pid)
        for _ in range(300):
            client.publish("IMAGE", DATA)
        client.sync()
        assert hub.statistics().dropped > 4 * 200
        assert resident(hub.pid) - before < (4 * 4 + 4 + 8) * MEBIBYTE


def test_channels_without_end_are_not_remembered(hub) -> None:
    with raw_client(hub.url) as sock:
        before = resident(hub.pid)
        for i in range(200):
            sock.sendall(b"".join(record(1, b"CHANNEL_%0240d" % (500 * i + j), b"") for j in range(500)))
        wait_until(lambda: hub.statistics().messages == 100_000)
        assert resident(hub.pid) - before < 16 * MEBIBYTE


def test_who_does_not_greet_is_cut_off() -> None:
    with Hub(port=0, patience=0.2) as hub, raw_client(hub.url, greeting=b"\x28\x76") as sock:
        assert is_disconnected(sock)
        assert hub.statistics().disconnected == {"greeting": 1}


def test_one_client_too_many_is_turned_away() -> None:
    with Hub(port=0, max_clients=2) as hub:
        clients = [Client(hub.url, "A") for _ in range(2)]
        with raw_client(hub.url, greeting=b"") as sock:
            assert is_disconnected(sock)
        clients[0].publish("A")
        clients[1].wait(lambda: bool(clients[1].received))
        assert hub.statistics().disconnected == {"too many": 1}


def test_without_file_descriptors_the_hub_goes_on_and_lets_the_next_client_in_when_there_are(hub) -> None:
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
        assert receive(waiting, 8)[:4] == b"\x28\x76\x17\xfa"
    assert client.received == [("A", b"as before")]
