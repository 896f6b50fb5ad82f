"""What becomes of the records that come in: whom they go to, and whether they may."""

from __future__ import annotations

from typing import NamedTuple

from vtbdrake.lcm.hub import tcpq
from vtbdrake.lcm.hub.clients import ClientConnection, text
from vtbdrake.lcm.hub.config import HubConfig
from vtbdrake.lcm.hub.log_rate import limited_logger
from vtbdrake.lcm.hub.protection import ProtectedChannel
from vtbdrake.lcm.hub.reader import publish_record
from vtbdrake.lcm.hub.statistics import HubStatistics

_log = limited_logger(__name__)

# Channels whose subscribers are remembered; clients may publish on any number of channels.
_MAX_ROUTES = 4096

# What it costs to handle a record, and one on a channel whose subscribers have to be found, in the same unit.
_RECORD, _NEW_CHANNEL = 1, 16


class _Route(NamedTuple):
    """Where a channel's messages go.

    Attributes:
        channel: its name.
        subscribers: all clients that want them.
        protection: who may publish, if not everybody.
        reserved: whether it is the hub's own, and nothing is relayed.
    """

    channel: str
    subscribers: tuple[ClientConnection, ...]
    protection: ProtectedChannel | None
    reserved: bool


class Relay:
    """Clients, their subscriptions, and the messages between them. It reads no socket and waits for nothing.

    What goes to a client is collected until `deliver`: several messages that came together leave together, and wake
    it up once.

    Attributes:
        lost: clients whose connection failed when something was sent, and how; to be cleared by who has seen to it.
        behind: clients that have begun to queue; likewise.
        news: whether an owner changed or something was refused since the last status.
    """

    def __init__(self, config: HubConfig) -> None:
        self.lost: list[tuple[ClientConnection, OSError]] = []
        self.behind: list[ClientConnection] = []
        self.news = False
        self._leaving: dict[ClientConnection, list[bytes | bytearray]] = {}
        self._clients: list[ClientConnection] = []
        self._routes: dict[bytes, _Route] = {}
        self._protected = {name: ProtectedChannel(name, lease=config.lease) for name in config.protect}
        self._statistics = HubStatistics()

    def join(self, client: ClientConnection) -> None:
        self._clients.append(client)

    def leave(self, client: ClientConnection, reason: str) -> None:
        """The client is gone."""
        self._clients.remove(client)
        self._routes.clear()
        self.turn_away(reason)
        for protected in self._protected.values():
            self.news |= protected.release(client)

    def turn_away(self, reason: str) -> None:
        """Counts a client that is no more, or never was."""
        disconnected = self._statistics.disconnected
        disconnected[reason] = disconnected.get(reason, 0) + 1

    def handle(self, client: ClientConnection, record: tcpq.Record, now: float) -> int:
        """Does what a client asks for; returns what that cost: 1, or 16 where the subscribers had to be found.

        Raises:
            TcpqError: the client is of no use any more.
        """
        kind, channel, content = record
        if kind == tcpq.PUBLISH:
            return self._publish(client, channel, content, now)
        if kind == tcpq.SUBSCRIBE:
            self._forget(client.subscriptions.add(text(channel)))
        elif kind == tcpq.UNSUBSCRIBE:
            self._forget(client.subscriptions.remove(text(channel)))
        else:
            self._send(client, tcpq.GREETING)
        return _RECORD

    def _forget(self, channel: str | None) -> None:
        """Forgets who has subscribed to a channel; to all of them, if it is None."""
        if channel is None:
            self._routes.clear()
        else:
            self._routes.pop(channel.encode(), None)

    def _publish(self, client: ClientConnection, channel: bytes, content: bytes | bytearray, now: float) -> int:
        statistics = self._statistics
        client.published = True
        cost, route = _RECORD, self._routes.get(channel)
        if route is None:
            cost, route = _NEW_CHANNEL, self._find_route(channel)
        if route.reserved:
            self._answer(client, route.channel, now)
        elif route.protection is not None and not self._admit(client, route.protection, now):
            statistics.refused += 1
        else:
            statistics.messages += 1
            statistics.volume += len(content)
            self._distribute(route, content)
        return cost

    def _find_route(self, channel: bytes) -> _Route:
        name = text(channel)
        route = _Route(
            channel=name,
            subscribers=tuple(client for client in self._clients if client.subscriptions.wants(name)),
            protection=self._protected.get(name),
            reserved=name == tcpq.STATUS_CHANNEL or name.startswith(tcpq.TAKE_PREFIX),
        )
        if len(self._routes) >= _MAX_ROUTES:
            self._routes.clear()
        self._routes[channel] = route
        return route

    def _distribute(self, route: _Route, content: bytes | bytearray) -> None:
        for subscriber in route.subscribers:
            if not subscriber.closed:
                self._send(subscriber, content)
                self._statistics.delivered += 1

    def _send(self, client: ClientConnection, content: bytes | bytearray) -> None:
        self._leaving.setdefault(client, []).append(content)

    def deliver(self, now: float) -> None:
        """Sends what was collected."""
        for client, messages in self._leaving.items():
            if client.closed:
                continue
            try:
                self._statistics.dropped += client.send(messages, now)
            except OSError as error:
                client.close()
                self.lost.append((client, error))
                continue
            if client.queued and not client.watched:
                client.watched = True
                self.behind.append(client)
        self._leaving.clear()

    def _admit(self, client: ClientConnection, protection: ProtectedChannel, now: float) -> bool:
        owner = protection.owner
        admitted = protection.admit(client, now)
        self.news |= not admitted or protection.owner is not owner
        return admitted

    def _answer(self, client: ClientConnection, channel: str, now: float) -> None:
        """Grants or refuses a request for a channel."""
        self.news = True
        protected = self._protected.get(channel.removeprefix(tcpq.TAKE_PREFIX))
        if protected is None:
            _log.warning(
                "refused: %s publishes on %s; the hub protects %s", client.name, channel, list(self._protected)
            )
        if protected is None or not protected.take(client, now):
            self._statistics.refused += 1

    def excuse(self, seconds: float) -> None:
        """A time in which nothing was handled ends here."""
        for protected in self._protected.values():
            protected.excuse(seconds)

    def publish_status(self, now: float) -> None:
        """Tells those who want to know."""
        self.news = False
        channel = tcpq.STATUS_CHANNEL.encode()
        route = self._routes.get(channel) or self._find_route(channel)
        if route.subscribers:
            self._distribute(route, publish_record(channel, self.statistics(now).to_json()))
            self.deliver(now)

    def statistics(self, now: float) -> HubStatistics:
        statistics = self._statistics
        statistics.clients = len(self._clients)
        statistics.queued = sum(client.queued for client in self._clients)
        statistics.protected = {name: protected.statistics(now) for name, protected in self._protected.items()}
        return statistics
