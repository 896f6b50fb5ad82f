"""Who may publish on the own command channels, as a hub tells."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable

from vtbdrake.lcm.hub import ChannelStatistics, HubStatistics

_log = logging.getLogger(__name__)


class Ownership:
    """Learns from the status of a hub which of its protected channels belong to somebody else.

    What is published there all the same does not pass. The hub says so within 10 ms of the first refusal.

    Args:
        channels: those that one publishes on.
        name: under which the hub knows the connection at present; None while there is none.

    Attributes:
        protected: the channels among them that the hub protects: only one client at a time gets through there.
        foreign: those of them that belong to somebody else.
        attempts: how often the hub has refused somebody else on a channel that is one's own.
        last: by channel, when it did so last, in seconds by `time.monotonic`.
    """

    def __init__(self, channels: Iterable[str], name: Callable[[], str | None]) -> None:
        self.protected: frozenset[str] = frozenset()
        self.foreign: frozenset[str] = frozenset()
        self.attempts = 0
        self.last: dict[str, float] = {}
        self._refused: dict[str, int] = {}  # by channel, as far as the hub has told
        self._channels = tuple(channels)
        self._name = name

    def take(self, _: str, data: bytes) -> None:
        """Handles one message of the status channel."""
        try:
            protected = HubStatistics.from_json(data).protected
        except (ValueError, TypeError, KeyError, AttributeError):
            _log.warning("what came on the hub's status channel is no status: %r", data[:100])
            return
        own, foreign = self._name(), set()
        for channel in self._channels:
            owner = protected[channel].owner if channel in protected else None
            if owner is not None and owner != own:
                foreign.add(channel)
                if channel not in self.foreign:
                    _log.error("commands on %s are refused by the hub: the channel belongs to %s", channel, owner)
            if channel in protected:
                self._count(channel, protected[channel], own)
        self.protected = frozenset(channel for channel in self._channels if channel in protected)
        self.foreign = frozenset(foreign)

    def _count(self, channel: str, state: ChannelStatistics, own: str | None) -> None:
        """Counts what the hub has refused since its last status; what came before the first one is not one's own."""
        before = self._refused.get(channel, state.refused)
        self._refused[channel] = state.refused
        if own is not None and state.owner == own != state.last_refused and state.refused > before:
            self.attempts += state.refused - before
            self.last[channel] = time.monotonic()

    def contended(self, seconds: float) -> list[str]:
        """Return the own channels on which somebody else was refused within the last ``seconds``."""
        return [channel for channel, last in self.last.items() if last > time.monotonic() - seconds]
