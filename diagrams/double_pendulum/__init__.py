"""A double pendulum with two motors, calibrated with recordings of a real one."""

from vtbdrake_diagrams.double_pendulum.scenario import DoublePendulumScenario

__all__ = ["DoublePendulumScenario"]
