"""Routing: subscribers receive messages, and protected channels have one publisher at a time."""

import random
import socket
import threading
import time
from types import SimpleNamespace

import pytest
from pydrake.lcm import DrakeLcm

from tests.lcm.hub.clients import Client, ClientProcess, wait_until
from vtbdrake.lcm.hub import Hub, HubConfig, HubServer, HubStatistics, client_name
from vtbdrake.lcm.hub import hub_server as server
from vtbdrake.lcm.hub.clients import ClientConnection
from vtbdrake.lcm.hub.routing import ProtectedChannel

pytestmark = pytest.mark.one_python


def test_message_reaches_every_subscriber_once(hub) -> None:
    clients = [Client(hub.url, "A", "A") for _ in range(3)]
    clients[0].publish("A", b"\x00one")
    clients[0].publish("A", b"")
    for client in clients:
        client.wait(lambda client=client: len(client.received) >= 4)
        client.sync()
        # liblcm calls both handlers of a client.
        assert client.received == [("A", b"\x00one")] * 2 + [("A", b"")] * 2


def test_other_channels_are_not_delivered(hub) -> None:
    a, b = Client(hub.url, "A"), Client(hub.url, "B")
    a.publish("B", b"for b")
    b.wait(lambda: bool(b.received))
    a.sync()
    assert (a.received, b.received) == ([], [("B", b"for b")])
    # B's message, and the messages of the clients to themselves.
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
def test_patterns_match_as_in_lcm(quiet_hub, pattern: str, expected: list[str]) -> None:
    client = Client(quiet_hub.url, pattern)
    for channel in ("ARM", "ARM_1", "LEG.1", "LEGX1"):
        client.publish(channel)
    client.sync()
    assert [channel for channel, _ in client.received if not channel.startswith("SYNC")] == expected


def test_unsubscribing_ends_one_subscription(hub) -> None:
    client = Client(hub.url, "A", "B")
    again = client.bus.subscribe("A", client.receive)
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


def test_messages_arrive_in_order(hub) -> None:
    client = Client(hub.url, "A", "B")
    numbers = [(channel, str(i).encode()) for i in range(500) for channel in "AB"]
    for channel, data in numbers:
        client.publish(channel, data)
    client.sync()
    assert client.received == numbers


def test_drake_lcm_is_a_client(hub) -> None:
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


def test_killed_client_is_removed(hub) -> None:
    client = Client(hub.url, "A")
    with ClientProcess(hub.url) as process:
        process.publish(("A", "last"))
        assert hub.statistics().clients == 2
    wait_until(lambda: hub.statistics().clients == 1)
    client.publish("A", b"next")
    client.sync()
    assert client.received == [("A", b"last"), ("A", b"next")]
    assert sum(hub.statistics().disconnected.values()) == 1


def test_statistics_count_messages(hub) -> None:
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


@pytest.fixture
def long_lease():
    """A hub with a protected channel and a lease that does not expire during a test."""
    with Hub(port=0, protect=["COMMAND"], lease=300.0) as hub:
        yield hub


@pytest.fixture
def short_lease():
    """A hub with a protected channel and a lease that expires at once."""
    with Hub(port=0, protect=["COMMAND"], lease=0.05) as hub:
        yield hub


def state(hub: Hub | HubServer):
    return hub.statistics().protected["COMMAND"]


def test_first_publisher_owns_the_channel(long_lease) -> None:
    robot, dps, intruder = Client(long_lease.url, "COMMAND"), Client(long_lease.url), Client(long_lease.url)
    dps.publish("COMMAND", b"mine")
    dps.sync()
    for _ in range(3):
        intruder.publish("COMMAND", b"not mine")
    intruder.sync()
    dps.publish("COMMAND", b"mine again")
    dps.sync()
    robot.sync()
    assert robot.data("COMMAND") == [b"mine", b"mine again"]

    status = robot.wait_for_status(lambda status: status.refused == 3).protected["COMMAND"]
    assert status.owner == client_name(dps.bus.fileno())
    assert status.last_refused == client_name(intruder.bus.fileno())
    assert (status.refused, status.taken, status.lease_over) == (3, 0, False)


def test_change_of_owner_and_rejection_are_published_at_once() -> None:
    with Hub(port=0, protect=["COMMAND"], status_period=3600.0, patience=3600.0) as hub:
        watcher, dps, intruder = Client(hub.url, "VTB_HUB"), Client(hub.url), Client(hub.url)
        owner = client_name(dps.bus.fileno())

        def published(refused: int) -> bool:
            status = [HubStatistics.from_json(data).protected["COMMAND"] for data in watcher.data("VTB_HUB")]
            return (owner, refused) in [(channel.owner, channel.refused) for channel in status]

        # Each is published before the next one happens.
        dps.publish("COMMAND")
        watcher.wait(lambda: published(refused=0))
        for refused in (1, 2, 3):
            intruder.publish("COMMAND")
            watcher.wait(lambda refused=refused: published(refused=refused))


def test_unprotected_channels_have_many_publishers(long_lease) -> None:
    client = Client(long_lease.url, "COMMAND_2")
    for publisher in (Client(long_lease.url), Client(long_lease.url)):
        publisher.publish("COMMAND_2", b"x")
        publisher.sync()
    client.sync()
    assert client.data("COMMAND_2") == [b"x", b"x"]


def test_expired_lease_of_disconnected_owner_frees_the_channel(short_lease) -> None:
    robot, successor = Client(short_lease.url, "COMMAND"), Client(short_lease.url)
    with ClientProcess(short_lease.url) as owner:
        owner.publish(("COMMAND", "first"))
        wait_until(lambda: state(short_lease).owner is not None)
    wait_until(lambda: state(short_lease).owner is None)
    successor.publish("COMMAND", b"second")
    successor.sync()
    robot.sync()
    assert robot.data("COMMAND") == [b"first", b"second"]
    assert state(short_lease).taken == 0


def test_lease_of_disconnected_owner_admits_requests_only(long_lease) -> None:
    robot, other = Client(long_lease.url, "COMMAND"), Client(long_lease.url)
    with ClientProcess(long_lease.url) as owner:
        owner.publish(("COMMAND", "first"))
        wait_until(lambda: state(long_lease).owner is not None)
    wait_until(lambda: long_lease.statistics().disconnected)
    other.publish("COMMAND", b"without request")
    other.sync()
    assert (state(long_lease).refused, state(long_lease).last_refused) == (1, client_name(other.bus.fileno()))
    other.publish("VTB_HUB_TAKE/COMMAND")
    other.publish("COMMAND", b"with request")
    other.sync()
    robot.sync()
    assert robot.data("COMMAND") == [b"first", b"with request"]


def test_stopped_owner_is_replaced_on_request_only(short_lease) -> None:
    robot, successor = Client(short_lease.url, "COMMAND"), Client(short_lease.url)
    with ClientProcess(short_lease.url) as owner:
        owner.publish(("COMMAND", "owner"))
        owner.stop()
        wait_until(lambda: state(short_lease).lease_over)
        successor.publish("COMMAND", b"without request")
        successor.sync()
        assert state(short_lease).refused == 1

        successor.publish("VTB_HUB_TAKE/COMMAND")
        successor.sync()
        successor.publish("COMMAND", b"successor")
        successor.sync()
        assert (state(short_lease).owner, state(short_lease).taken) == (
            client_name(successor.bus.fileno()),
            1,
        )

        owner.begin(("COMMAND", "stale"))
        owner.resume()
        owner.end()
        wait_until(lambda: state(short_lease).refused == 2)
    robot.sync()
    assert robot.data("COMMAND") == [b"owner", b"successor"]


def test_active_owner_is_not_replaced(long_lease) -> None:
    owner, other = Client(long_lease.url, "COMMAND"), Client(long_lease.url)
    owner.publish("COMMAND", b"1")
    owner.sync()
    other.publish("VTB_HUB_TAKE/COMMAND", b"please")
    other.publish("COMMAND", b"2")
    other.sync()
    owner.publish("COMMAND", b"3")
    owner.sync()
    assert owner.data("COMMAND") == [b"1", b"3"]
    assert (state(long_lease).owner, state(long_lease).refused) == (client_name(owner.bus.fileno()), 2)


def test_owner_that_keeps_the_channel_is_not_replaced(short_lease) -> None:
    robot, owner, other = Client(short_lease.url, ".*COMMAND"), Client(short_lease.url), Client(short_lease.url)
    owner.publish("COMMAND", b"1")
    owner.sync()
    wait_until(lambda: state(short_lease).lease_over)
    owner.publish("VTB_HUB_KEEP/COMMAND")
    other.publish("VTB_HUB_KEEP/COMMAND")
    other.sync()
    robot.sync()
    # Neither a request nor a rejection, and relayed to nobody.
    assert (state(short_lease).owner, state(short_lease).refused) == (client_name(owner.bus.fileno()), 0)
    assert [channel for channel, _ in robot.received if channel.endswith("COMMAND")] == ["COMMAND"]


def test_free_channel_belongs_to_the_client_that_keeps_it(long_lease) -> None:
    first, second = Client(long_lease.url), Client(long_lease.url)
    first.publish("VTB_HUB_KEEP/COMMAND")
    first.publish("VTB_HUB_KEEP/UNPROTECTED")
    first.sync()
    second.publish("COMMAND")
    second.sync()
    assert (state(long_lease).owner, long_lease.statistics().refused) == (client_name(first.bus.fileno()), 1)


def test_delay_of_the_hub_extends_the_lease(monkeypatch: pytest.MonkeyPatch) -> None:
    delay = 0.0
    monkeypatch.setattr(server, "time", SimpleNamespace(monotonic=lambda: time.monotonic() + delay))
    hub = HubServer(HubConfig(port=0, protect=["COMMAND"], lease=60.0))
    thread = threading.Thread(target=hub.serve_forever)
    thread.start()
    try:
        owner, other = Client(hub.url), Client(hub.url)
        owner.publish("COMMAND")
        owner.sync()
        delay = 1.1 * hub.config.lease
        other.publish("VTB_HUB_TAKE/COMMAND")
        other.sync()
        name = client_name(owner.bus.fileno())
    finally:
        hub.stop()
        thread.join()
    assert (state(hub).owner, state(hub).refused) == (name, 1)


def test_free_channel_can_be_requested(long_lease) -> None:
    first, second = Client(long_lease.url), Client(long_lease.url)
    first.publish("VTB_HUB_TAKE/COMMAND")
    first.sync()
    second.publish("COMMAND")
    second.sync()
    assert (state(long_lease).owner, state(long_lease).refused) == (client_name(first.bus.fileno()), 1)


@pytest.mark.parametrize("channel", ["VTB_HUB", "VTB_HUB_TAKE/OTHER", "VTB_HUB_TAKE/"])
def test_reserved_channels_reject_publications(long_lease, channel: str) -> None:
    listener, client = Client(long_lease.url, channel), Client(long_lease.url)
    client.publish(channel, b"forged")
    client.sync()
    listener.sync()
    assert b"forged" not in listener.data(channel)
    assert long_lease.statistics().refused == 1


class TestLease:
    """Rules of the lease, without a clock."""

    @pytest.fixture
    def connections(self):
        with socket.create_server(("127.0.0.1", 0)) as server:
            ends = [socket.create_connection(server.getsockname()) for _ in range(2)]
            accepted = [
                ClientConnection(server.accept()[0], max_message=1, max_queue=1, now=0.0, user=None) for _ in ends
            ]
            yield accepted
            for end in (*ends, *accepted):
                end.close()

    def test_publication_renews_the_lease(self, connections) -> None:
        owner, other = connections
        channel = ProtectedChannel("C", lease=1.0)
        assert channel.publish(owner, 0.0)
        assert channel.publish(owner, 0.9)
        assert not channel.take_over(other, 1.9)
        assert not channel.statistics(1.9).lease_over
        assert channel.statistics(1.91).lease_over
        assert channel.take_over(other, 1.91)
        assert not channel.publish(owner, 1.92)

    def test_owner_keeps_the_channel_without_publications(self, connections) -> None:
        owner, other = connections
        channel = ProtectedChannel("C", lease=1.0)
        channel.keep(owner, 0.0)
        channel.keep(other, 0.9)
        channel.keep(owner, 0.9)
        assert not channel.take_over(other, 1.9)
        assert channel.take_over(other, 1.91)
        channel.keep(owner, 5.0)
        assert channel.owner is other

    def test_extension_prolongs_the_lease(self, connections) -> None:
        owner, other = connections
        channel = ProtectedChannel("C", lease=1.0)
        channel.extend(5.0)
        assert channel.publish(owner, 0.0)
        channel.extend(5.0)
        assert not channel.take_over(other, 6.0)
        assert channel.take_over(other, 6.1)

    def test_request_begins_a_lease(self, connections) -> None:
        first, second = connections
        channel = ProtectedChannel("C", lease=1.0)
        assert channel.take_over(first, 0.0)
        assert not channel.take_over(second, 1.0)
        assert channel.take_over(second, 1.1)
