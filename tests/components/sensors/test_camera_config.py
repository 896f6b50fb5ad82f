"""A camera from Drake's config sees what Drake's own camera of that config sees."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydrake.common.yaml import yaml_load_typed
from pydrake.geometry import Box, Rgba, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import ApplyCameraConfig, CameraConfig

from vtbdrake.components.sensors.camera import Camera, connect_camera
from vtbdrake.state.systems import collect

CONFIG = """
name: front
width: 80
height: 60
focal: !FovDegrees { y: 60 }
center_x: 42
z_near: 0.4
z_far: 1.6
fps: 20
depth: true
X_PB: { base_frame: stand, translation: [0.1, 0, 0], rotation: !Rpy { deg: [-90, 0, -90] } }
"""


def config(**changes: Any) -> CameraConfig:
    camera = yaml_load_typed(schema=CameraConfig, data=CONFIG)
    for name, value in changes.items():
        setattr(camera, name, value)
    return camera


def test_images_are_those_of_drakes_camera() -> None:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    stand = plant.AddRigidBody("stand", SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.1, 0.1))
    plant.WeldFrames(plant.world_frame(), stand.body_frame(), RigidTransform([0.2, 0.1, 0.0]))
    for x, y, shape in ((1.2, 0.1, Box(0.2, 0.3, 0.2)), (0.6, 0.3, Sphere(0.06)), (2.5, 0.0, Box(0.1, 4.0, 1.0))):
        plant.RegisterVisualGeometry(
            plant.world_body(), RigidTransform([x, y, 0.0]), shape, f"at_{x}", [0.2, 0.6, 0.3, 1.0]
        )
    plant.Finalize()
    camera = builder.AddNamedSystem("camera", Camera.from_config(config(), plant))
    connect_camera(builder, camera, scene_graph)
    ApplyCameraConfig(config(lcm_bus="default"), builder, plant=plant, scene_graph=scene_graph)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.06)
    theirs, ours = diagram.GetSubsystemByName("rgbd_sensor_front"), camera
    context = simulator.get_context()
    images = [
        system.GetOutputPort(port).Eval(system.GetMyContextFromRoot(context)).data.astype(float)
        for system, port in (
            (theirs, "color_image"),
            (ours, "color_image"),
            (theirs, "depth_image_32f"),
            (ours, "depth_image"),
        )
    ]
    assert np.abs(images[0] - images[1]).mean() < 2.0  # of 255: the edges are smoothed in another way
    same = np.isclose(images[2], images[3], atol=2e-3) | (images[2] == images[3])
    assert same.mean() > 0.98
    assert {0.0, np.inf} <= set(np.unique(images[3]))
    assert camera.period == 0.05


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"label": True}, "label images: set label to false"),
        ({"capture_offset": 0.01}, "a capture_offset .0.01 s.: set it to 0"),
        ({"output_delay": 0.02}, "an output_delay of 0.4 periods"),
        ({"renderer_class": "RenderEngineGl"}, "take RenderEngineVtk"),
        ({"background": Rgba(0.0, 0.0, 0.0, 1.0)}, "a background"),
    ],
)
def test_what_the_camera_does_not_have_is_refused(changes: dict[str, Any], message: str) -> None:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.001)
    plant.AddRigidBody("stand", SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.1, 0.1))
    plant.Finalize()
    with pytest.raises(ValueError, match=f"CameraConfig 'front' .*{message}"):
        Camera.from_config(config(**changes), plant)


def test_delay_is_a_latency() -> None:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.001)
    plant.AddRigidBody("stand", SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.1, 0.1))
    plant.Finalize()
    builder.AddNamedSystem("camera", Camera.from_config(config(output_delay=0.1), plant))
    diagram = builder.Build()
    variables = collect(diagram)
    assert variables.read(diagram.CreateDefaultContext(), ["camera.latency"]) == {"camera.latency": 2.0}
