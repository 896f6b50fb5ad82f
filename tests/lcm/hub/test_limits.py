"""Slow, silent and too many clients: none costs the others anything."""

import contextlib
import os
import resource
import signal
from pathlib import Path

import pytest

from tests.lcm.hub.clients import Client, is_disconnected, raw_client, receive, record, wait_until
from vtbdrake.lcm.hub import Hub

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


def test_a_message_that_is_not_completed_ends_the_connection() -> None:
    with Hub(port=0, patience=0.2) as hub, raw_client(hub.url) as sock:
        sock.sendall(record(1, b"A", b"whole") + record(1, b"A", DATA)[:-1])
        assert is_disconnected(sock)
        assert hub.statistics().disconnected == {"incomplete": 1}


def test_drops_that_come_one_by_one_do_not_keep_a_message_alive() -> None:
    with Hub(port=0, patience=0.2) as hub, raw_client(hub.url) as sock:
        text = record(1, b"A", bytes(10_000_000))

        def is_over() -> bool:
            nonlocal text
            with contextlib.suppress(ConnectionError):
                sock.sendall(text[:1])
                text = text[1:]
            return hub.statistics().disconnected == {"incomplete": 1}

        wait_until(is_over)


def test_all_incomplete_messages_together_are_bounded() -> None:
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


def test_all_backlogs_together_are_bounded_and_who_reads_is_spared() -> None:
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


def test_refusals_do_not_flood_the_log(capfd: pytest.CaptureFixture[str]) -> None:
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


def test_who_sends_much_takes_turns_with_the_others(hub) -> None:
    """A thousand messages wait at the hub before that of another client does; it need not wait for them."""
    observer = Client(hub.url, "FLOOD.*", "QUIET")
    with raw_client(hub.url) as flood, raw_client(hub.url) as quiet:
        for sock in (flood, quiet):
            receive(sock, 8)
        os.kill(hub.pid, signal.SIGSTOP)
        flood.sendall(b"".join(record(1, b"FLOOD_%d" % (i % 7), b"%d" % i) for i in range(2000)))
        quiet.sendall(record(1, b"QUIET", b""))
        os.kill(hub.pid, signal.SIGCONT)
        observer.wait(lambda: len(observer.received) == 2001)
    place = [channel for channel, _ in observer.received].index("QUIET")
    assert place <= 2 * 64
    assert [data for channel, data in observer.received if channel != "QUIET"] == [b"%d" % i for i in range(2000)]


def test_new_channels_are_found_a_few_at_a_time(hub) -> None:
    observer = Client(hub.url, "NEW.*", "QUIET")
    with raw_client(hub.url) as flood, raw_client(hub.url) as quiet:
        for sock in (flood, quiet):
            receive(sock, 8)
        os.kill(hub.pid, signal.SIGSTOP)
        flood.sendall(b"".join(record(1, b"NEW_%d" % i, b"") for i in range(2000)))
        quiet.sendall(record(1, b"QUIET", b""))
        os.kill(hub.pid, signal.SIGCONT)
        observer.wait(lambda: len(observer.received) == 2001)
    assert [channel for channel, _ in observer.received].index("QUIET") <= 2 * 64 / 16
