"""Scenarios with the fields of Drake's example ``hardware_sim``, so that its YAML files describe simulated worlds."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Union

import numpy as np
import pydrake.manipulation
from pydrake.geometry import (
    MakeRenderEngineGl,
    MakeRenderEngineGltfClient,
    MakeRenderEngineVtk,
    RenderEngine,
    RenderEngineGlParams,
    RenderEngineGltfClientParams,
    RenderEngineVtkParams,
    SceneGraphConfig,
)
from pydrake.lcm import DrakeLcmParams
from pydrake.multibody.parsing import (
    GetScopedFrameByName,
    ModelDirective,
    ModelDirectives,
    ModelInstanceInfo,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import System
from pydrake.systems.lcm import ApplyLcmBusConfig
from pydrake.systems.sensors import CameraConfig, RgbdSensor, RgbdSensorDiscrete
from pydrake.visualization import VisualizationConfig

from vtbdrake.testbed.builder import VirtualTestbedBuilder
from vtbdrake.testbed.scenario import Scenario, ScenarioError

_log = logging.getLogger(__name__)
# JointStiffnessDriver is newer than drake 1.51.
_DRIVERS = ("IiwaDriver", "JointStiffnessDriver", "SchunkWsgDriver", "ZeroForceDriver")
Driver: Any = Union[tuple(vars(pydrake.manipulation)[n] for n in _DRIVERS if n in dir(pydrake.manipulation))]  # noqa: UP007


@dataclass
class HardwareSimScenario(Scenario):
    """A scenario whose world is described like that of Drake's ``examples/hardware_sim``.

    A file of hardware_sim loads as it is: ``load_scenario("package.module:Class@example_scenarios.yaml#Demo")``. A
    subclass defines `interface` and `make_dps`, and connects the signals to the world::

        def add_world(self, builder):
            self.add_models(builder)
            cameras = self.add_cameras(builder)
            builder.sim_sensor("image", cameras["oracular_view"].GetOutputPort("color_image"))
            builder.sim_actuator("torque", builder.plant.get_actuation_input_port())

    Some fields are read and kept, but not used: the switches and a bridge replace ``lcm_buses`` and all
    ``model_drivers`` but the `IiwaDriver` (see `add_drivers`), ``build(meshcat=...)`` replaces ``visualization``, and
    the horizon of a rollout replaces ``simulation_duration``. The world has the default values, so that ``random_seed``
    is not used either.

    Attributes:
        simulator_config, plant_config, scene_graph_config: As in hardware_sim; the defaults are Drake's.
        directives: The models, as for `ProcessModelDirectives`.
        cameras: Cameras by any name; ``CameraConfig.name`` is the name in the Diagram.
        initial_position: Positions of joints, by joint, by model instance; they override those of the directives.
    """

    plant_config: MultibodyPlantConfig = field(default_factory=MultibodyPlantConfig)
    scene_graph_config: SceneGraphConfig = field(default_factory=SceneGraphConfig)
    directives: list[ModelDirective] = field(default_factory=list)
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    initial_position: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    random_seed: int = 0
    simulation_duration: float | None = None
    lcm_buses: dict[str, DrakeLcmParams] = field(default_factory=dict)
    model_drivers: dict[str, Driver] = field(default_factory=dict)
    visualization: VisualizationConfig = field(default_factory=VisualizationConfig)

    def add_models(self, builder: VirtualTestbedBuilder) -> list[ModelInstanceInfo]:
        """Add the plant with the models of the directives at their initial positions, and finalize it.

        Returns:
            The models that the directives have added.

        Raises:
            ScenarioError: A directive or an initial position does not fit.
        """
        # A plant applies zero force by itself; add_drivers adds the iiwas.
        simulated = ("ZeroForceDriver", "IiwaDriver")
        unused = [name for name, driver in self.model_drivers.items() if type(driver).__name__ not in simulated]
        if unused:
            _log.warning(
                "the model_drivers of %s are not simulated: connect an actuator signal to these models",
                ", ".join(unused),
            )
        plant, _ = builder.add_plant(self.plant_config, self.scene_graph_config)
        try:
            models = ProcessModelDirectives(ModelDirectives(directives=self.directives), Parser(plant))
            plant.Finalize()
            pydrake.manipulation.ApplyNamedPositionsAsDefaults(self.initial_position, plant)
        except RuntimeError as error:
            raise ScenarioError(f"{type(self).__name__}: the models cannot be added: {error}") from error
        return list(models)

    def add_drivers(self, builder: VirtualTestbedBuilder, models: Sequence[ModelInstanceInfo]) -> dict[str, System]:
        """Add the KUKA iiwas of ``model_drivers`` as Drake simulates them with their control cabinets.

        A command port, ``position`` or ``torque``, is that of an actuator signal::

            driver = self.add_drivers(builder, self.add_models(builder))["iiwa"]
            builder.sim_actuator("joint_torque", driver.GetInputPort("torque"))
            builder.sim_sensor("joint_position", driver.GetOutputPort("position_measured"))

        The driver compensates gravity, with the hand that its ``hand_model_name`` names. Torques at its output ports
        have the sign of the plant; maps give messages the sign of an iiwa (`vtbdrake.lcm.iiwa_status`).

        Args:
            builder: The builder to which `add_models` has added the models.
            models: What `add_models` has returned.

        Returns:
            The systems ``sim.act.<model>``, of the class `SimIiwaDriver`, by model.

        Raises:
            ScenarioError: A driver does not fit its model.
        """
        drivers = {
            name: driver
            for name, driver in self.model_drivers.items()
            if isinstance(driver, pydrake.manipulation.IiwaDriver)
        }
        diagram_builder, by_name = builder.diagram_builder, {model.model_name: model for model in models}
        # On these buses Drake adds no systems that send or receive.
        silent = {driver.lcm_bus: DrakeLcmParams(lcm_url="memq://null") for driver in drivers.values()}
        buses = ApplyLcmBusConfig(silent, diagram_builder)
        for name, driver in drivers.items():
            try:
                pydrake.manipulation.ApplyDriverConfig(driver, name, builder.plant, by_name, buses, diagram_builder)
            except RuntimeError as error:
                raise ScenarioError(f"{type(self).__name__}.model_drivers.{name} cannot be added: {error}") from error
            diagram_builder.GetMutableSubsystemByName(name).set_name(f"sim.act.{name}")
        return {name: diagram_builder.GetSubsystemByName(f"sim.act.{name}") for name in drivers}

    def add_cameras(self, builder: VirtualTestbedBuilder) -> dict[str, RgbdSensorDiscrete]:
        """Add the cameras to the models that `add_models` has added.

        A camera takes an image every ``1 / fps`` seconds, and holds it. Its output ports are ``color_image``,
        ``depth_image_32f``, ``depth_image_16u``, ``label_image`` and ``body_pose_in_world``.

        Returns:
            The cameras ``sim.sense.<CameraConfig.name>``, by their keys in ``cameras``.

        Raises:
            ScenarioError: A camera has an offset or a delay, which `RgbdSensorDiscrete` does not have.
        """
        added = {}
        for key, config in self.cameras.items():
            if config.capture_offset or config.output_delay:
                raise ScenarioError(
                    f"{type(self).__name__}.cameras.{key} has a capture_offset or output_delay: set both to 0, and put "
                    "a DiscreteTimeDelay behind the camera"
                )
            camera = RgbdSensorDiscrete(self._sensor(builder, config), 1.0 / config.fps, config.label)
            added[key] = builder.add("sense", config.name, camera)
            assert builder.scene_graph is not None
            builder.connect(builder.scene_graph.get_query_output_port(), camera.query_object_input_port())
        return added

    def _sensor(self, builder: VirtualTestbedBuilder, config: CameraConfig) -> RgbdSensor:
        plant, scene_graph = builder.plant, builder.scene_graph
        if plant is None or scene_graph is None:
            raise ScenarioError("cameras need a plant: call add_models first")
        if not scene_graph.HasRenderer(config.renderer_name):
            scene_graph.AddRenderer(config.renderer_name, _renderer(config))
        base = config.X_PB.base_frame
        parent = GetScopedFrameByName(plant, base) if base else plant.world_frame()
        X_PB = parent.GetFixedPoseInBodyFrame() @ config.X_PB.GetDeterministicValue()
        color, depth = config.MakeCameras()
        return RgbdSensor(plant.GetBodyFrameIdOrThrow(parent.body().index()), X_PB, color, depth)


def _renderer(config: CameraConfig) -> RenderEngine:
    makers = {
        RenderEngineVtkParams: MakeRenderEngineVtk,
        RenderEngineGlParams: MakeRenderEngineGl,
        RenderEngineGltfClientParams: MakeRenderEngineGltfClient,
    }
    renderer = config.renderer_class
    if isinstance(renderer, str):
        named = {f"RenderEngine{name}": globals()[f"RenderEngine{name}Params"] for name in ("Vtk", "Gl", "GltfClient")}
        if renderer not in ("", *named):
            raise ScenarioError(f"the renderer_class of {config.name} is one of {', '.join(named)}, not {renderer!r}")
        rgb = config.background
        renderer = (
            RenderEngineVtkParams(default_clear_color=[rgb.r(), rgb.g(), rgb.b()])
            if not renderer
            else named[renderer]()
        )
    return makers[type(renderer)](renderer)
