"""Who may publish on the own command channels, as a hub tells."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable

from vtbdrake.control.hub.statistics import Statistics

_log = logging.getLogger(__name__)


class Ownership:
    """Learns from the status of a hub which of its protected channels belong to somebody else.

    What is published there all the same does not pass. The hub says so within 10 ms of the first refusal.

    Args:
        channels: those that one publishes on.
        name: under which the hub knows the connection at present; None while there is none.

    Attributes:
        foreign: the channels among them that belong to somebody else.
    """

    def __init__(self, channels: Iterable[str], name: Callable[[], str | None]) -> None:
        self.foreign: frozenset[str] = frozenset()
        self._channels = tuple(channels)
        self._name = name

    def take(self, _: str, data: bytes) -> None:
        """Handles one message of the status channel."""
        try:
            protected = Statistics.from_json(data).protected
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
        self.foreign = frozenset(foreign)
