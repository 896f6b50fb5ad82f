"""The machine's end of the bridge over UDP."""

from __future__ import annotations

import select
import socket
from collections.abc import Mapping, Sequence

import numpy as np

from vtbdrake.testbed import Interface
from vtbdrake.testing import MachineEnd
from vtbdrake_diagrams.udp_bridge import Address, decode, encode


class UdpEnd(MachineEnd):
    """Sends datagrams with sensor signals to the bridge, and receives datagrams with commands."""

    def __init__(self, interface: Interface, own: Address, bridge: Address) -> None:
        self.interface = interface
        self._own, self._bridge = own, bridge
        self._socket: socket.socket | None = None

    def open(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(self._own)

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None

    def send(self, values: Mapping[str, np.ndarray], stamp: float) -> None:
        self.send_bytes(encode(self.interface.sense, values, stamp))

    def send_bytes(self, data: bytes) -> None:
        assert self._socket is not None
        self._socket.sendto(data, self._bridge)

    def receive(self, timeout: float) -> Sequence[Mapping[str, np.ndarray]]:
        assert self._socket is not None
        commands = []
        while select.select([self._socket], [], [], 0.0 if commands else timeout)[0]:
            commands.append(decode(self.interface.act, self._socket.recv(65536))[1])
        return commands
