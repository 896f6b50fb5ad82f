"""A real bus with an independent client, for tests."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

import lcm

from tests.control.arm import status
from vtbdrake.lcm.bridge import LcmBridge
from vtbdrake.lcm.hub import STATUS_CHANNEL

PATIENCE = 60.0  # s, for what depends on another process


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
