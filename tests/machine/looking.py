"""A sliding box that is held in the middle of a camera's image; the images come over LCM."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from drake import lcmt_iiwa_status
from pydrake.common.value import Value
from pydrake.geometry import Box
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.multibody.tree import FixedOffsetFrame, PrismaticJoint, SpatialInertia
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, DiscreteValues, System
from pydrake.systems.primitives import Demultiplexer
from pydrake.systems.sensors import CameraInfo, ImageRgba8U

from vtbdrake.components.sensors.camera import Camera, connect_camera
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.iiwa_messages import iiwa_command
from vtbdrake.lcm.maps import vector_map
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.lcm.sensor_messages import image_map
from vtbdrake.state import AddressedSystem
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

PERIOD, CAMERA_PERIOD = 0.01, 0.02
WIDTH, HEIGHT = 64, 48
POSITION = "sim.sys.slide.position"


class Centring(AddressedSystem):
    """Pushes what is bright to the middle of the image.

    .. pydrake_system::

        name: Centring
        input_ports:
        - image
        - speed
        output_ports:
        - force
    """

    def __init__(self) -> None:
        super().__init__()
        self._image = self.DeclareAbstractInputPort("image", Value(ImageRgba8U(WIDTH, HEIGHT)))
        self._speed = self.DeclareVectorInputPort("speed", 1)
        self.DeclareStateOutputPort("force", self.DeclareDiscreteState(1))
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        image: Any = self._image.Eval(context)
        columns = image.data[..., :3].astype(float).sum(axis=(0, 2))
        off = columns @ np.linspace(-1.0, 1.0, WIDTH) / max(columns.sum(), 1.0)
        state.set_value(12.0 * off - 5.0 * self._speed.Eval(context))


@dataclass
class LookingScenario(Scenario):
    """A box of 1 kg slides along y; the camera looks along x, so that y points to the left in its image."""

    simulator_config: SimulatorConfig = field(
        default_factory=lambda: SimulatorConfig(use_error_control=False, max_step_size=PERIOD)
    )

    def interface(self) -> Interface:
        return Interface(
            sense=[
                Signal("image", model_value=ImageRgba8U(WIDTH, HEIGHT)),
                Signal("speed", size=1, unit="m/s", lower=-9.0, upper=9.0, max_age=1.0),
            ],
            act=[Signal("force", size=1, unit="N", lower=-50.0, upper=50.0, idle=0.0)],
        )

    def make_dps(self) -> System:
        return Centring()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, scene_graph = builder.add_plant(MultibodyPlantConfig(time_step=0.0))
        body = plant.AddRigidBody("box", SpatialInertia.SolidBoxWithMass(1.0, 0.2, 0.2, 0.2))
        slide = plant.AddJoint(PrismaticJoint("slide", plant.world_frame(), body.body_frame(), [0.0, 1.0, 0.0]))
        plant.RegisterVisualGeometry(body, RigidTransform(), Box(0.2, 0.2, 0.2), "box", [1.0, 1.0, 1.0, 1.0])
        wall = RigidTransform([1.0, 0.0, 0.0])
        plant.RegisterVisualGeometry(plant.world_body(), wall, Box(0.1, 9.0, 9.0), "wall", [0.0, 0.0, 0.0, 1.0])
        X_WC = RigidTransform(RollPitchYaw(-np.pi / 2.0, 0.0, -np.pi / 2.0), [-2.0, 0.0, 0.0])
        frame = plant.AddFrame(FixedOffsetFrame("camera", plant.world_frame(), X_WC))
        plant.AddJointActuator("motor", slide)
        slide.set_default_translation(0.3)
        plant.Finalize()
        camera = Camera(plant, frame, period=CAMERA_PERIOD, info=CameraInfo(WIDTH, HEIGHT, 0.6))
        builder.add("sense", "camera", camera)
        connect_camera(builder.diagram_builder, camera, scene_graph)
        split = builder.add("sense", "joint", Demultiplexer([1, 1]))
        builder.connect(plant.get_state_output_port(), split.get_input_port())
        builder.sim_sensor("image", camera.GetOutputPort("color_image"))
        builder.sim_sensor("speed", split.get_output_port(1))
        builder.sim_actuator("force", plant.get_actuation_input_port())

    def deployment(self) -> Deployment:
        protocol = Protocol(
            sense=[
                vector_map("STATUS", lcmt_iiwa_status, {"speed": "joint_velocity_estimated"}),
                image_map("CAMERA", "image", compress=True),
            ],
            act=[iiwa_command({"force": "joint_torque"})],
            periods={"CAMERA": CAMERA_PERIOD},
        )
        return Deployment(protocol=protocol, period=PERIOD, continuity={"force": None})
