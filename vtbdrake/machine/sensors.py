"""What a machine tells of itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.control.bridge import reported_signals
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.machine.config import MachineConfig
from vtbdrake.machine.faults import Packet
from vtbdrake.testbed import WorldAlone


class Sensors:
    """Makes messages of the simulated sensor signals, with noise, and of the commands that acted last.

    Attributes:
        channels: on which they are told.
    """

    def __init__(
        self,
        world: WorldAlone,
        protocol: Protocol,
        config: MachineConfig,
        random: np.random.Generator,
        *,
        given: Mapping[str, Any],
    ) -> None:
        """
        Args:
            given: the commands that act, by actuator signal (of a vector as an array), kept up to date from outside.

        Raises:
            ValueError: there is to be noise on what is no vector sensor signal.
        """
        signals = {signal.name: signal for signal in world.interface.sense}
        vectors = [signal.name for signal in signals.values() if signal.is_vector]
        for name in config.noise:
            if name not in vectors:
                raise ValueError(f"noise is added to vector sensor signals ({', '.join(vectors)}), not to {name!r}")
        self._noise = config.noise
        self._random = random
        self._given = given
        carriers = reported_signals(world.interface, protocol.reported)
        known = signals | {signal.name: signal for signal in carriers.values()}
        self._reported = {signal.name: name for name, signal in carriers.items()}
        self._maps = [(map, map.encoder([known[name] for name in map.signals])) for map in protocol.sense]
        self._every = {
            map.channel: max(1, round(protocol.periods.get(map.channel, config.period) / config.period))
            for map in protocol.sense
        }
        self._ports = {name: world.diagram.GetOutputPort(f"sense.{name}") for name in vectors}
        self._readers = {name: world.reader(f"sense.{name}") for name in signals if name not in vectors}
        self.channels = list(self._every)

    def packets(self, context: Context, cycle: int, utime: int, errors: Mapping[str, int]) -> list[Packet]:
        """The messages of this cycle.

        Args:
            utime: what they tell as their time, in microseconds.
            errors: what is to be added to it, by channel.
        """
        return [
            Packet(
                map.channel,
                map.type,
                write({name: self._measure(name, context) for name in map.signals}, utime + errors[map.channel]),
                cycle,
            )
            for map, write in self._maps
            if cycle % self._every[map.channel] == 0
        ]

    def _measure(self, name: str, context: Context) -> Any:
        if name in self._reported:
            return self._given[self._reported[name]]
        if name not in self._ports:
            return self._readers[name](context)
        # Not a copy: it becomes a message before anything changes.
        value = self._ports[name].Eval(context)
        deviation = self._noise.get(name)
        return value if deviation is None else value + deviation * self._random.standard_normal(value.shape)
