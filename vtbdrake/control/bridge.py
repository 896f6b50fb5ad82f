"""What lies behind the real ports of a testbed: a bridge, which lives outside the Diagram."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from vtbdrake.control.kernels import ReceivedSignal

if TYPE_CHECKING:
    # A link to a bus needs nothing of Drake: whoever only listens is spared its weight.
    from vtbdrake.testbed import Interface

__all__ = ["Bridge", "BridgeError", "ReceivedSignal"]


class BridgeError(RuntimeError):
    """A bridge that cannot be opened, or is used before it is."""


class Bridge(ABC):
    """Carries what crosses the boundary between a testbed and the real machine.

    One thread uses it. No call of it waits longer than it is told to, and none raises because of what came in or
    because the machine is gone: that is counted, and told by `connected`.

    Attributes:
        interface: the DPS's signals.
        sensed: reception of each sensor signal, by name.
        commanded: reception of each command u that comes from outside, by name.
        channels: by sensor signal, the channel of its messages, for a bridge that has such.
        reported: reception of the command that the machine says acts on an actuator signal, by the signal's name; of
            those that it reports.
        tap: called with channel and bytes of every message that comes or has left, by a bridge that has such; it must
            not raise, and costs the loop's time.
    """

    interface: Interface
    sensed: dict[str, ReceivedSignal]
    commanded: dict[str, ReceivedSignal]
    reported: Mapping[str, ReceivedSignal] = MappingProxyType({})
    channels: Mapping[str, str] = MappingProxyType({})
    tap: Callable[[str, bytes], None] | None = None

    @abstractmethod
    def open(self) -> None:
        """Connects.

        Raises:
            BridgeError: it cannot; there is no private substitute.
        """

    @abstractmethod
    def poll(self, timeout: float = 0.0) -> int:
        """Takes in what has arrived, waiting up to ``timeout`` seconds for the first; says how many messages came."""

    @abstractmethod
    def publish(self, commands: Mapping[str, Any]) -> Collection[str]:
        """Send actuator signals, by name. A signal that is not named is not sent: there is no message for "no
        command".

        Returns:
            The signals whose commands did not leave, as far as is known; mostly empty.
        """

    @property
    @abstractmethod
    def connected(self) -> bool:
        """Whether messages can come and go at present. A bridge that lost its connection seeks a new one in `poll`."""

    @property
    def hindrance(self) -> str | None:
        """Why commands that leave do not reach the machine, as far as is known; None if nothing is."""
        return None

    @property
    def foreign(self) -> int:
        """How many commands of somebody else have been heard on the own command channels, by a bridge that listens, or
        were refused there by a hub."""
        return 0

    @property
    def contention(self) -> str | None:
        """Who else commands the machine at present, as far as is heard; None if nobody does."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Gives the connection back; it may be opened again."""
