"""A quadruped that trots, is pushed, and decides fifty times a second where to set its feet."""

from vtbdrake_diagrams.quadruped.scenario import QuadrupedScenario

__all__ = ["QuadrupedScenario"]
