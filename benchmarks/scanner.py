"""The cost of the laser scanner, against the bare ray caster on the same rays, and beside Drake's depth camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from benchmarks.measure import LOWER, Benchmark, interleaved_values, processor_time, ratio, spread
from vtbdrake.components.ray_casting import RayCaster, body_surfaces
from vtbdrake.components.rendering import RenderingError, check_rendering
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.components.sensors.laser_scanner import LaserScanner, LaserScannerConfig, raster, raster_size
from vtbdrake_diagrams.satellite.plant import add_servicer, add_target

GOAL = 1.0  # no more than the bare ray caster on the same rays
# As many rays as the Velodyne VLP-16 fires, in single return mode (its data sheet, 63-9229, 2016).
CONFIG = LaserScannerConfig(frequency=10.0, rays_per_second=300_000.0, azimuth=1.0, elevation=0.8)
SLICE_PERIOD = 0.05
SECONDS = 1.0
CAMERA = (640, 480)


@dataclass(frozen=True)
class Scene:
    """Servicer and target, which drift and tumble."""

    diagram: Diagram
    plant: MultibodyPlant
    context: Context
    caster: RayCaster
    moving: list[tuple[Any, RigidTransform]]  # a scene of embreex for each rigid group, and X_WB
    resting: Any  # one of all together, where they are at first


def scene() -> Scene:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.01)
    add_servicer(plant)
    add_target(plant)
    plant.Finalize()
    resting, moving = EmbreeScene(robust=True), []
    plant_context = plant.CreateDefaultContext()
    for body, surfaces in body_surfaces(plant, scene_graph).items():
        X_WB, group = (
            plant.EvalBodyPoseInWorld(plant_context, plant.get_body(BodyIndex(body))),
            EmbreeScene(robust=True),
        )
        for vertices, triangles in surfaces:
            TriangleMesh(group, vertices.astype(np.float32), triangles)
            TriangleMesh(resting, (X_WB @ vertices.T).T.astype(np.float32), triangles)
        moving.append((group, X_WB))
    caster = RayCaster(plant, scene_graph)
    diagram = builder.Build()
    return Scene(diagram, plant, diagram.CreateDefaultContext(), caster, moving, resting)


def scanner_cost(repeats: int = 11) -> Benchmark:
    """CPU time of a simulated second of the scanner, with all that it does, over the time of its rays in bare embreex.

    As the bodies move, the rays must be cast at each of them, in its own frame: the bare ray caster gets the rays in
    all these frames. The scanner is simulated alone, with poses and velocities at its ports; range noise and incidence
    are on, divergence and haze are off.
    """
    made = scene()
    simulator = _scanning(made)
    rays = _rays()
    X_WL = made.plant.GetFrameByName("scanner").CalcPoseInWorld(made.plant.GetMyContextFromRoot(made.context))
    slices = np.array_split(rays, round(1.0 / (CONFIG.frequency * SLICE_PERIOD)))
    moving = [(group, *_in_frame(part, X_WB.inverse() @ X_WL)) for group, X_WB in made.moving for part in slices]
    resting = [(made.resting, *_in_frame(part, X_WL)) for part in slices]
    hit = np.mean(made.resting.run(*_in_frame(rays, X_WL)) >= 0)

    def scan() -> None:
        context = simulator.get_mutable_context()
        simulator.get_system().SetDefaultContext(context)
        context.SetTime(0.0)
        simulator.Initialize()
        simulator.AdvanceTo(SECONDS)

    def cast(calls: list[tuple[Any, np.ndarray, np.ndarray]]) -> None:
        for _ in range(round(SECONDS * CONFIG.frequency)):
            for group, origins, directions in calls:
                group.run(origins, directions, output=True)

    ours, bare = interleaved_values(
        lambda: processor_time(scan), lambda: processor_time(lambda: cast(moving)), repeats=repeats
    )
    at_rest = np.median([processor_time(lambda: cast(resting)) for _ in range(repeats)])
    count = len(rays) * SECONDS * CONFIG.frequency
    return Benchmark(
        name="scanner_cost",
        value=ratio(ours, bare),
        unit="1",
        goal=GOAL,
        better=LOWER,
        against=f"bare embreex, the same rays at {len(made.moving)} moving rigid groups",
        note=(
            f"{count / np.median(ours):.3g} rays per s of CPU, bare {count / np.median(bare):.3g}, in one scene of all "
            f"bodies at rest {count / at_rest:.3g}; {_depth_camera(made)}; {hit:.0%} of the rays hit; scanner "
            f"{spread(ours)}, bare {spread(bare)}"
        ),
    )


def _in_frame(directions_L: np.ndarray, X_BL: RigidTransform) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and directions of rays in B, with 32 bits."""
    origins = np.tile(X_BL.translation(), (len(directions_L), 1))
    return origins.astype(np.float32), (directions_L @ X_BL.rotation().matrix().T).astype(np.float32)


def _rays() -> np.ndarray:
    return raster(*raster_size(CONFIG), CONFIG.azimuth, CONFIG.elevation)


def _scanning(made: Scene) -> Simulator:
    scanner = LaserScanner(
        made.plant,
        made.plant.GetFrameByName("scanner"),
        made.caster,
        config=CONFIG,
        slice_period=SLICE_PERIOD,
        errors=ErrorModel(noise=0.01),
    )
    simulator = Simulator(scanner)
    plant_context = made.plant.GetMyContextFromRoot(made.context)
    poses = made.plant.GetOutputPort("body_poses").Eval(plant_context)
    drifting = [SpatialVelocity(w=[0.02, 0.01, -0.03], v=[-0.1, 0.01, 0.0])] * made.plant.num_bodies()
    context = simulator.get_mutable_context()
    scanner.GetInputPort("body_poses").FixValue(context, Value[list[RigidTransform]](poses))
    scanner.GetInputPort("body_spatial_velocities").FixValue(context, Value[list[SpatialVelocity]](drifting))
    return simulator


def _depth_camera(made: Scene) -> str:
    """Return the pixels per second of Drake's depth camera in the same scene, as a part of a note."""
    from pydrake.geometry import (
        ClippingRange,
        DepthRange,
        DepthRenderCamera,
        MakeRenderEngineVtk,
        RenderCameraCore,
        RenderEngineVtkParams,
    )
    from pydrake.systems.sensors import CameraInfo

    try:
        check_rendering()
    except RenderingError:
        return "Drake's depth camera cannot render here"
    width, height = CAMERA
    scene_graph = made.diagram.GetSubsystemByName("scene_graph")
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL")))
    context = made.diagram.CreateDefaultContext()
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    core = RenderCameraCore("vtk", CameraInfo(width, height, 0.8), ClippingRange(0.05, 50.0), RigidTransform())
    camera = DepthRenderCamera(core, DepthRange(0.1, 40.0))
    frame = made.plant.GetBodyFrameIdOrThrow(made.plant.GetBodyByName("base").index())
    X_BC = made.plant.GetFrameByName("camera").GetFixedPoseInBodyFrame()

    def render() -> None:
        query.RenderDepthImage(camera, frame, X_BC)

    render()
    return f"Drake's depth camera {width * height / np.median([processor_time(render) for _ in range(11)]):.3g} pixels"
