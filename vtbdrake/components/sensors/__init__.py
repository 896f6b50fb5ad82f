"""Simulated sensors: sampled, with an output that is their own state, and repeatable errors."""

from vtbdrake.components.sensors.encoders import JointEncoders, JointTachometers
from vtbdrake.components.sensors.errors import ErrorModel
from vtbdrake.components.sensors.floating_base import BasePoseSensor, BaseTwistSensor
from vtbdrake.components.sensors.foot_contact import ContactSensor
from vtbdrake.components.sensors.imu import Imu
from vtbdrake.components.sensors.noise import normal_noise, stream_of, uniform_noise
from vtbdrake.components.sensors.reaction import ForceTorqueSensor, JointTorqueSensors
from vtbdrake.components.sensors.sampled import SampledSensor, connect_to_plant

__all__ = [
    "BasePoseSensor",
    "BaseTwistSensor",
    "ContactSensor",
    "ErrorModel",
    "ForceTorqueSensor",
    "Imu",
    "JointEncoders",
    "JointTachometers",
    "JointTorqueSensors",
    "SampledSensor",
    "connect_to_plant",
    "normal_noise",
    "stream_of",
    "uniform_noise",
]
