"""Connections to a real bus are restored, and never waited for."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import closing
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tests.control.arm import bridge, status
from tests.lcm.bus import PATIENCE, Peer, free_port, in_step, wait
from vtbdrake.control.bridge import BridgeError
from vtbdrake.lcm.connections import TcpqConnection
from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.lcm_bridge import LcmBridge
from vtbdrake.lcm.maps import LcmMap
from vtbdrake.testbed import Interface, Signal


@pytest.mark.parametrize(
    "url", ["tcpq://127.0.0.1:{port}", "udpm://10.0.0.1:7667", "nosuch://", "file:///nowhere/log?mode=r"]
)
def test_missing_bus_is_an_error(url: str) -> None:
    arm = bridge(url.format(port=free_port()))
    with pytest.raises(BridgeError, match="no LCM bus at"):
        arm.open()
    assert not arm.connected
    with pytest.raises(BridgeError, match="is not open"):
        arm.poll()


def test_server_that_is_no_hub_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        arm = bridge(f"tcpq://127.0.0.1:{server.getsockname()[1]}", connect_timeout=0.1)
        with pytest.raises(BridgeError, match="timed out"):
            arm.open()


def test_poll_notices_a_killed_hub_and_finds_its_successor() -> None:
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
        while arm.poll():  # messages that the hub had sent before
            pass
        assert not arm.connected
        assert arm.publish({"position": np.zeros(7)}) == ("position",)
        assert arm.sent["position"].withheld == {"no bus": 1}
        with Hub(port=port):
            assert wait(arm, lambda: arm.connected)
            assert (arm.link.losses, arm.link.reconnections) == (1, 1)
            peer = Peer(arm.url)
            peer.lcm.publish("IIWA_STATUS", status(3_600_000_000).encode())  # An hour is missing.
            assert wait(arm, lambda: arm.sensed["position"].count == 2)
            assert arm.sensed["position"].rejected == {}
            arm.publish({"position": np.zeros(7)})
            assert [channel for channel, _ in peer.hear(2)] == ["IIWA_STATUS", "IIWA_COMMAND"]
    finally:
        arm.close()
        hub.close()


def test_publish_notices_a_killed_hub() -> None:
    with Hub(port=0) as hub, closing(bridge(hub.url)) as arm:
        arm.open()
        os.kill(hub.pid, signal.SIGKILL)
        hub.close()
        for _ in range(2):  # the first succeeds: the connection is half open
            arm.publish({"position": np.zeros(7)})
        assert not arm.connected


def test_close_ends_the_search_for_a_bus() -> None:
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


def test_publish_does_not_wait_for_a_frozen_server() -> None:
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


def test_messages_arrive_in_order_and_stamped(hub: Hub) -> None:
    messages = [("A", b"1"), ("B", b"2"), ("A", b"")]
    heard: list[tuple[str, bytes]] = []
    handlers = dict.fromkeys("AB", lambda *message: heard.append(message))
    with (
        closing(TcpqConnection(hub.url, {}, PATIENCE)) as sender,
        closing(TcpqConnection(hub.url, handlers, PATIENCE, stamped=True)) as receiver,
    ):
        limit = time.monotonic() + PATIENCE
        while receiver.arrived is None:  # The kernel begins to stamp with a delay.
            assert time.monotonic() < limit
            sender.publish([("A", b"")])
            select.select([receiver], [], [], PATIENCE)
            receiver.receive(10)
        heard.clear()
        begin = time.monotonic()
        sender.publish(messages)
        while len(heard) < len(messages):
            assert time.monotonic() < limit
            select.select([receiver], [], [], PATIENCE)
            receiver.receive(10)
        assert heard == messages
        assert begin < receiver.arrived < time.monotonic()


def test_frozen_hub_is_neither_lost_nor_waited_for(hub: Hub, user_types: ModuleType) -> None:
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
