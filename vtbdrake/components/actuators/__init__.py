"""Simulated actuators, which turn an actuator command into the torque on a joint."""

from vtbdrake.components.actuators.joint_drives import JointDrives

__all__ = ["JointDrives"]
