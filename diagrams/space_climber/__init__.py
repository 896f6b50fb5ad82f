"""A six-legged robot in the style of DFKI's SpaceClimber, walking on the moon: on a plane, and in a crater."""

from vtbdrake_diagrams.space_climber.crater_scenario import CraterScenario
from vtbdrake_diagrams.space_climber.scenario import SpaceClimberScenario

__all__ = ["CraterScenario", "SpaceClimberScenario"]
