"""A link to an LCM bus that comes back by itself."""

from __future__ import annotations

import os
import select
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial

from vtbdrake.control.bridge import BridgeError
from vtbdrake.lcm.connections import Connection, Handler, RefusedError, connect

FIRST_PAUSE, LONGEST_PAUSE = 0.005, 0.5
"""Seconds between attempts to connect; each is twice the one before."""


class _Search(threading.Thread):
    """Seeks a bus until it finds one or is cancelled; in a thread of its own, because connecting may take long."""

    def __init__(self, connect: Callable[[], Connection]) -> None:
        super().__init__(name="vtbdrake-lcm-search", daemon=True)
        self._connect = connect
        self._cancelled = threading.Event()
        self._lock = threading.Lock()
        self._found: Connection | None = None
        self.ended = threading.Event()

    def run(self) -> None:
        # A thread has the scheduling of the one that started it; this one must not compete with a real-time loop.
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        pause = FIRST_PAUSE
        while not self._cancelled.is_set():
            try:
                connection = self._connect()
            except OSError:
                self._cancelled.wait(pause)
                pause = min(2 * pause, LONGEST_PAUSE)
                continue
            with self._lock:
                if self._cancelled.is_set():
                    connection.close()
                else:
                    self._found = connection
            break
        self.ended.set()

    def result(self) -> Connection | None:
        """The connection, once."""
        with self._lock:
            found, self._found = self._found, None
        return found

    def cancel(self) -> None:
        with self._lock:
            self._cancelled.set()
            if self._found is not None:
                self._found.close()
                self._found = None


class LcmLink:
    """Receives and publishes while there is a bus, and seeks it while there is none.

    Attributes:
        url: the bus.
        losses: how often the bus was lost.
        reconnections: how often it was found again.
    """

    def __init__(
        self, url: str, handlers: Mapping[str, Handler], *, connect_timeout: float, stamped: bool = False
    ) -> None:
        """``stamped``: see `connect`."""
        self.url = url
        self.losses = 0
        self.reconnections = 0
        self._connect = partial(connect, url, handlers, connect_timeout, stamped=stamped)
        self._connection: Connection | None = None
        self._search: _Search | None = None

    def open(self) -> None:
        """
        Raises:
            BridgeError: there is no bus.
        """
        if self.is_open:
            return
        try:
            self._connection = self._connect()
        except RefusedError as error:
            raise BridgeError(f"the hub at {self.url} refuses the connection: {error}") from error
        except OSError as error:
            remedy = "start a hub there (vtbdrake hub)" if self.url.startswith("tcpq:") else "is the URL right?"
            if isinstance(error, TimeoutError):
                remedy = "if a hub runs there, it is frozen; else, is the URL right?"
            raise BridgeError(f"no LCM bus at {self.url} ({error}); {remedy}") from error

    @property
    def is_open(self) -> bool:
        """Whether it has a bus, or seeks it."""
        return self._connection is not None or self._search is not None

    @property
    def connected(self) -> bool:
        return self._current() is not None

    @property
    def name(self) -> str | None:
        """Under which a hub knows the present connection; None if there is no connection, or no hub."""
        return None if self._connection is None else self._connection.name

    def _current(self) -> Connection | None:
        if self._search is not None:
            self._connection = self._search.result()
            if self._connection is not None:
                self._search = None
                self.reconnections += 1
        return self._connection

    def _required(self) -> Connection | None:
        connection = self._current()
        if connection is None and self._search is None:
            raise BridgeError(f"the bridge to {self.url} is not open: call open() first")
        return connection

    @property
    def arrived(self) -> float | None:
        """Of the message that is handed on; see `Connection`."""
        return None if self._connection is None else self._connection.arrived

    @property
    def sources(self) -> list[Connection]:
        """What becomes readable when messages arrive, for `select`; empty while there is no bus."""
        connection = self._current()
        return [] if connection is None else [connection]

    def take(self, timeout: float, limit: int) -> int:
        """Hands messages to their handlers, waiting up to ``timeout`` seconds for the first; says how many."""
        connection = self._connection or self._required()
        if connection is None:
            if timeout > 0 and self._search is not None:
                self._search.ended.wait(timeout)
            return 0
        try:
            count = connection.take(limit)
            end = time.monotonic() + timeout
            while not count and timeout > 0:
                select.select((connection,), (connection,) if connection.pending else (), (), timeout)
                count = connection.take(limit)
                timeout = end - time.monotonic()
            return count
        except OSError:
            self._lose()
            return 0

    def publish(self, *messages: tuple[str, bytes]) -> bool:
        """Whether the messages (channel and bytes) went to the bus."""
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
        self._search.start()

    def close(self) -> None:
        if self._search is not None:
            self._search.cancel()
            self._search = None
        if self._connection is not None:
            self._connection.close()
            self._connection = None
