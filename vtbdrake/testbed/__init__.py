"""Figure 4: signals, switches, the virtual testbed as a Diagram, scenarios that build one."""

from typing import TYPE_CHECKING, Any

from vtbdrake.testbed.builder import VirtualTestbedBuilder
from vtbdrake.testbed.parts import DpsAlone, WorldAlone
from vtbdrake.testbed.scenario import Scenario, ScenarioError
from vtbdrake.testbed.scenario_file import load_scenario
from vtbdrake.testbed.signal import Interface, Signal, SignalError
from vtbdrake.testbed.slow_part import SlowPart, slow_parts
from vtbdrake.testbed.switch import ActuatorCommand
from vtbdrake.testbed.testbed import VirtualTestbed

if TYPE_CHECKING:
    from vtbdrake.testbed.hardware_sim import HardwareSimScenario

__all__ = [
    "ActuatorCommand",
    "DpsAlone",
    "HardwareSimScenario",
    "Interface",
    "Scenario",
    "ScenarioError",
    "Signal",
    "SignalError",
    "SlowPart",
    "VirtualTestbed",
    "VirtualTestbedBuilder",
    "WorldAlone",
    "load_scenario",
    "slow_parts",
]


def __getattr__(name: str) -> Any:
    # It imports far more of Drake than the others.
    if name == "HardwareSimScenario":
        from vtbdrake.testbed.hardware_sim import HardwareSimScenario

        return HardwareSimScenario
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
