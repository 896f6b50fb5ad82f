"""The hub's end of the connection to one client."""

from __future__ import annotations

import socket
from collections import deque

from vtbdrake.lcm.hub.reader import TcpqReader
from vtbdrake.lcm.hub.subscriptions import Subscriptions
from vtbdrake.lcm.hub.tcpq import TcpqError, address_name

# A slice of a large message: while it is copied to the kernel, or from there, all others wait (some 50 us).
SLICE = 256 * 1024

# Seconds after which the kernel asks whether the other machine is still there, between two such questions, and how
# often it asks.
_KEEP_ALIVE = {socket.TCP_KEEPIDLE: 10, socket.TCP_KEEPINTVL: 5, socket.TCP_KEEPCNT: 3}


class ClientConnection:
    """A client: its socket, its subscriptions, and the queue of what it has not read yet.

    Args:
        sock: connected; the connection owns it.
        max_message, max_queue: in bytes.
        now: the time, on the hub's clock, in seconds.
        user: whose the client is; None if nobody knows.

    Attributes:
        name: of the client; see `address_name`.
        user: as above.
        reader: of what comes from it.
        subscriptions: its subscriptions.
        published: whether it has published anything.
        connected: when it connected.
        progressed: when it connected, when its queue began, or when it last took something off it.
        begun: when the message began to come that is not complete yet; None if there is none.
        watched: whether the hub waits for it to take more.
        queued: bytes that wait for it.
        closed: whether the hub has closed it.
    """

    def __init__(self, sock: socket.socket, *, max_message: int, max_queue: int, now: float, user: int | None) -> None:
        self.socket = sock
        self.fileno = sock.fileno()
        self.name = address_name(sock.getpeername())
        self.user = user
        self.reader = TcpqReader(max_message=max_message)
        self.subscriptions = Subscriptions()
        self.published = False
        self.connected = self.progressed = now
        self.begun: float | None = None
        self.watched = False
        self.queued = 0
        self.closed = False
        self._max_queue = max_queue
        self._queue: deque[bytes | bytearray] = deque()
        self._offset = 0  # of the first message of the queue: so much of it is sent
        self._by_tcp = sock.family == socket.AF_INET
        sock.setblocking(False)
        if self._by_tcp:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for option, value in _KEEP_ALIVE.items():
                sock.setsockopt(socket.IPPROTO_TCP, option, value)

    @property
    def idle(self) -> bool:
        """Whether it has never asked for anything, nor said anything."""
        return not self.published and not self.subscriptions

    @property
    def held(self) -> int:
        """Return how many bytes are kept for it: what waits for it, and what it has begun to send."""
        return self.queued + self.reader.held

    def acknowledge(self) -> None:
        """Acknowledges at once what was read: liblcm writes a message in five pieces, and leaves Nagle's algorithm on,
        which holds back the second piece until the first is acknowledged (by default 40 ms later).
        The kernel forgets the option, so it takes one call for every piece read."""
        if self._by_tcp:
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)

    def send(self, messages: list[bytes | bytearray], now: float) -> int:
        """Sends messages, or queues what of them cannot be sent at once; says how many messages that drops.

        Raises:
            OSError: the connection is lost.
        """
        begun = 0
        if not self._queue:
            data = messages[0] if len(messages) == 1 else b"".join(messages)
            begun = self._send(data)
            if begun == len(data):
                return 0
            done = 0
            while begun >= len(messages[done]):
                begun -= len(messages[done])
                done += 1
            messages = messages[done:]
            self.progressed = now
            self._offset = begun
        self._queue.extend(messages)
        self.queued += sum(map(len, messages)) - begun
        return self._drop()

    def flush(self, now: float) -> None:
        """Sends a slice of what is queued.

        Raises:
            OSError: the connection is lost.
        """
        room = SLICE
        while self._queue and room > 0:
            first = self._queue[0]
            sent = self._send(memoryview(first)[self._offset :])
            if not sent:
                return
            room -= sent
            self.progressed = now
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

    def _drop(self) -> int:
        oldest = 1 if self._offset else 0  # what has begun must end
        dropped = 0
        while self.queued > self._max_queue and len(self._queue) > oldest:
            self.queued -= len(self._queue[oldest])
            del self._queue[oldest]
            dropped += 1
        return dropped

    def close(self) -> None:
        self.closed = True
        self._queue.clear()
        self.queued = 0
        self.socket.close()


def text(channel: bytes) -> str:
    """A channel or pattern as text, as liblcm's clients in Python and Java need it.

    Raises:
        TcpqError: it is none.
    """
    try:
        name = channel.decode()
    except UnicodeDecodeError:
        raise TcpqError("malformed", f"names a channel {channel!r}, which is not UTF-8") from None
    if "\0" in name:
        raise TcpqError("malformed", f"names a channel {channel!r}, with a null character")
    return name
