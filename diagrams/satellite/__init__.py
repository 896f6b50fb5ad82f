"""A service satellite whose arm captures a tumbling target, seen by a docking camera and a laser scanner."""

from vtbdrake_diagrams.satellite.scenario import SatelliteScenario

__all__ = ["SatelliteScenario"]
