"""Connections to an LCM bus that never block, and a link that restores them."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from queue import Empty, SimpleQueue
from urllib.parse import urlsplit

import lcm

from vtbdrake.control.bridge import BridgeError
from vtbdrake.lcm.hub.reader import TcpqReader, publish_record
from vtbdrake.lcm.hub.tcpq import (
    MAGIC_CLIENT,
    MAGIC_REJECTION,
    MAGIC_SERVER,
    MAX_REJECTION,
    VERSION,
    RecordType,
    TcpqError,
    address_name,
)

Handler = Callable[[str, bytes], None]
"""Takes the channel and the bytes of a message; it must not raise."""

_DEFAULT_PORT = 7700
_LONGEST_MESSAGE = 1 << 28  # LCM_MAX_MESSAGE_SIZE
_RECEIVE = 1 << 16
_WORDS = struct.Struct(">II")
_SO_TIMESTAMPNS = 35  # <asm-generic/socket.h>; the type of the control message, too
_TIMESPEC = struct.Struct("@ll")

FIRST_PAUSE = 0.005
"""Seconds before the first attempt to connect again; each later pause is twice the one before."""
LONGEST_PAUSE = 0.5
"""Longest pause between two attempts, in seconds."""


class RejectedError(ConnectionRefusedError):
    """The hub rejects this client, for the reason in the message."""


class Connection(ABC):
    """One connection, whose calls do not wait. It is of no use after an OSError.

    Attributes:
        name: The client's name at the hub; None without a hub.
        arrived: When the last received message arrived at this computer, by `time.monotonic`; None unless the kernel
            stamps messages.
        pending: Whether the rest of what was published waits to be sent; `receive` sends it.
    """

    name: str | None = None
    arrived: float | None = None
    pending: bool = False

    @abstractmethod
    def fileno(self) -> int:
        """Return the file descriptor that becomes readable when messages arrive."""

    @abstractmethod
    def receive(self, limit: int) -> int:
        """Pass up to ``limit`` messages that have arrived to their handlers, and return how many.

        Raises:
            OSError: The connection is lost.
        """

    @abstractmethod
    def publish(self, messages: Sequence[tuple[str, bytes]]) -> None:
        """Publish messages, each a channel and its bytes.

        Raises:
            BlockingIOError: The bus takes nothing at present; the messages are dropped.
            OSError: The connection is lost.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the connection."""


class LibraryConnection(Connection):
    """A connection by liblcm: udpm, mpudpm, memq, file.

    Args:
        url: The LCM URL of the bus.
        handlers: By channel, the function that takes its messages.
    """

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

    def receive(self, limit: int) -> int:
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
    """A connection to a tcpq hub.

    liblcm's client is not used because it blocks: it sends a message in five parts, waits in the middle of a message
    for as long as the hub does, and reconnects (and waits) in any call after a loss, even in its destructor. It also
    accepts any message length without a check.

    Args:
        url: ``tcpq://host:port``; both have defaults.
        handlers: By channel, what takes its messages.
        timeout: Seconds to wait for the hub.
        stamped: Whether the kernel shall stamp what arrives.

    Raises:
        OSError: There is no hub.
    """

    def __init__(self, url: str, handlers: Mapping[str, Handler], timeout: float, *, stamped: bool = False) -> None:
        self._handlers = {channel.encode(): (channel, handler) for channel, handler in handlers.items()}
        # The hub's greeting is read below; the rest has the form of a client's records.
        self._reader = TcpqReader(max_message=_LONGEST_MESSAGE, greeted=True)
        self._unsent = b""
        self._stamped = stamped
        parts = urlsplit(url)
        address = parts.hostname or "127.0.0.1", _DEFAULT_PORT if parts.port is None else parts.port
        self._socket = socket.create_connection(address, timeout)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._socket.settimeout(timeout)
            self.name = address_name(self._socket.getsockname())
            self._greet()
            for channel in handlers:
                name = _literally(channel).encode()
                self._socket.sendall(_WORDS.pack(RecordType.SUBSCRIBE, len(name)) + name)
            if stamped:
                self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            self._socket.setblocking(False)
        except OSError:
            self._socket.close()
            raise

    def _greet(self) -> None:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # A rejection may have been sent before.
            self._socket.sendall(_WORDS.pack(MAGIC_CLIENT, VERSION))
        magic, size = _WORDS.unpack(self._receive_exactly(_WORDS.size))
        if magic == MAGIC_REJECTION:
            raise RejectedError(self._receive_exactly(min(size, MAX_REJECTION)).decode(errors="replace"))
        if magic != MAGIC_SERVER:
            raise ConnectionError("the server at this address is not a tcpq hub")

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

    def receive(self, limit: int) -> int:
        if self.pending:
            with contextlib.suppress(BlockingIOError):
                self._send(self._unsent)
        count = self._dispatch(limit) if self._reader.partial else 0
        size = _RECEIVE
        while count < limit and size == _RECEIVE:  # after a smaller piece, nothing is left
            size = self._receive_stamped() if self._stamped else self._reader.receive(self._socket.fileno(), _RECEIVE)
            if size == 0:
                raise ConnectionResetError("the hub closed the connection")
            if size > 0:
                count += self._dispatch(limit - count)
        return count

    def _receive_stamped(self) -> int:
        """Receive as `TcpqReader.receive` does, and set `arrived` to the time of the last byte."""
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
        next_publication, handlers, count = self._reader.next_publication, self._handlers, 0
        try:
            while count < limit and (publication := next_publication()) is not None:
                count += 1
                if publication[0] in handlers:
                    channel, handler = handlers[publication[0]]
                    handler(channel, publication[1])
        except TcpqError as error:
            raise ConnectionError(f"the hub violates the protocol: {error}") from None
        return count

    def publish(self, messages: Sequence[tuple[str, bytes]]) -> None:
        if self.pending:
            self._send(self._unsent)
            if self.pending:
                raise BlockingIOError("an earlier message is not sent completely yet")
        self._send(b"".join([publish_record(channel.encode(), data) for channel, data in messages]))

    def _send(self, records: bytes) -> None:
        sent = self._socket.send(records)
        self.pending = sent < len(records)
        self._unsent = records[sent:] if self.pending else b""

    def close(self) -> None:
        self._socket.close()


def _literally(channel: str) -> str:
    """Return the regular expression that matches this channel only."""
    return "".join(f"\\{c}" if c in r".^$*+?()[]{}|" + "\\" else c for c in channel)


class _Search:
    """Tries to connect until it succeeds or is cancelled, in a separate thread, because connecting may take long."""

    def __init__(self, connect: Callable[[], Connection]) -> None:
        self._connect = connect
        self._cancelled = threading.Event()
        self._result: SimpleQueue[Connection] = SimpleQueue()
        threading.Thread(target=self._run, name="vtbdrake-lcm-search", daemon=True).start()

    def _run(self) -> None:
        # A thread inherits the scheduling of the one that starts it; this one must not compete with a real-time loop.
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        pause = FIRST_PAUSE
        while not self._cancelled.is_set():
            try:
                self._result.put(self._connect())
                break
            except OSError:
                self._cancelled.wait(pause)
                pause = min(2 * pause, LONGEST_PAUSE)
        if self._cancelled.is_set():
            self.cancel()

    def result(self, timeout: float = 0.0) -> Connection | None:
        """Return the connection, once; wait for it."""
        try:
            return self._result.get(timeout=timeout) if timeout > 0 else self._result.get_nowait()
        except Empty:
            return None

    def cancel(self) -> None:
        """End the search, and close the connection that it has found."""
        self._cancelled.set()
        if (connection := self.result()) is not None:
            connection.close()


class LcmLink:
    """Receives and publishes while there is a bus, and searches for it while there is none."""

    def __init__(
        self,
        url: str,
        handlers: Mapping[str, Handler],
        *,
        connect_timeout: float,
        stamped: bool = False,
        reconnected: Callable[[], None] = lambda: None,
    ) -> None:
        """Prepare the link; `open` connects.

        Args:
            url: The LCM URL of the bus.
            handlers: By channel, what takes its messages.
            connect_timeout: Seconds to wait for a hub.
            stamped: Whether the kernel shall stamp what arrives; see `TcpqConnection`.
            reconnected: Called when the bus was found again, before any message of the new connection.
        """
        self.url = url  # the LCM URL of the bus
        self.losses = 0  # how often the bus was lost
        self.reconnections = 0  # how often it was found again
        self._connect: Callable[[], Connection] = partial(LibraryConnection, url, handlers)
        if url.startswith("tcpq://"):
            self._connect = partial(TcpqConnection, url, handlers, connect_timeout, stamped=stamped)
        self._connection: Connection | None = None
        self._search: _Search | None = None
        self._reconnected = reconnected

    def open(self) -> None:
        """Connect to the bus.

        Raises:
            BridgeError: There is no bus.
        """
        if self.is_open:
            return
        try:
            self._connection = self._connect()
        except RejectedError as error:
            raise BridgeError(f"the hub at {self.url} rejects the connection: {error}") from error
        except OSError as error:
            remedy = "start a hub there (vtbdrake hub)" if self.url.startswith("tcpq:") else "is the URL right?"
            if isinstance(error, TimeoutError):
                remedy = "if a hub runs there, it is frozen; else, is the URL right?"
            raise BridgeError(f"no LCM bus at {self.url} ({error}); {remedy}") from error

    @property
    def is_open(self) -> bool:
        """Return whether the link has a bus or searches for one."""
        return self._connection is not None or self._search is not None

    @property
    def connected(self) -> bool:
        """Return whether the link has a bus at present."""
        return self._current() is not None

    @property
    def name(self) -> str | None:
        """Return the client's name at the hub; None without a connection or a hub."""
        return None if self._connection is None else self._connection.name

    @property
    def arrived(self) -> float | None:
        """Return the time at which the last received message arrived; see `Connection`."""
        return None if self._connection is None else self._connection.arrived

    @property
    def sources(self) -> list[Connection]:
        """Return the connections that `select` waits on for messages; empty while there is no bus."""
        connection = self._current()
        return [] if connection is None else [connection]

    def _current(self, timeout: float = 0.0) -> Connection | None:
        if self._search is not None and (connection := self._search.result(timeout)) is not None:
            self._connection, self._search = connection, None
            self.reconnections += 1
            self._reconnected()
        return self._connection

    def _required(self, timeout: float = 0.0) -> Connection | None:
        if not self.is_open:
            raise BridgeError(f"the bridge to {self.url} is not open: call open() first")
        return self._current(timeout)

    def receive(self, timeout: float, limit: int) -> int:
        """Pass messages to their handlers, and return how many.

        Args:
            timeout: Seconds to wait for the first message.
            limit: The most messages that are taken.
        """
        end = time.monotonic() + timeout
        connection = self._connection or self._required(timeout)
        if connection is None:
            return 0
        try:
            count = connection.receive(limit)
            timeout = end - time.monotonic()
            while not count and timeout > 0:
                select.select((connection,), (connection,) if connection.pending else (), (), timeout)
                count = connection.receive(limit)
                timeout = end - time.monotonic()
            return count
        except OSError:
            self._lose()
            return 0

    def publish(self, *messages: tuple[str, bytes]) -> bool:
        """Publish messages (channel and bytes), and return whether they went to the bus."""
        connection = self._connection or self._required()
        if connection is None:
            return False
        try:
            connection.publish(messages)
        except BlockingIOError:
            return False
        except OSError:
            self._lose()
            return False
        return True

    def _lose(self) -> None:
        self.losses += 1
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        self._search = _Search(self._connect)

    def close(self) -> None:
        """Close the connection, or end the search; the link may be opened again."""
        if self._search is not None:
            self._search.cancel()
            self._search = None
        if self._connection is not None:
            self._connection.close()
            self._connection = None
