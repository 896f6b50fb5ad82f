"""Builds a virtual testbed: the simulated world around a DPS, behind switches."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Diagram, DiagramBuilder, InputPort, OutputPort, System

from vtbdrake.common.argument_checks import as_addresses
from vtbdrake.drake_workarounds.kept_meshcats import keep_meshcat
from vtbdrake.state.codecs import abstract_state
from vtbdrake.state.systems import class_name, is_plant, is_python, is_scene_graph, leaves, name_systems
from vtbdrake.testbed.integrator import controls_error
from vtbdrake.testbed.signal import Interface, Signal, SignalError
from vtbdrake.testbed.switch import COMMAND, Switches
from vtbdrake.testbed.testbed import MODES, BeliefRule, VirtualTestbed, check_mode

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat, SceneGraph, SceneGraphConfig
    from pydrake.multibody.plant import MultibodyPlant, MultibodyPlantConfig

    from vtbdrake.testbed.scenario import Scenario

_log = logging.getLogger(__name__)

ROLES = ("sense", "sys", "act", "env")
S = TypeVar("S", bound=System)
P = TypeVar("P", InputPort, OutputPort)


_PORTS = "Its ports have the names of the signals: export them under these names, from a Diagram"
# Systems of Drake that copies of a context cannot continue, and what to use instead.
_LISTENS = "which receives data from outside the Diagram: feed the DPS by a real port (see Bridge), or leave it out"
_SENDS = "which sends data out of the Diagram, from every copy of it, too: let a bridge send it (see Protocol)"
_REFUSED = {
    "RandomSource": "whose generator no copy can continue: compute noise from (seed, stream, tick), as the sensors in "
    "vtbdrake.components do",
    "RgbdSensorAsync": "which renders in a thread that no copy can continue: use an RgbdSensorDiscrete, or an "
    "RgbdSensor with a ZeroOrderHold behind it",
    "SchunkWsgTrajectoryGenerator": "which keeps its trajectory in itself, where no copy can find it: use a "
    "SchunkWsgPositionController",
    "LcmSubscriberSystem": _LISTENS,
    "LcmInterfaceSystem": _LISTENS,
    "LcmPublisherSystem": _SENDS,
    "LcmScopeSystem": _SENDS,
    "JointSliders": _LISTENS,
    "MeshcatPoseSliders": _LISTENS,
}


def _draws(system: System) -> bool:
    """Return whether a system is one of Drake's visualizers, which draw whatever context is simulated."""
    return not is_python(system) and class_name(system).endswith("Visualizer")


class VirtualTestbedBuilder:
    """Adds the parts of Figure 4 one by one; `build` puts the switches between them.

    Args:
        interface: The signals of the DPS.
        simulator_config: The settings of the integration; Drake's defaults if left out.

    Attributes:
        diagram_builder: The DiagramBuilder of the testbed, for functions of Drake that take one.
        plant, scene_graph: Plant and SceneGraph of the simulated world; None until `add_plant` adds them.
        sensors, actuators: The ports of the simulated world, by signal.
        belief_rules: The rules that `believe` has declared.
        place_of: Returns where the default position of a joint is declared, of model and joint; for messages.
    """

    def __init__(self, interface: Interface, *, simulator_config: SimulatorConfig | None = None) -> None:
        if not isinstance(interface, Interface):
            raise SignalError(
                f"a testbed has an Interface(sense, act, commands), not {interface!r}: does interface() return it?"
            )
        self.interface = interface
        self.simulator_config = simulator_config or SimulatorConfig()
        self.place_of: Callable[[str, str], str] = lambda model, joint: ""
        self.diagram_builder = DiagramBuilder()
        self.plant: MultibodyPlant | None = None
        self.scene_graph: SceneGraph | None = None
        self._dps: System | None = None
        self.sensors: dict[str, OutputPort] = {}
        self.actuators: dict[str, InputPort] = {}
        self._raising: dict[str, str] = {}  # by actuator signal, see `sim_actuator`
        self._commands: dict[str, OutputPort] = {}
        self._places: dict[str, str] = {}
        self.belief_rules: list[BeliefRule] = []

    def add(self, role: str, name: str, system: S) -> S:
        """Add a part of the simulated world under the name ``sim.<role>.<name>``, and return it.

        Args:
            role: ``sense``, ``sys``, ``act`` or ``env``.
            name: Unique within the role.
            system: Any System; a Diagram, too.
        """
        if role not in ROLES:
            raise ValueError(f"the role of {name} is one of {', '.join(ROLES)}, not {role!r}")
        if not isinstance(name, str) or not name:
            raise ValueError(f"a part of the simulated world has a name, a text, not {name!r}")
        if not isinstance(system, System):
            raise ValueError(f"sim.{role}.{name} is a System, not {system!r}")
        return self.diagram_builder.AddNamedSystem(f"sim.{role}.{name}", system)

    def connect(self, source: OutputPort, target: InputPort) -> None:
        """Connect an output port of the simulated world to an input port, like `DiagramBuilder.Connect`.

        Args:
            source: An output port of a system that was added.
            target: An input port of a system that was added.
        """
        self.diagram_builder.Connect(source, target)

    def add_plant(
        self, config: MultibodyPlantConfig | None = None, scene_graph_config: SceneGraphConfig | None = None
    ) -> tuple[MultibodyPlant, SceneGraph]:
        """Add the MultibodyPlant, named ``plant``, and its SceneGraph, like Drake's `AddMultibodyPlant`.

        Args:
            config: Config of the plant; by default Drake's (a discrete plant). ``time_step=0`` makes it continuous.
            scene_graph_config: Config of the SceneGraph; by default Drake's.
        """
        if self.plant is not None:
            raise ValueError("the testbed has a plant already: add bodies in contact with its bodies to that plant")
        from pydrake.geometry import SceneGraphConfig
        from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig

        self.plant, self.scene_graph = AddMultibodyPlant(
            config or MultibodyPlantConfig(), scene_graph_config or SceneGraphConfig(), self.diagram_builder
        )
        self.plant.set_name("plant")
        self.scene_graph.set_name("scene_graph")
        return self.plant, self.scene_graph

    def place(self, instance: str, *, role: str) -> None:
        """Assign a model instance of the plant to the role ``sys`` or ``env``.

        By default, a model instance that is fixed to the world and has no joints belongs to ``env``.

        Args:
            instance: Name of the model instance.
            role: ``sys`` or ``env``.
        """
        if role not in ("sys", "env"):
            raise ValueError(f"model instance {instance} belongs to sys or env, not to {role!r}")
        self._places[instance] = role

    def add_sensor(
        self,
        signal: str,
        sensor: S,
        *,
        name: str = "",
        output: str = "",
        inputs: Mapping[str, OutputPort] | None = None,
    ) -> S:
        """Add a simulated sensor, connect its inputs to the plant and offer its output as a sensor signal.

        Args:
            signal: The sensor signal of the interface.
            sensor: A System whose input ports have the names of output ports of the plant, or of ``inputs``, such as
                the sensors in `vtbdrake.components.sensors`; ``geometry_query``, of a camera, is the SceneGraph's.
                What may stay unconnected is in the sensor's attribute ``optional_inputs``, if it has one.
            name: The sensor is added as ``sim.sense.<name>``; by default, it has the name of the signal.
            output: The output port that is the signal; by default the only one.
            inputs: The ports that other inputs come from, by the name of the input: ``light`` and ``haze`` of a camera.

        Raises:
            ValueError: The testbed has no plant; nothing offers an input; or the output port is not known.
        """
        if self.plant is None:
            raise ValueError(f"the sensor {name or signal} measures a plant: call add_plant first")
        self.add("sense", name or signal, sensor)
        self._connect_inputs(sensor, inputs or {})
        names = [sensor.get_output_port(index).get_name() for index in range(sensor.num_output_ports())]
        if output not in names and (output or len(names) != 1):
            given = f", not {output!r}" if output else ""
            raise ValueError(f"output= of {class_name(sensor)}, for {signal}, is one of {', '.join(names)}{given}")
        self.sim_sensor(signal, sensor.GetOutputPort(output or names[0]))
        return sensor

    def _connect_inputs(self, sensor: System, inputs: Mapping[str, OutputPort]) -> None:
        """Connect the inputs of a sensor to the ports of their names: given ones, the plant's, the SceneGraph's."""
        assert self.plant is not None and self.scene_graph is not None
        sources = {"geometry_query": self.scene_graph.get_query_output_port()}
        offered = [self.plant.get_output_port(index) for index in range(self.plant.num_output_ports())]
        sources |= {port.get_name(): port for port in offered} | dict(inputs)
        ports = [sensor.get_input_port(index) for index in range(sensor.num_input_ports())]
        for port in ports:
            if port.get_name() in sources:
                self.connect(sources[port.get_name()], port)
            elif port.get_name() not in getattr(sensor, "optional_inputs", ()):
                raise ValueError(
                    f"neither plant nor SceneGraph has an output {port.get_name()}, which {class_name(sensor)} needs: "
                    f"give inputs={{{port.get_name()!r}: port}}"
                )
        names = [port.get_name() for port in ports]
        if unknown := [name for name in inputs if name not in names]:
            raise ValueError(f"{class_name(sensor)} has no input {unknown[0]!r}; it has: {', '.join(names) or 'none'}")

    def sim_sensor(self, name: str, port: OutputPort) -> None:
        """Offer ``port`` as the simulated sensor signal ``name``.

        Args:
            name: Name of a sensor signal of the interface.
            port: The output port that measures it.
        """
        self._claim(self.interface.sense, name, "sensor", self.sensors, port, OutputPort)

    def sim_actuator(self, name: str, port: InputPort, *, raises_at: str = "") -> None:
        """Lead the actuator signal ``name`` to ``port`` of the simulated world.

        Args:
            name: The actuator signal of the interface.
            port: The port that gets its commands.
            raises_at: Commands at which what lies behind the port raises an exception: ``"nan"``, as a plant does, or
                ``"not finite"``. Else, a check is added where a command that is not finite would stop the integration.
        """
        if raises_at not in ("", "nan", "not finite"):
            raise ValueError(f"actuator signal {name}: raises_at is 'nan' or 'not finite', not {raises_at!r}")
        self._raising[name] = raises_at
        self._claim(self.interface.act, name, "actuator", self.actuators, port, InputPort)

    def command(self, name: str, port: OutputPort) -> None:
        """Take the command ``name`` from ``port``, instead of the variable ``u.<name>``.

        Args:
            name: Name of a command of the interface.
            port: The output port that shows its value.
        """
        self._claim(self.interface.commands, name, "command", self._commands, port, OutputPort)

    @staticmethod
    def _claim(
        signals: Sequence[Signal], name: str, kind: str, taken: dict[str, P], port: P, kind_of_port: type[P]
    ) -> None:
        """Check that ``port`` can carry the signal ``name``, which has no port yet, and add it to ``taken``."""
        signals_by_name = {signal.name: signal for signal in signals}
        if name not in signals_by_name:
            names = ", ".join(signals_by_name) or "none"
            raise SignalError(f"the interface has no {kind} signal {name!r}; it has: {names}")
        if not isinstance(port, kind_of_port):
            raise SignalError(f"the {kind} signal {name} takes an {kind_of_port.__name__} of a system, not {port!r}")
        if name in taken:
            raise SignalError(f"two ports are given for the {kind} signal {name}")
        signals_by_name[name].check_port(port, str(port.get_system().get_name()))
        taken[name] = port

    def set_dps(self, dps: S) -> S:
        """Add the data processing system: one System whose ports have the names of the interface's signals."""
        if not isinstance(dps, System):
            raise SignalError(f"the DPS is a System, not {dps!r}: does make_dps return it, built?")
        if self._dps is not None:
            raise SignalError("the testbed has a DPS already; put several parts into one Diagram")
        self._check_ports(dps)
        self._dps = self.diagram_builder.AddNamedSystem("dps", dps)
        return dps

    def _check_ports(self, dps: System) -> None:
        inputs = {dps.get_input_port(i).get_name(): dps.get_input_port(i) for i in range(dps.num_input_ports())}
        outputs = {dps.get_output_port(i).get_name(): dps.get_output_port(i) for i in range(dps.num_output_ports())}
        port_names = ", ".join(inputs) or "none"
        for signal in [*self.interface.sense, *self.interface.commands]:
            if signal.name not in inputs:
                raise SignalError(f"the DPS has no input port {signal.name}; it has: {port_names}. {_PORTS}")
            signal.check_port(inputs.pop(signal.name), "the DPS")
        for signal in self.interface.act:
            if signal.name not in outputs:
                has = ", ".join(outputs) or "none"
                raise SignalError(f"the DPS has no output port {signal.name}; it has: {has}. {_PORTS}")
            signal.check_port(outputs[signal.name], "the DPS")
        if inputs:
            raise SignalError(f"the interface has no signal for the DPS's input port {', '.join(inputs)}")

    def believe(
        self,
        target: str | Sequence[str],
        *,
        of: Sequence[str],
        by: Callable[..., Any] | None = None,
        age: float = 0.0,
        period: float | None = None,
    ) -> None:
        """Declare which estimates of the DPS set which variables of the simulated world: s_sim(t0) from s_dps(t).

        Args:
            target: Address of the simulated variable; or of several, which one call of ``by`` determines.
            of: Addresses of the estimates.
            by: Function of the estimates that returns the target's value, or one value per target, such as an array
                with the positions of all joints; by default the value of the one estimate.
            age: Age of the estimates in seconds, when the DPS gets the sensor values that they come from. A sampled
                sensor, which shows its state, is one period late. Predictions from the belief need the age.
            period: Sample period of the estimates in seconds; 0 if the DPS computes them at any time. If it is given,
                ``by`` gets the keyword ``late``, the present age of the estimates in seconds, and returns the present
                value of the target, for example ``lambda q, v, *, late: q + late * v``. So a mental world begins at the
                present, and not at an instant that lies ``age`` and up to a period before it.
        """
        self.belief_rules.append(
            BeliefRule(
                (target,) if isinstance(target, str) else as_addresses("what is believed", target),
                as_addresses(f"what the belief about {target} is of", of),
                by,
                age,
                period,
            )
        )

    def build(
        self, *, mode: str = "sim", scenario: Scenario | None = None, meshcat: Meshcat | None = None, prefix: str = ""
    ) -> VirtualTestbed:
        """Put the switches between the parts and build the Diagram.

        Args:
            mode: Initial position of the switches: ``sim``, ``shadow``, ``real`` or ``twin``.
            scenario: The scenario that the testbed is built from, if any.
            meshcat: Draws the simulated world while it runs.
            prefix: Path in Meshcat under which the world is drawn; ``visualizer`` by default.

        Raises:
            SignalError: A signal of the interface is missing on one side.
        """
        check_mode(mode)
        if self._dps is None:
            raise SignalError("the testbed has no DPS: call set_dps")
        self.finish_world()
        sense_position, act_position = MODES[mode]
        u = {s.name: s.default_vector() for s in self.interface.commands if s.name not in self._commands}
        guarded = self._guarded_commands()
        switches = Switches(
            self.diagram_builder, self.interface, sense_position, act_position, self._dps, u, guarded=guarded
        )
        self._connect_switches(switches, self._dps)
        commands = tuple(switches.commands.variables(self.interface.commands))
        for command in commands:
            command.check(u[command.address.removeprefix(COMMAND)].reshape(command.shape))
        if meshcat is not None:
            if self.scene_graph is None:
                raise ValueError("there is nothing to draw: the testbed has no plant with a SceneGraph")
            from pydrake.geometry import MeshcatVisualizer, MeshcatVisualizerParams

            parameters = MeshcatVisualizerParams(prefix=prefix or "visualizer")
            MeshcatVisualizer.AddToBuilder(self.diagram_builder, self.scene_graph, meshcat, parameters)
        diagram = self.build_diagram("vtb")
        if meshcat is not None:
            keep_meshcat(meshcat, diagram)
        return VirtualTestbed(
            self,
            self._dps,
            switches,
            diagram,
            commands=commands,
            scenario=scenario,
            visualized=any(_draws(system) for _, system in leaves(diagram)),
            guarded=bool(guarded),
        )

    def build_diagram(self, name: str) -> Diagram:
        """Build the Diagram of all systems that have been added.

        Systems without a name are named by their class, see `name_systems`.

        Raises:
            ValueError: Two systems have one name, or copies of the state could not continue a system.
        """
        names = [system.get_name() for system in self.diagram_builder.GetSystems()]
        for twin in sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"two systems of the testbed are called {twin}: rename one of them with set_name")
        diagram = self.diagram_builder.Build()
        diagram.set_name(name)
        name_systems(diagram)
        paths: set[str] = set()
        for path, system in leaves(diagram):
            if path in paths:
                raise ValueError(f"two systems of the testbed have the path {path}: rename one, or its parent")
            paths.add(path)
            kind = class_name(system)
            if kind in _REFUSED:
                raise ValueError(f"{path} is a {kind}, {_REFUSED[kind]}")
            if not is_scene_graph(system):  # Its default context is costly, and its state is known.
                abstract_state(path, system, system.CreateDefaultContext())
        return diagram

    def finish_world(self) -> None:
        """Finalize the plant: the one of `add_plant`, or one that Drake's own functions have added as ``plant``.

        Raises:
            SignalError: The simulated world lacks a signal of the interface.
        """
        for signal in self.interface.sense:
            if signal.name not in self.sensors:
                raise SignalError(f"no simulated sensor offers {signal.name}: call sim_sensor({signal.name!r}, port)")
        for signal in self.interface.act:
            if signal.name not in self.actuators:
                raise SignalError(
                    f"no simulated actuator takes {signal.name}: call sim_actuator({signal.name!r}, port)"
                )
        if self.plant is None:
            systems = {system.get_name(): system for system in self.diagram_builder.GetSystems()}
            plant, scene_graph = systems.get("plant"), systems.get("scene_graph")
            if plant is not None and is_plant(plant):
                self.plant = plant
                self.scene_graph = scene_graph if scene_graph is not None and is_scene_graph(scene_graph) else None
        if self.plant is not None:
            if not self.plant.is_finalized():
                self.plant.Finalize()
            for model, joint, problem in _positions_outside(self.plant):
                place = self.place_of(model, joint)
                _warn_once(f"{place}: {problem}" if place else problem)

    def _guarded_commands(self) -> dict[str, bool]:
        """Return the actuator signals whose commands are checked -> whether what they enter, as a plant, refuses NaN.

        NaN and infinity make the time derivatives of a continuous world useless, and an integrator with error control
        then shortens its step without end, in a loop that nothing can interrupt; CENIC raises instead.
        """
        continuous = any(system.num_continuous_states() for system in self.diagram_builder.GetSystems())
        if not (continuous and controls_error(self.simulator_config)):
            return {}
        vectors = [signal.name for signal in self.interface.act if signal.is_vector]
        return {
            name: self._raising.get(name) == "nan" or is_plant(self.actuators[name].get_system())
            for name in vectors
            if self._raising.get(name) != "not finite"
        }

    def _connect_switches(self, switches: Switches, dps: System) -> None:
        for name, sensor in self.sensors.items():
            self.connect(sensor, switches.sim_sense[name])
            self.diagram_builder.ExportInput(switches.real_sense[name], f"real.sense.{name}")
            self.connect(switches.dps_sense[name], dps.GetInputPort(name))
        for name, actuator in self.actuators.items():
            self.connect(switches.sim_act[name], actuator)
            self.diagram_builder.ExportOutput(switches.real_act[name], f"real.act.{name}")
        if self.actuators:
            self.diagram_builder.ExportOutput(switches.active, "real.act.active")
        for name, port in {**switches.commands.ports, **self._commands}.items():
            self.connect(port, dps.GetInputPort(name))

    def plant_roles(self) -> dict[str, str]:
        """Return the role of every model instance of the plant: ``sys`` or ``env``."""
        if self.plant is None:
            return {}
        from pydrake.multibody.tree import ModelInstanceIndex

        roles = {}
        for index in range(self.plant.num_model_instances()):
            instance = ModelInstanceIndex(index)
            bodies = self.plant.GetBodyIndices(instance)
            fixed = all(self.plant.IsAnchored(self.plant.get_body(body)) for body in bodies)
            joints = self.plant.num_velocities(instance)
            roles[self.plant.GetModelInstanceName(instance)] = "env" if fixed and not joints else "sys"
        for name, role in self._places.items():
            if name not in roles:
                raise ValueError(f"the plant has no model instance {name}; it has: {', '.join(roles)}")
            roles[name] = role
        return roles


def _positions_outside(plant: MultibodyPlant) -> Iterator[tuple[str, str, str]]:
    """Yield (model, joint, problem) for every joint of a plant whose default position is outside its limits."""
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        q, lower, upper = joint.default_positions(), joint.position_lower_limits(), joint.position_upper_limits()
        if ((q < lower) | (q > upper)).any():
            model = plant.GetModelInstanceName(joint.model_instance())
            unit = {"revolute": " rad", "prismatic": " m"}.get(joint.type_name(), "")
            start, low, high = (np.array2string(each, precision=6).strip("[] ") for each in (q, lower, upper))
            yield (
                model,
                joint.name(),
                f"the default position of {joint.name()} of {model} is {start}{unit}, outside its limits, {low} to "
                f"{high}{unit}: give it another one, or correct the limits",
            )


@cache
def _warn_once(message: str) -> None:
    # A study builds the same testbed again and again.
    _log.warning("%s", message)
