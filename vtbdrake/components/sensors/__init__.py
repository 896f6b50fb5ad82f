"""Simulated sensors: sampled, with an output that is their own state, and repeatable noise."""

from vtbdrake.components.sensors.encoders import JointEncoders
from vtbdrake.components.sensors.foot_contact import ContactSensor
from vtbdrake.components.sensors.imu import Imu
from vtbdrake.components.sensors.noise import normal_noise
from vtbdrake.components.sensors.sampled import SampledSensor, connect_to_plant

__all__ = ["ContactSensor", "Imu", "JointEncoders", "SampledSensor", "connect_to_plant", "normal_noise"]
