"""A station as Drake's ``hardware_sim`` describes it: an arm with the names of a KUKA iiwa and a Schunk WSG gripper."""

from vtbdrake_diagrams.station.scenario import FILE, HOME, ArmStation, JointControl

__all__ = ["FILE", "HOME", "ArmStation", "JointControl"]
