"""A car that localizes itself among the trees of a park, by its wheels, its steering and a detector of trees."""

from vtbdrake_diagrams.park.scenario import ParkScenario

__all__ = ["ParkScenario"]
