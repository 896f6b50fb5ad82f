"""Scenarios with the fields of Drake's example ``hardware_sim``, so that its YAML files describe simulated worlds."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

import numpy as np
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
from pydrake.manipulation import (
    ApplyDriverConfig,
    ApplyNamedPositionsAsDefaults,
    IiwaDriver,
    SchunkWsgDriver,
    ZeroForceDriver,
)
from pydrake.multibody.parsing import (
    GetScopedFrameByName,
    ModelDirective,
    ModelDirectives,
    ModelInstanceInfo,
    PackageMap,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.framework import System
from pydrake.systems.lcm import ApplyLcmBusConfig
from pydrake.systems.sensors import CameraConfig, RgbdSensor, RgbdSensorDiscrete
from pydrake.visualization import VisualizationConfig

from vtbdrake.drake_workarounds.schunk_wsg import simulated_gripper
from vtbdrake.testbed.builder import VirtualTestbedBuilder
from vtbdrake.testbed.scenario import Scenario
from vtbdrake.testbed.scenario_identity import ScenarioError
from vtbdrake.testbed.testbed import VirtualTestbed

_log = logging.getLogger(__name__)
Driver: TypeAlias = IiwaDriver | SchunkWsgDriver | ZeroForceDriver


@dataclass
class HardwareSimScenario(Scenario):
    """A scenario whose world is described as in Drake's ``examples/hardware_sim``.

    A file of hardware_sim loads as it is: ``load_scenario("package.module:Class@example_scenarios.yaml#Demo")``. A
    subclass defines `interface` and `make_dps`, and connects the signals to the world::

        def add_world(self, builder):
            self.add_models(builder)
            cameras = self.add_cameras(builder)
            builder.sim_sensor("image", cameras["oracular_view"].GetOutputPort("color_image"))
            builder.sim_actuator("torque", builder.plant.get_actuation_input_port())

    `vtbdrake.station.Station` does all of this: it takes signals, drivers and messages from the file, too.

    Some fields are read and kept, but not used: the switches and a bridge replace ``lcm_buses``,
    ``build(meshcat=...)`` replaces ``visualization``, and the horizon of a rollout replaces ``simulation_duration``.
    The world has the default values, so that ``random_seed`` is not used either. `add_drivers` adds the
    ``model_drivers``.

    Attributes:
        simulator_config, plant_config, scene_graph_config: As in hardware_sim; the defaults are Drake's.
        directives: The models, as for `ProcessModelDirectives`.
        cameras: Cameras by any name; ``CameraConfig.name`` is the name in the Diagram.
        initial_position: Positions of joints, by joint, by model instance; they override the directives' positions.
        packages: Folders of packages, by name, for ``package://``. The package of the scenario's file is there: the one
            of the next ``package.xml`` in its folder or above.
        random_seed, simulation_duration, lcm_buses, visualization: As in hardware_sim; read and kept, but not used.
        model_drivers: The drivers of models, by model, for `add_drivers`.
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
    packages: dict[str, str] = field(default_factory=dict)

    _PLACES: ClassVar[tuple[str, ...]] = ("packages",)

    def set_origin(self, path: str, lines: Mapping[str, int]) -> None:
        super().set_origin(path, lines)
        for folder in Path(path).parents:
            if (folder / "package.xml").exists():
                package = PackageMap.MakeEmpty()
                package.AddPackageXml(str(folder / "package.xml"))
                self.packages = {**dict.fromkeys(package.GetPackageNames(), str(folder)), **self.packages}
                break

    def where_position(self, model: str, joint: str) -> str:
        if joint in self.initial_position.get(model, {}):
            return self.where(f"initial_position.{model}.{joint}")
        for index, directive in enumerate(self.directives):
            added = directive.add_model
            if added is not None and added.name == model:
                return self.where(f"directives.{index}.add_model.default_joint_positions.{joint}")
        return self.where("directives")

    def add_models(self, builder: VirtualTestbedBuilder) -> list[ModelInstanceInfo]:
        """Add the plant with the models of the directives at their initial positions, and finalize it.

        ``package://`` finds what Drake finds, the packages of ``ROS_PACKAGE_PATH``, and ``packages``.

        Returns:
            The models that the directives have added.

        Raises:
            ScenarioError: A directive or an initial position does not fit.
        """
        plant, _ = builder.add_plant(self.plant_config, self.scene_graph_config)
        return self.add_models_to(plant)

    def add_models_to(self, plant: MultibodyPlant) -> list[ModelInstanceInfo]:
        """Add the models to a plant at their initial positions, and finalize it; see `add_models`."""
        parser = Parser(plant)
        packages = parser.package_map()
        packages.PopulateFromRosPackagePath()
        for name, folder in self.packages.items():
            packages.Add(name, folder)
        try:
            models = ProcessModelDirectives(ModelDirectives(directives=self.directives), parser)
            plant.Finalize()
            ApplyNamedPositionsAsDefaults(self.initial_position, plant)
        except RuntimeError as error:
            raise ScenarioError(
                f"{self.where('directives')}: the models cannot be added: {error}{_remedy(str(error))}"
            ) from error
        return list(models)

    def add_drivers(self, builder: VirtualTestbedBuilder, models: Sequence[ModelInstanceInfo]) -> dict[str, System]:
        """Add the ``model_drivers``: arms and grippers as Drake simulates them with their control cabinets.

        A command port belongs to an actuator signal::

            driver = self.add_drivers(builder, self.add_models(builder))["iiwa"]
            builder.sim_actuator("joint_torque", driver.GetInputPort("torque"))
            builder.sim_sensor("joint_position", driver.GetOutputPort("position_measured"))

        An `IiwaDriver` becomes a `SimIiwaDriver` with the command ports ``position`` and ``torque`` of its control
        mode. It compensates gravity, with the hand that its ``hand_model_name`` names. Torques at its output ports have
        the sign of the plant; maps give messages the sign of an iiwa (`vtbdrake.lcm.iiwa_status`). A
        `SchunkWsgDriver` becomes a `simulated_gripper`. A `ZeroForceDriver` needs no system.

        Args:
            builder: The builder to which `add_models` has added the models.
            models: What `add_models` has returned.

        Returns:
            The systems ``sim.act.<model>``, by model.

        Raises:
            ScenarioError: A driver does not fit its model.
        """
        plant = builder.plant
        if plant is None:
            raise ScenarioError("drivers need a plant: call add_models first")
        self._check_drivers(models)
        for name, driver in self.model_drivers.items():
            if isinstance(driver, IiwaDriver):
                self._add_arm(builder, name, driver, models)
            elif isinstance(driver, SchunkWsgDriver):
                gripper = builder.add("act", name, simulated_gripper(driver))
                instance = plant.GetModelInstanceByName(name)
                for source, port in (
                    (plant.get_state_output_port(instance), "state"),
                    (plant.get_generalized_contact_forces_output_port(instance), "generalized_contact_forces"),
                ):
                    builder.connect(source, gripper.GetInputPort(port))
                builder.connect(gripper.GetOutputPort("actuation"), plant.get_actuation_input_port(instance))
        parts = builder.diagram_builder
        paths = {name: f"sim.act.{name}" for name in self.model_drivers}
        return {name: parts.GetSubsystemByName(path) for name, path in paths.items() if parts.HasSubsystemNamed(path)}

    def _check_drivers(self, models: Sequence[ModelInstanceInfo]) -> None:
        names = [model.model_name for model in models]
        for name, driver in self.model_drivers.items():
            kind = type(driver).__name__
            if isinstance(driver, IiwaDriver) and not 0.0 < driver.lcm_status_period < inf:
                raise ScenarioError(
                    f"{self.where(f'model_drivers.{name}.lcm_status_period')}: the lcm_status_period of {name} is a "
                    f"positive number of seconds, such as 0.005, not {driver.lcm_status_period:g}"
                )
            hand = driver.hand_model_name if isinstance(driver, IiwaDriver) else ""
            for model, field_name in ((name, f"model_drivers.{name}"), (hand, f"model_drivers.{name}.hand_model_name")):
                if model and model not in names:
                    raise ScenarioError(
                        f"{self.where(field_name)}: {kind} of {name} names the model {model!r}, which no add_model "
                        f"directive adds; there are: {', '.join(names) or 'none'}"
                    )

    def _check_cameras(self) -> None:
        for key, config in self.cameras.items():
            if not 0.0 < config.fps < inf:
                raise ScenarioError(
                    f"{self.where(f'cameras.{key}.fps')}: the fps of {key} is a positive number of images per second, "
                    f"not {config.fps:g}"
                )

    def _add_arm(
        self, builder: VirtualTestbedBuilder, name: str, driver: IiwaDriver, models: Sequence[ModelInstanceInfo]
    ) -> None:
        parts, by_name = builder.diagram_builder, {model.model_name: model for model in models}
        # On such a bus Drake adds no systems that send or receive.
        silent = {driver.lcm_bus: DrakeLcmParams(lcm_url="memq://null")}
        buses = ApplyLcmBusConfig(silent, parts)
        parts.GetSystems()[-1].set_name(f"sim.act.{name}_no_bus")
        try:
            ApplyDriverConfig(driver, name, builder.plant, by_name, buses, parts)
        except RuntimeError as error:
            raise ScenarioError(
                f"{self.where(f'model_drivers.{name}')}: {type(driver).__name__} cannot drive {name}: {error}"
            ) from error
        parts.GetMutableSubsystemByName(name).set_name(f"sim.act.{name}")

    def build(self, **options: Any) -> VirtualTestbed:
        testbed = super().build(**options)
        simulated = {system.get_name() for system in testbed.diagram.GetSystems()}
        unused = [
            name
            for name, driver in self.model_drivers.items()
            if not isinstance(driver, ZeroForceDriver) and f"sim.act.{name}" not in simulated
        ]
        if unused:
            _log.warning(
                "the model_drivers of %s are not simulated: call add_drivers, or connect an actuator signal to these "
                "models",
                ", ".join(unused),
            )
        return testbed

    def add_cameras(
        self, builder: VirtualTestbedBuilder, *, only: Collection[str] | None = None
    ) -> dict[str, RgbdSensorDiscrete]:
        """Add the cameras to the models that `add_models` has added.

        A camera takes an image every ``1 / fps`` seconds, and holds it. As Drake makes unrestricted updates before
        discrete ones, a discrete update at the same instant sees this image, an unrestricted one that before. Its
        output ports are ``color_image``, ``depth_image_32f``, ``depth_image_16u``, ``label_image`` and
        ``body_pose_in_world``.

        Args:
            builder: The builder to which `add_models` has added the models.
            only: The keys of the cameras to add; by default all.

        Returns:
            The cameras ``sim.sense.<CameraConfig.name>``, by their keys in ``cameras``.

        Raises:
            ScenarioError: A camera has an offset or a delay, which `RgbdSensorDiscrete` does not have.
        """
        self._check_cameras()
        added = {}
        for key, config in self.cameras.items():
            if only is not None and key not in only:
                continue
            if config.capture_offset or config.output_delay:
                raise ScenarioError(
                    f"{self.where(f'cameras.{key}')}: {key} has a capture_offset or output_delay: set both to 0, and "
                    "put a DiscreteTimeDelay behind the camera"
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


def _remedy(error: str) -> str:
    """Return the remedy for an error of Drake's parser."""
    if "does not exist" in error or "could not resolve" in error or "unknown package" in error:
        return "; correct the path in the file, or put the mesh or model there (package:// needs a ROS package.xml)"
    if "unrecognized type" in error:
        return "; Drake knows revolute, continuous, prismatic, fixed, floating, ball, planar and universal joints"
    return ""


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
