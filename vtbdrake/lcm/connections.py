"""Connections to an LCM bus, which tell when they are lost."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from urllib.parse import urlsplit

import lcm

from vtbdrake.lcm.hub.reader import TcpqReader, publish_record
from vtbdrake.lcm.hub.tcpq import (
    MAGIC_CLIENT,
    MAGIC_REJECTION,
    MAGIC_SERVER,
    MAX_REJECTION,
    SUBSCRIBE,
    VERSION,
    TcpqError,
    address_name,
    connect_shortcut,
)

Handler = Callable[[str, bytes], None]
"""Takes the channel and the bytes of a message; it must not raise."""

_DEFAULT_PORT = 7700
_LONGEST_MESSAGE = 1 << 28  # LCM_MAX_MESSAGE_SIZE
_RECEIVE = 1 << 16
_WORDS = struct.Struct(">II")
_SO_TIMESTAMPNS = 35  # <asm-generic/socket.h>; the type of the control message, too
_TIMESPEC = struct.Struct("@ll")


class RefusedError(ConnectionRefusedError):
    """There is a hub, which does not let this client in, and says why."""


class Connection(ABC):
    """One connection. Its calls do not wait. After an OSError it is of no use any more.

    Attributes:
        name: under which a hub knows it; None where there is no hub.
        arrived: when the message that is handed on had arrived at this computer, by `time.monotonic`; if it was to be
            stamped and can be, else None.
        pending: whether the rest of what was published waits for room; `take` sends it.
    """

    name: str | None = None
    arrived: float | None = None
    pending: bool = False

    @abstractmethod
    def fileno(self) -> int:
        """What becomes readable when messages arrive."""

    @abstractmethod
    def take(self, limit: int) -> int:
        """Hands up to ``limit`` messages that have arrived to their handlers; says how many.

        Raises:
            OSError: the connection is lost.
        """

    @abstractmethod
    def publish(self, messages: Sequence[tuple[str, bytes]]) -> None:
        """Publishes messages, each a channel and its bytes.

        Raises:
            BlockingIOError: the bus takes nothing at present; the messages are dropped.
            OSError: the connection is lost.
        """

    @abstractmethod
    def close(self) -> None: ...


def connect(url: str, handlers: Mapping[str, Handler], timeout: float, *, stamped: bool = False) -> Connection:
    """A connection to the bus at ``url``, subscribed to the channels of ``handlers``.

    Args:
        stamped: whether the kernel is to stamp what arrives; it does for tcpq, by TCP.

    Raises:
        OSError: there is no bus.
    """
    if url.startswith("tcpq://"):
        return TcpqConnection(url, handlers, timeout, stamped=stamped)
    return LibraryConnection(url, handlers)


class LibraryConnection(Connection):
    """By liblcm: udpm, mpudpm, memq, file."""

    def __init__(self, url: str, handlers: Mapping[str, Handler]) -> None:
        try:
            self._lcm = lcm.LCM(url)
        except RuntimeError as error:
            raise OSError(f"liblcm: {error}") from None
        for channel, handler in handlers.items():
            if self._lcm.subscribe(_literally(channel), handler) is None:
                raise OSError(f"liblcm cannot subscribe to {channel}")

    def fileno(self) -> int:
        return int(self._lcm.fileno())

    def take(self, limit: int) -> int:
        count = 0
        while count < limit and self._lcm.handle_timeout(0):
            count += 1
        return count

    def publish(self, messages: Sequence[tuple[str, bytes]]) -> None:
        for channel, data in messages:
            self._lcm.publish(channel, data)

    def close(self) -> None:
        del self._lcm


class TcpqConnection(Connection):
    """To a tcpq hub, by a socket of its own that is never waited for: the hub's shortcut if there is one, or TCP.

    liblcm's client writes a message in five sends, waits inside of a message for as long as the hub does, connects anew
    (and waits again) in whatever call comes after a loss, even in the destructor, and believes any length that it is
    told.
    """

    def __init__(self, url: str, handlers: Mapping[str, Handler], timeout: float, *, stamped: bool = False) -> None:
        self._handlers = {channel.encode(): (channel, handler) for channel, handler in handlers.items()}
        # The hub's greeting is read below; what follows has the form of a client's records.
        self._reader = TcpqReader(max_message=_LONGEST_MESSAGE, greeted=True)
        self._unsent = b""
        self._socket = _open(tcpq_address(url), timeout, stamped=stamped)
        try:
            self.name = address_name(self._socket.getsockname())
            self._greet()
            for channel in handlers:
                name = _literally(channel).encode()
                self._socket.sendall(_WORDS.pack(SUBSCRIBE, len(name)) + name)
            if stamped:
                self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            self._socket.setblocking(False)
        except OSError:
            self._socket.close()
            raise
        self._stamped = stamped

    def _greet(self) -> None:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # Who is not let in may be told before that.
            self._socket.sendall(_WORDS.pack(MAGIC_CLIENT, VERSION))
        magic, size = _WORDS.unpack(self._receive_exactly(_WORDS.size))
        if magic == MAGIC_REJECTION:
            raise RefusedError(self._receive_exactly(min(size, MAX_REJECTION)).decode(errors="replace"))
        if magic != MAGIC_SERVER:
            raise ConnectionError("what listens there is no tcpq hub")

    def _receive_exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            chunk = self._socket.recv(size - len(data))
            if not chunk:
                raise ConnectionResetError("it closed the connection")
            data += chunk
        return data

    def fileno(self) -> int:
        return self._socket.fileno()

    def take(self, limit: int) -> int:
        if self.pending:
            with contextlib.suppress(BlockingIOError):
                self._send(self._unsent)
        count = self._dispatch(limit) if self._reader.partial else 0
        size = _RECEIVE
        while count < limit and size == _RECEIVE:  # a smaller piece was all that there was
            size = self._receive_stamped() if self._stamped else self._reader.receive(self._socket.fileno(), _RECEIVE)
            if size <= 0:
                if size < 0:
                    break
                raise ConnectionResetError("the hub closed the connection")
            count += self._dispatch(limit - count)
        return count

    def _receive_stamped(self) -> int:
        """As `TcpqReader.receive`; `arrived` is then the time of the last byte that came."""
        try:
            chunk, ancillary, _, _ = self._socket.recvmsg(_RECEIVE, socket.CMSG_SPACE(_TIMESPEC.size))
        except BlockingIOError:
            return -1
        stamps = [data for level, kind, data in ancillary if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS)]
        if stamps:
            seconds, nanoseconds = _TIMESPEC.unpack(stamps[0])
            age = time.time() - (seconds + 1e-9 * nanoseconds)
            self.arrived = time.monotonic() - age
        self._reader.append(chunk)
        return len(chunk)

    def _dispatch(self, limit: int) -> int:
        publication, handlers, count = self._reader.next_publication, self._handlers, 0
        try:
            while count < limit and (come := publication()) is not None:
                count += 1
                if come[0] in handlers:
                    channel, handler = handlers[come[0]]
                    handler(channel, come[1])
        except TcpqError as error:
            raise ConnectionError(f"the hub violates the protocol: {error}") from None
        return count

    def publish(self, messages: Sequence[tuple[str, bytes]]) -> None:
        if self.pending:
            self._send(self._unsent)
            if self.pending:
                raise BlockingIOError("an earlier message is still on its way")
        records = [publish_record(channel.encode(), data) for channel, data in messages]
        self._send(records[0] if len(records) == 1 else b"".join(records))

    def _send(self, records: bytes) -> None:
        sent = self._socket.send(records)
        self.pending = sent < len(records)
        self._unsent = records[sent:] if self.pending else b""

    def close(self) -> None:
        self._socket.close()


def _open(address: tuple[str, int], timeout: float, *, stamped: bool) -> socket.socket:
    """A connection to the hub, with a time-out, until it is told otherwise."""
    # The kernel does not stamp what comes by a Unix socket.
    sock = None if stamped else connect_shortcut(*address)
    if sock is None:
        sock = socket.create_connection(address, timeout)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.settimeout(timeout)
    return sock


def tcpq_address(url: str) -> tuple[str, int]:
    """Host and port of ``tcpq://host:port``; both may be left out.

    Raises:
        ValueError: the port is no number.
    """
    parts = urlsplit(url)
    return parts.hostname or "127.0.0.1", _DEFAULT_PORT if parts.port is None else parts.port


def _literally(channel: str) -> str:
    """A subscription is a regular expression; this one means the channel's name only."""
    return "".join(f"\\{c}" if c in r".^$*+?()[]{}|" + "\\" else c for c in channel)
