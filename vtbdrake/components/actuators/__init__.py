"""Simulated actuators: drives, which turn a command into the torque on a joint, and the control of a gripper."""

from vtbdrake.common.lazy_names import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)
