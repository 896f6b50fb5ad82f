"""Simulated actuators: what lies between a command and the torque that a joint feels."""

from vtbdrake.components.actuators.joint_drives import JointDrives

__all__ = ["JointDrives"]
