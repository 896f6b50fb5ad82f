"""Figure 4: signals, switches, the virtual testbed as a Diagram, scenarios that build one."""

from vtbdrake.testbed.alone import DpsAlone, WorldAlone
from vtbdrake.testbed.builder import VirtualTestbedBuilder
from vtbdrake.testbed.scenario import Scenario, ScenarioError
from vtbdrake.testbed.scenario_file import load_scenario
from vtbdrake.testbed.signal import Interface, Signal, SignalError
from vtbdrake.testbed.slow_part import SlowPart, slow_parts
from vtbdrake.testbed.switch import Command
from vtbdrake.testbed.testbed import VirtualTestbed

__all__ = [
    "Command",
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
