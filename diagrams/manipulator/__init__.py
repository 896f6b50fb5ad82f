"""A seven-joint arm with impedance and admittance control, in free space and against a compliant wall."""

from vtbdrake_diagrams.manipulator.scenario import ManipulatorScenario

__all__ = ["ManipulatorScenario"]
