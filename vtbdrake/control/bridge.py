"""The bridge, which connects the real ports of a testbed with the machine."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from math import inf
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from vtbdrake.control.received_signal import ReceivedSignal

if TYPE_CHECKING:
    # So that a process that only listens on a bus need not load Drake.
    from vtbdrake.testbed import Interface, Signal


class BridgeError(RuntimeError):
    """A bridge that cannot be opened, or is used before it is open."""


class Bridge(ABC):
    """The connection between the real ports of a testbed and the machine; it lives outside the Diagram.

    One thread uses it. No call waits longer than its ``timeout``, and none raises because of a received message or
    because the machine is gone: messages are counted, and `connected` is the state.

    Attributes:
        interface: Signals of the DPS.
        sensed: The received sensor signals, by name.
        commands: The received commands u that come from outside, by name.
        channels: Channel of the messages of each sensor signal, for a bridge that has channels.
        reported: For the actuator signals that the machine reports: the received command that acts there, by name.
        tap: Called with channel and bytes of every message that was received or sent, by a bridge that has channels. It
            must not raise, and costs the loop's time.
        real_time: Whether `poll` waits in real time; False for a bridge of tests that advances a `SimulatedClock`.
    """

    interface: Interface
    sensed: dict[str, ReceivedSignal]
    commands: dict[str, ReceivedSignal]
    reported: Mapping[str, ReceivedSignal] = MappingProxyType({})
    channels: Mapping[str, str] = MappingProxyType({})
    tap: Callable[[str, bytes], None] | None = None
    real_time: bool = True

    @abstractmethod
    def open(self) -> None:
        """Connect.

        Raises:
            BridgeError: The connection cannot be made. A bridge never falls back to a private bus.
        """

    @abstractmethod
    def poll(self, timeout: float = 0.0) -> int:
        """Receive all messages that have arrived, return their number; wait up to ``timeout`` seconds for the first.

        A bridge that has lost its connection tries to connect again here.
        """

    def note_pause(self, since: float, signals: Collection[str]) -> bool:
        """Take note that `poll` was not called for a while: what waits now may be as old as the pause.

        Values that waited count as arrived when the pause began. By default nothing is done, because the messages of a
        bridge need not wait.

        Args:
            since: When everything that had arrived was read last, on the clock of `ReceivedSignal.arrived`, in seconds.
            signals: Names of the sensor signals whose values would be too old if they had arrived then.

        Returns:
            True if values count as older than their arrival, so that the loop may have to wait for newer ones.
        """
        return False

    @abstractmethod
    def publish(self, actuation: Mapping[str, Any]) -> Collection[str]:
        """Send actuator commands.

        Args:
            actuation: Commands by actuator signal. A signal that is missing is not sent: there is no message for "no
                command".

        Returns:
            The signals whose commands did not leave, as far as is known; mostly empty.
        """

    def keep(self, signals: Collection[str]) -> None:  # noqa: B027 - most take nothing away
        """Keep the right to command signals for which nothing is sent at present, such as under a silent fallback.

        By default nothing is done, because nothing takes that right from a bridge that does not send.

        Args:
            signals: Names of actuator signals that are on real.
        """

    @property
    @abstractmethod
    def connected(self) -> bool:
        """Return whether messages can be received and sent at present."""

    @property
    def blocked_reason(self) -> str | None:
        """Return why commands that leave do not reach the machine, as far as is known; None if they do."""
        return None

    @property
    def foreign(self) -> int:
        """Return the number of other publishers' commands heard on the own channels, or rejected there by a hub."""
        return 0

    @property
    def competing_publisher(self) -> str | None:
        """Return which other publisher commands the machine at present, as a sentence; None if none is heard."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Disconnect; the bridge may be opened again."""


def reported_signals(interface: Interface, reported: Mapping[str, str]) -> dict[str, Signal]:
    """Return the signals that carry the commands that the machine reports as acting, by actuator signal.

    They have no limits: they are only observed.

    Args:
        interface: Signals of the DPS.
        reported: Actuator signal -> name, in a message, of the signal that reports what acts there.

    Raises:
        ValueError: There is no such actuator signal, or the name is that of another signal.
    """
    actuators = {signal.name: signal for signal in interface.act}
    taken = {signal.name for signal in interface.sense}
    carriers = {}
    for name, carrier in reported.items():
        if name not in actuators:
            raise ValueError(
                f"the machine cannot report {name!r}, which is no actuator signal; there are: "
                f"{', '.join(actuators) or 'none'}"
            )
        if carrier in taken:
            raise ValueError(f"the reported command of {name} needs a name of its own: {carrier!r} is taken")
        taken.add(carrier)
        carriers[name] = replace(actuators[name], name=carrier, lower=-inf, upper=inf, rate=inf, acceleration=inf)
    return carriers
