"""The simulated world alone, as it plays the robot: the same systems, without the DPS that they are made for."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.state import Variable, collect
from vtbdrake.state.variable import X
from vtbdrake.testbed.addressed import AddressedDiagram
from vtbdrake.testbed.builder import VirtualTestbedBuilder
from vtbdrake.testbed.feed import Feed
from vtbdrake.testbed.signal import SignalError

if TYPE_CHECKING:
    from vtbdrake.testbed.scenario import Scenario


class WorldAlone(AddressedDiagram):
    """The simulated world of a scenario without its DPS: what is left of the testbed when `DpsAlone` is taken away.

    Its variables have the addresses that they have in the testbed.

    Attributes:
        diagram: input ports ``act.<signal>``, which lead to the simulated actuators, and output ports
            ``sense.<signal>``, which come from the simulated sensors.
        plant: of the simulated world, if it has one.
        beliefs: which estimates of the DPS set which of its variables.
    """

    def __init__(self, scenario: Scenario) -> None:
        """
        Raises:
            ScenarioError: a field of the scenario has a value that nothing can be built with.
            SignalError: the world lacks a signal of the interface.
        """
        scenario.validate()
        own = copy.deepcopy(scenario)
        parts = VirtualTestbedBuilder(own.interface(), simulator_config=own.simulator_config)
        own.add_world(parts)
        parts.finish_world()
        for signal in parts.interface.sense:
            parts.diagram_builder.ExportOutput(parts.sensors[signal.name], f"sense.{signal.name}")
        for signal in parts.interface.act:
            parts.diagram_builder.ExportInput(parts.actuators[signal.name], f"act.{signal.name}")
        diagram = parts.build_diagram("world_alone")
        roles = parts.plant_roles()
        clock = Variable("time", X, (), "s", lambda context: context.get_time())
        super().__init__(
            diagram=diagram,
            interface=parts.interface,
            simulator_config=own.simulator_config,
            scenario=own,
            variables=collect(
                diagram,
                plant_prefix=lambda path, instance: f"sim.{roles[instance]}" if path == "plant" else path,
                extra=[clock, *parts.extra_variables],
            ),
        )
        self.plant = parts.plant
        self.beliefs = tuple(parts.beliefs)
        self._actuators = {s.name: (s, diagram.GetInputPort(f"act.{s.name}")) for s in parts.interface.act}

    def default_context(self) -> Context:
        """A new context: s0 from defaults, every actuator with its idle command."""
        context = super().default_context()
        for signal in self.interface.act:
            self.command(context, signal.name, signal.idle)
        return context

    def command(self, context: Context, name: str, value: Any) -> None:
        """Gives the simulated actuator ``name`` a command, which lasts until the next one.

        Args:
            value: an array of shape (size,), a scalar for all entries, or a value of an abstract signal.

        Raises:
            SignalError: there is no such actuator signal, or the value has another size or type, or a NaN.
        """
        if name not in self._actuators:
            raise SignalError(f"the interface has no actuator signal {name!r}; it has: {', '.join(self._actuators)}")
        signal, _ = self._actuators[name]
        if signal.is_vector and np.ndim(value) == 0:
            value = np.broadcast_to(value, signal.vector(0.0).shape)
        signal.check_value(value)
        self.feed(context)(name, np.array(value, dtype=float) if signal.is_vector else value)

    def feed(self, context: Context) -> Feed:
        """What commands the simulated actuators of one context again and again, unchecked, at the lowest cost."""
        self.check_context(context)
        return Feed(self._actuators, context)
