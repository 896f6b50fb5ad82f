"""What Drake's ``examples/hardware_sim/hardware_sim.py`` does with a station's file, in plain Drake."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from drake import lcmt_schunk_wsg_command
from pydrake.common.value import Value
from pydrake.common.yaml import yaml_load_typed
from pydrake.geometry import SceneGraphConfig
from pydrake.lcm import DrakeLcm, DrakeLcmParams
from pydrake.manipulation import (
    ApplyDriverConfigs,
    ApplyNamedPositionsAsDefaults,
    IiwaDriver,
    SchunkWsgDriver,
    ZeroForceDriver,
)
from pydrake.multibody.parsing import ModelDirective, ModelDirectives, Parser, ProcessModelDirectives
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder, OutputPort, System
from pydrake.systems.lcm import ApplyLcmBusConfig, LcmBuses, LcmInterfaceSystem
from pydrake.systems.primitives import ConstantValueSource, PortSwitch
from pydrake.systems.sensors import ApplyCameraConfig, CameraConfig


@dataclass
class Scenario:
    """The fields of hardware_sim, with its defaults; as fast as possible instead of in real time."""

    simulator_config: SimulatorConfig = field(
        default_factory=lambda: SimulatorConfig(max_step_size=1e-3, accuracy=1.0e-2, target_realtime_rate=0.0)
    )
    plant_config: MultibodyPlantConfig = field(default_factory=MultibodyPlantConfig)
    scene_graph_config: SceneGraphConfig = field(default_factory=SceneGraphConfig)
    directives: typing.List[ModelDirective] = field(default_factory=list)  # noqa: UP006 - what Drake's reader knows
    lcm_buses: typing.Mapping[str, DrakeLcmParams] = field(default_factory=lambda: {"default": DrakeLcmParams()})
    model_drivers: typing.Mapping[str, typing.Union[IiwaDriver, SchunkWsgDriver, ZeroForceDriver]] = field(  # noqa: UP007
        default_factory=dict
    )
    cameras: typing.Mapping[str, CameraConfig] = field(default_factory=dict)
    initial_position: typing.Dict[str, typing.Dict[str, np.ndarray]] = field(default_factory=dict)  # noqa: UP006


# Drake's reader needs types.
for _item in Scenario.__dataclass_fields__.values():
    _item.type = typing.get_type_hints(Scenario)[_item.name]


@dataclass
class Plain:
    """The loop of hardware_sim.

    Attributes:
        simulator: Its Simulator.
        plant: Its plant.
        bus: Its bus, if it is not one of the file.
    """

    simulator: Simulator
    plant: MultibodyPlant
    bus: DrakeLcm | None

    def states(self, times: np.ndarray) -> np.ndarray:
        """Advance to each of the times, and return the plant's states there."""
        context, states = self.simulator.get_context(), []
        for time in times:
            self.simulator.AdvanceTo(time)
            states.append(self.plant.GetPositionsAndVelocities(self.plant.GetMyContextFromRoot(context)))
        return np.array(states)


def build(
    file: Path,
    key: str,
    *,
    urls: Mapping[str, str],
    bus: DrakeLcm | None = None,
    grip: lcmt_schunk_wsg_command | None = None,
    sources: Mapping[str, System] | None = None,
    switched: bool = False,
    cameras: bool = False,
    rate: float = 0.0,
    offset: float = 0.0,
) -> Plain:
    """Build the loop of hardware_sim.

    Args:
        file: The file.
        key: The station in it.
        urls: The URL of the LCM bus of each driver, by model.
        bus: The bus of all drivers instead.
        grip: A command that waits on the gripper's bus.
        sources: What feeds the ports of the arm's driver, which has no bus.
        switched: Whether a port switch leads from each source to the driver, beside as many more as a station of an arm
            and a gripper has.
        cameras: Whether there are cameras, on the bus of the gripper.
        rate: The realtime rate.
        offset: How far all joints of the arm are from their initial positions, in rad.
    """
    scenario = yaml_load_typed(schema=Scenario, filename=str(file), child_name=key, defaults=Scenario())
    scenario.simulator_config.target_realtime_rate = rate
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(
        plant_config=scenario.plant_config, scene_graph_config=scenario.scene_graph_config, builder=builder
    )
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(file.with_name("package.xml")))
    models = ProcessModelDirectives(ModelDirectives(directives=scenario.directives), parser)
    ApplyNamedPositionsAsDefaults(input=scenario.initial_position, plant=plant)
    plant.Finalize()
    for name, url in urls.items():
        scenario.model_drivers[name].lcm_bus = f"bus_{name}"
        scenario.lcm_buses[f"bus_{name}"] = DrakeLcmParams(lcm_url=url)
    scenario.lcm_buses.pop("default")
    # What is to be published here needs a bus in Python.
    own, name = (bus, "default") if grip is None else (DrakeLcm(urls["wsg"]), "bus_wsg")
    scenario.lcm_buses.pop(name, None)
    buses = ApplyLcmBusConfig(lcm_buses=scenario.lcm_buses, builder=builder) if scenario.lcm_buses else LcmBuses()
    if own is not None:
        builder.AddSystem(LcmInterfaceSystem(own))
        buses.Add(name, own)
    ApplyDriverConfigs(
        driver_configs=scenario.model_drivers,
        sim_plant=plant,
        models_from_directives=models,
        lcm_buses=buses,
        builder=builder,
    )
    if cameras:
        for camera in scenario.cameras.values():
            camera.lcm_bus = "default" if bus else "bus_wsg"
            ApplyCameraConfig(config=camera, builder=builder, lcm_buses=buses)
    for name, source in (sources or {}).items():
        builder.AddSystem(source)
        output = source.get_output_port()
        if switched:
            output = _behind_switches(builder, output)
        builder.Connect(output, builder.GetSubsystemByName("iiwa").GetInputPort(name))
    simulator = Simulator(builder.Build())
    ApplySimulatorConfig(scenario.simulator_config, simulator)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    arm = plant.GetModelInstanceByName("iiwa")
    plant.SetPositions(context, arm, plant.GetPositions(context, arm) + offset)
    if own is not None and grip is not None:
        own.Publish("SCHUNK_WSG_COMMAND", grip.encode())
    return Plain(simulator, plant, own)


def _behind_switches(builder: DiagramBuilder, output: OutputPort) -> OutputPort:
    """Add a port switch for each of ten ports, and return the output of the first.

    Three commands have one to the world and one to the machine, four sensors have one to the DPS.
    """
    first, *_ = switches = [builder.AddSystem(PortSwitch(output.size())) for _ in range(2 * 3 + 4)]
    ports = [switch.DeclareInputPort("sim") for switch in switches]
    selector = builder.AddSystem(ConstantValueSource(Value(ports[0].get_index())))
    for switch, port in zip(switches, ports, strict=True):
        builder.Connect(selector.get_output_port(), switch.get_port_selector_input_port())
        builder.Connect(output, port)
    return first.get_output_port()
