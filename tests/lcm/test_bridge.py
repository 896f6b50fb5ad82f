"""The bridge on a real bus, with real processes at its other ends."""

from __future__ import annotations

import math
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from types import ModuleType
from typing import Any

import lcm
import numpy as np
import pytest

from tests.control.arm import LIMIT, bridge, command, status
from vtbdrake.control.bridge import BridgeError
from vtbdrake.lcm.bridge import ForeignCommands, LcmBridge
from vtbdrake.lcm.connections import TcpqConnection
from vtbdrake.lcm.hub import STATUS_CHANNEL, ChannelStatistics, Hub, HubStatistics
from vtbdrake.lcm.maps import LcmMap, vector_map
from vtbdrake.testbed import Interface, Signal

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 60.0  # s, for what depends on another process


@pytest.fixture
def hub() -> Iterator[Hub]:
    with Hub(port=0) as hub:
        yield hub


class Peer:
    """An independent LCM client, which keeps all that is published, except for what the hub says of itself."""

    def __init__(self, url: str) -> None:
        self.lcm = lcm.LCM(url)
        self.heard: list[tuple[str, bytes]] = []
        self.lcm.subscribe(".*", self._keep)

    def _keep(self, channel: str, data: bytes) -> None:
        if not channel.startswith(STATUS_CHANNEL):
            self.heard.append((channel, data))

    def hear(self, count: int) -> list[tuple[str, bytes]]:
        """The first ``count`` messages and what has come with them."""
        end = time.monotonic() + PATIENCE
        while len(self.heard) < count and time.monotonic() < end:
            self.lcm.handle_timeout(100)
        return self.heard


def wait(bridge: LcmBridge, condition: Callable[[], bool]) -> bool:
    """Polls until the condition holds."""
    end = time.monotonic() + PATIENCE
    while not condition() and time.monotonic() < end:
        bridge.poll(0.02)
    return condition()


def in_step(bridge: LcmBridge, peer: Peer) -> None:
    """Returns when the bus carries messages in both directions."""
    peer.lcm.publish("IIWA_STATUS", status(1).encode())
    assert wait(bridge, lambda: bridge.sensed["position"].count > 0)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def test_status_of_another_process_arrives(hub: Hub) -> None:
    sender = f"""
import lcm
from tests.control.arm import status
bus = lcm.LCM({hub.url!r})
for utime in range(1, 101):
    bus.publish("IIWA_STATUS", status(utime, position=utime * 0.01).encode())
"""
    with closing(bridge(hub.url)) as arm:
        arm.open()
        subprocess.run([sys.executable, "-c", sender], cwd=ROOT, check=True, timeout=60)
        assert wait(arm, lambda: arm.sensed["position"].count == 100)
        received = arm.sensed["position"]
        np.testing.assert_array_equal(received.value, [1.0] * 7)
        assert 0.0 <= received.age(time.monotonic()) < PATIENCE
        assert (received.sent, received.rejected) == (pytest.approx(100e-6), {})


def test_what_is_published_and_nothing_else_is_on_the_bus(hub: Hub) -> None:
    peer = Peer(hub.url)
    with closing(bridge(hub.url)) as arm:
        arm.open()
        in_step(arm, peer)
        arm.publish({})
        arm.publish({"position": np.full(7, 0.5)})
        arm.publish({"position": np.full(7, 0.6), "torque": np.full(7, -1.0)})
        heard = peer.hear(3)
    assert [channel for channel, _ in heard] == ["IIWA_STATUS", "IIWA_COMMAND", "IIWA_COMMAND"]
    np.testing.assert_array_equal(command(heard[1][1])[0], [0.5] * 7)
    assert command(heard[1][1])[1].size == 0
    np.testing.assert_array_equal(command(heard[2][1]), [[0.6] * 7, [-1.0] * 7])
    assert arm.sent["position"].count == 2
    assert arm.sent["torque"].count == 1


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (np.full(7, math.nan), "not finite"),
        (np.full(7, math.inf), "not finite"),
        (np.full(7, 2 * LIMIT), "limits"),
        (np.zeros(6), "size"),
        ("text", "type"),
    ],
)
def test_command_that_must_not_leave_is_withheld_with_its_whole_message(hub: Hub, value: object, reason: str) -> None:
    peer = Peer(hub.url)
    with closing(bridge(hub.url)) as arm:
        arm.open()
        in_step(arm, peer)
        assert arm.publish({"position": value, "torque": np.zeros(7)}) == ("position", "torque")
        assert arm.publish({"torque": np.ones(7)}) == ()
        heard = peer.hear(2)
    assert [command(data)[1].tolist() for _, data in heard[1:]] == [[1.0] * 7]
    assert arm.sent["position"].withheld == {reason: 1}
    assert arm.sent["torque"].withheld == {"companion": 1}


def test_signal_that_is_not_there_cannot_be_published() -> None:
    with closing(bridge("memq://")) as arm:
        arm.open()
        with pytest.raises(ValueError, match="there is no actuator signal jaw; there are position, torque"):
            arm.publish({"jaw": [0.0]})


@pytest.mark.parametrize(
    "url", ["tcpq://127.0.0.1:{port}", "udpm://10.0.0.1:7667", "nosuch://", "file:///nowhere/log?mode=r"]
)
def test_bus_that_cannot_be_opened_is_an_error_and_nothing_private(url: str) -> None:
    arm = bridge(url.format(port=free_port()))
    with pytest.raises(BridgeError, match="no LCM bus at"):
        arm.open()
    assert not arm.connected
    with pytest.raises(BridgeError, match="is not open"):
        arm.poll()


def test_what_listens_without_being_a_hub_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        arm = bridge(f"tcpq://127.0.0.1:{server.getsockname()[1]}", connect_timeout=0.1)
        with pytest.raises(BridgeError, match="timed out"):
            arm.open()


@pytest.mark.parametrize("url", ["", "127.0.0.1:7700"])
def test_url_without_a_provider_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match="provider://network"):
        bridge(url)


def test_private_bus_is_used_when_it_is_asked_for() -> None:
    with closing(bridge("memq://", watch=True)) as arm:
        arm.open()
        arm.publish({"position": np.zeros(7)})
        assert arm.poll(1.0) == 1
        assert arm.foreign_messages == {"IIWA_COMMAND": 0}


def test_killed_hub_is_noticed_by_the_next_poll_and_its_successor_found() -> None:
    port = free_port()
    hub = Hub(port=port)
    hub.start()
    arm = bridge(hub.url)
    try:
        arm.open()
        in_step(arm, Peer(hub.url))
        os.kill(hub.pid, signal.SIGKILL)
        hub.close()  # waits until it is gone
        assert arm.connected
        while arm.poll():  # what the hub still said
            pass
        assert not arm.connected
        assert arm.publish({"position": np.zeros(7)}) == ("position",)
        assert arm.sent["position"].withheld == {"no bus": 1}
        with Hub(port=port):
            assert wait(arm, lambda: arm.connected)
            assert (arm.link.losses, arm.link.reconnections) == (1, 1)
            peer = Peer(arm.url)
            peer.lcm.publish("IIWA_STATUS", status(2).encode())
            assert wait(arm, lambda: arm.sensed["position"].count == 2)
            arm.publish({"position": np.zeros(7)})
            assert [channel for channel, _ in peer.hear(2)] == ["IIWA_STATUS", "IIWA_COMMAND"]
    finally:
        arm.close()
        hub.close()


def test_killed_hub_is_noticed_by_publishing_too() -> None:
    with Hub(port=0) as hub, closing(bridge(hub.url)) as arm:
        arm.open()
        os.kill(hub.pid, signal.SIGKILL)
        hub.close()
        for _ in range(2):  # the kernel takes the first: a connection that one end has closed is half open
            arm.publish({"position": np.zeros(7)})
        assert not arm.connected


def test_bridge_that_is_closed_while_it_seeks_a_bus_stops_seeking() -> None:
    with Hub(port=0) as hub:
        arm = bridge(hub.url)
        arm.open()
        others = set(threading.enumerate())
    arm.poll()
    (search,) = set(threading.enumerate()) - others
    arm.close()
    search.join(PATIENCE)
    assert not search.is_alive()


def test_closed_bridge_opens_again(hub: Hub) -> None:
    arm = bridge(hub.url)
    for _ in range(2):
        arm.open()
        assert arm.connected
        arm.close()
        assert not arm.connected


def test_bus_that_takes_nothing_is_not_waited_for() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        code = """
import socket, sys
server = socket.socket(fileno=int(sys.argv[1]))
client, _ = server.accept()
client.sendall(bytes.fromhex("287617fa00000100"))
sys.stdin.read()
"""
        frozen = subprocess.Popen(
            [sys.executable, "-c", code, str(server.fileno())], pass_fds=[server.fileno()], stdin=subprocess.PIPE
        )
        try:
            url = f"tcpq://127.0.0.1:{server.getsockname()[1]}"
            with closing(TcpqConnection(url, {}, PATIENCE)) as connection, pytest.raises(BlockingIOError):
                for _ in range(1000):
                    connection.publish([("A", bytes(100_000))])
        finally:
            frozen.kill()
            frozen.communicate()


def test_messages_that_leave_together_arrive_in_order_and_stamped_with_their_arrival(hub: Hub) -> None:
    messages = [("A", b"1"), ("B", b"2"), ("A", b"")]
    heard: list[tuple[str, bytes]] = []
    handlers = dict.fromkeys("AB", lambda *message: heard.append(message))
    with (
        closing(TcpqConnection(hub.url, {}, PATIENCE)) as sender,
        closing(TcpqConnection(hub.url, handlers, PATIENCE, stamped=True)) as receiver,
    ):
        limit = time.monotonic() + PATIENCE
        while receiver.arrived is None:  # The kernel begins a moment after it was asked to.
            assert time.monotonic() < limit
            sender.publish([("A", b"")])
            select.select([receiver], [], [], PATIENCE)
            receiver.take(10)
        heard.clear()
        begin = time.monotonic()
        sender.publish(messages)
        while len(heard) < len(messages):
            assert time.monotonic() < limit
            select.select([receiver], [], [], PATIENCE)
            receiver.take(10)
        assert heard == messages
        assert begin < receiver.arrived < time.monotonic()


def test_frozen_hub_is_not_lost_and_not_waited_for(hub: Hub, user_types: ModuleType) -> None:
    def encode(values: Mapping[str, Any], utime: int) -> Any:
        message = user_types.mixed_t()
        message.utime, message.m, message.blob = utime, 200_000, bytes(200_000)
        return message

    blob = LcmMap(channel="BLOB", type=user_types.mixed_t, signals=["jaw"], encode=encode)
    jaw = Interface(sense=[], act=[Signal("jaw", size=1, idle=0.0)])
    with closing(LcmBridge(jaw, hub.url, sense=[], act=[blob])) as arm:
        arm.open()
        os.kill(hub.pid, signal.SIGSTOP)
        try:
            while not arm.sent["jaw"].withheld and arm.sent["jaw"].count < 1000:
                arm.publish({"jaw": [0.0]})
            assert arm.sent["jaw"].withheld == {"no bus": 1}
            assert arm.connected
        finally:
            os.kill(hub.pid, signal.SIGCONT)
        peer = Peer(hub.url)
        count = arm.sent["jaw"].count
        assert wait(arm, lambda: arm.publish({"jaw": [0.0]}) or arm.sent["jaw"].count > count)
        assert user_types.mixed_t.decode(peer.hear(1)[-1][1]).m == 200_000


def test_burst_is_taken_in_by_portions(hub: Hub) -> None:
    peer = Peer(hub.url)
    with closing(bridge(hub.url, burst=10)) as arm:
        arm.open()
        for utime in range(1, 36):
            peer.lcm.publish("IIWA_STATUS", status(utime).encode())
        peer.hear(35)
        counts = []
        while sum(counts) < 35 and len(counts) < 1000:
            counts.append(arm.poll(1.0))
        assert max(counts) <= 10
        assert arm.sensed["position"].count == 35


def test_foreign_publisher_on_a_command_channel_raises_an_alarm(hub: Hub) -> None:
    told: list[str] = []
    peer = Peer(hub.url)
    with closing(bridge(hub.url, watch=True, on_foreign=lambda channel, data: told.append(channel))) as arm:
        arm.open()
        in_step(arm, peer)
        for _ in range(5):
            arm.publish({"position": np.zeros(7)})
        own = peer.hear(6)[-1][1]
        taken = 0
        while taken < 5:
            came = arm.poll(PATIENCE)
            assert came
            taken += came
        assert arm.foreign_messages == {"IIWA_COMMAND": 0}
        peer.lcm.publish("IIWA_COMMAND", own)  # a recorded one, byte for byte
        assert wait(arm, lambda: arm.foreign_messages == {"IIWA_COMMAND": 1})
        assert told == ["IIWA_COMMAND"]


def test_second_publisher_of_commands_is_heard_on_a_hub_and_speaks_against_commanding_for_a_while(hub: Hub) -> None:
    peer = Peer(hub.url)
    with closing(bridge(hub.url)) as arm:
        arm.open()
        in_step(arm, peer)
        arm.publish({"position": np.zeros(7)})
        peer.hear(2)
        arm.poll(0.1)
        assert (arm.foreign, arm.competing_publisher) == (0, None)
        peer.lcm.publish("IIWA_COMMAND", b"foreign")
        assert wait(arm, lambda: arm.foreign == 1)
        assert "somebody else publishes commands on IIWA_COMMAND" in (arm.competing_publisher or "")
        assert wait(arm, lambda: arm.competing_publisher is None)
        assert arm.foreign == 1


def test_second_publisher_that_a_hub_refuses_is_an_alarm_too() -> None:
    with Hub(port=0, protect=["IIWA_COMMAND"], lease=300.0) as hub, closing(bridge(hub.url)) as arm:
        intruder = Peer(hub.url)
        arm.open()
        arm.publish({"position": np.zeros(7)})
        assert wait(arm, lambda: hub.statistics().protected["IIWA_COMMAND"].owner is not None)

        def is_noticed() -> bool:
            intruder.lcm.publish("IIWA_COMMAND", b"foreign")
            return arm.foreign > 0

        assert wait(arm, is_noticed)
        assert "somebody else publishes commands on IIWA_COMMAND" in (arm.competing_publisher or "")
        assert [data for channel, data in intruder.heard if channel == "IIWA_COMMAND"].count(b"foreign") == 0
        assert wait(arm, lambda: arm.competing_publisher is None)
        assert arm.blocked_reason is None


def test_own_and_earlier_refusals_are_not_foreign() -> None:
    foreign = ForeignCommands(["C"], lambda: "me")

    def told(owner: str, refused: int, last: str) -> int:
        state = ChannelStatistics(owner=owner, refused=refused, last_refused=last)
        foreign.take_status(STATUS_CHANNEL, HubStatistics(protected={"C": state}).to_json())
        return foreign.refused

    assert told("me", 7, "other") == 0  # before the first status
    assert told("me", 9, "other") == 2
    assert told("other", 12, "me") == 2
    assert told("me", 13, "me") == 2
    assert told("me", 0, "other") == 2  # of a hub that was started again
    assert told("me", 1, "other") == 3
    assert foreign.recent(60.0) == {"C"} and foreign.recent(0.0) == set()


def test_on_a_protected_channel_the_hub_tells_who_commands() -> None:
    with (
        Hub(port=0, protect=["IIWA_COMMAND"]) as hub,
        closing(bridge(hub.url)) as commander,
        closing(bridge(hub.url)) as listener,
    ):
        commander.open()
        listener.open()
        in_step(listener, Peer(hub.url))
        commander.publish({"position": np.zeros(7)})
        assert wait(listener, lambda: listener.foreign == 1 and listener.blocked_reason is not None)
        assert listener.competing_publisher is None


def test_own_messages_that_come_back_late_are_not_foreign() -> None:
    foreign = ForeignCommands(["C"], lambda: None)
    own = [str(number).encode() for number in range(3000)]
    for data in (*own, own[7]):
        foreign.expect("C", data)
    for data in (own[7], *reversed(own)):
        foreign.take("C", data)
    assert foreign.heard == {"C": 0}
    for data in (own[7], b"foreign"):
        foreign.take("C", data)
    assert foreign.heard == {"C": 2}


def test_own_messages_that_never_come_back_are_forgotten() -> None:
    foreign = ForeignCommands(["C"], lambda: None)
    for number in range(20_000):
        foreign.expect("C", str(number).encode())
    foreign.take("C", b"0")
    assert foreign.heard == {"C": 1}


def test_own_message_on_another_channel_is_foreign() -> None:
    foreign = ForeignCommands(["C", "D"], lambda: None)
    foreign.expect("C", b"1")
    foreign.take("D", b"1")
    assert foreign.heard == {"C": 0, "D": 1}


def test_callback_that_raises_does_not_end_the_loop(hub: Hub) -> None:
    def refuse(channel: str, data: bytes) -> None:
        raise RuntimeError

    peer = Peer(hub.url)
    with closing(bridge(hub.url, watch=True, on_foreign=refuse)) as arm:
        arm.open()
        in_step(arm, peer)
        peer.lcm.publish("IIWA_COMMAND", b"1")
        peer.lcm.publish("IIWA_COMMAND", b"2")
        assert wait(arm, lambda: arm.foreign_messages == {"IIWA_COMMAND": 2})


def test_foreign_publisher_is_heard_on_udpm() -> None:
    url = f"udpm://239.255.76.67:{free_port()}?ttl=0"
    with closing(bridge(url)) as arm:
        try:
            arm.open()
        except BridgeError:
            pytest.skip("no multicast here")
        arm.publish({"position": np.zeros(7)})
        if not arm.poll(1.0):
            pytest.skip("no multicast here")
        assert arm.foreign_messages == {"IIWA_COMMAND": 0}
        code = f"import lcm; lcm.LCM({url!r}).publish('IIWA_COMMAND', b'foreign')"
        subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
        if not wait(arm, lambda: arm.foreign_messages == {"IIWA_COMMAND": 1}):
            pytest.skip("multicast does not pass between processes here")


def test_frozen_owner_of_a_protected_channel_is_succeeded_only_on_request() -> None:
    with Hub(port=0, protect=["IIWA_COMMAND"], lease=0.05) as hub:
        peer = Peer(hub.url)
        with closing(bridge(hub.url)) as first, closing(bridge(hub.url)) as second:
            first.open()
            second.open()
            in_step(first, peer)
            first.publish({"position": np.full(7, 1.0)})
            peer.hear(2)
            second.publish({"position": np.full(7, 2.0)})
            end = time.monotonic() + PATIENCE
            while len(peer.heard) < 3 and time.monotonic() < end:
                second.take_over()
                second.publish({"position": np.full(7, 3.0)})
                peer.lcm.handle_timeout(20)
            positions = [command(data)[0][0] for channel, data in peer.heard if channel == "IIWA_COMMAND"]
            assert positions[:2] == [1.0, 3.0]


def test_bridge_whose_commands_the_hub_refuses_counts_and_logs_it(caplog: pytest.LogCaptureFixture) -> None:
    with (
        Hub(port=0, protect=["IIWA_COMMAND"], lease=300.0) as hub,
        closing(bridge(hub.url)) as first,
        closing(bridge(hub.url)) as second,
    ):
        first.open()
        second.open()

        def both_publish() -> bool:
            for arm in (first, second):
                arm.poll()
                left_out = arm.publish({"position": np.full(7, 1.0)})
            refused = second.sent["position"].withheld.get("refused", 0)
            assert left_out == (("position",) if refused else ())
            return refused >= 3

        first.publish({"position": np.full(7, 1.0)})
        wait(first, lambda: hub.statistics().protected["IIWA_COMMAND"].owner is not None)
        assert wait(second, both_publish)
        assert first.sent["position"].withheld == {}
        assert first.blocked_reason is None
        assert second.blocked_reason == "the hub protects IIWA_COMMAND for somebody else"
        [record] = [record for record in caplog.records if "refused by the hub" in record.message]
        assert hub.statistics().protected["IIWA_COMMAND"].owner in record.message


@pytest.mark.parametrize("status", [b"", b"{}", b"[]", b"\xff", b'{"protected": {"IIWA_COMMAND": 1}}'])
def test_what_is_no_status_of_a_hub_is_told_and_changes_nothing(
    status: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    foreign = ForeignCommands(["IIWA_COMMAND"], lambda: "127.0.0.1:1")
    foreign.take_status("VTB_HUB", status)
    assert foreign.blocked == frozenset()
    assert "no status" in caplog.text


def test_only_a_hub_can_be_asked_for_channels() -> None:
    with pytest.raises(ValueError, match="only a hub protects channels"):
        bridge("memq://").take_over()


def test_commands_u_come_over_lcm_too(hub: Hub, user_types: ModuleType) -> None:
    goal = Interface(
        sense=[], act=[], commands=[Signal("goal", size=3, lower=-1.0, upper=1.0), Signal("local", size=1)]
    )
    map = vector_map("GOAL", user_types.point_t, {"goal": ("x", "y", "z")}, stamp="")
    with closing(LcmBridge(goal, hub.url, sense=[], act=[], commands=[map])) as arm:
        arm.open()
        peer = Peer(hub.url)
        for x in (0.5, 2.0):
            message = user_types.point_t()
            message.x, message.y = x, 0.25
            peer.lcm.publish("GOAL", message.encode())
        assert wait(arm, lambda: arm.commands["goal"].rejected == {"limits": 1})
        np.testing.assert_array_equal(arm.commands["goal"].value, [0.5, 0.25, 0.0])
        assert list(arm.commands) == ["goal"]
