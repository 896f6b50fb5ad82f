"""A DPS with a camera, whose images come by raw messages; its actuator command depends on every pixel."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from drake import lcmt_image
from pydrake.common.value import Value
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import BasicVector, Context, LeafSystem, System
from pydrake.systems.primitives import ConstantValueSource, ZeroOrderHold
from pydrake.systems.sensors import ImageGrey8U

from tests.control.scripted import PERIOD
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.iiwa_messages import iiwa_command
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.lcm.sensor_messages import image_map
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

WIDTH, HEIGHT = 8, 6


class Gaze(LeafSystem):
    """velocity = sum of w_k pixel_k, sampled.

    .. pydrake_system::

        name: Gaze
        input_ports:
        - image
        output_ports:
        - velocity
    """

    def __init__(self) -> None:
        super().__init__()
        self._image = self.DeclareAbstractInputPort("image", Value(ImageGrey8U(WIDTH, HEIGHT)))
        velocity = self.DeclareDiscreteState(BasicVector([0.0]))
        self.DeclareStateOutputPort("velocity", velocity)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    def _update(self, context: Context, discrete: Any) -> None:
        image: Any = self._image.Eval(context)
        discrete.set_value(0, [brightness(image.data)])


def brightness(pixels: np.ndarray) -> float:
    """Return the actuator command of `Gaze` for an image."""
    return float(np.sin(np.arange(pixels.size)) @ pixels.ravel().astype(float))


@dataclass
class SeeingScenario(Scenario):
    """A scenario whose simulated camera shows a blank image."""

    simulator_config: SimulatorConfig = field(default_factory=lambda: SimulatorConfig(max_step_size=0.1, accuracy=1e-6))

    def interface(self) -> Interface:
        return Interface(
            sense=[Signal("image", model_value=ImageGrey8U(WIDTH, HEIGHT))],
            act=[Signal("velocity", size=1, unit="rad/s", idle=0.0)],
        )

    def deployment(self) -> Deployment:
        act = [iiwa_command({"velocity": "joint_position"})]
        return Deployment(
            protocol=Protocol(sense=[image_map("CAMERA", "image")], act=act), continuity={"velocity": None}
        )

    def make_dps(self) -> System:
        return Gaze()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        camera = builder.add("sense", "camera", ConstantValueSource(Value(ImageGrey8U(WIDTH, HEIGHT))))
        wheel = builder.add("act", "wheel", ZeroOrderHold(PERIOD, 1))
        builder.sim_sensor("image", camera.get_output_port())
        builder.sim_actuator("velocity", wheel.get_input_port())


def picture(utime: int, pixels: np.ndarray) -> bytes:
    """Return a message of the camera."""
    message = lcmt_image()
    message.header.utime = utime
    message.width, message.height, message.row_stride = WIDTH, HEIGHT, WIDTH
    message.pixel_format, message.channel_type = lcmt_image.PIXEL_FORMAT_GRAY, lcmt_image.CHANNEL_TYPE_UINT8
    message.data = pixels.astype(np.uint8).tobytes()
    message.size = len(message.data)
    return bytes(message.encode())
