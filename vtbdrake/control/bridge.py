"""The bridge, which connects the real ports of a testbed with the machine."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import partial
from math import inf
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.common.argument_checks import as_array
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.robot_mode import ReportedMode, RobotMode

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
        robot_mode: The mode that the machine reports, if it does.
        tap: Called with channel and bytes of every message that was received or sent, by a bridge that has channels. It
            must not raise, and costs the loop's time.
        real_time: Whether `poll` waits in real time; False for a bridge of tests that advances a `SimulatedClock`.
    """

    interface: Interface
    sensed: dict[str, ReceivedSignal]
    commands: dict[str, ReceivedSignal]
    reported: Mapping[str, ReceivedSignal] = MappingProxyType({})
    robot_mode: ReportedMode | None = None
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
        """Return the reason why commands that leave do not reach the machine, as far as is known; None if they do."""
        return None

    @property
    def foreign(self) -> int:
        """Return the number of other publishers' commands heard on the own channels, or rejected there by a hub."""
        return 0

    @property
    def competing_publisher(self) -> str | None:
        """Return a sentence about another publisher that commands the machine at present; None if none is heard."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Disconnect; the bridge may be opened again."""


def acts_idle(idle: Mapping[str, ArrayLike]) -> Callable[[Bridge], bool]:
    """Return a function for `Deployment.released_by`: whether a machine reports that idle commands act.

    A machine that brakes reports them, for example a torque of zero, whatever it is sent.

    Args:
        idle: The idle command by actuator signal, a scalar or one per entry; all of them have to act. Without any, the
            machine never confirms.

    Raises:
        ValueError: An idle command is no number, or NaN.
    """
    commands = {name: as_array(f"the idle command of {name}", value) for name, value in idle.items()}
    if unknown := [name for name, value in commands.items() if np.isnan(value).any()]:
        raise ValueError(f"the idle command of {unknown[0]} is NaN, which no machine reports")
    return partial(_acts_idle, commands)


def _acts_idle(idle: Mapping[str, NDArray[np.float64]], bridge: Bridge) -> bool:
    acting = {name: bridge.reported[name].value for name in idle}
    return bool(idle) and all(
        v is not None and np.array_equal(v, np.broadcast_to(idle[name], v.shape)) for name, v in acting.items()
    )


class Reports:
    """The values that a machine reports beside the sensor signals of its DPS: the commands that act, and its mode.

    Attributes:
        carriers: By actuator signal, the signal in the messages that reports what acts there. It has no limits.
        signals: All signals of reports.
        acting: By actuator signal, the received command that acts there.
        robot_mode: The received mode; None if the machine does not report it.
    """

    def __init__(self, interface: Interface, reported: Mapping[str, str], robot_mode: RobotMode | None) -> None:
        """Check the names.

        Args:
            interface: Signals of the DPS.
            reported: Actuator signal -> name, in a message, of the signal that reports what acts there.
            robot_mode: The mode that the machine reports; None if it does not.

        Raises:
            ValueError: There is no such actuator signal, or another signal has the name of a report.
        """
        taken = {signal.name for signal in interface.sense}
        self.carriers = _carriers(interface, reported, taken)
        self.signals = list(self.carriers.values())
        self.acting = {name: ReceivedSignal() for name in self.carriers}
        self.robot_mode: ReportedMode | None = None
        if robot_mode is not None:
            self.signals.append(robot_mode.signal(taken))
            self.robot_mode = ReportedMode(robot_mode)

    @property
    def received(self) -> dict[str, ReceivedSignal]:
        """Return the received reports, by the names of their signals."""
        received = {carrier.name: self.acting[name] for name, carrier in self.carriers.items()}
        if self.robot_mode is not None:
            received[self.robot_mode.mode.carrier] = self.robot_mode.received
        return received


def _carriers(interface: Interface, reported: Mapping[str, str], taken: set[str]) -> dict[str, Signal]:
    """Return the signals that carry what acts, by actuator signal; add their names to those that are taken."""
    actuators = {signal.name: signal for signal in interface.act}
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
