"""A six-legged robot in the style of DFKI's SpaceClimber, walking on the moon with an attachment at its front."""

from vtbdrake_diagrams.space_climber.scenario import SpaceClimberScenario

__all__ = ["SpaceClimberScenario"]
