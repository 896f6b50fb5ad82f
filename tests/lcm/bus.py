"""An independent client of a real bus, and functions that wait for it."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

import lcm

from tests.control.arm import status
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.lcm.hub import STATUS_CHANNEL
from vtbdrake.lcm.lcm_bridge import LcmBridge

PATIENCE = 60.0  # seconds to wait for another process


class Peer:
    """An independent LCM client that keeps every message except the status of the hub."""

    def __init__(self, url: str) -> None:
        self.lcm = lcm.LCM(url)
        self.heard: list[tuple[str, bytes]] = []
        self.lcm.subscribe(".*", self._keep)

    def _keep(self, channel: str, data: bytes) -> None:
        if not channel.startswith(STATUS_CHANNEL):
            self.heard.append((channel, data))

    def hear(self, count: int) -> list[tuple[str, bytes]]:
        """Return all messages once there are ``count`` of them."""
        end = time.monotonic() + PATIENCE
        while len(self.heard) < count and time.monotonic() < end:
            self.lcm.handle_timeout(100)
        return self.heard


def wait(bridge: LcmBridge, condition: Callable[[], bool]) -> bool:
    """Poll until the condition holds, and return whether it does."""
    end = time.monotonic() + PATIENCE
    while not condition() and time.monotonic() < end:
        bridge.poll(0.02)
    return condition()


def handled(received: ReceivedSignal) -> int:
    """Return how many messages were accepted or rejected."""
    return received.count + sum(received.rejected.values())


def in_step(bridge: LcmBridge, peer: Peer) -> None:
    """Return when the bus carries messages from the peer to the bridge."""
    peer.lcm.publish("IIWA_STATUS", status(1).encode())
    assert wait(bridge, lambda: bridge.sensed["position"].count > 0)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])
