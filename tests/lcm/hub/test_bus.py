"""Unmodified LCM clients on the hub."""

import random

import pytest
from pydrake.lcm import DrakeLcm

from tests.lcm.hub.clients import Client, ClientProcess, wait_until


def test_a_message_reaches_every_subscriber_once(hub) -> None:
    clients = [Client(hub.url, "A", "A") for _ in range(3)]
    clients[0].publish("A", b"\x00one")
    clients[0].publish("A", b"")
    for client in clients:
        client.wait(lambda client=client: len(client.received) >= 4)
        client.sync()
        # LCM itself calls both handlers of a client.
        assert client.received == [("A", b"\x00one")] * 2 + [("A", b"")] * 2


def test_other_channels_are_not_sent(hub) -> None:
    a, b = Client(hub.url, "A"), Client(hub.url, "B")
    a.publish("B", b"for b")
    b.wait(lambda: bool(b.received))
    a.sync()
    assert (a.received, b.received) == ([], [("B", b"for b")])
    # B's message, and what the clients sent to themselves.
    assert hub.statistics().delivered == 1 + 3


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ("ARM.*", ["ARM", "ARM_1"]),
        (".*", ["ARM", "ARM_1", "LEG.1", "LEGX1"]),
        ("ARM|LEG.1", ["ARM", "ARM_1", "LEG.1", "LEGX1"]),  # ^ARM|LEG.1$
        ("(ARM|LEG).1", ["ARM_1", "LEG.1", "LEGX1"]),
        (r"LEG\.1", ["LEG.1"]),
        ("LEG[X.]1", ["LEG.1", "LEGX1"]),
        ("ARM", ["ARM"]),
        (r"(?:A(R)M)+", ["ARM"]),
        (r"\QLEG.1\E", ["LEG.1"]),
    ],
)
def test_patterns_mean_what_they_mean_to_lcm(hub, pattern: str, expected: list[str]) -> None:
    client = Client(hub.url, pattern)
    for channel in ("ARM", "ARM_1", "LEG.1", "LEGX1"):
        client.publish(channel)
    client.sync()
    assert [channel for channel, _ in client.received if not channel.startswith("SYNC")] == expected


def test_unsubscribing_ends_one_subscription(hub) -> None:
    client = Client(hub.url, "A", "B")
    again = client.bus.subscribe("A", client._receive)
    client.bus.unsubscribe(client.subscriptions["B"])
    client.bus.unsubscribe(again)
    client.publish("B")
    client.publish("A")
    client.sync()
    assert client.received == [("A", b"")]
    client.publish("A")
    client.wait(lambda: len(client.received) == 2)
    before = hub.statistics().delivered
    client.bus.unsubscribe(client.subscriptions["A"])
    client.publish("A")
    client.sync()
    assert hub.statistics().delivered == before + 1


def test_large_messages_arrive_whole(hub) -> None:
    data = random.Random(1).randbytes(16 * 1024 * 1024)
    client, other = Client(hub.url), Client(hub.url, "IMAGE")
    for size in (1, 65536, 262144 - 17, 262144, 1_000_001, len(data)):
        client.publish("IMAGE", data[:size])
        other.wait(lambda: bool(other.received))
        assert other.received.pop() == ("IMAGE", data[:size])


def test_order_is_kept(hub) -> None:
    client = Client(hub.url, "A", "B")
    numbers = [(channel, str(i).encode()) for i in range(500) for channel in "AB"]
    for channel, data in numbers:
        client.publish(channel, data)
    client.sync()
    assert client.received == numbers


def test_drake_is_a_client(hub) -> None:
    received: list[bytes] = []
    drake, client = DrakeLcm(hub.url), Client(hub.url, "TO.*")
    drake.Subscribe("FROM_LCM/1.0", received.append)
    drake.Publish("TO_LCM", b"from Drake")
    client.wait(lambda: bool(client.received))
    assert client.received == [("TO_LCM", b"from Drake")]
    client.publish("FROM_LCM/1x0", b"not meant")
    client.publish("FROM_LCM/1.0", b"from LCM")
    wait_until(lambda: drake.HandleSubscriptions(10) > 0 and bool(received))
    assert received == [b"from LCM"]


def test_a_killed_client_is_forgotten(hub) -> None:
    client = Client(hub.url, "A")
    with ClientProcess(hub.url) as process:
        process.publish(("A", "last words"))
        assert hub.statistics().clients == 2
    wait_until(lambda: hub.statistics().clients == 1)
    client.publish("A", b"life goes on")
    client.sync()
    assert client.received == [("A", b"last words"), ("A", b"life goes on")]
    assert sum(hub.statistics().disconnected.values()) == 1


def test_statistics_count_what_passed(hub) -> None:
    client, other = Client(hub.url, "A"), Client(hub.url, "A")
    before = hub.statistics()
    client.publish("A", b"12345")
    other.wait(lambda: bool(other.received))
    after = hub.statistics()
    assert after.messages - before.messages == 1
    assert after.volume - before.volume == 4 + 4 + 1 + 4 + 5
    assert after.delivered - before.delivered == 2
    assert (after.clients, after.dropped, after.queued, after.refused) == (2, 0, 0, 0)


def test_status_is_published(hub) -> None:
    client = Client(hub.url)
    assert client.wait_for_status(lambda status: status.clients == 1).messages >= 1
