"""The control of a Schunk WSG gripper, as its own controller does it."""

from vtbdrake.drake_workarounds.schunk_wsg import SchunkWsgControl, SchunkWsgIntegralControl

__all__ = ["SchunkWsgControl", "SchunkWsgIntegralControl"]
