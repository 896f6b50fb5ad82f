"""The hub's side of a connection to a client."""

from __future__ import annotations

import socket
from collections import deque

from vtbdrake.lcm.hub.reader import TcpqReader
from vtbdrake.lcm.hub.subscriptions import Subscriptions
from vtbdrake.lcm.hub.tcpq import address_name

# Most bytes that are sent or received at once: copying them takes some 50 us, during which all other clients wait.
SLICE = 256 * 1024

# Seconds until the kernel probes a silent peer, seconds between probes, and probes until the connection is lost.
_KEEP_ALIVE = {socket.TCP_KEEPIDLE: 10, socket.TCP_KEEPINTVL: 5, socket.TCP_KEEPCNT: 3}


class ClientConnection:
    """A connected client: its socket, its subscriptions and its backlog, the messages that it has not read yet.

    Args:
        sock: Connected socket, which the connection owns from now on.
        max_message: Largest data of a message, in bytes.
        max_queue: Largest backlog, in bytes.
        now: Time on the hub's clock, in seconds.
        user: User id of the client; None if unknown.
    """

    def __init__(self, sock: socket.socket, *, max_message: int, max_queue: int, now: float, user: int | None) -> None:
        self.socket = sock
        self.fileno = sock.fileno()
        self.name = address_name(sock.getpeername())
        self.user = user
        self.reader = TcpqReader(max_message=max_message)
        self.subscriptions = Subscriptions()
        self.published = False  # whether it has published anything
        self.connected_at = now
        self.progressed_at = now  # when it connected, its backlog began, or it last read some of its backlog
        self.incomplete_since: float | None = None  # when an incomplete message began to arrive
        self.awaits_room = False  # whether the hub waits until the socket accepts more
        self.queued = 0  # bytes of the backlog
        self.closed = False
        self.reads_no_more = False  # it has closed, and what it had sent before is still to be read
        self._max_queue = max_queue
        self._queue: deque[bytes | bytearray] = deque()
        self._offset = 0  # bytes of the first queued message that have been sent
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _KEEP_ALIVE.items():
            sock.setsockopt(socket.IPPROTO_TCP, option, value)

    @property
    def idle(self) -> bool:
        """Return whether the client has never published and has no subscriptions."""
        return not self.published and not self.subscriptions

    @property
    def memory(self) -> int:
        """Return the number of bytes that the hub keeps for the client: its backlog and its incomplete message."""
        return self.queued + self.reader.buffered

    def acknowledge(self) -> None:
        """Acknowledge the received data at once.

        liblcm writes a message in five pieces with Nagle's algorithm, which holds back the second piece until the
        first is acknowledged (40 ms later by default). The kernel resets the option, so every piece needs a call.
        """
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)

    def send(self, messages: list[bytes | bytearray], now: float) -> int:
        """Send messages, and queue what cannot be sent at once.

        Args:
            messages: The messages as they are on the wire, in this order.
            now: The time on the hub's clock, in seconds.

        Returns:
            Number of messages that were dropped because the backlog exceeded ``max_queue``.

        Raises:
            OSError: The connection is lost.
        """
        sent = 0
        if not self._queue and not self.reads_no_more:
            data = messages[0] if len(messages) == 1 else b"".join(messages)
            sent = self._send(data)
            if sent == len(data):
                return 0
            complete = 0
            while sent >= len(messages[complete]):
                sent -= len(messages[complete])
                complete += 1
            messages = messages[complete:]
            self.progressed_at = now
            self._offset = sent
        if self.reads_no_more:
            return 0
        self._queue.extend(messages)
        self.queued += sum(map(len, messages)) - sent
        oldest = 1 if self._offset else 0  # a message that is partly sent must be completed
        dropped = 0
        while self.queued > self._max_queue and len(self._queue) > oldest:
            self.queued -= len(self._queue[oldest])
            del self._queue[oldest]
            dropped += 1
        return dropped

    def flush(self, now: float) -> None:
        """Send a slice of the backlog.

        Raises:
            OSError: The connection is lost.
        """
        room = SLICE
        while self._queue and room > 0:
            first = self._queue[0]
            sent = self._send(memoryview(first)[self._offset :])
            if not sent:
                return
            room -= sent
            self.progressed_at = now
            self.queued -= sent
            self._offset += sent
            if self._offset == len(first):
                self._queue.popleft()
                self._offset = 0

    def _send(self, data: bytes | bytearray | memoryview) -> int:
        try:
            return self.socket.send(data if len(data) <= SLICE else memoryview(data)[:SLICE])
        except BlockingIOError:
            return 0
        except (BrokenPipeError, ConnectionResetError):
            # What the client sent before it closed is still to be read, such as the last command of a loop.
            self.reads_no_more = True
            self._discard_backlog()
            return 0

    def _discard_backlog(self) -> None:
        self._queue.clear()
        self.queued = self._offset = 0

    def close(self) -> None:
        """Close the socket and discard the backlog."""
        self.closed = True
        self._discard_backlog()
        self.socket.close()
