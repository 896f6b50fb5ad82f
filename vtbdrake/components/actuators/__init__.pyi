"""The public names of simulated actuators."""

from .gripper import SchunkWsgControl as SchunkWsgControl
from .gripper import SchunkWsgIntegralControl as SchunkWsgIntegralControl
from .joint_drives import JointDrives as JointDrives
