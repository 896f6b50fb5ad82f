"""The virtual testbed (VTB) of Figure 4 as a Drake Diagram, with its switches, addresses and snapshots."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import ApplySimulatorConfig, InitializeParams, Simulator
from pydrake.systems.framework import Context, Diagram, OutputPort, PortDataType, System

from vtbdrake.state import AddressError, Snapshot, SnapshotError, Variable, Variables, collect
from vtbdrake.state import snapshot as snapshots
from vtbdrake.state.copying import StateCopier
from vtbdrake.state.systems import is_python, leaves
from vtbdrake.state.variable import X
from vtbdrake.state.variables import suggestion
from vtbdrake.testbed.belief import Belief
from vtbdrake.testbed.config import SimulatorFields
from vtbdrake.testbed.signal import Interface
from vtbdrake.testbed.switch import ACT_POSITIONS, BOARD, REAL, SENSE_POSITIONS, SIM, T_ACT, T_SENSE, TWIN, Selector

if TYPE_CHECKING:
    from vtbdrake.testbed.scenario import Scenario

# Mode -> where (T_sense, T_act) stand.
MODES = {"sim": (SIM, SIM), "shadow": (REAL, SIM), "real": (REAL, REAL), "twin": (REAL, TWIN)}


def check_mode(mode: str) -> None:
    """
    Raises:
        ValueError: ``mode`` is not a mode of a testbed.
    """
    if mode not in MODES:
        raise ValueError(f"a testbed's mode is one of {', '.join(MODES)}, not {mode!r}")


class VirtualTestbed:
    """A DPS in one Diagram with the simulated world around it, behind switches.

    Attributes:
        diagram: input ports ``real.sense.<signal>``; output ports ``real.act.<signal>`` and ``real.act.active`` (1
            for every actuator signal that commands, else 0). While an actuator signal's switch is on sim, its real
            port carries no command: NaN, or an empty `Command` for an abstract signal. No system in it touches
            anything outside the Diagram, so that any of its contexts can be simulated without side effects.
        interface: the DPS's signals.
        dps: the data processing system, a direct subsystem of the diagram.
        plant, scene_graph: of the simulated world, if it has them.
        simulator_fields: how the testbed is to be integrated.
        scenario: what built it, or None.
        visualized: True if a Meshcat draws it.

    It is not a subclass of Diagram: Drake would then look for Python overrides in every step of a simulation.
    """

    def __init__(
        self,
        *,
        diagram: Diagram,
        interface: Interface,
        dps: System,
        plant: MultibodyPlant | None,
        scene_graph: SceneGraph | None,
        sense: Mapping[str, Selector],
        act: Mapping[str, Selector],
        simulator: SimulatorFields,
        scenario: Scenario | None,
        beliefs: tuple[Belief, ...],
        extra_variables: tuple[Variable, ...],
        plant_roles: Mapping[str, str],
        visualized: bool,
    ) -> None:
        self.diagram = diagram
        self.interface = interface
        self.dps = dps
        self.plant = plant
        self.scene_graph = scene_graph
        self.simulator_fields = simulator
        self.scenario = scenario
        self.visualized = visualized
        self._sense = dict(sense)
        self._act = dict(act)
        self._beliefs = beliefs
        self._variables = collect(
            diagram,
            plant_prefix=lambda path, instance: f"sim.{plant_roles[instance]}" if path == "plant" else path,
            skip=lambda path: path == BOARD or path.startswith((T_SENSE, T_ACT)),
            extra=[
                Variable("time", X, (), "s", lambda context: context.get_time()),
                *(selector.variable() for selector in [*self._sense.values(), *self._act.values()]),
                *extra_variables,
            ],
        )
        for belief in beliefs:
            belief.check(self._variables)

    # -- contexts and simulators

    def default_context(self) -> Context:
        """A new context: s0 from defaults."""
        return self.diagram.CreateDefaultContext()

    def simulator(self, context: Context | None = None, *, restored: bool = False) -> Simulator:
        """A new Drake Simulator of the testbed with its own integrator settings.

        Args:
            restored: ``context`` continues another one; initialization events, which would overwrite its state, have
                happened before.
        """
        simulator = Simulator(self.diagram, context if context is not None else self.default_context())
        time = simulator.get_context().get_time()
        ApplySimulatorConfig(self.simulator_fields.config(), simulator)
        simulator.get_mutable_context().SetTime(time)
        if restored:
            simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        return simulator

    # -- addresses

    def variables(self) -> Variables:
        """Every element of s = [x, a], by address."""
        return self._variables

    def read(self, context: Context, address: str) -> Any:
        """The value of a variable, or of an output port (``path.port``), in ``context``."""
        return self.reader(address)(context)

    def write(self, context: Context, values: Mapping[str, Any]) -> None:
        """Sets variables by address."""
        self._variables.write(context, values)

    def reader(self, address: str) -> Callable[[Context], Any]:
        """Reads a variable, or an output port by ``path.port``, from any context.

        Raises:
            AddressError: there is neither.
        """
        if address in self._variables:
            return self._variables[address].get
        if address in self._ports:
            return _port_reader(*self._ports[address])
        hint = suggestion(address, [*self._variables, *self._ports])
        raise AddressError(f"there is no variable and no output port {address!r}{hint}")

    @cached_property
    def _ports(self) -> dict[str, tuple[System, OutputPort]]:
        ports = {}
        for path, system in [("", self.diagram), *_all_systems(self.diagram)]:
            for i in range(system.num_output_ports()):
                port = system.get_output_port(i)
                ports[f"{path}.{port.get_name()}".lstrip(".")] = (system, port)
        return ports

    # -- switches

    def positions(self, context: Context) -> dict[str, dict[str, str]]:
        """Where every switch stands: ``{"sense": {signal: position}, "act": {signal: position}}``."""
        sides = {"sense": self._sense, "act": self._act}
        return {side: {name: s.get(context) for name, s in switches.items()} for side, switches in sides.items()}

    def switch(
        self,
        context: Context,
        mode: str | None = None,
        *,
        sense: str | Mapping[str, str] | None = None,
        act: str | Mapping[str, str] | None = None,
    ) -> None:
        """Throws switches, at any time.

        Args:
            mode: all together: ``sim``, ``real``, ``shadow`` (sense real, act sim: the DPS listens to reality and acts
                on nothing real) or ``twin`` (both real, and the simulated actuators get the commands too).
            sense: ``sim`` or ``real`` for all sensor signals, or by signal.
            act: ``sim``, ``real`` or ``twin`` for all actuator signals, or by signal.

        Raises:
            ValueError: a mode, position or signal is unknown, or nothing feeds a sensor signal that would become
                real. No switch has been thrown then.
        """
        if mode is not None:
            check_mode(mode)
            if sense is not None or act is not None:
                raise ValueError(f"give either the mode ({mode}) or the positions of a side, not both")
            sense, act = MODES[mode]
        changes = [
            *self._changes("T_sense", self._sense, SENSE_POSITIONS, sense),
            *self._changes("T_act", self._act, ACT_POSITIONS, act),
        ]
        for selector, position in changes:
            name = selector.name.removeprefix(T_SENSE)
            if name != selector.name and position == REAL:
                port = self.diagram.GetInputPort(f"real.sense.{name}")
                if not port.HasValue(context):
                    raise ValueError(
                        f"nothing feeds real.sense.{name}: fix a value on that input port, or start a bridge, before "
                        "its switch is thrown to real"
                    )
        for selector, position in changes:
            selector.set(context, position)

    @staticmethod
    def _changes(
        side: str, selectors: Mapping[str, Selector], positions: tuple[str, ...], wanted: str | Mapping[str, str] | None
    ) -> list[tuple[Selector, str]]:
        if wanted is None:
            return []
        by_signal = dict.fromkeys(selectors, wanted) if isinstance(wanted, str) else wanted
        for name, position in by_signal.items():
            if name not in selectors:
                raise ValueError(f"{side} has no signal {name!r}; it has: {', '.join(selectors)}")
            if position not in positions:
                raise ValueError(f"{side}.{name} goes to one of {', '.join(positions)}, not to {position!r}")
        return [(selectors[name], position) for name, position in by_signal.items()]

    # -- s(t) as a whole

    def snapshot(self, context: Context) -> Snapshot:
        """s(t) as named arrays."""
        record = self.scenario.record() if self.scenario is not None else {}
        return snapshots.take(self.diagram, context, self._variables, scenario=record)

    def restore(self, context: Context, snapshot: Snapshot) -> None:
        """Makes ``context`` continue from ``snapshot``: s_sim(t0) from a file.

        Raises:
            SnapshotError: it is of another scenario, or of a testbed that is built in another way.
        """
        if self.scenario is not None and snapshot.scenario:
            mine, theirs = self.scenario.record(), snapshot.scenario
            keys = ["scenario"] if theirs["scenario"] != mine["scenario"] else [*mine, *(theirs.keys() - mine.keys())]
            differing = [
                f"{key}: {theirs.get(key, 'nothing')!r} there, {mine.get(key, 'nothing')!r} here"
                for key in keys
                if key not in mine or key not in theirs or mine[key] != theirs[key]
            ]
            if differing:
                raise SnapshotError(f"the snapshot is of another scenario ({'; '.join(differing)})")
        snapshots.apply(snapshot, self.diagram, context, self._variables)

    def start_from_belief(self, context: Context) -> None:
        """s_sim(t0) from s_dps(t): sets the simulated world to what the DPS in ``context`` believes.

        An estimate beyond the bounds of what it is about (a joint a little past its stop) is taken to the bound.

        Raises:
            ValueError: the testbed declares no belief, or a variable refuses what is believed of it.
        """
        if not self._beliefs:
            raise ValueError("this testbed does not declare what of its DPS sets its simulated world (see `believe`)")
        self.write(
            context,
            {
                belief.target: np.clip(belief.value(self._variables, context), *self._variables[belief.target].bounds)
                for belief in self._beliefs
            },
        )

    def copier_from(self, source: VirtualTestbed) -> StateCopier:
        """Copies contexts of ``source`` (this testbed, or another of the same scenario) to contexts of this one."""
        return StateCopier(source.diagram, source.variables(), self.diagram, self._variables)

    @cached_property
    def python_systems(self) -> tuple[str, ...]:
        """Paths of the systems that are written in Python and have work to do while time runs."""
        # The board of the switches has no work to do.
        return tuple(path for path, system in leaves(self.diagram) if is_python(system) and path != BOARD)


def _all_systems(diagram: Diagram, path: str = "") -> list[tuple[str, System]]:
    found = []
    for system in diagram.GetSystems():
        below = f"{path}.{system.get_name()}".lstrip(".")
        found.append((below, system))
        if isinstance(system, Diagram):
            found += _all_systems(system, below)
    return found


def _port_reader(system: System, port: OutputPort) -> Callable[[Context], Any]:
    if port.get_data_type() == PortDataType.kVectorValued:
        return lambda context: np.array(port.Eval(system.GetMyContextFromRoot(context)))
    return lambda context: port.EvalAbstract(system.GetMyContextFromRoot(context)).Clone().get_value()
