"""A bridge over UDP, as an example of a driver of one's own: one datagram of numbers per cycle in each direction."""

from __future__ import annotations

import select
import socket
import struct
import time
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from vtbdrake.control import Bounds, Bridge, Inbox
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.testbed import Interface, Signal

Address = tuple[str, int]

_HEADER = struct.Struct("<Q")  # The sender's time in microseconds; the numbers of all signals follow.


def encode(signals: Sequence[Signal], values: Mapping[str, Any], stamp: float) -> bytes:
    """Return a datagram with the values of all signals, sent at ``stamp`` in seconds."""
    numbers = [np.asarray(values[signal.name], dtype="<f8").reshape(signal.size).tobytes() for signal in signals]
    return _HEADER.pack(round(1e6 * stamp)) + b"".join(numbers)


def decode(signals: Sequence[Signal], data: bytes) -> tuple[float, dict[str, np.ndarray]]:
    """Return the stamp in seconds and the values of a datagram; a ValueError if it has another size."""
    sizes = [signal.size or 0 for signal in signals]
    if len(data) != _HEADER.size + 8 * sum(sizes):
        raise ValueError(f"a datagram of {len(data)} bytes, not {_HEADER.size + 8 * sum(sizes)}")
    parts = np.split(np.frombuffer(data, "<f8", offset=_HEADER.size), np.cumsum(sizes)[:-1])
    return 1e-6 * _HEADER.unpack_from(data)[0], {s.name: part for s, part in zip(signals, parts, strict=True)}


class UdpBridge(Bridge):
    """Carries the vector signals of a DPS in datagrams: all sensor signals in one, all actuator commands in one.

    Args:
        interface: The signals of the DPS.
        local: The host and the port on which the bridge listens; say 127.0.0.1 or the address of the robot's network.
        machine: The host and the port of the machine; datagrams from elsewhere are ignored.
    """

    def __init__(self, interface: Interface, local: Address, machine: Address) -> None:
        self.interface = interface
        self.sensed = {signal.name: ReceivedSignal() for signal in interface.sense}
        self.commands = {}
        self._inbox = Inbox(interface.sense, self.sensed)
        self._bounds = {signal.name: Bounds(signal) for signal in interface.act}
        self._local, self._machine = local, machine
        self._socket: socket.socket | None = None

    def open(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(self._local)
        self._socket.setblocking(False)

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None

    @property
    def connected(self) -> bool:
        return self._socket is not None

    def poll(self, timeout: float = 0.0) -> int:
        if self._socket is None or not select.select([self._socket], [], [], timeout)[0]:
            return 0
        count = 0
        try:
            while True:
                data, sender = self._socket.recvfrom(65536)
                count += 1
                if sender == self._machine:
                    self._take(data)
        except OSError:  # Nothing more has arrived, or the machine does not listen at present.
            return count

    def _take(self, data: bytes) -> None:
        try:
            sent, values = decode(self.interface.sense, data)
        except ValueError:
            self._inbox.reject("size")
        else:
            self._inbox.take(values, sent=sent, now=time.monotonic())

    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        good = all(name in actuation and not bounds.violation(actuation[name]) for name, bounds in self._bounds.items())
        if self._socket is None or not good:  # A datagram has all commands, or is not sent.
            return tuple(actuation)
        try:
            self._socket.sendto(encode(self.interface.act, actuation, time.time()), self._machine)
        except OSError:
            return tuple(actuation)
        return ()
