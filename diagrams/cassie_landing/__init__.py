"""A biped that lands, driven by recorded torques, calibrated with landings of the real robot."""

from vtbdrake_diagrams.cassie_landing.scenario import CassieLandingScenario

__all__ = ["CassieLandingScenario"]
