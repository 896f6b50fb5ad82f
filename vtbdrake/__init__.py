"""vtbdrake: virtual testbeds on Drake. One model to develop, optimize, reason and control.

Names are loaded when they are first used, so that importing the package costs next to nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vtbdrake.optimization import Boundary, Choice, CVaR, Parameter, Problem, Quantile, Study, Sweep
    from vtbdrake.rollout import Constraint, Quality, RolloutResult
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
    "CVaR",
    "Choice",
    "Constraint",
    "Interface",
    "Parameter",
    "PlantFields",
    "Problem",
    "Quality",
    "Quantile",
    "RolloutResult",
    "Scenario",
    "Signal",
    "SimulatorFields",
    "Snapshot",
    "Study",
    "Sweep",
    "VirtualTestbed",
    "VirtualTestbedBuilder",
    "load_scenario",
]

_LAYERS = {
    "optimization": ("Boundary", "CVaR", "Choice", "Parameter", "Problem", "Quantile", "Study", "Sweep"),
    "rollout": ("Constraint", "Quality", "RolloutResult"),
    "state": ("Snapshot",),
    "testbed": (
        "Interface",
        "PlantFields",
        "Scenario",
        "Signal",
        "SimulatorFields",
        "VirtualTestbed",
        "VirtualTestbedBuilder",
        "load_scenario",
    ),
}
_HOME = {name: layer for layer, names in _LAYERS.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'vtbdrake' has no attribute {name!r}")
    value = getattr(import_module(f"vtbdrake.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
