"""Figure 4: signals, switches, the virtual testbed as a Diagram, scenarios that build one."""

from vtbdrake.testbed.builder import VirtualTestbedBuilder
from vtbdrake.testbed.parts import DpsAlone, WorldAlone
from vtbdrake.testbed.scenario import Scenario
from vtbdrake.testbed.scenario_file import load_scenario
from vtbdrake.testbed.scenario_identity import ScenarioError
from vtbdrake.testbed.signal import Interface, Signal, SignalError
from vtbdrake.testbed.slow_part import SlowPart, slow_parts
from vtbdrake.testbed.switch import ActuatorCommand
from vtbdrake.testbed.testbed import VirtualTestbed

__all__ = [
    "ActuatorCommand",
    "DpsAlone",
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
