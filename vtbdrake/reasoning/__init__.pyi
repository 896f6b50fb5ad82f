"""The public names for reasoning."""

from vtbdrake.reasoning.trajectory import Trajectory as Trajectory
