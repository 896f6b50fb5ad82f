"""Routing of the records of clients: subscribers of a channel, protected channels, and the statistics."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from math import inf
from typing import Any, NamedTuple

from vtbdrake.lcm.hub import tcpq
from vtbdrake.lcm.hub.clients import ClientConnection
from vtbdrake.lcm.hub.reader import publish_record
from vtbdrake.lcm.hub.tcpq import RecordType

_log = logging.getLogger(__package__)

# Largest number of channels whose subscribers are remembered; clients may publish on any number.
_MAX_ROUTES = 4096

# Cost of handling a record.
_RECORD = 1
# Cost of handling a record on a channel whose subscribers must be found first, in the same unit.
_NEW_CHANNEL = 16


@dataclass
class ChannelStatistics:
    """Statistics of a protected channel.

    Attributes:
        owner: Name of the owner, also of one that has disconnected until its lease expires.
        lease_over: Whether the owner's lease has expired.
        refused: Rejected publications and rejected requests to take over the channel.
        last_refused: Name of the client that was rejected last.
        taken: Times that the channel was taken over from an owner whose lease had expired.
    """

    owner: str | None = None
    lease_over: bool = False
    refused: int = 0
    last_refused: str | None = None
    taken: int = 0


@dataclass
class HubStatistics:
    """Statistics of a hub since its start.

    Attributes:
        clients: Connected clients.
        messages: Accepted publications.
        volume: Size of the accepted publications on the wire, in bytes.
        delivered: Messages that were sent, or queued to be sent, to a client.
        dropped: Messages that were dropped from the backlogs of slow clients.
        queued: Size of all backlogs, in bytes.
        refused: Rejected publications.
        disconnected: Disconnected and rejected clients by reason.
        protected: The statistics of protected channels, by channel.
    """

    clients: int = 0
    messages: int = 0
    volume: int = 0
    delivered: int = 0
    dropped: int = 0
    queued: int = 0
    refused: int = 0
    disconnected: dict[str, int] = field(default_factory=dict)
    protected: dict[str, ChannelStatistics] = field(default_factory=dict)

    def to_json(self) -> bytes:
        """Return one line of JSON in UTF-8."""
        return json.dumps(asdict(self)).encode()

    @classmethod
    def from_json(cls, text: bytes) -> HubStatistics:
        """Parse what `to_json` returned: the content of a message on the status channel."""
        fields: dict[str, Any] = json.loads(text)
        protected = {name: ChannelStatistics(**channel) for name, channel in fields.pop("protected").items()}
        return cls(**fields, protected=protected)


class ProtectedChannel:
    """A channel on which only its owner may publish; the docstring of the package has the rules.

    Args:
        name: Name of the channel.
        lease: Time after the owner's last publication during which no other client can take over, in seconds.
    """

    def __init__(self, name: str, *, lease: float) -> None:
        self.name = name
        self.owner: ClientConnection | None = None  # the client that may publish; None if there is none
        self._lease = lease
        self._renewed = -inf
        # The owner's name remains there when it has disconnected.
        self._statistics = ChannelStatistics()

    def publish(self, client: ClientConnection, now: float) -> bool:
        """Decide about a publication; return whether it is accepted.

        Args:
            client: The client that publishes.
            now: The time on the hub's clock, in seconds.
        """
        self.keep(client, now)
        if client is self.owner:
            return True
        self._reject(client, "publication")
        return False

    def keep(self, client: ClientConnection, now: float) -> None:
        """Renew the owner's lease; a client that is not the owner gets the channel only if it is free.

        Args:
            client: The client that has asked to keep the channel, or has published on it.
            now: The time on the hub's clock, in seconds, from which the lease counts.
        """
        if client is self.owner:
            self._renewed = now
        elif self.owner is None and self._lease_over(now):
            self._set_owner(client, now)

    def take_over(self, client: ClientConnection, now: float) -> bool:
        """Decide about a request to take over the channel; return whether the client is the owner now.

        Args:
            client: The client that asks for the channel.
            now: The time on the hub's clock, in seconds.
        """
        if self.owner is not None and client is not self.owner:
            if not self._lease_over(now):
                self._reject(client, "takeover")
                return False
            self._statistics.taken += 1
        self._set_owner(client, now)
        return True

    def release(self, client: ClientConnection) -> bool:
        """Remove a client that has disconnected; return whether it was the owner."""
        if client is not self.owner:
            return False
        _log.info("%s: its owner %s has disconnected", self.name, client.name)
        self.owner = None
        return True

    def extend(self, seconds: float) -> None:
        """Extend the lease by a time in which no client could renew it."""
        self._renewed += seconds

    def statistics(self, now: float) -> ChannelStatistics:
        """Return the statistics at a time."""
        over, owned = self._lease_over(now), self.owner is not None
        owner = self._statistics.owner if owned or not over else None
        return replace(self._statistics, owner=owner, lease_over=owned and over)

    def _lease_over(self, now: float) -> bool:
        return now - self._renewed > self._lease

    def _set_owner(self, client: ClientConnection, now: float) -> None:
        if client is not self.owner:
            if self.owner is None:
                _log.info("%s: its owner is %s", self.name, client.name)
            else:
                _log.warning("%s: its owner is %s, previously %s", self.name, client.name, self.owner.name)
        self.owner, self._statistics.owner, self._renewed = client, client.name, now

    def _reject(self, client: ClientConnection, request: str) -> None:
        statistics = self._statistics
        statistics.refused += 1
        statistics.last_refused = client.name
        _log.warning(
            "%s: %s by %s rejected; its owner is %s%s (%d rejected so far)",
            self.name,
            request,
            client.name,
            statistics.owner,
            "" if self.owner else ", disconnected, with a lease that has not expired",
            statistics.refused,
        )


class _Route(NamedTuple):
    channel: str
    subscribers: tuple[ClientConnection, ...]
    protected: ProtectedChannel | None  # decides which client may publish; None if every client may
    reserved: bool  # whether the channel is the hub's own: nothing is relayed


class Router:
    """Decides for every record where it goes; it neither reads nor writes sockets.

    Args:
        protect: The names of the protected channels.
        lease: How long an owner that is silent keeps a protected channel, in seconds.

    Attributes:
        outgoing: Messages to send, by client: those that arrive together leave together, so that the client wakes up
            once. The server sends and removes them.
        status_changed: Whether an owner changed or something was rejected since the last status.
        totals: The statistics that are counted; `statistics` returns all.
    """

    def __init__(self, protect: Iterable[str], *, lease: float) -> None:
        self.outgoing: dict[ClientConnection, list[bytes | bytearray]] = {}
        self.status_changed = False
        self.totals = HubStatistics()
        self._clients: list[ClientConnection] = []
        self._routes: dict[bytes, _Route] = {}
        self._protected = {name: ProtectedChannel(name, lease=lease) for name in protect}

    def add(self, client: ClientConnection) -> None:
        """Add a client that has connected."""
        self._clients.append(client)

    def remove(self, client: ClientConnection, reason: str) -> None:
        """Remove a client that has disconnected.

        Args:
            client: The client.
            reason: Why it disconnected, as `HubStatistics` counts it, such as ``closed`` or ``lost``.
        """
        self._clients.remove(client)
        self._routes.clear()
        self.count_disconnected(reason)
        for protected in self._protected.values():
            self.status_changed |= protected.release(client)

    def count_disconnected(self, reason: str) -> None:
        """Count a client that was disconnected or rejected."""
        disconnected = self.totals.disconnected
        disconnected[reason] = disconnected.get(reason, 0) + 1

    def handle(self, client: ClientConnection, record: tcpq.Record, now: float) -> int:
        """Handle a record of a client.

        Args:
            client: The client that has sent the record.
            record: Kind, channel and content of the record.
            now: The time on the hub's clock, in seconds.

        Returns:
            Cost of handling it: 1, or 16 if the subscribers of a channel had to be found.

        Raises:
            TcpqError: The client violates the protocol.
        """
        kind, channel, content = record
        if kind == RecordType.PUBLISH:
            return self._publish(client, channel, content, now)
        if kind == RecordType.SUBSCRIBE:
            self._forget_routes(client.subscriptions.add(_decode(channel)))
        elif kind == RecordType.UNSUBSCRIBE:
            self._forget_routes(client.subscriptions.remove(_decode(channel)))
        else:
            self.outgoing.setdefault(client, []).append(tcpq.GREETING)
        return _RECORD

    def _forget_routes(self, channel: str | None) -> None:
        """Forget the subscribers of a channel, or of all channels if it is None."""
        if channel is None:
            self._routes.clear()
        else:
            self._routes.pop(channel.encode(), None)

    def _publish(self, client: ClientConnection, channel: bytes, content: bytes | bytearray, now: float) -> int:
        client.published = True
        cost, route = _RECORD, self._routes.get(channel)
        if route is None:
            cost, route = _NEW_CHANNEL, self._find_route(channel)
        if route.reserved:
            self._handle_reserved(client, route.channel, now)
            return cost
        if route.protected is not None:
            owner = route.protected.owner
            accepted = route.protected.publish(client, now)
            self.status_changed |= not accepted or route.protected.owner is not owner
            if not accepted:
                self.totals.refused += 1
                return cost
        self.totals.messages += 1
        self.totals.volume += len(content)
        self._distribute(route, content)
        return cost

    def _find_route(self, channel: bytes) -> _Route:
        name = _decode(channel)
        route = _Route(
            channel=name,
            subscribers=tuple(client for client in self._clients if client.subscriptions.match(name)),
            protected=self._protected.get(name),
            reserved=name == tcpq.STATUS_CHANNEL or name.startswith((tcpq.TAKE_PREFIX, tcpq.KEEP_PREFIX)),
        )
        if len(self._routes) >= _MAX_ROUTES:
            self._routes.clear()
        self._routes[channel] = route
        return route

    def _distribute(self, route: _Route, content: bytes | bytearray) -> None:
        for subscriber in route.subscribers:
            if not subscriber.closed:
                self.outgoing.setdefault(subscriber, []).append(content)
                self.totals.delivered += 1

    def _handle_reserved(self, client: ClientConnection, channel: str, now: float) -> None:
        """Handle a publication on one of the hub's own channels: to take over or keep a channel, or an error."""
        if channel.startswith(tcpq.KEEP_PREFIX):
            self._keep(client, channel.removeprefix(tcpq.KEEP_PREFIX), now)
            return
        self.status_changed = True
        protected = self._protected.get(channel.removeprefix(tcpq.TAKE_PREFIX))
        if protected is None:
            _log.warning(
                "publication by %s on %s rejected; protected channels: %s", client.name, channel, [*self._protected]
            )
        if protected is None or not protected.take_over(client, now):
            self.totals.refused += 1

    def _keep(self, client: ClientConnection, channel: str, now: float) -> None:
        protected = self._protected.get(channel)
        if protected is not None:  # Clients do not know which channels are protected.
            owner = protected.owner
            protected.keep(client, now)
            self.status_changed |= protected.owner is not owner

    def extend_leases(self, seconds: float) -> None:
        """Extend all leases by a time in which the hub was delayed."""
        for protected in self._protected.values():
            protected.extend(seconds)

    def publish_status(self, now: float) -> None:
        """Publish the statistics on the status channel."""
        self.status_changed = False
        channel = tcpq.STATUS_CHANNEL.encode()
        route = self._routes.get(channel) or self._find_route(channel)
        if route.subscribers:
            self._distribute(route, publish_record(channel, self.statistics(now).to_json()))

    def statistics(self, now: float) -> HubStatistics:
        """Return the statistics at a time."""
        return replace(
            self.totals,
            clients=len(self._clients),
            queued=sum(client.queued for client in self._clients),
            disconnected=dict(self.totals.disconnected),
            protected={name: protected.statistics(now) for name, protected in self._protected.items()},
        )


def _decode(channel: bytes) -> str:
    """Return a channel or pattern as text; liblcm's clients in Python and Java cannot read other bytes."""
    try:
        name = channel.decode()
    except UnicodeDecodeError:
        raise tcpq.TcpqError("malformed", f"channel {channel!r} is not UTF-8") from None
    if "\0" in name:
        raise tcpq.TcpqError("malformed", f"channel {channel!r} contains a null character")
    return name
