"""vtbdrake: virtual testbeds on Drake. One model to develop, optimize, reason and control."""

from vtbdrake.optimization import Boundary, Parameter, Problem, Sweep
from vtbdrake.rollout import Quality, RolloutResult
from vtbdrake.state import Snapshot
from vtbdrake.testbed import (
    Interface,
    PlantFields,
    Scenario,
    Signal,
    SimulatorFields,
    VirtualTestbed,
    VirtualTestbedBuilder,
    load_scenario,
)

__all__ = [
    "Boundary",
    "Interface",
    "Parameter",
    "PlantFields",
    "Problem",
    "Quality",
    "RolloutResult",
    "Scenario",
    "Signal",
    "SimulatorFields",
    "Snapshot",
    "Sweep",
    "VirtualTestbed",
    "VirtualTestbedBuilder",
    "load_scenario",
]
