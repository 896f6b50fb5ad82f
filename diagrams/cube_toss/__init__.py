"""A cube that is tossed onto a plane, with every contact model of Drake, calibrated with recordings of a real one."""

from vtbdrake_diagrams.cube_toss.scenario import CubeTossScenario

__all__ = ["CubeTossScenario"]
