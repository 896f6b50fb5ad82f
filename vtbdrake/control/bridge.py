"""What lies behind the real ports of a testbed: a bridge, which lives outside the Diagram."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from math import inf
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from vtbdrake.control.kernels import ReceivedSignal

if TYPE_CHECKING:
    # A link to a bus needs nothing of Drake: whoever only listens is spared its weight.
    from vtbdrake.testbed import Interface, Signal

__all__ = ["Bridge", "BridgeError", "ReceivedSignal", "reported_signals"]


class BridgeError(RuntimeError):
    """A bridge that cannot be opened, or is used before it is."""


class Bridge(ABC):
    """Carries what crosses the boundary between a testbed and the real machine.

    One thread uses it. No call of it waits longer than it is told to, and none raises because of what came in or
    because the machine is gone: that is counted, and told by `connected`.

    Attributes:
        interface: the DPS's signals.
        sensed: reception of each sensor signal, by name.
        commands: reception of each command u that comes from outside, by name.
        channels: by sensor signal, the channel of its messages, for a bridge that has such.
        reported: reception of the command that the machine says acts on an actuator signal, by the signal's name; of
            those that it reports.
        tap: called with channel and bytes of every message that comes or has left, by a bridge that has such; it must
            not raise, and costs the loop's time.
    """

    interface: Interface
    sensed: dict[str, ReceivedSignal]
    commands: dict[str, ReceivedSignal]
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
    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
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
    def blocked_reason(self) -> str | None:
        """Why commands that leave do not reach the machine, as far as is known; None if nothing is."""
        return None

    @property
    def foreign(self) -> int:
        """How many commands of somebody else have been heard on the own command channels, by a bridge that listens, or
        were refused there by a hub."""
        return 0

    @property
    def competing_publisher(self) -> str | None:
        """Who else commands the machine at present, as far as is heard; None if nobody does."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Gives the connection back; it may be opened again."""


def reported_signals(interface: Interface, reported: Mapping[str, str]) -> dict[str, Signal]:
    """The signals that carry reported commands, by actuator signal.

    They have no limits: what is reported is looked at, not obeyed.

    Args:
        reported: by actuator signal, the name of the signal in a message that tells what acts on it.

    Raises:
        ValueError: there is no such actuator signal, or the name is another signal's.
    """
    actuators = {signal.name: signal for signal in interface.act}
    taken = {signal.name for signal in interface.sense}
    found = {}
    for name, carrier in reported.items():
        if name not in actuators:
            known = ", ".join(actuators) or "none"
            raise ValueError(f"the machine cannot report {name!r}, which is no actuator signal; there are: {known}")
        if carrier in taken:
            raise ValueError(f"the reported command of {name} needs a name of its own: {carrier!r} is taken")
        taken.add(carrier)
        found[name] = replace(actuators[name], name=carrier, lower=-inf, upper=inf, rate=inf, acceleration=inf)
    return found
