"""The hub itself: one thread that waits for all its clients, and for none of them."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import time
from collections.abc import Callable, Sequence
from functools import partial

from vtbdrake.lcm.hub import tcpq
from vtbdrake.lcm.hub.admission import FULL, Admission
from vtbdrake.lcm.hub.clients import SLICE, ClientConnection
from vtbdrake.lcm.hub.config import MEBIBYTE, HubConfig
from vtbdrake.lcm.hub.log_rate import limited_logger
from vtbdrake.lcm.hub.relay import Relay
from vtbdrake.lcm.hub.statistics import HubStatistics
from vtbdrake.lcm.hub.tcpq import LOOPBACK, listen_shortcut

_log = limited_logger(__name__)

_READS = 8  # liblcm writes a message in five pieces
_TURN = 64  # what the records of one client may cost, see `Relay.handle`, before it is another's turn
_LEAST_RATE = MEBIBYTE  # bytes a second that come of a message once `HubConfig.patience` is over
_MEMORY_CHECK = MEBIBYTE  # bytes that come between two looks at how much is held for all clients
_NEWS_PERIOD = 0.01
_ACCEPT_PAUSE = 1.0


class HubAddressError(ValueError):
    """The hub cannot listen at its address."""


def listen(config: HubConfig) -> list[socket.socket]:
    """Sockets that listen where the hub is told to: by TCP, and the shortcut if there is one.

    Raises:
        HubAddressError: it cannot listen there.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listeners = [sock]
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((config.host, config.port))
        # The shortcut opens first: who seeks the hub and finds no shortcut yet must not stay with TCP.
        shortcut = listen_shortcut(*sock.getsockname())
        if shortcut is not None:
            listeners.append(shortcut)
        sock.listen()
    except OSError as error:
        for listener in listeners:
            listener.close()
        if error.errno == errno.EADDRINUSE:
            raise HubAddressError(
                f"port {config.port} of {config.host} is in use, perhaps by another hub: end that one, or choose "
                "another port (0 for any that is free)"
            ) from error
        raise HubAddressError(
            f"the hub cannot listen on port {config.port} of {config.host!r} ({error.strerror}): choose an IPv4 "
            "address of this machine, and a port that you may use"
        ) from error
    if not sock.getsockname()[0].startswith(LOOPBACK):
        _log.warning("listens on %s, not on loopback: whoever reaches that address is a client", config.host)
    return listeners


class HubServer:
    """A hub that runs in the thread that calls `serve_forever`.

    ``lcm.LCM(url)`` holds Python's interpreter lock until the hub has answered. So clients of the same process need a
    hub in another: `Hub`.

    Args:
        config: address, protected channels and limits.
        listeners: what `listen` returned; the hub owns them. None: it listens itself.
        control: a connected socket, which the hub owns: for every byte that comes in, the statistics go out as a line
            of JSON; when its other end closes, the hub stops.

    Raises:
        HubAddressError: it cannot listen.
    """

    def __init__(
        self,
        config: HubConfig,
        *,
        listeners: Sequence[socket.socket] | None = None,
        control: socket.socket | None = None,
    ) -> None:
        self.config = config
        self._listeners = listen(config) if listeners is None else listeners
        self.url = f"tcpq://{tcpq.address_name(self._listeners[0].getsockname())}"
        self._control = control
        self._wake = os.eventfd(0, os.EFD_NONBLOCK)
        self._epoll = select.epoll()
        self._others: dict[int, Callable[[], None]] = {self._wake: self._stop}
        for listener in self._listeners:
            listener.setblocking(False)
            self._others[listener.fileno()] = partial(self._accept, listener)
        if control is not None:
            control.setblocking(False)
            self._others[control.fileno()] = self._answer
        for fileno in self._others:
            self._epoll.register(fileno, select.EPOLLIN)

        self._clients: dict[int, ClientConnection] = {}
        self._waiting: dict[int, ClientConnection] = {}  # those of them that have sent more than a turn's records
        self._unchecked = 0  # bytes that have come since the last look at the memory
        self._admission = Admission(config, on_loopback=self._listeners[0].getsockname()[0].startswith(LOOPBACK))
        self._relay = Relay(config)
        self._running = True
        self._now = time.monotonic()
        # A quarter: how much of a time may pass unnoticed.
        self._tick = min(config.status_period, config.patience / 4.0, config.lease / 4.0)
        self._checked = self._reported = self._now
        self._paused: float | None = None

    def serve_forever(self) -> None:
        """Relays until `stop`, then closes all connections."""
        relay = self._relay
        due = self._due()
        try:
            while self._running:
                events = self._epoll.poll(0.0 if self._waiting else max(0.0, due - self._now))
                self._now = time.monotonic()
                if self._now > due:
                    # The hub was held up. What its clients sent meanwhile has not been read.
                    self._excuse(self._now - due)
                for fileno, event in [*events, *((fileno, 0) for fileno in self._waiting)]:
                    client = self._clients.get(fileno)
                    if client is not None:
                        self._attend(client, event)
                        relay.deliver(self._now)
                    elif fileno in self._others:  # or it is a client that another event has just disconnected
                        self._others[fileno]()
                    if relay.behind or relay.lost:
                        self._follow_up()
                if self._unchecked >= _MEMORY_CHECK:
                    self._check_memory()
                if relay.news or self._now >= due:
                    self._keep_house()
                    self._follow_up()
                    due = self._due()
        finally:
            self.close()

    def stop(self) -> None:
        """Ends `serve_forever`; from any thread, or from a signal handler."""
        if not self._epoll.closed:
            os.eventfd_write(self._wake, 1)

    def close(self) -> None:
        """Closes all sockets."""
        for client in self._clients.values():
            client.close()
        self._clients.clear()
        self._waiting.clear()
        if not self._epoll.closed:
            self._epoll.close()
            for listener in self._listeners:
                listener.close()
            os.close(self._wake)
            if self._control is not None:
                self._control.close()

    def statistics(self) -> HubStatistics:
        """Of this moment. To be asked in the thread of `serve_forever`, or when it has ended."""
        return self._relay.statistics(self._now)

    def _due(self) -> float:
        """When the next thing is to be done that no client asks for."""
        status = _NEWS_PERIOD if self._relay.news else self.config.status_period
        return min(self._checked + self._tick, self._reported + status)

    def _stop(self) -> None:
        self._running = False

    def _answer(self) -> None:
        assert self._control is not None
        try:
            asked = self._control.recv(64)
            self._control.send((self.statistics().to_json() + b"\n") * len(asked))
        except OSError:
            asked = b""
        if not asked:
            self._running = False

    def _accept(self, listener: socket.socket) -> None:
        try:
            sock, _ = listener.accept()
        except (BlockingIOError, ConnectionError):
            return
        except OSError as error:
            # Such as: no more file descriptors. The connection stays at the door, and would wake the hub for ever.
            _log.warning("no client is accepted for %g s: %s", _ACCEPT_PAUSE, error)
            for listener in self._listeners:
                self._epoll.unregister(listener.fileno())
            self._paused = self._now
            return
        user, reason, message = self._admission.decide(sock, self._clients.values())
        if reason == FULL and self._make_room():
            user, reason, message = self._admission.decide(sock, self._clients.values())
        if reason:
            _log.warning("a client is not let in: %s", message)
            self._relay.turn_away(reason)
            with contextlib.suppress(OSError):
                sock.send(tcpq.rejection(message), socket.MSG_DONTWAIT)
            sock.close()
            return
        try:
            client = ClientConnection(
                sock, max_message=self.config.max_message, max_queue=self.config.max_queue, now=self._now, user=user
            )
        except OSError:  # It is gone already.
            sock.close()
            return
        self._clients[client.fileno] = client
        self._relay.join(client)
        self._epoll.register(client.fileno, select.EPOLLIN)

    def _make_room(self) -> bool:
        """Disconnects the client that has neither subscribed nor published for longest; returns whether there is one
        that has not for as long as the hub's patience."""
        idle = [c for c in self._clients.values() if c.idle and self._now - c.connected > self.config.patience]
        if not idle:
            return False
        first = min(idle, key=lambda client: client.connected)
        self._disconnect(first, "idle", "has neither subscribed nor published, and makes room for another client")
        return True

    def _attend(self, client: ClientConnection, event: int) -> None:
        try:
            if event & select.EPOLLOUT:
                self._flush(client)
            if client.fileno in self._waiting:
                if not event & ~select.EPOLLOUT:  # Its turn comes by the list of those that wait.
                    self._handle(client)
            elif event & ~select.EPOLLOUT:
                self._read(client)
        except BlockingIOError:
            pass
        except OSError as error:
            self._disconnect(client, "lost", f"is lost: {error}")
        except tcpq.TcpqError as error:
            self._disconnect(client, error.reason, str(error))

    def _flush(self, client: ClientConnection) -> None:
        client.flush(self._now)
        if not client.queued:
            client.watched = False
            self._epoll.modify(client.fileno, select.EPOLLIN)

    def _read(self, client: ClientConnection) -> None:
        for _ in range(_READS):
            size = client.reader.receive(client.fileno, SLICE)
            if size < 0:
                return
            if size == 0:
                self._disconnect(client, "closed", "closed its connection")
                return
            self._unchecked += size
            handled_all = self._handle(client)
            client.acknowledge()
            # The rest of a message is there as soon as its beginning is acknowledged; but large messages come in turns.
            if not handled_all or not client.reader.partial or size == SLICE:
                return

    def _handle(self, client: ClientConnection) -> bool:
        """Handles what a client has sent, but no more than is its turn; returns whether that was all."""
        reader, left, first = client.reader, _TURN, True
        while left > 0:
            record = reader.next_record()
            if record is None:
                self._waiting.pop(client.fileno, None)
                if not reader.partial:
                    client.begun = None
                elif not first or client.begun is None:
                    client.begun = self._now
                return True
            first = False
            left -= self._relay.handle(client, record, self._now)
        client.begun = None
        self._waiting[client.fileno] = client
        return False

    def _disconnect(self, client: ClientConnection, reason: str, message: str) -> None:
        client.close()
        self._waiting.pop(client.fileno, None)
        if self._clients.pop(client.fileno, None) is not None:
            # A client that ends with messages unread is lost, too: nothing to worry about.
            log = _log.info if reason in ("closed", "lost") else _log.warning
            log("%s %s", client.name, message)
            self._relay.leave(client, reason)

    def _excuse(self, seconds: float) -> None:
        """A time in which the hub was held up ends here; it does not count against anybody."""
        self._relay.excuse(seconds)
        for client in self._clients.values():
            client.connected += seconds
            client.progressed += seconds
            if client.begun is not None:
                client.begun += seconds

    def _check_memory(self) -> None:
        """Disconnects the clients for which most is held, until all together are within the limit."""
        self._unchecked = 0
        held = {client: client.held for client in self._clients.values()}
        total = sum(held.values())
        for client in sorted(held, key=lambda client: -held[client]):
            if total <= self.config.max_memory:
                break
            total -= held[client]
            message = f"is disconnected: it holds {held[client]} bytes, and all together more than max_memory"
            self._disconnect(client, "memory", message)

    def _follow_up(self) -> None:
        """Sees to the clients that did not take what was sent to them."""
        relay = self._relay
        for client, error in relay.lost:
            self._disconnect(client, "lost", f"is lost: {error}")
        for client in relay.behind:
            if not client.closed:
                self._epoll.modify(client.fileno, select.EPOLLIN | select.EPOLLOUT)
        relay.lost.clear()
        relay.behind.clear()

    def _keep_house(self) -> None:
        now, patience = self._now, self.config.patience
        if now >= self._reported + (_NEWS_PERIOD if self._relay.news else self.config.status_period):
            self._reported = now
            self._relay.publish_status(now)
        if now < self._checked + self._tick:
            return
        self._checked = now
        for client in [c for c in self._clients.values() if now - c.progressed > patience]:
            if client.queued:
                self._disconnect(
                    client, "stalled", f"has not read for {patience:g} s, {client.queued} bytes wait for it"
                )
            elif not client.reader.greeted:
                self._disconnect(client, "greeting", f"has not greeted for {patience:g} s")
        for client in list(self._clients.values()):
            came = client.reader.held
            if client.begun is not None and now - client.begun > patience + came / _LEAST_RATE:
                self._disconnect(
                    client,
                    "incomplete",
                    f"has not completed a message for {now - client.begun:.3g} s, {came} bytes of it have come",
                )
        if self._paused is not None and now >= self._paused + _ACCEPT_PAUSE:
            self._paused = None
            for listener in self._listeners:
                self._epoll.register(listener.fileno(), select.EPOLLIN)
