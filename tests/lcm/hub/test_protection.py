"""Protected channels: one publisher at a time."""

import os
import signal
import socket
import time

import pytest

from tests.lcm.hub.clients import Client, ClientProcess, wait_until
from vtbdrake.lcm.hub import Hub, HubConfig, client_name
from vtbdrake.lcm.hub.clients import ClientConnection
from vtbdrake.lcm.hub.routing import ProtectedChannel


@pytest.fixture
def guarded():
    """A hub with one protected channel and a lease that does not end during a test."""
    with Hub(port=0, protect=["COMMAND"], lease=300.0) as hub:
        yield hub


@pytest.fixture
def short():
    """The same with a lease that ends at once."""
    with Hub(port=0, protect=["COMMAND"], lease=0.05) as hub:
        yield hub


def state(hub: Hub):
    return hub.statistics().protected["COMMAND"]


def test_the_first_publisher_owns_the_channel_and_an_intruder_is_refused_and_reported(guarded) -> None:
    robot, dps, intruder = Client(guarded.url, "COMMAND"), Client(guarded.url), Client(guarded.url)
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


def test_refusals_are_reported_without_being_asked_for_within_the_status_period() -> None:
    with Hub(port=0, protect=["COMMAND"], status_period=3600.0, patience=3600.0) as hub:
        dps, intruder = Client(hub.url), Client(hub.url)
        dps.publish("COMMAND")
        dps.sync()
        intruder.publish("COMMAND")
        intruder.sync()
        watcher = Client(hub.url, "VTB_HUB")
        intruder.publish("COMMAND")
        assert watcher.wait_for_status(lambda status: status.refused == 2).protected["COMMAND"].refused == 2


def test_other_channels_are_free(guarded) -> None:
    client = Client(guarded.url, "COMMAND_2")
    for publisher in (Client(guarded.url), Client(guarded.url)):
        publisher.publish("COMMAND_2", b"x")
        publisher.sync()
    client.sync()
    assert client.data("COMMAND_2") == [b"x", b"x"]


def test_a_dead_owner_leaves_the_channel_free_when_its_lease_is_over(short) -> None:
    robot, successor = Client(short.url, "COMMAND"), Client(short.url)
    with ClientProcess(short.url) as owner:
        owner.publish(("COMMAND", "first"))
        wait_until(lambda: state(short).owner is not None)
    wait_until(lambda: state(short).owner is None)
    successor.publish("COMMAND", b"second")
    successor.sync()
    robot.sync()
    assert robot.data("COMMAND") == [b"first", b"second"]
    assert state(short).taken == 0


def test_while_a_dead_owners_lease_runs_on_only_who_asks_gets_the_channel(guarded) -> None:
    robot, other = Client(guarded.url, "COMMAND"), Client(guarded.url)
    with ClientProcess(guarded.url) as owner:
        owner.publish(("COMMAND", "first"))
        wait_until(lambda: state(guarded).owner is not None)
    wait_until(lambda: guarded.statistics().disconnected)
    other.publish("COMMAND", b"slips in")
    other.sync()
    assert (state(guarded).refused, state(guarded).last_refused) == (1, client_name(other.bus.fileno()))
    other.publish("VTB_HUB_TAKE/COMMAND")
    other.publish("COMMAND", b"asked")
    other.sync()
    robot.sync()
    assert robot.data("COMMAND") == [b"first", b"asked"]


def test_a_frozen_owner_is_succeeded_on_request_only_and_refused_when_it_thaws(short) -> None:
    robot, successor = Client(short.url, "COMMAND"), Client(short.url)
    with ClientProcess(short.url) as owner:
        owner.publish(("COMMAND", "owner"))
        owner.freeze()
        wait_until(lambda: state(short).lease_over)
        successor.publish("COMMAND", b"did not ask")
        successor.sync()
        assert state(short).refused == 1

        successor.publish("VTB_HUB_TAKE/COMMAND")
        successor.sync()
        successor.publish("COMMAND", b"successor")
        successor.sync()
        assert (state(short).owner, state(short).taken) == (client_name(successor.bus.fileno()), 1)

        owner.begin(("COMMAND", "stale"))
        owner.thaw()
        owner.end()
        wait_until(lambda: state(short).refused == 2)
    robot.sync()
    assert robot.data("COMMAND") == [b"owner", b"successor"]


def test_a_living_owner_is_not_succeeded(guarded) -> None:
    owner, other = Client(guarded.url, "COMMAND"), Client(guarded.url)
    owner.publish("COMMAND", b"1")
    owner.sync()
    other.publish("VTB_HUB_TAKE/COMMAND", b"please")
    other.publish("COMMAND", b"2")
    other.sync()
    owner.publish("COMMAND", b"3")
    owner.sync()
    assert owner.data("COMMAND") == [b"1", b"3"]
    assert (state(guarded).owner, state(guarded).refused) == (client_name(owner.bus.fileno()), 2)


def test_a_time_in_which_the_hub_was_frozen_does_not_count_against_a_lease() -> None:
    with Hub(port=0, protect=["COMMAND"], lease=4.0) as hub:
        owner, other = Client(hub.url), Client(hub.url)
        owner.publish("COMMAND")
        owner.sync()
        os.kill(hub.pid, signal.SIGSTOP)
        try:
            end = time.monotonic() + 1.1 * hub.config.lease
            wait_until(lambda: time.monotonic() > end)
            other.publish("VTB_HUB_TAKE/COMMAND")
        finally:
            os.kill(hub.pid, signal.SIGCONT)
        other.sync()
        assert (state(hub).owner, state(hub).refused) == (client_name(owner.bus.fileno()), 1)


def test_an_unowned_channel_can_be_taken_before_the_first_publication(guarded) -> None:
    first, second = Client(guarded.url), Client(guarded.url)
    first.publish("VTB_HUB_TAKE/COMMAND")
    first.sync()
    second.publish("COMMAND")
    second.sync()
    assert (state(guarded).owner, state(guarded).refused) == (client_name(first.bus.fileno()), 1)


@pytest.mark.parametrize("channel", ["VTB_HUB", "VTB_HUB_TAKE/OTHER", "VTB_HUB_TAKE/"])
def test_the_hubs_own_channels_cannot_be_published_on(guarded, channel: str) -> None:
    listener, client = Client(guarded.url, channel), Client(guarded.url)
    client.publish(channel, b"forged")
    client.sync()
    listener.sync()
    assert b"forged" not in listener.data(channel)
    assert guarded.statistics().refused == 1


class TestLease:
    """The rules over time, without a clock."""

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

    def test_each_publication_renews_the_lease(self, connections) -> None:
        owner, other = connections
        channel = ProtectedChannel("C", lease=1.0)
        assert channel.publish(owner, 0.0)
        assert channel.publish(owner, 0.9)
        assert not channel.take(other, 1.9)
        assert not channel.statistics(1.9).lease_over
        assert channel.statistics(1.91).lease_over
        assert channel.take(other, 1.91)
        assert not channel.publish(owner, 1.92)

    def test_a_time_that_is_excused_does_not_count(self, connections) -> None:
        owner, other = connections
        channel = ProtectedChannel("C", lease=1.0)
        channel.extend(5.0)
        assert channel.publish(owner, 0.0)
        channel.extend(5.0)
        assert not channel.take(other, 6.0)
        assert channel.take(other, 6.1)

    def test_a_request_begins_a_lease(self, connections) -> None:
        first, second = connections
        channel = ProtectedChannel("C", lease=1.0)
        assert channel.take(first, 0.0)
        assert not channel.take(second, 1.0)
        assert channel.take(second, 1.1)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"protect": "COMMAND"}, "must be a sequence of channels, such as ['COMMAND']"),
        ({"protect": ["VTB_HUB"]}, "cannot protect 'VTB_HUB', one of the hub's own channels"),
        ({"protect": ["VTB_HUB_TAKE/A"]}, "one of the hub's own channels"),
        ({"protect": [""]}, "must have 1 to 242 bytes"),
        ({"protect": ["Ä" * 122]}, "must have 1 to 242 bytes"),
        ({"lease": 0.0}, "lease must be a positive time in seconds, not 0.0"),
        ({"patience": float("nan")}, "patience must be a positive time"),
        ({"port": 65536}, "port must be between 0 and 65535"),
        ({"max_queue": 1000}, "max_queue must be between"),
        ({"max_message": 0}, "max_message must be between 1 and"),
        ({"max_clients": 0}, "max_clients must be between 1 and inf"),
        ({"priority": 100}, "priority must be between 0 and 99"),
        ({"cpus": [-1]}, "cpus must be processor numbers"),
    ],
)
def test_config_out_of_range(fields, message: str) -> None:
    with pytest.raises(ValueError) as error:
        HubConfig(**fields)
    assert message in str(error.value)
