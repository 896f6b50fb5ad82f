"""The hub itself: its configuration and its event loop, one thread that serves all clients and waits for none."""

from __future__ import annotations

import contextlib
import logging
import os
import pwd
import select
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from vtbdrake.common.settings import check_settings, setting
from vtbdrake.lcm.hub import tcpq
from vtbdrake.lcm.hub.clients import SLICE, ClientConnection
from vtbdrake.lcm.hub.routing import HubStatistics, Router
from vtbdrake.lcm.hub.tcpq import KEEP_PREFIX, LOOPBACK, MAX_CHANNEL, STATUS_CHANNEL, TAKE_PREFIX, TcpqError

MEBIBYTE = 1024 * 1024

_READS = 8  # receive calls per turn; liblcm writes a message in five pieces
_TURN = 64  # cost of the records of one client, see `Router.handle`, before the next client is served
_MIN_RATE = MEBIBYTE  # bytes per second of an incomplete message that a client must send after `HubConfig.patience`
_MEMORY_CHECK = MEBIBYTE  # received bytes between two checks of the memory of all clients
_STATUS_CHANGED_PERIOD = 0.01
_ACCEPT_PAUSE = 1.0


class RateLimitFilter(logging.Filter):
    """Passes only a few log messages of each kind per period, because clients can cause thousands per second.

    Messages of one kind have the same level and the same text before their arguments are filled in. The first one of
    the next period says how many were suppressed.
    """

    BURST = 5  # messages of a kind that pass per period
    PERIOD = 10.0  # s

    def __init__(self) -> None:
        super().__init__()
        self._windows: dict[tuple[int, str], tuple[float, int]] = {}  # by kind: end of the period, number of messages

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a message passes."""
        now = time.monotonic()
        kind = (record.levelno, str(record.msg))
        end, count = self._windows.get(kind, (now, 0))
        if now < end:
            self._windows[kind] = (end, count + 1)
            return count < self.BURST
        self._windows[kind] = (now + self.PERIOD, 1)
        if count > self.BURST:
            record.msg = f"{record.getMessage()} ({count - self.BURST} more messages like this one were suppressed)"
            record.args = None
        return True


_log = logging.getLogger(__package__)  # shared by the modules of the server
_log.addFilter(RateLimitFilter())


@dataclass(frozen=True, kw_only=True)
class HubConfig:
    """Address, protected channels and limits of a hub.

    Raises:
        ValueError: A value is out of range.
    """

    host: str = setting(
        "127.0.0.1", "IPv4 address or name to listen on; beyond loopback, every machine that reaches it can connect."
    )
    port: int = setting(7700, "TCP port, by default LCM's; 0: any free port.", ge=0, le=65535)
    protect: Sequence[str] = setting((), "Channels with one publisher at a time (names, no patterns).")
    lease: float = setting(
        0.5, "Time after the owner's last message during which no other client can take over.", unit="s", gt=0.0
    )
    max_message: int = setting(16 * MEBIBYTE, "Largest message.", unit="bytes", ge=1, le=256 * MEBIBYTE)  # as LCM's
    max_queue: int = setting(
        32 * MEBIBYTE, "Largest backlog of a client; beyond it, the oldest messages are dropped.", unit="bytes", ge=1
    )
    max_memory: int = setting(
        512 * MEBIBYTE,
        "Largest sum of all backlogs and incomplete messages; beyond it, the client with the most is disconnected.",
        unit="bytes",
        ge=1,
    )
    # Clients of one other user: at most a quarter; of all others together: three quarters.
    max_clients: int = setting(128, "Maximum number of clients at a time.", ge=1)
    users: Sequence[str | int] = setting((), "Names or ids of users that may connect besides the hub's own and root.")
    all_users: bool = setting(False, "Let every user of this machine connect.")
    # For a message, a client has another second for each MiB of it.
    patience: float = setting(
        5.0,
        "Time until a client is disconnected that does not greet, read its backlog, or complete a message.",
        unit="s",
        gt=0.0,
    )
    status_period: float = setting(1.0, "Time between messages on the status channel.", unit="s", gt=0.0)
    priority: int = setting(
        0, "Priority of real-time scheduling (SCHED_FIFO), if the system grants it; 0: none.", ge=0, le=99
    )
    cpus: Sequence[int] = setting((), "Processors to run on, if the system grants them; empty: any.", ge=0)

    def __post_init__(self) -> None:
        check_settings(self)
        for name in ("protect", "cpus"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        object.__setattr__(self, "users", tuple(map(_user_id, self.users)))
        longest = MAX_CHANNEL - max(len(TAKE_PREFIX), len(KEEP_PREFIX))
        for channel in self.protect:
            if channel == STATUS_CHANNEL or channel.startswith((TAKE_PREFIX, KEEP_PREFIX)):
                raise ValueError(f"cannot protect {channel!r}, one of the hub's own channels")
            if not 0 < len(channel.encode()) <= longest:
                raise ValueError(f"the name of a protected channel must have 1 to {longest} bytes, not {channel!r}")
        least = self.max_message + 12 + MAX_CHANNEL
        if self.max_queue < least:
            raise ValueError(f"HubConfig.max_queue must be at least {least} bytes, one message, not {self.max_queue!r}")
        if self.max_memory < self.max_queue:
            raise ValueError(
                f"HubConfig.max_memory must be at least max_queue, {self.max_queue} bytes, not {self.max_memory!r}"
            )


def _user_id(user: str | int) -> int:
    if isinstance(user, str) and not user.isdecimal():
        try:
            return pwd.getpwnam(user).pw_uid
        except KeyError:
            raise ValueError(f"no user {user!r} on this machine; give a user name or id") from None
    return int(user)


class HubAddressError(ValueError):
    """The hub cannot listen at its address."""


def listen(config: HubConfig) -> socket.socket:
    """Return a socket that listens at the address of the config.

    Raises:
        HubAddressError: The hub cannot listen there.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((config.host, config.port))
        sock.listen()
    except OSError as error:
        sock.close()
        raise HubAddressError(
            f"the hub cannot listen on {config.host}:{config.port} ({error.strerror}); choose an IPv4 address of this "
            "machine, and a free port (0: any) that you may use"
        ) from error
    if not sock.getsockname()[0].startswith(LOOPBACK):
        _log.warning("listening on %s, beyond loopback: every machine that reaches it can connect", config.host)
    return sock


class HubServer:
    """A hub that runs in the thread that calls `serve_forever`.

    ``lcm.LCM(url)`` holds Python's global interpreter lock until the hub answers. So clients in the same process need a
    hub in another process: `Hub`.

    Args:
        config: Address, protected channels and limits.
        listener: Socket returned by `listen`, which the hub owns from now on; by default it calls `listen`.
        control: Connected socket, which the hub owns from now on. For every byte received there, the hub sends its
            statistics as a line of JSON; when the other end closes, the hub stops.

    Attributes:
        url: URL for clients, ``tcpq://host:port``.

    Raises:
        HubAddressError: The hub cannot listen at its address.
    """

    def __init__(
        self,
        config: HubConfig,
        *,
        listener: socket.socket | None = None,
        control: socket.socket | None = None,
    ) -> None:
        self.config = config
        self._listener = listener or listen(config)
        host_port = self._listener.getsockname()
        self.url = f"tcpq://{tcpq.address_name(host_port)}"
        self._control = control
        self._wake = os.eventfd(0, os.EFD_NONBLOCK)
        self._epoll = select.epoll()
        self._listener.setblocking(False)
        self._callbacks: dict[int, Callable[[], None]] = {
            self._wake: self._stop,
            self._listener.fileno(): self._accept,
        }
        if control is not None:
            control.setblocking(False)
            self._callbacks[control.fileno()] = self._answer
        for fileno in self._callbacks:
            self._epoll.register(fileno, select.EPOLLIN)

        self._clients: dict[int, ClientConnection] = {}
        self._unfinished: dict[int, ClientConnection] = {}  # clients that have sent more records than fit into a turn
        self._unchecked = 0  # bytes received since the last check of the memory
        self._on_loopback = host_port[0].startswith(LOOPBACK)
        self._own_users = {0, os.geteuid()}
        self._router = Router(config.protect, lease=config.lease)
        self._running = True
        self._now = time.monotonic()
        self._check_period = min(config.status_period, config.patience / 4.0, config.lease / 4.0)
        self._checked_at = self._reported_at = self._now
        self._accept_paused_at: float | None = None

    def serve_forever(self) -> None:
        """Relay messages until `stop` is called, then close all sockets."""
        due = self._due()
        try:
            while self._running:
                events = self._epoll.poll(0.0 if self._unfinished else max(0.0, due - self._now))
                self._now = time.monotonic()
                if self._now > due:
                    self._discount(self._now - due)
                for fileno, event in [*events, *((fileno, 0) for fileno in self._unfinished)]:
                    client = self._clients.get(fileno)
                    if client is not None:
                        self._serve(client, event)
                        self._send_outgoing()
                    elif fileno in self._callbacks:  # else a client that was disconnected during an earlier event
                        self._callbacks[fileno]()
                if self._unchecked >= _MEMORY_CHECK:
                    self._check_memory()
                if self._router.status_changed or self._now >= due:
                    self._report()
                    self._check_clients()
                    due = self._due()
        finally:
            self.close()

    def stop(self) -> None:
        """End `serve_forever`; may be called from any thread and from a signal handler."""
        if not self._epoll.closed:
            os.eventfd_write(self._wake, 1)

    def close(self) -> None:
        """Close all sockets."""
        for client in self._clients.values():
            client.close()
        self._clients.clear()
        self._unfinished.clear()
        if not self._epoll.closed:
            self._epoll.close()
            self._listener.close()
            os.close(self._wake)
            if self._control is not None:
                self._control.close()

    def statistics(self) -> HubStatistics:
        """Return the present statistics; call it in the thread of `serve_forever`, or after its end."""
        return self._router.statistics(self._now)

    def _status_period(self) -> float:
        return _STATUS_CHANGED_PERIOD if self._router.status_changed else self.config.status_period

    def _due(self) -> float:
        """Return the time at which the hub must act without an event."""
        return min(self._checked_at + self._check_period, self._reported_at + self._status_period())

    def _stop(self) -> None:
        self._running = False

    def _answer(self) -> None:
        assert self._control is not None
        try:
            request = self._control.recv(64)
            self._control.send((self.statistics().to_json() + b"\n") * len(request))
        except OSError:
            request = b""
        if not request:
            self._running = False

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except (BlockingIOError, ConnectionError):
            return
        except OSError as error:
            # Such as no free file descriptor: the pending connection would wake the hub again and again.
            _log.warning("accepting no clients for %g s: %s", _ACCEPT_PAUSE, error)
            self._epoll.unregister(self._listener.fileno())
            self._accept_paused_at = self._now
            return
        limits = {"max_message": self.config.max_message, "max_queue": self.config.max_queue}
        try:
            client = ClientConnection(sock, **limits, now=self._now, user=self._admit(sock))
        except TcpqError as rejected:
            _log.warning("connection rejected: %s", rejected)
            self._router.count_disconnected(rejected.reason)
            with contextlib.suppress(OSError):
                sock.send(tcpq.rejection(str(rejected)), socket.MSG_DONTWAIT)
            sock.close()
        except OSError:  # The client has disconnected already.
            sock.close()
        else:
            self._clients[client.fileno] = client
            self._router.add(client)
            self._epoll.register(client.fileno, select.EPOLLIN)

    def _admit(self, sock: socket.socket) -> int | None:
        """Return the user of a new client; if the hub is full, an idle client is disconnected to make room."""
        config, clients = self.config, self._clients.values()
        if self._on_loopback:
            user = tcpq.peer_user(sock)
            if not config.all_users and user not in {*self._own_users, *config.users}:
                name = "unknown user" if user is None else f"user {user}"
                raise TcpqError("user", f"{name} may not connect; start the hub with --user or --all-users")
            if user not in self._own_users:
                per_user, all_others = max(1, config.max_clients // 4), max(1, 3 * config.max_clients // 4)
                other_users = [client.user for client in clients if client.user not in self._own_users]
                if len(other_users) >= all_others or (user is not None and other_users.count(user) >= per_user):
                    limits = f"{per_user} clients per user, {all_others} together"
                    raise TcpqError("quota", f"limit for users other than the hub's own reached: {limits}")
        else:
            user = None  # The kernel knows only the users of this machine.
        if len(clients) >= config.max_clients:
            idle = [client for client in clients if client.idle and self._now - client.connected_at > config.patience]
            if not idle:
                limit = f"max_clients={config.max_clients} reached"
                raise TcpqError("too many", f"{limit}; disconnect another client or raise max_clients")
            oldest = min(idle, key=lambda client: client.connected_at)
            self._disconnect(oldest, "idle", "it has neither subscribed nor published, and max_clients is reached")
        return user

    def _serve(self, client: ClientConnection, event: int) -> None:
        try:
            if event & select.EPOLLOUT:
                client.flush(self._now)
                if not client.queued:
                    client.awaits_room = False
                    self._epoll.modify(client.fileno, select.EPOLLIN)
            if client.fileno in self._unfinished:
                if not event & ~select.EPOLLOUT:  # Its turn comes once per loop, by way of `_unfinished`.
                    self._handle(client)
            elif event & ~select.EPOLLOUT:
                self._read(client)
        except BlockingIOError:
            pass
        except OSError as error:
            self._disconnect(client, "lost", str(error))
        except TcpqError as error:
            self._disconnect(client, error.reason, str(error))

    def _read(self, client: ClientConnection) -> None:
        for _ in range(_READS):
            size = client.reader.receive(client.fileno, SLICE)
            if size < 0:
                return
            if size == 0:
                self._disconnect(client, "closed", "it closed the connection")
                return
            self._unchecked += size
            handled_all = self._handle(client)
            client.acknowledge()
            # The rest of a message arrives when its beginning is acknowledged; large messages are received in turns.
            if not handled_all or not client.reader.partial or size == SLICE:
                return

    def _handle(self, client: ClientConnection) -> bool:
        """Handle the received records of a client, up to a turn; return whether that was all."""
        reader, budget, is_first = client.reader, _TURN, True
        while budget > 0:
            record = reader.next_record()
            if record is None:
                self._unfinished.pop(client.fileno, None)
                if not reader.partial:
                    client.incomplete_since = None
                elif not is_first or client.incomplete_since is None:
                    client.incomplete_since = self._now
                return True
            is_first = False
            budget -= self._router.handle(client, record, self._now)
        client.incomplete_since = None
        self._unfinished[client.fileno] = client
        return False

    def _send_outgoing(self) -> None:
        outgoing = self._router.outgoing
        for client, messages in outgoing.items():
            if client.closed:
                continue
            try:
                self._router.totals.dropped += client.send(messages, self._now)
            except OSError as error:
                self._disconnect(client, "lost", str(error))
                continue
            if client.queued and not client.awaits_room:
                client.awaits_room = True
                self._epoll.modify(client.fileno, select.EPOLLIN | select.EPOLLOUT)
        outgoing.clear()

    def _disconnect(self, client: ClientConnection, reason: str, message: str) -> None:
        client.close()
        self._unfinished.pop(client.fileno, None)
        if self._clients.pop(client.fileno, None) is not None:
            # A connection is also lost, not closed, if a client ends with unread messages.
            level = logging.INFO if reason in ("closed", "lost") else logging.WARNING
            _log.log(level, "client %s disconnected: %s", client.name, message)
            self._router.remove(client, reason)

    def _discount(self, seconds: float) -> None:
        """Shift all time limits by a delay of the hub, during which it did not read from clients."""
        self._router.extend_leases(seconds)
        for client in self._clients.values():
            client.connected_at += seconds
            client.progressed_at += seconds
            if client.incomplete_since is not None:
                client.incomplete_since += seconds

    def _check_memory(self) -> None:
        """Disconnect the clients with the most memory until the sum of all is within the limit."""
        self._unchecked = 0
        memory = {client: client.memory for client in self._clients.values()}
        total = sum(memory.values())
        for client in sorted(memory, key=lambda client: -memory[client]):
            if total <= self.config.max_memory:
                break
            total -= memory[client]
            limit = f"all clients together exceed max_memory={self.config.max_memory}"
            self._disconnect(client, "memory", f"backlog and incomplete message of {memory[client]} bytes; {limit}")

    def _report(self) -> None:
        if self._now >= self._reported_at + self._status_period():
            self._reported_at = self._now
            self._router.publish_status(self._now)
            self._send_outgoing()

    def _check_clients(self) -> None:
        """Disconnect the clients that exceed the patience; accept clients again after a pause."""
        now, patience = self._now, self.config.patience
        if now < self._checked_at + self._check_period:
            return
        self._checked_at = now
        for client in list(self._clients.values()):
            received = client.reader.buffered
            if now - client.progressed_at > patience and client.queued:
                self._disconnect(client, "stalled", f"no reading for {patience:g} s, backlog of {client.queued} bytes")
            elif now - client.progressed_at > patience and not client.reader.greeted:
                self._disconnect(client, "greeting", f"no greeting for {patience:g} s")
            elif client.incomplete_since is not None:
                seconds = now - client.incomplete_since
                if seconds > patience + received / _MIN_RATE:
                    message = f"message incomplete for {seconds:.3g} s, {received} bytes received"
                    self._disconnect(client, "incomplete", message)
        if self._accept_paused_at is not None and now >= self._accept_paused_at + _ACCEPT_PAUSE:
            self._accept_paused_at = None
            self._epoll.register(self._listener.fileno(), select.EPOLLIN)
