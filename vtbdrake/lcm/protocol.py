"""The LCM protocol of a machine: the maps between its channels and the signals of its scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from vtbdrake.control.robot_mode import RobotMode
from vtbdrake.lcm.lcm_bridge import LcmBridge
from vtbdrake.lcm.maps import LcmMap
from vtbdrake.testbed import Interface, Scenario


class ProtocolError(ValueError):
    """The protocol of a machine is missing, or does not fit the signals of its scenario."""


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """The LCM protocol of a machine; controller and machine make their ends of it from the same maps.

    It is part of the deployment of a scenario::

        def deployment(self) -> Deployment:
            protocol = Protocol(
                sense=[iiwa_status({"position": "joint_position_measured"})],
                act=[iiwa_command({"torque": "joint_torque"})],
            )
            return Deployment(protocol=protocol)

    Attributes:
        sense: Maps of the channels that the machine publishes; each sensor signal in one map.
        act: Maps of the channels that it receives; each actuator signal in one map.
        commands: Maps of the commands u that reach the controller over LCM; the machine does not use them.
        reported: By actuator signal, the name under which a map of ``sense`` carries the actuator command that the
            machine says it executed in the cycle that has just ended. The guards compare it with what was sent: of a
            machine that does not report it, nobody notices that commands do not arrive.
        robot_mode: The name under which a map of ``sense`` carries the machine's mode, and what its numbers mean. The
            machine is commanded only while it says that it executes commands, or waits for them; see `RobotMode`. None
            if no message tells it.
        periods: By channel of ``sense``, seconds between two messages; by default, one is sent in every cycle of the
            machine. The first message is sent in cycle 0, the others one cycle after the multiples of the period: a
            sensor that samples at these has its new value then.
    """

    sense: Sequence[LcmMap]
    act: Sequence[LcmMap]
    commands: Sequence[LcmMap] = ()
    reported: Mapping[str, str] = field(default_factory=dict)
    robot_mode: RobotMode | None = None
    periods: Mapping[str, float] = field(default_factory=dict)

    def check_interface(self, interface: Interface) -> None:
        """Check that the maps carry the signals of ``interface``.

        Raises:
            ValueError: A signal has no map or several, a map does not fit it, or a period belongs to no channel.
        """
        self.bridge(interface, "memq://")
        channels = [map.channel for map in self.sense]
        for channel, period in self.periods.items():
            if channel not in channels or not period > 0.0:
                raise ValueError(
                    f"its periods must map channels of sense ({', '.join(channels)}) to positive times, "
                    f"not {channel!r} to {period!r} s"
                )

    def bridge(self, interface: Interface, url: str, **options: Any) -> LcmBridge:
        """Return the controller's end, not yet open.

        Args:
            interface: The DPS's signals.
            url: The LCM URL of the bus.
            **options: Further arguments of `LcmBridge`.
        """
        return LcmBridge(
            interface,
            url,
            sense=self.sense,
            act=self.act,
            commands=self.commands,
            reported=self.reported,
            robot_mode=self.robot_mode,
            periods=self.periods,
            **options,
        )


def protocol_of(scenario: Scenario) -> Protocol:
    """Return the protocol of the machine of ``scenario``, checked against its signals.

    Raises:
        ProtocolError: The deployment of the scenario has no protocol, or one that does not fit its signals.
    """
    name, protocol = type(scenario).__name__, scenario.deployment().protocol
    if protocol is None:
        raise ProtocolError(
            f"{name} has no protocol for its machine: give it a method deployment() that returns "
            "Deployment(protocol=Protocol(...))"
        )
    try:
        protocol.check_interface(scenario.interface())
    except ValueError as error:
        raise ProtocolError(f"the protocol of {name} does not fit its signals: {error}") from error
    return protocol
