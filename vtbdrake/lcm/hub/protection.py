"""A channel with one publisher at a time."""

from __future__ import annotations

from math import inf

from vtbdrake.lcm.hub.clients import ClientConnection
from vtbdrake.lcm.hub.log_rate import limited_logger
from vtbdrake.lcm.hub.statistics import ChannelStatistics

_log = limited_logger(__name__)


class ProtectedChannel:
    """Who may publish on a channel; the package's docstring has the rules.

    Args:
        name: of the channel.
        lease: in seconds.

    Attributes:
        owner: the client that may publish, None before the first and after the last.
    """

    def __init__(self, name: str, *, lease: float) -> None:
        self.name = name
        self._lease = lease
        self.owner: ClientConnection | None = None
        self._holder: str | None = None  # the owner's name, also when it is gone
        self._renewed = -inf
        self._refused = 0
        self._last_refused: str | None = None
        self._taken = 0

    def admit(self, client: ClientConnection, now: float) -> bool:
        """Whether what the client publishes at the time ``now`` may pass."""
        if client is self.owner:
            self._renewed = now
            return True
        if self.owner is None and self._is_over(now):
            self._give(client, now)
            return True
        self._refuse(client, now, "publishes on it")
        return False

    def take(self, client: ClientConnection, now: float) -> bool:
        """Whether the client, which asks for the channel, has it now."""
        if self.owner is not None and client is not self.owner:
            if not self._is_over(now):
                self._refuse(client, now, "asks for it")
                return False
            self._taken += 1
        self._give(client, now)
        return True

    def release(self, client: ClientConnection) -> bool:
        """The client is gone; says whether it was the owner."""
        if client is not self.owner:
            return False
        _log.warning("%s: its owner %s is gone", self.name, client.name)
        self.owner = None
        return True

    def excuse(self, seconds: float) -> None:
        """A time in which nobody could have renewed a lease: it does not count."""
        self._renewed += seconds

    def statistics(self, now: float) -> ChannelStatistics:
        over = self._is_over(now)
        return ChannelStatistics(
            owner=None if self.owner is None and over else self._holder,
            lease_over=self.owner is not None and over,
            refused=self._refused,
            last_refused=self._last_refused,
            taken=self._taken,
        )

    def _is_over(self, now: float) -> bool:
        return now - self._renewed > self._lease

    def _give(self, client: ClientConnection, now: float) -> None:
        if client is not self.owner:
            before = "" if self.owner is None else f", until now {self._holder}"
            _log.warning("%s: its owner is %s%s", self.name, client.name, before)
        self.owner, self._holder, self._renewed = client, client.name, now

    def _refuse(self, client: ClientConnection, now: float, what: str) -> None:
        self._refused += 1
        self._last_refused = client.name
        _log.warning(
            "%s: refused, %s %s and its owner is %s%s (%d refused so far)",
            self.name,
            client.name,
            what,
            self._holder,
            ", whose lease runs on" if self.owner is None else "",
            self._refused,
        )
