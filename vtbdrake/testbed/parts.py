"""The two halves of a testbed: the DPS alone, as it runs on the robot, and the simulated world alone."""

from __future__ import annotations

import copy
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context
from pydrake.systems.primitives import ConstantVectorSource

from vtbdrake.state import Snapshot
from vtbdrake.state import snapshot as snapshots
from vtbdrake.state.snapshot import StateCopier
from vtbdrake.testbed.addressed import AddressedDiagram, is_dps
from vtbdrake.testbed.builder import VirtualTestbedBuilder
from vtbdrake.testbed.scenario import Scenario, check_is_scenario
from vtbdrake.testbed.signal import Feed, SignalError
from vtbdrake.testbed.switch import COMMAND, CommandBoard

if TYPE_CHECKING:
    from vtbdrake.testbed.testbed import VirtualTestbed


class DpsAlone(AddressedDiagram):
    """The DPS of a scenario without its simulated world, and with the same boundary to the machine as the testbed.

    The DPS's own knowledge of the world (a map, a model of the robot) is part of the DPS, and stays. All actuator
    signals command: every entry of ``real.act.active`` is 1.

    Attributes:
        dps: The data processing system, a direct subsystem of the diagram.
    """

    scenario: Scenario | None

    def __init__(self, scenario: Scenario) -> None:
        check_is_scenario(scenario)
        scenario.validate()
        interface = scenario.interface()
        parts = VirtualTestbedBuilder(interface)
        dps = parts.set_dps(scenario.make_dps())
        builder = parts.diagram_builder
        u = {s.name: s.default_vector() for s in interface.commands}
        commands = CommandBoard(builder, u)
        for name, port in commands.ports.items():
            builder.Connect(port, dps.GetInputPort(name))
        for signal in interface.sense:
            builder.ExportInput(dps.GetInputPort(signal.name), f"real.sense.{signal.name}")
        for signal in interface.act:
            builder.ExportOutput(dps.GetOutputPort(signal.name), f"real.act.{signal.name}")
        if interface.act:
            active = builder.AddNamedSystem("T_act.active", ConstantVectorSource(np.ones(len(interface.act))))
            builder.ExportOutput(active.get_output_port(), "real.act.active")
        diagram = parts.build_diagram("dps_alone")
        super().__init__(
            diagram=diagram,
            interface=interface,
            simulator_config=unpaced(scenario.simulator_config, has_plant=False),
            scenario=scenario,
            extra=commands.variables(interface.commands),
        )
        self.dps = dps
        self._copiers: dict[int, StateCopier] = {}

    def _repr_html_(self) -> str:
        """Show the signals and the variables in a notebook."""
        return f"<b>{escape(repr(self))}</b>{self.interface._repr_html_()}{self.variables()._repr_html_()}"

    def continue_from(self, testbed: VirtualTestbed, context: Context) -> Context:
        """Return a context in which the DPS continues from a context of its testbed, at the same time.

        Args:
            testbed: The whole testbed.
            context: Its root context, from which the DPS continues.
        """
        copied = self.default_context()
        if id(testbed) not in self._copiers:
            self._copiers[id(testbed)] = StateCopier(
                testbed.diagram, testbed.variables(), self.diagram, self.variables(), only=is_dps
            )
        self._copiers[id(testbed)].copy(context, copied)
        commands = [f"{COMMAND}{signal.name}" for signal in self.interface.commands]
        self.write(copied, {a: testbed.read(context, a) for a in commands if a in testbed.variables()})
        return copied

    def restore(self, context: Context, snapshot: Snapshot) -> None:
        """Make ``context`` continue from where the DPS is in a snapshot, of a testbed or of a DPS alone.

        Args:
            context: The root context of the DPS alone, which is changed.
            snapshot: The snapshot.

        Raises:
            SnapshotError: The snapshot is of another scenario, or of a DPS that is built in another way.
        """
        self.check_context(context)
        self.check_scenario(snapshot)
        snapshots.apply(snapshot, self.diagram, context, self._variables, only=is_dps)
        commands = [f"{COMMAND}{signal.name}" for signal in self.interface.commands]
        self.write(context, {a: snapshot[a] for a in commands if a in snapshot.values})


def unpaced(config: SimulatorConfig, *, has_plant: bool = True) -> SimulatorConfig:
    """Return a config for a loop that sets the pace itself.

    Args:
        config: The config of a testbed.
        has_plant: Whether the Diagram has a plant, as CENIC needs it.
    """
    unpaced = copy.deepcopy(config)
    unpaced.target_realtime_rate = 0.0
    # CENIC integrates a MultibodyPlant.
    if unpaced.integration_scheme == "cenic" and not has_plant:
        unpaced.integration_scheme = "runge_kutta3"
    return unpaced


class WorldAlone(AddressedDiagram):
    """The simulated world of a scenario without its DPS: the complement of `DpsAlone`.

    Its variables have the addresses that they have in the testbed.

    Attributes:
        diagram: Input ports ``act.<signal>``, which lead to the simulated actuators, and output ports
            ``sense.<signal>``, which come from the simulated sensors.
        plant: Plant of the simulated world, if it has one.
        belief_rules: How estimates of the DPS set its variables.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Build the world of ``scenario``.

        Raises:
            ScenarioError: A field of the scenario has a value that nothing can be built with.
            SignalError: The world lacks a signal of the interface.
        """
        check_is_scenario(scenario)
        scenario.validate()
        scenario_copy = copy.deepcopy(scenario)
        parts = VirtualTestbedBuilder(scenario_copy.interface(), simulator_config=scenario_copy.simulator_config)
        parts.place_of = scenario_copy.where_position
        scenario_copy.add_world(parts)
        parts.finish_world()
        for signal in parts.interface.sense:
            parts.diagram_builder.ExportOutput(parts.sensors[signal.name], f"sense.{signal.name}")
        for signal in parts.interface.act:
            parts.diagram_builder.ExportInput(parts.actuators[signal.name], f"act.{signal.name}")
        diagram = parts.build_diagram("world_alone")
        super().__init__(
            diagram=diagram,
            interface=parts.interface,
            simulator_config=unpaced(scenario_copy.simulator_config),
            scenario=scenario_copy,
            plant_roles=parts.plant_roles(),
        )
        self.plant = parts.plant
        self.belief_rules = tuple(parts.belief_rules)
        self._actuators = {s.name: (s, diagram.GetInputPort(f"act.{s.name}")) for s in parts.interface.act}

    def default_context(self) -> Context:
        """Return a new context: s0 from defaults, every actuator with its idle command."""
        context = super().default_context()
        for signal in self.interface.act:
            self.actuate(context, signal.name, signal.idle)
        return context

    def actuate(self, context: Context, name: str, value: Any) -> None:
        """Set the command of the simulated actuator ``name``, which holds until the next one.

        A `feed` of the same context is invalid afterwards: Drake has deleted what it writes to. Use one of the two.

        Args:
            context: A root context of this world.
            name: The actuator signal.
            value: An array of shape (size,), a scalar for all entries, or a value of an abstract signal.

        Raises:
            SignalError: There is no such actuator signal, or the value has another size or type, or a NaN.
        """
        if name not in self._actuators:
            raise SignalError(f"the interface has no actuator signal {name!r}; it has: {', '.join(self._actuators)}")
        signal, _ = self._actuators[name]
        if signal.is_vector and np.ndim(value) == 0:
            value = np.broadcast_to(value, signal.vector(0.0).shape)
        signal.check_value(value)
        self.feed(context)(name, np.array(value, dtype=float) if signal.is_vector else value)

    def feed(self, context: Context) -> Feed:
        """Return a `Feed` of the simulated actuators of one context; it does not check values.

        There is one feed of a context at a time, and no `actuate` beside it.
        """
        self.check_context(context)
        return Feed(self._actuators, context)
