"""A testbed with every kind of visual shape, a camera and a laser scanner: a turning arm beside a falling body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Mesh,
    MeshcatCone,
    Role,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import PrismaticJoint, RevoluteJoint, RigidBody, SpatialInertia
from pydrake.systems.framework import System
from pydrake.systems.primitives import Demultiplexer
from pydrake.systems.sensors import CameraInfo

from vtbdrake.components.meshes import surface_mesh, unit_sphere
from vtbdrake.components.ray_casting import RayCaster
from vtbdrake.components.sensors.camera import Camera, connect_camera
from vtbdrake.components.sensors.laser_scanner import LaserScanner, LaserScannerConfig, connect_laser_scanner
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

X_LINK = RigidTransform(RollPitchYaw(0.3, -0.2, 0.5), [0.1, 0.2, 0.3])
CAMERA = CameraInfo(32, 24, 30.0, 31.0, 16.0, 12.0)
BALL = surface_mesh(unit_sphere(1))

# The shapes of the link by their names.
SHAPES: dict[str, Shape] = {
    "box": Box(0.1, 0.2, 0.3),
    "sphere": Sphere(0.11),
    "cylinder": Cylinder(0.05, 0.4),
    "capsule": Capsule(0.06, 0.5),
    "ellipsoid": Ellipsoid(0.1, 0.2, 0.3),
    "mesh": Mesh(BALL, scale=0.1),
    "convex": Convex(BALL, scale=0.2),
    "cone": MeshcatCone(0.3, 0.1, 0.2),
}


def _body(plant: MultibodyPlant, name: str) -> RigidBody:
    return plant.AddRigidBody(name, plant.GetModelInstanceByName("arm"), SpatialInertia.SolidSphereWithMass(1.0, 0.1))


@dataclass
class ShapesScenario(Scenario):
    """An arm of a turning and a sliding link, with a welded tool, and a body that falls.

    Attributes:
        sensors: Whether there are a camera and a laser scanner on the tool.
    """

    sensors: bool = False

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("joint_position", size=2, entry_names=("turn", "slide"))],
            act=[Signal("drive", size=2, unit="N m", idle=0.0)],
        )

    def make_dps(self) -> System:
        from pydrake.systems.framework import DiagramBuilder
        from pydrake.systems.primitives import Gain

        builder = DiagramBuilder()
        law = builder.AddNamedSystem("law", Gain(-2.0, 2))
        builder.ExportInput(law.get_input_port(), "joint_position")
        builder.ExportOutput(law.get_output_port(), "drive")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, scene_graph = builder.add_plant(MultibodyPlantConfig(time_step=0.01))
        plant.AddModelInstance("arm")
        self._add_bodies(plant)
        plant.Finalize()
        joints = builder.add("sense", "joints", Demultiplexer([2, plant.num_multibody_states() - 2]))
        builder.connect(plant.get_state_output_port(), joints.get_input_port())
        builder.sim_sensor("joint_position", joints.get_output_port(0))
        builder.sim_actuator("drive", plant.get_actuation_input_port())
        if self.sensors:
            frame = plant.GetFrameByName("tool")
            camera = builder.add("sense", "camera", Camera(plant, frame, period=0.1, info=CAMERA, depth=True))
            connect_camera(builder.diagram_builder, camera, scene_graph)
            config = LaserScannerConfig(
                frequency=10.0, rays_per_second=2000.0, azimuth=6.0, elevation=3.0, max_range=20.0
            )
            scanner = LaserScanner(
                plant, frame, RayCaster(plant, scene_graph, role=Role.kProximity), config=config, slice_period=0.05
            )
            builder.add("sense", "scanner", scanner)
            connect_laser_scanner(builder.diagram_builder, scanner, plant)

    def _add_bodies(self, plant: MultibodyPlant) -> None:
        link, slider, tool, ball = (_body(plant, name) for name in ("link", "slider", "tool", "ball"))
        turn = plant.AddJoint(RevoluteJoint("turn", plant.world_frame(), link.body_frame(), [0.0, 0.6, 0.8]))
        slide = plant.AddJoint(PrismaticJoint("slide", link.body_frame(), slider.body_frame(), [1.0, 0.0, 0.0]))
        plant.WeldFrames(slider.body_frame(), tool.body_frame(), X_LINK)
        for joint in (turn, slide):
            plant.AddJointActuator(joint.name(), joint)
        turn.set_default_angle(0.4)
        slide.set_default_translation(0.2)
        for name, shape in SHAPES.items():
            if name != "cone" or not self.sensors:  # VTK does not render it.
                plant.RegisterVisualGeometry(link, X_LINK, shape, name, np.array([1.0, 0.5, 0.25, 1.0]))
        plant.RegisterVisualGeometry(ball, RigidTransform(), Sphere(0.2), "ball", np.array([0.0, 0.5, 0.25, 0.75]))
        plant.RegisterVisualGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", np.full(4, 0.5))
        plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(0.2), "ball", CoulombFriction(1.0, 1.0))
        plant.RegisterCollisionGeometry(
            plant.world_body(), RigidTransform([0.0, 0.0, -2.0]), Box(20.0, 20.0, 1.0), "ground", CoulombFriction()
        )
        plant.SetDefaultFloatingBaseBodyPose(ball, RigidTransform([3.0, 0.0, 1.0]))
