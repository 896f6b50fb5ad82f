"""Render the pictures of docs/gallery.md into docs/gallery/, one of each testbed.

python tools/gallery.py [NAME ...]
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    LightParameter,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

from vtbdrake.testbed import Scenario
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.double_pendulum import DoublePendulumScenario
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.plain.scenario import PlainScenario
from vtbdrake_diagrams.quadruped import QuadrupedScenario
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.space_climber import SpaceClimberScenario
from vtbdrake_diagrams.station.scenario import ArmStation

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "gallery"
SKY, SPACE, MARS = (0.80, 0.88, 0.96), (0.02, 0.02, 0.04), (0.86, 0.72, 0.58)

SWUNG = {f"sim.sys.pendulum.{joint}.position": angle for joint, angle in (("shoulder", 0.7), ("elbow", -1.1))}

PUSHED = {"sim.env.push.impulse": (0.0, 20.0, 0.0)}


@dataclass(frozen=True)
class Shot:
    """A picture of a testbed."""

    scenario: Callable[[], Scenario]
    time: float  # s
    eye: tuple[float, float, float]  # m, relative to the target
    target: str  # a body
    background: tuple[float, float, float] = SKY
    values: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)  # of variables, at the begin


SHOTS = {
    "space_climber": Shot(SpaceClimberScenario, 3.0, (1.3, -1.2, 0.7), "base", SPACE),
    "manipulator": Shot(ManipulatorScenario, 2.0, (1.3, -1.3, 0.5), "link_4"),
    "satellite": Shot(SatelliteScenario, 5.0, (1.5, -8.0, 2.5), "hand", SPACE),
    "forest": Shot(ForestScenario, 5.0, (-8.0, -5.0, 3.0), "base"),
    "plain": Shot(PlainScenario, 5.0, (-8.0, -5.0, 3.0), "base", MARS),
    "quadruped": Shot(QuadrupedScenario, 1.16, (0.95, -0.95, 0.3), "trunk", values=PUSHED),
    "station": Shot(ArmStation, 1.0, (1.9, 1.3, 0.6), "iiwa_link_6"),
    "double_pendulum": Shot(DoublePendulumScenario, 0.0, (0.5, -1.2, 0.1), "lower", values=SWUNG),
    "cart_pole": Shot(CartPoleScenario, 1.0, (0.5, -2.2, 0.1), "cart"),
}


def look_at(eye: np.ndarray, target: np.ndarray) -> RigidTransform:
    """Return the pose of a camera in the world: z forwards, y down."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return RigidTransform(RotationMatrix(np.column_stack([x, np.cross(z, x), z])), eye)


def render(shot: Shot) -> Image.Image:
    """Return the picture, 480 x 320 pixels, rendered at twice the size."""
    testbed = shot.scenario().build()
    start = testbed.default_context()
    testbed.write(start, shot.values)
    simulator = testbed.simulator(start)
    simulator.AdvanceTo(shot.time)
    context = simulator.get_context()
    plant, scene_graph = testbed.plant, testbed.scene_graph
    body = plant.GetBodyByName(shot.target)
    p_WT = plant.EvalBodyPoseInWorld(plant.GetMyContextFromRoot(context), body).translation()
    light = LightParameter(type="directional", direction=[-0.3, 0.5, -0.8], intensity=1.0, frame="world")
    fill = LightParameter(type="directional", direction=[0.0, 0.0, 1.0], intensity=0.5, frame="camera")
    renderer = MakeRenderEngineVtk(
        RenderEngineVtkParams(backend="EGL", default_clear_color=shot.background, lights=[light, fill])
    )
    scene_graph.AddRenderer(
        scene_graph.GetMyMutableContextFromRoot(simulator.get_mutable_context()), "gallery", renderer
    )
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    camera = CameraInfo(width=960, height=640, fov_y=0.6)
    core = RenderCameraCore("gallery", camera, ClippingRange(0.05, 300.0), RigidTransform())
    pose = look_at(p_WT + np.asarray(shot.eye), p_WT)
    image = query.RenderColorImage(ColorRenderCamera(core, False), scene_graph.world_frame_id(), pose)
    picture = Image.fromarray(np.asarray(image.data)[..., :3])
    return picture.resize((480, 320), Image.Resampling.LANCZOS).quantize(128)


def main(names: list[str]) -> None:
    """Render the pictures of these names, or all."""
    FOLDER.mkdir(exist_ok=True)
    for name in names or SHOTS:
        render(SHOTS[name]).save(FOLDER / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main(sys.argv[1:])
