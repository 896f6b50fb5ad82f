"""What a machine speaks: the maps between its LCM channels and the signals of the scenario that plays it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from vtbdrake.lcm.bridge import LcmBridge
from vtbdrake.lcm.maps import LcmMap
from vtbdrake.testbed import Interface, Scenario


class ProtocolError(ValueError):
    """A scenario that does not say what its machine speaks, or says it in a way that does not fit its signals."""


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """The LCM protocol of a machine; controller and machine make their ends of it from the same maps.

    A scenario has one if it has a method ``protocol``::

        def protocol(self) -> Protocol:
            return Protocol(
                sense=[iiwa_status({"position": "joint_position_measured"})],
                act=[iiwa_command({"torque": "joint_torque"})],
            )

    Attributes:
        sense: what the machine publishes; each sensor signal in one map.
        act: what it listens to; each actuator signal in one map.
        commands: commands u that reach the controller over LCM; the machine has no part in them.
        reported: by actuator signal, the name under which a map of ``sense`` carries the command that the machine says
            acts on it: the command of its cycle that has just ended.
        periods: by channel of ``sense``, seconds between two messages; one per cycle of the machine, if not named.
    """

    sense: Sequence[LcmMap]
    act: Sequence[LcmMap]
    commands: Sequence[LcmMap] = ()
    reported: Mapping[str, str] = field(default_factory=dict)
    periods: Mapping[str, float] = field(default_factory=dict)

    def bridge(self, interface: Interface, url: str, **options: Any) -> LcmBridge:
        """The controller's end, not yet open; ``options`` are those of `LcmBridge`."""
        return LcmBridge(
            interface,
            url,
            sense=self.sense,
            act=self.act,
            commands=self.commands,
            reported=self.reported,
            **options,
        )


def protocol_of(scenario: Scenario) -> Protocol:
    """What the machine of ``scenario`` speaks.

    Raises:
        ProtocolError: the scenario does not say, or what it says does not fit its signals.
    """
    # The layer of scenarios knows nothing of LCM: so the method is optional, and looked for here.
    method = getattr(scenario, "protocol", None)
    if method is None:
        raise ProtocolError(
            f"{type(scenario).__name__} does not say what its machine speaks: give it a method protocol() that returns "
            "a vtbdrake.lcm.protocol.Protocol"
        )
    protocol = method()
    if not isinstance(protocol, Protocol):
        raise ProtocolError(
            f"{type(scenario).__name__}.protocol() returns a vtbdrake.lcm.protocol.Protocol, not {protocol!r}"
        )
    try:
        protocol.bridge(scenario.interface(), "memq://")
    except ValueError as error:
        raise ProtocolError(f"{type(scenario).__name__}.protocol(): {error}") from error
    channels = [map.channel for map in protocol.sense]
    for channel, period in protocol.periods.items():
        if channel not in channels or not period > 0.0:
            raise ProtocolError(
                f"{type(scenario).__name__}.protocol(): periods gives a positive time for channels of sense "
                f"({', '.join(channels)}), not {period!r} s for {channel!r}"
            )
    return protocol
