"""What a hub tells about itself."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass
class ChannelStatistics:
    """Of one protected channel.

    Attributes:
        owner: the client that may publish, or the one that is gone and whose lease runs on; None if there is neither.
        lease_over: whether the owner has not published for longer than its lease.
        refused: publications of others and refused requests to take the channel.
        last_refused: whose the last of them was.
        taken: how often the channel was taken from an owner whose lease was over.
    """

    owner: str | None = None
    lease_over: bool = False
    refused: int = 0
    last_refused: str | None = None
    taken: int = 0


@dataclass
class HubStatistics:
    """Of a hub, since it began.

    Attributes:
        clients: how many are connected.
        messages: publications that were accepted.
        volume: their size on the wire, in bytes.
        delivered: messages sent, or queued to be sent, to a client.
        dropped: messages that clients lost from their queues because they were slow.
        queued: bytes in the queues of all clients.
        refused: publications that were not accepted.
        disconnected: clients that are gone, by the reason.
        protected: by channel.
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
        """One line, UTF-8."""
        return json.dumps(asdict(self)).encode()

    @classmethod
    def from_json(cls, text: bytes) -> HubStatistics:
        """What `to_json` made, the content of a message on the status channel."""
        fields: dict[str, Any] = json.loads(text)
        protected = {name: ChannelStatistics(**channel) for name, channel in fields.pop("protected").items()}
        return cls(**fields, protected=protected)
